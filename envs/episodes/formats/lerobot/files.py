"""The files of a LeRobot v3.0 data set but videos: info.json, tasks, episodes, rows, single pictures; damage
is named.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot import version2
from envs.episodes.formats.lerobot.columns import VERSION

_SUMS: dict[str, Any] = {"write_page_checksum": True}  # a flipped bit is an error, not another number


def column_array(table: pa.Table, name: str) -> NDArray[Any]:
    """A column of numbers or of lists of numbers, however nested, as [rows, n].

    Raises:
        EpisodeError: if something is missing in it, or it holds no numbers.
    """
    values = table[name].combine_chunks()
    if isinstance(values, pa.ChunkedArray):
        values = pa.concat_arrays(values.chunks) if values.num_chunks else pa.array([], values.type)
    if isinstance(values, pa.ExtensionArray):
        values = values.storage
    while pa.types.is_list(values.type) or _fixed(values.type) or pa.types.is_large_list(values.type):
        if values.null_count:
            raise EpisodeError(f"column {name} misses values; what is unknown is left out as a whole")
        values = values.flatten()
    if values.null_count:
        raise EpisodeError(f"column {name} misses values; what is unknown is left out as a whole")
    flat = values.to_numpy(zero_copy_only=False)
    if flat.dtype == object:
        raise EpisodeError(f"column {name} holds {values.type} where numbers should be")
    return flat.reshape(len(table), -1)


def _fixed(kind: pa.DataType) -> bool:
    return bool(pa.types.is_fixed_size_list(kind))


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a parquet file, or say which one is damaged."""
    try:
        return pq.ParquetFile(path, page_checksum_verification=True)
    except (OSError, pa.ArrowInvalid) as error:
        raise EpisodeError(f"{path}: {error}; restore the file or collect its episodes again") from error


def stored_picture(root: Path, name: str, cell: Mapping[str, Any] | None) -> NDArray[np.uint8]:
    """A picture uint8 [H, W, 3] of a column's cell {bytes, path}.

    Raises:
        EpisodeError: if it cannot be decoded, or is one of depths.
    """
    cell = cell or {}
    stored = cell.get("bytes")
    if stored is None and cell.get("path"):
        beside = root / cell["path"]
        stored = beside.read_bytes() if beside.exists() else None
    flat = np.frombuffer(stored or b"", np.uint8)
    picture = cv2.imdecode(flat, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH) if len(flat) else None
    if picture is None:
        raise EpisodeError(f"column {name} holds no readable picture ({cell.get('path')})")
    if picture.dtype != np.uint8:
        plain = cv2.imdecode(flat, cv2.IMREAD_UNCHANGED)
        if plain is None or plain.ndim == 2:
            raise EpisodeError(
                f"column {name} holds {picture.dtype} of one channel, which are depths; they are left out"
                f' where features.{name} of meta/info.json says "info": {{"is_depth_map": true}}'
            )
        picture = cv2.imdecode(flat, cv2.IMREAD_COLOR_RGB)
    return np.asarray(picture, np.uint8)


def write_groups(path: Path, tables: Sequence[pa.Table]) -> None:
    """Each table as a row group of its own, so that one episode can be read without the others."""
    with pq.ParquetWriter(path, tables[0].schema, **_SUMS) as writer:
        for table in tables:
            writer.write_table(table)


def read_info(root: Path) -> dict[str, Any]:
    """The contents of meta/info.json of a LeRobot v3.0, v2.1 or v2.0 data set.

    Raises:
        EpisodeError: if there is none, or of another version.
    """
    path = Path(root) / "meta/info.json"
    try:
        info: dict[str, Any] = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise EpisodeError(
            f"{path}: {error}; {root} is not a LeRobot data set, or its collection never finished a shard"
        ) from error
    if not isinstance(info, dict):
        raise EpisodeError(
            f"{path}: holds {type(info).__name__} instead of a dictionary; the file is damaged"
        )
    if info.get("codebase_version") != VERSION and not version2.is_version2(info):
        raise EpisodeError(
            f"{path}: codebase_version {info.get('codebase_version')} is none of {VERSION},"
            f" {', '.join(version2.VERSIONS)}; convert the data set with LeRobot's own tools first"
        )
    missing = [key for key in ("features", "fps") if key not in info]
    if missing:
        raise EpisodeError(f"{path}: {missing} are missing; the file is damaged")
    return info


def read_episode_rows(root: Path, stats: bool = False) -> list[dict[str, Any]]:
    """Metadata of every episode, by episode_index; with their statistics, if asked for."""
    rows: list[dict[str, Any]] = []
    for path in sorted((Path(root) / "meta/episodes").glob("chunk-*/file-*.parquet")):
        file = open_parquet(path)
        chosen = [name for name in file.schema_arrow.names if stats or not name.startswith("stats/")]
        try:
            rows += file.read(columns=chosen).to_pylist()
        except (OSError, pa.ArrowInvalid) as error:
            raise EpisodeError(f"{path}: {error}; restore the file") from error
    return sorted(rows, key=lambda row: int(row["episode_index"]))


def read_tasks(root: Path) -> dict[str, int]:
    """Instruction -> task index; empty for a new data set."""
    path = Path(root) / "meta/tasks.parquet"
    if not path.exists():
        return {}
    table = open_parquet(path).read()
    # LeRobot keeps the instruction in pandas' index, which may have no name.
    column = next((name for name in ("task", "__index_level_0__") if name in table.column_names), None)
    if column is None or "task_index" not in table.column_names:
        raise EpisodeError(f"{path}: has columns {table.column_names}, not task and task_index")
    return dict(zip(table[column].to_pylist(), table["task_index"].to_pylist(), strict=True))


def write_tasks(path: Path, tasks: Mapping[str, int]) -> None:
    """Tasks as LeRobot reads them: by pandas, with the instruction as index."""
    table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": list(tasks)})
    kinds = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
    about = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in kinds
        ],
        "pandas_version": "2.0.0",
    }
    write_groups(path, [table.replace_schema_metadata({"pandas": json.dumps(about)})])
