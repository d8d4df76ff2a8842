"""The house rules that a machine can check."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = ["envs", "actors", "learners", "pipeline"]
FILES = [path for room in ORDER for path in sorted((ROOT / capacity).rglob("*.py"))]


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_only_go_down(path: Path) -> None:
    capacity = path.relative_to(ROOT).parts[0]
    above = set(ORDER[ORDER.index(capacity) + 1 :])
    assert not imported(path) & above


def test_physics_workers_start_without_torch() -> None:
    for path in sorted((ROOT / "envs/physics").glob("*.py")):
        if path.name != "env.py":
            assert "torch" not in imported(path), path


def test_files_are_short_and_say_what_they_are() -> None:
    for path in FILES:
        text = path.read_text()
        assert len(text.splitlines()) <= 500, f"{path} is too long"
        assert not text.strip() or ast.get_docstring(ast.parse(text)) or path.name == "__init__.py", (
            f"{path} has no docstring"
        )
        assert path.stem not in {"utils", "helpers"}
