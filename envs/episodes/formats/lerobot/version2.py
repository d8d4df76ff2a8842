"""The metadata of LeRobot v2.0 and v2.1 data sets in the terms of v3.0, so that they are read as they lie.

In v2 every episode has files of its own, and what v3.0 keeps in parquet stands in lines of JSON:
meta/episodes.jsonl and meta/tasks.jsonl. Columns, features and pictures are the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from envs.episodes.episode import EpisodeError

VERSIONS = ("v2.0", "v2.1")
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
EPISODES, TASKS = "meta/episodes.jsonl", "meta/tasks.jsonl"
_FOLDER_EPISODES = 1000  # of a folder, unless info.json says another number


def is_version2(info: Mapping[str, Any]) -> bool:
    """Whether an info.json is one of v2."""
    return info.get("codebase_version") in VERSIONS


def episode_rows(root: Path, info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Metadata of every episode, by episode_index, with the keys of v3.0's meta/episodes; none says where a
    video ends, for each ends with its file.

    Raises:
        EpisodeError: if there are none, or a line is damaged.
    """
    videos = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    rows = []
    for number, line in _lines(Path(root) / EPISODES):
        try:
            index, row = int(line["episode_index"]), {**line, "length": int(line["length"])}
        except (KeyError, TypeError, ValueError) as error:
            raise EpisodeError(
                f"{root}/{EPISODES}, line {number}: {line} has no episode_index and length; restore the file"
            ) from error
        chunk = index // int(info.get("chunks_size") or _FOLDER_EPISODES)
        for prefix in ("data", *(f"videos/{key}" for key in videos)):
            row |= {f"{prefix}/chunk_index": chunk, f"{prefix}/file_index": index}
        rows.append(row | {f"videos/{key}/from_timestamp": 0.0 for key in videos})
    return sorted(rows, key=lambda row: int(row["episode_index"]))


def tasks(root: Path) -> dict[str, int]:
    """Instruction -> task index; empty where none are named.

    Raises:
        EpisodeError: if a line is damaged.
    """
    path = Path(root) / TASKS
    if not path.exists():
        return {}
    try:
        return {str(line["task"]): int(line["task_index"]) for _, line in _lines(path)}
    except (KeyError, TypeError, ValueError) as error:
        raise EpisodeError(
            f"{path}: a line has no task and task_index ({error}); restore the file"
        ) from error


def _lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Each line that holds something, by its number from 1 on."""
    try:
        text = path.read_text()
    except OSError as error:
        raise EpisodeError(f"{path}: {error}; the data set is incomplete, download it again") from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            value = json.loads(line)
        except json.JSONDecodeError as error:
            raise EpisodeError(f"{path}, line {number}: {error}; restore the file") from error
        if not isinstance(value, dict):
            raise EpisodeError(f"{path}, line {number}: holds {value!r} instead of a dictionary")
        yield number, value
