"""What stages read that no stage made: recordings, released weights, descriptions of robots, files of judges,
and those that options name.

Keys know it by its content, so that recordings that were labelled anew, or weights that were exchanged, make
out of date what was learned from them. Large things are told apart without reading all of them.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from envs.embodiment import PYTHON
from envs.episodes.formats.lerobot.info import INFO_KEY
from envs.files import files_below, named_files
from envs.manifest import digest_of, hashes, mark_of
from envs.targets import TARGET, ConfigError, target
from pipeline.graph.code_version import code_of, digest

Cfg = Mapping[str, Any]

CHECKPOINT = "simulator.checkpoint"
STATE_CHECKPOINT = "simulator.state_expert.checkpoint"
KINEMATICS = "simulator.kinematics.model"
WEIGHTS = "finetune.weights"

_NAMING = ("task.suite", "task.variants", "policy", "algorithm", "simulator")  # whose options may name files
_TOLD = (CHECKPOINT, STATE_CHECKPOINT, KINEMATICS)  # by the settings of the stages that read them (files_at)

_DATA = ("meta", "data", "videos", "images")  # folders of a LeRobot data set
_TEXTS = (".json", ".jsonl")
_WHOLE = 32 << 20  # bytes of a parquet file up to which all of it is read
_COLUMN = 1 << 20  # bytes of texts or pictures in a row group, up to which they are
_END = 1 << 16  # bytes at either end of a video


def fingerprint(paths: list[str], key: str = "task.data") -> str:
    """Changes when recorded data sets do: a hash of their tables, of each video's size and ends, and of the
    robot's file that they name.

    Args:
        key: of the config, that names them.

    Raises:
        ConfigError: for a folder that is no LeRobot data set.
    """
    marks = []
    for path in paths:
        info = Path(path) / "meta" / "info.json"
        if not info.is_file():
            raise ConfigError(
                f"{key}: {info} is missing; name folders of LeRobot data sets (`worldloop convert`"
                " makes them of other recordings)"
            )
        root = Path(path).resolve()
        marks.append({one.relative_to(root).as_posix(): _part(one, _stat(one)) for one in _recorded(root)})
        marks.append({"kinematics": _described(info)})
    return digest(marks)


def judge_files(cfg: Cfg, part: str = "") -> dict[str, Any]:
    """A setting with the hashes of files that decide what the judge says, if there are any: when one changes,
    what it judged is out of date.

    Args:
        part: of section judge, such as text_world, whose files alone are meant; "" means all.
    """
    kind: Any = target(cfg["judge"], "judge")
    found = _marks(kind.files(cfg["judge"][part] if part else cfg["judge"]))
    return {"files": found} if found else {}


def option_files(path: str, section: Any) -> dict[str, str]:
    """Hashes of the files that options of suite, policy, algorithm and simulator name: when one changes, what
    was made with it is out of date. Texts count that have a folder or an ending, such as weights.pt.

    Args:
        path: where the section stands in the config.
        section: its value.
    """
    texts = [text for key, text in _texts(section, path) if key not in _TOLD and _under(key, _NAMING)]
    return _marks(file for text in texts if _like_a_path(text) for file in named_files(text))


def _like_a_path(text: str) -> bool:
    """Whether a text has a folder or an ending: a word such as "scene" may be a folder's name by chance."""
    return len(Path(text).parts) > 1 or bool(Path(text).suffix)


def _texts(section: Any, path: str) -> Iterator[tuple[str, str]]:
    """The texts in a section, however deep, and their dotted keys; names of classes are none."""
    if isinstance(section, str):
        yield path, section
    elif isinstance(section, Mapping):
        for name, value in section.items():
            if name != TARGET:
                yield from _texts(value, f"{path}.{name}")
    elif isinstance(section, (list, tuple)):
        for value in section:
            yield from _texts(value, path)


