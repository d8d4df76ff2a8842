"""The version of a stage's code: hashes of every source file that its module imports, directly or not, and of
descriptions and texts that lie beside one, such as a robot's.

Imports are found in the syntax tree, also those inside functions, so nothing is run. Comments, docstrings and
formatting do not count. Installed packages, and Python's own, are not followed; a class of one counts by the
package's version.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.metadata
import importlib.util
import json
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from envs.targets import ROOMS

ROOT = Path(__file__).resolve().parents[2]
_BESIDE = ("*.xml", "*.txt")
_INSTALLED = ("site-packages", "dist-packages")


def code_of(module: str, config: Mapping[str, Any]) -> dict[str, str]:
    """Hashes of the sources behind a stage, by path, and versions of foreign packages, by name.

    Args:
        module: import path of the stage's module.
        config: what the stage reads; modules of the `_target_`s in it count as imported.
    """
    out: dict[str, str] = {}
    for name in sorted({module, *(target.rpartition(".")[0] for target in targets(config))}):
        for found in _closure(name):
            out |= _version(found) | _beside(found)
    return out


def digest(value: Any) -> str:
    """A short hash of a text."""
    return hashlib.sha256(str(value).encode()).hexdigest()[:12]


def json_digest(value: Any) -> str:
    """A short hash of what JSON can hold, in whatever order its keys are; of other things, as text."""
    return digest(json.dumps(value, sort_keys=True, default=str))


def targets(section: Any) -> Iterable[str]:
    """Every `_target_` in a config section, however deep."""
    if isinstance(section, Mapping):
        if isinstance(section.get("_target_"), str):
            yield section["_target_"]
        for value in section.values():
            yield from targets(value)
    elif isinstance(section, (list, tuple)):
        for value in section:
            yield from targets(value)


@cache
def _closure(module: str) -> frozenset[str]:
    """Modules that `module` imports, itself and packages on the way included; foreign ones are not."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or not name:
            continue
        found.add(name)
        package = name.rpartition(".")[0]
        if package:
            waiting.append(package)
        path = _source(name)
        if path is not None:
            waiting += [other for other in _imports(name, path) if _followed(other, name)]
    return frozenset(found)


def _followed(name: str, importer: str) -> bool:
    """Whether an import is followed: from this repository within it; from somebody else's module also to the
    others of his, in whatever folder or package.
    """
    top = name.split(".")[0]
    return top in ROOMS or (importer.split(".")[0] not in ROOMS and _of_somebody(top))


@cache
def _of_somebody(top: str) -> bool:
    """Whether a module or package without a dot is neither installed nor Python's own."""
    if not top or top in sys.stdlib_module_names:
        return False
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return False
    if spec is None:
        return False
    # a package without __init__.py is its folders
    places = [spec.origin] if spec.has_location and spec.origin else spec.submodule_search_locations or ()
    return bool(places) and not any(_installed(Path(place)) for place in places)


def _installed(path: Path) -> bool:
    return any(part in _INSTALLED for part in path.parts)


@cache
def _source(module: str) -> Path | None:
    """The module's source file, None for one that does not exist or is part of an installed package."""
    if module.split(".")[0] in ROOMS:
        base = ROOT.joinpath(*module.split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file():
                return path
        return None
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # a package on the way is run, and may raise anything
        return None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    path = Path(spec.origin)
    return None if _installed(path) else path


@cache
def _tree(path: Path) -> ast.Module:
    """A file's syntax tree without docstrings."""
    tree = ast.parse(path.read_text(), filename=str(path))
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = node.body[1:]
    return tree


@cache
def _imports(module: str, path: Path) -> tuple[str, ...]:
    """Names of the modules that a file imports; of `from a import b` both a and a.b, if the latter is one."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    out: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            out.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, *([base] if base else [])])
            out.add(base)
            out.update(f"{base}.{alias.name}" for alias in node.names)
    return tuple(name for name in sorted(out) if name.split(".")[0] not in ROOMS or _source(name))


@cache
def _file_hash(path: Path) -> str:
    """Hash of a file's syntax tree; positions are not part of it."""
    return digest(ast.dump(_tree(path)))


@cache
def _beside(module: str) -> dict[str, str]:
    """{path: hash} of what lies beside a module and is no Python, but read by it."""
    path = _source(module)
    if path is None:
        return {}
    found = sorted(one for pattern in _BESIDE for one in path.parent.glob(pattern))
    if not ("." in module or path.name == "__init__.py"):
        # a module without a package may lie among anything; what it reads it names
        said = {node.value for node in ast.walk(_tree(path)) if isinstance(node, ast.Constant)}
        found = [one for one in found if one.name in said]
    return {_name(one): hashlib.sha256(one.read_bytes()).hexdigest()[:12] for one in found}


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else str(path)


@cache
def _version(module: str) -> dict[str, str]:
    """{path: hash} of a module that has sources here, {distribution: version} of an installed one."""
    path = _source(module)
    if path is not None:
        return {_name(path): _file_hash(path)}
    top = module.split(".")[0]
    if top in ROOMS:
        return {}
    try:
        return {top: importlib.metadata.version(top)}
    except importlib.metadata.PackageNotFoundError:
        return {}
