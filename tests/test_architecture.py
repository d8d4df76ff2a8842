"""The house rules that a machine can check."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = ["envs", "actors", "learners", "pipeline"]
FILES = [path for room in ORDER for path in sorted((ROOT / room).rglob("*.py"))]
# Where robots learn, act and are judged: nothing here may open what only physics knows.
UNPRIVILEGED = (
    *("envs/simulators", "envs/judges", "envs/transforms", "envs/world.py", "actors", "learners"),
    *("envs/conditioning", "envs/initial_states.py", "envs/encoders"),
    *("envs/chunked.py", "envs/specs.py"),
    *("pipeline/stages", "pipeline/loop.py"),
)
# What physics workers import; torch takes seconds and hundreds of megabytes in each of them.
TORCH_FREE = ("envs/physics", "envs/embodiment.py", "envs/targets.py", "envs/files.py")
WITH_TORCH = ("envs/physics/env.py", "envs/physics/toy_tracking.py")


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def within(path: Path, places: tuple[str, ...]) -> bool:
    return any(named(path) == place or named(path).startswith(place + "/") for place in places)


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


def words(tree: ast.AST) -> Iterator[str]:
    """Every name and every string of code, but no docstring."""
    said = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield node.value
        for field in ("id", "attr", "arg", "name", "module"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                yield value


@pytest.mark.parametrize("path", FILES, ids=named)
def test_imports_only_go_down(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    above = set(ORDER[ORDER.index(room) + 1 :])
    assert not imported(path) & above


@pytest.mark.parametrize("path", [path for path in FILES if within(path, UNPRIVILEGED)], ids=named)
def test_nothing_that_learns_names_privileged_columns(path: Path) -> None:
    assert not [word for word in words(ast.parse(path.read_text())) if "privileged" in word.lower()]


def test_every_place_that_learns_is_there() -> None:
    for place in UNPRIVILEGED:
        assert any(within(path, (place,)) for path in FILES), f"{place} is not searched: it does not exist"


def test_only_evaluation_reads_privileged_columns() -> None:
    readers = {
        named(path)
        for path in FILES
        if any("read_privileged" in word for word in words(ast.parse(path.read_text())))
    }
    assert all(
        reader == "envs/episodes/privileged.py" or reader.startswith("pipeline/evaluation/")
        for reader in readers
    ), readers


def test_the_search_for_privileged_names_finds_them() -> None:
    for code in (
        "from envs.episodes.privileged import f",
        "store.privileged('x')",
        "data['privileged.pose']",
        "f(privileged=1)",
    ):
        assert any("privileged" in word for word in words(ast.parse(code))), code
    assert not any("privileged" in word for word in words(ast.parse('"""privileged"""')))


def test_physics_workers_start_without_torch() -> None:
    for path in FILES:
        if within(path, TORCH_FREE) and not within(path, WITH_TORCH):
            assert "torch" not in imported(path), path


def test_physics_workers_load_without_torch() -> None:
    modules = "envs.rng, envs.physics.worker, envs.physics.tabletop.scenes.suite"
    code = f"import sys, {modules}; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_no_task_suite_is_known_above_physics() -> None:
    suites = {"tabletop", "metaworld", "aloha", "ogbench"}
    assert suites <= {path.stem for path in (ROOT / "envs/physics").iterdir()}
    for path in FILES:
        if within(path, ("envs/physics", "pipeline/cli")):  # help gives examples
            continue
        said = [word for word in words(ast.parse(path.read_text())) if any(s in word.lower() for s in suites)]
        assert not said, f"{named(path)} names a task suite: {said[:3]}"


def test_random_numbers_come_from_one_module() -> None:
    makers = {"manual_seed", "default_rng", "SeedSequence", "RandomState", "Philox"}
    found = {named(path) for path in FILES if makers & set(words(ast.parse(path.read_text())))}
    assert found == {"envs/rng.py"}


def test_files_are_put_in_place_by_one_module() -> None:
    for path in FILES:
        if named(path) == "envs/files.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner = getattr(node.func.value, "id", "")
                assert node.func.attr != "rename", f"{named(path)}:{node.lineno}"
                assert (owner, node.func.attr) != ("os", "replace"), f"{named(path)}:{node.lineno}"


def test_files_are_short_and_say_what_they_are() -> None:
    for path in FILES:
        text = path.read_text()
        assert len(text.splitlines()) <= 300, f"{path} is too long"
        assert not text.strip() or ast.get_docstring(ast.parse(text)) or path.name == "__init__.py", (
            f"{path} has no docstring"
        )
        assert path.stem not in {"utils", "helpers"}


def test_the_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    assert not [line for line in lines if len(line) > 120]


def test_tables_of_the_documents_are_tables() -> None:
    """A row that was wrapped is prose to whoever renders it."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for number, block in enumerate(path.read_text().split("\n\n")):
            if block.startswith("|"):
                columns = [len(re.findall(r"(?<!\\)\|", row)) for row in block.strip().splitlines()]
                assert len(set(columns)) == 1, f"{named(path)}, block {number}: {columns}"


def test_no_function_takes_ten_arguments() -> None:
    """What always travels together is one thing."""
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                given = node.args
                found = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
                names = [name.arg for name in found if name is not None and name.arg not in ("self", "cls")]
                assert len(names) < 10, f"{named(path)}:{node.lineno} {node.name} takes {len(names)}"


def test_folders_hold_about_a_dozen_files() -> None:
    for folder in {path.parent for path in [*FILES, *(ROOT / "tests").rglob("*.py")]}:
        files = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(files) <= 14, f"{named(folder)} holds {len(files)} files"