def _under(key: str, paths: tuple[str, ...]) -> bool:
    return any(f"{key}.".startswith(f"{path}.") for path in paths)


def _marks(paths: Iterable[Path]) -> dict[str, str]:
    """Hashes of files by name, as a file may move; those of one name, in two folders, in the given order."""
    found: dict[str, list[str]] = {}
    for path in paths:
        found.setdefault(path.name, []).append(_whole(path, _stat(path)))
    return {name: " ".join(marks) for name, marks in found.items()}


def files_at(cfg: Cfg, *keys: str) -> dict[str, Any]:
    """The same of files and folders that the config names at dotted keys, of those that name one."""
    found = {key: _named(value) for key in keys if (value := _value(cfg, key))}
    return {"files": found} if found else {}


def _value(cfg: Any, key: str) -> Any:
    for part in key.split("."):
        cfg = cfg.get(part) if isinstance(cfg, Mapping) else None
    return cfg


def _named(value: str) -> str:
    """A mark of a file, a folder, or a function of somebody's ("python:..."); "" of what is not there."""
    if value.startswith(PYTHON):
        return digest(code_of(value.removeprefix(PYTHON).rpartition(".")[0], {}))
    path = Path(value)
    if path.is_dir():
        return _folder(path, tuple(_stat(one) for one in sorted(path.rglob("*"))))
    return _file(path, _stat(path)) if path.is_file() else ""


def _stat(path: Path) -> tuple[int, int]:
    """Size and time of the last change; within a process, a file of the same is not read again."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns


@functools.cache
def _whole(path: Path, stat: tuple[int, int]) -> str:
    return digest_of(path)


@functools.cache
def _file(path: Path, stat: tuple[int, int]) -> str:
    return mark_of(path)


@functools.cache
def _folder(path: Path, stats: tuple[tuple[int, int], ...]) -> str:
    return digest(hashes(path))


def _described(info: Path) -> str:
    """A mark of the file by which a data set describes its robot, "" if it names none."""
    try:
        about = json.loads(info.read_text())["features"]["action"]["info"][INFO_KEY]["kinematics"]
        model = str(about["model"])
    except (ValueError, KeyError, TypeError):  # what cannot be understood is told by who reads the data
        return ""
    return "" if model.startswith(PYTHON) else _named(model)  # data name no code


def _recorded(folder: Path) -> Iterator[Path]:
    """The files of a data set."""
    for part in _DATA:
        yield from files_below(folder / part)


@functools.cache
def _part(path: Path, stat: tuple[int, int]) -> str:
    """A mark of a file of a data set."""
    if path.suffix in _TEXTS or (path.suffix == ".parquet" and stat[0] <= _WHOLE):
        return digest_of(path)
    return _table(path) if path.suffix == ".parquet" else _ends(path, stat[0])


def _table(path: Path) -> str:
    """A hash of a large parquet file: of its numbers, and of how long its texts and pictures are."""
    found = hashlib.sha256()
    try:
        about = pq.read_metadata(path)
        parts = [
            about.row_group(g).column(c)
            for g in range(about.num_row_groups)
            for c in range(about.num_columns)
        ]
    except (OSError, pa.ArrowInvalid):  # who opens it says what is wrong
        return digest_of(path)
    with path.open("rb") as file:
        for part in parts:
            size = part.total_compressed_size
            found.update(f"{part.path_in_schema} {part.num_values} {size} ".encode())
            if part.physical_type != "BYTE_ARRAY" or size <= _COLUMN:
                file.seek(part.dictionary_page_offset or part.data_page_offset)
                found.update(file.read(size))
    return found.hexdigest()


def _ends(path: Path, size: int) -> str:
    """A hash of a video's size and ends: the one that is its index says how long each of its frames is."""
    found = hashlib.sha256(str(size).encode())
    with path.open("rb") as file:
        found.update(file.read(_END))
        file.seek(max(0, size - _END))
        found.update(file.read(_END))
    return found.hexdigest()
