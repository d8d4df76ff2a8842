"""LeRobot v3.0 data sets: parquet rows, mp4 videos per view, written shard by shard so that nothing finished
is lost.

A shard is one data file, one video per view and one episodes file, all with the same file index. The episodes
file is written last and by rename: a shard without it does not exist, and an interrupted collection goes on
there.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.video import read_video, write_video
from envs.physics.tabletop.scene import ARMS
from envs.specs import OBJECT_DIM

_VERSION = "v3.0"
_AXES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
_POSE_NAMES = [f"{side}_{axis}" for side in ARMS for axis in _AXES]
_STATE_NAMES = [
    f"{side}_{joint}" for side in ARMS for joint in (*(f"joint{k}" for k in range(1, 8)), "gripper")
]
_OBJECT_NAMES = ("x", "y", "z", "heading")
# parquet column -> Episode field, for numeric columns stored flat per row
_COLUMNS = {
    "observation.state": "states",
    "observation.command": "commands",
    "observation.eef_pose": "achieved",
    "observation.camera.c2w": "c2w",
    "observation.objects": "objects",
}


def _part(kind: str, shard: int, suffix: str) -> str:
    return f"{kind}/chunk-{shard // 1000:03d}/file-{shard % 1000:03d}.{suffix}"


def _replace(path: Path, write: Any) -> None:
    """Write through a temporary neighbour and rename it into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        write(temporary)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(
            error.errno, f"cannot write {path}: {error.strerror}; finished shards are intact", str(path)
        ) from error
    os.replace(temporary, path)


class LeRobotWriter:
    """Appends shards of episodes to a LeRobot v3.0 data set.

    Args:
        root: folder of the data set; an existing one is continued.
        views, size, fps: names of the cameras, (height, width) of their pictures, frames per second.

    Raises:
        EpisodeError: if `root` holds a data set of another shape.
    """

    def __init__(self, root: Path, views: tuple[str, ...], size: tuple[int, int], fps: float):
        self.root, self.views, self.size, self.fps = Path(root), views, size, fps
        if (self.root / "meta/info.json").exists():
            found = LeRobotDataset(self.root)
            if (found.views, found.size, found.fps) != (views, size, fps):
                raise EpisodeError(
                    f"{root} holds views {found.views} of {found.size} at {found.fps} Hz; this run wants {views} of {size} at {fps} Hz. Choose another folder."
                )

    @property
    def shards(self) -> int:
        """Number of finished shards."""
        return len(sorted((self.root / "meta/episodes").glob("chunk-*/file-*.parquet")))

    def write(self, episodes: Sequence[Episode]) -> None:
        """Add one shard; afterwards the data set on disk is complete and consistent."""
        shard = self.shards
        done = LeRobotDataset(self.root).episode_rows() if shard else []
        first_episode = len(done)
        first_row = int(done[-1]["dataset_to_index"]) if done else 0
        tasks = self._tasks(episodes)
        for k, view in enumerate(self.views):
            stream = (frame.transpose(1, 2, 0) for episode in episodes for frame in episode.frames[:, k])
            target = self.root / _part(f"videos/observation.images.{view}", shard, "mp4")
            _replace(target, lambda path, stream=stream: write_video(path, stream, self.fps))
        table = pa.concat_tables([self._rows(e, first_episode + n, tasks) for n, e in enumerate(episodes)])
        table = table.append_column(
            "index", pa.array(np.arange(first_row, first_row + len(table)), pa.int64())
        )
        _replace(self.root / _part("data", shard, "parquet"), lambda path: pq.write_table(table, path))
        records = []
        row, clock = first_row, 0
        for n, episode in enumerate(episodes):
            record: dict[str, Any] = {
                "episode_index": first_episode + n,
                "tasks": [episode.instruction],
                "length": len(episode),
                "seed": episode.seed,
                "behaviour": episode.behaviour,
                "success": episode.succeeded,
                "recorded_layout": episode.recorded_layout,
                "data/chunk_index": shard // 1000,
                "data/file_index": shard % 1000,
                "dataset_from_index": row,
                "dataset_to_index": row + len(episode),
                "meta/episodes/chunk_index": shard // 1000,
                "meta/episodes/file_index": shard % 1000,
            }
            for k, view in enumerate(self.views):
                key = f"observation.images.{view}"
                record |= {
                    f"videos/{key}/chunk_index": shard // 1000,
                    f"videos/{key}/file_index": shard % 1000,
                }
                record |= {
                    f"videos/{key}/from_timestamp": clock / self.fps,
                    f"videos/{key}/to_timestamp": (clock + len(episode)) / self.fps,
                }
                record |= {
                    f"stats/{key}/{name}": value for name, value in _image_stats(episode.frames[:, k]).items()
                }
            for column, attribute in (*_COLUMNS.items(), ("action", "commands")):
                value = getattr(episode, attribute).reshape(len(episode), -1)
                record |= {f"stats/{column}/{name}": stat for name, stat in _stats(value).items()}
            if episode.recorded is not None:
                record |= {
                    f"stats/action.recorded/{name}": stat for name, stat in _stats(episode.recorded).items()
                }
            records.append(record)
            row, clock = row + len(episode), clock + len(episode)
        _replace(
            self.root / _part("meta/episodes", shard, "parquet"),
            lambda path: pq.write_table(pa.Table.from_pylist(records), path),
        )
        self._describe(tasks)

    def _tasks(self, episodes: Sequence[Episode]) -> dict[str, int]:
        tasks = LeRobotDataset.read_tasks(self.root)
        for episode in episodes:
            tasks.setdefault(episode.instruction, len(tasks))
        table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": list(tasks)})
        # LeRobot reads this file by pandas and looks tasks up in the index.
        names = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
        columns = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in names
        ]
        table = table.replace_schema_metadata(
            {
                "pandas": json.dumps(
                    {
                        "index_columns": ["task"],
                        "column_indexes": [],
                        "columns": columns,
                        "pandas_version": "2.0.0",
                    }
                )
            }
        )
        _replace(self.root / "meta/tasks.parquet", lambda path: pq.write_table(table, path))
        return tasks

    def _rows(self, episode: Episode, index: int, tasks: dict[str, int]) -> pa.Table:
        length = len(episode)
        columns: dict[str, pa.Array] = {}
        for column, attribute in _COLUMNS.items():
            columns[column] = _flat(getattr(episode, attribute).reshape(length, -1))
        # LeRobot's action at t is what is done next; the last row repeats, for nothing follows it.
        columns["action"] = _flat(np.concatenate([episode.commands[1:], episode.commands[-1:]]))
        columns["observation.camera.intrinsic"] = _flat(
            np.tile(episode.intrinsic.reshape(1, -1), (length, 1))
        )
        if episode.recorded is not None:
            columns["action.recorded"] = _flat(episode.recorded)
        columns["observation.seen"] = pa.array(episode.seen)
        columns["success"] = pa.array(episode.success)
        columns["progress"] = pa.array(episode.progress)
        columns["timestamp"] = pa.array((np.arange(length) / self.fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(length), pa.int64())
        columns["episode_index"] = pa.array(np.full(length, index), pa.int64())
        columns["task_index"] = pa.array(np.full(length, tasks[episode.instruction]), pa.int64())
        return pa.table(columns)

    def _describe(self, tasks: dict[str, int]) -> None:
        """Rewrite stats.json and info.json from the finished shards."""
        rows = _read_rows(self.root)
        stats = {}
        for name in [
            key[len("stats/") : -len("/mean")]
            for key in rows[0]
            if key.startswith("stats/") and key.endswith("/mean")
        ]:
            count = np.array([row[f"stats/{name}/count"][0] for row in rows], np.float64)
            mean = np.array([row[f"stats/{name}/mean"] for row in rows], np.float64)
            std = np.array([row[f"stats/{name}/std"] for row in rows], np.float64)
            share = (count / count.sum()).reshape(-1, *([1] * (mean.ndim - 1)))
            total = (mean * share).sum(0)
            spread = np.sqrt((share * (std**2 + (mean - total) ** 2)).sum(0))
            stats[name] = {
                "min": np.min([row[f"stats/{name}/min"] for row in rows], 0).tolist(),
                "max": np.max([row[f"stats/{name}/max"] for row in rows], 0).tolist(),
                "mean": total.tolist(),
                "std": spread.tolist(),
                "count": [int(count.sum())],
            }
        _replace(self.root / "meta/stats.json", lambda path: path.write_text(json.dumps(stats, indent=1)))
        height, width = self.size
        count_views = len(self.views)

        def numbers(names: list[str] | None, size: int) -> dict[str, Any]:
            return {"dtype": "float32", "shape": [size], "names": names}

        objects = [
            f"object{k}_{name}"
            for k in range(len(rows[0]["stats/observation.objects/mean"]) // OBJECT_DIM)
            for name in _OBJECT_NAMES
        ]
        features: dict[str, Any] = {
            f"observation.images.{view}": {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.fps": self.fps,
                    "video.height": height,
                    "video.width": width,
                    "video.channels": 3,
                    "video.codec": "h264",
                    "video.pix_fmt": "yuv444p",
                    "video.is_depth_map": False,
                    "has_audio": False,
                },
            }
            for view in self.views
        }
        features |= {
            "observation.state": numbers(_STATE_NAMES, 16),
            "observation.command": numbers(_POSE_NAMES, 14),
            "observation.eef_pose": numbers(_POSE_NAMES, 14),
            "observation.camera.c2w": numbers(None, 16 * count_views),
            "observation.camera.intrinsic": numbers(None, 9 * count_views),
            "observation.objects": numbers(objects, len(objects)),
            "observation.seen": {"dtype": "bool", "shape": [1], "names": None},
            "action": numbers(_POSE_NAMES, 14),
            "success": {"dtype": "bool", "shape": [1], "names": None},
            "progress": {"dtype": "float32", "shape": [1], "names": None},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        }
        if "stats/action.recorded/mean" in rows[0]:
            features["action.recorded"] = numbers(None, len(rows[0]["stats/action.recorded/mean"]))
        features |= {
            name: {"dtype": "int64", "shape": [1], "names": None}
            for name in ("frame_index", "episode_index", "index", "task_index")
        }
        info = {
            "codebase_version": _VERSION,
            "robot_type": "worldloop_bench",
            "total_episodes": len(rows),
            "total_frames": int(rows[-1]["dataset_to_index"]),
            "total_tasks": len(tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.fps,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": features,
        }
        _replace(self.root / "meta/info.json", lambda path: path.write_text(json.dumps(info, indent=1)))


class LeRobotDataset:
    """Reads a LeRobot v3.0 data set that has poses, cameras and success, as LeRobotWriter writes it.

    Args:
        root: folder of the data set.

    Raises:
        EpisodeError: if the folder is not such a data set; the message says what is missing.
    """

    def __init__(self, root: Path):
        self.root = Path(root)
        path = self.root / "meta/info.json"
        try:
            info = json.loads(path.read_text())
        except (OSError, json.JSONDecodeError) as error:
            raise EpisodeError(
                f"{path}: {error}; {root} is not a LeRobot data set, or its collection never finished a shard"
            ) from error
        if info.get("codebase_version") != _VERSION:
            raise EpisodeError(
                f"{path}: codebase_version {info.get('codebase_version')} is not {_VERSION}; convert it with LeRobot's own tools first"
            )
        prefix = "observation.images."
        self.views: tuple[str, ...] = tuple(
            key[len(prefix) :] for key in info["features"] if key.startswith(prefix)
        )
        missing = [
            c
            for c in (*_COLUMNS, "action", "observation.camera.intrinsic", "success", "progress")
            if c not in info["features"]
        ]
        if missing or not self.views:
            raise EpisodeError(
                f"{path}: features {missing or ['observation.images.*']} are missing; Worldloop needs poses, cameras and success in the data set"
            )
        names = info["features"]["observation.objects"]["names"] or ()
        if (
            not all(name.endswith(_OBJECT_NAMES[k % OBJECT_DIM]) for k, name in enumerate(names))
            or len(names) != info["features"]["observation.objects"]["shape"][0]
        ):
            raise EpisodeError(
                f"{path}: observation.objects holds {names or 'numbers without names'}; Worldloop needs {list(_OBJECT_NAMES)} of every object. Collect or convert the data again."
            )
        height, width, _ = info["features"][prefix + self.views[0]]["shape"]
        self.size: tuple[int, int] = (height, width)
        self.fps = float(info["fps"])
        self._rows = _read_rows(self.root)

    @staticmethod
    def read_tasks(root: Path) -> dict[str, int]:
        """Instruction -> task index, empty for a new data set."""
        path = Path(root) / "meta/tasks.parquet"
        if not path.exists():
            return {}
        table = _read_table(path)
        # an index without a name, as pandas writes it
        column = "task" if "task" in table.column_names else "__index_level_0__"
        return dict(zip(table[column].to_pylist(), table["task_index"].to_pylist(), strict=True))

    def __len__(self) -> int:
        return len(self._rows)

    def episode_rows(self) -> list[dict[str, Any]]:
        """Metadata of every episode, in order."""
        return self._rows

    def __iter__(self) -> Iterator[Episode]:
        """Every episode in order, decoded shard by shard."""
        shards: dict[int, list[dict[str, Any]]] = {}
        for row in self._rows:
            shards.setdefault(row["data/chunk_index"] * 1000 + row["data/file_index"], []).append(row)
        for shard, rows in sorted(shards.items()):
            path = self.root / _part("data", shard, "parquet")
            table = _read_table(path)
            total = sum(row["length"] for row in rows)
            if len(table) != total:
                raise EpisodeError(
                    f"{path}: holds {len(table)} rows, its episodes need {total}; the file is damaged"
                )
            video = np.stack(
                [
                    read_video(self.root / _part(f"videos/observation.images.{view}", shard, "mp4"), total)[
                        :total
                    ]
                    for view in self.views
                ],
                1,
            )
            start = 0
            for row in rows:
                part = slice(start, start + row["length"])
                yield self._episode(table.slice(start, row["length"]), video[part], row, path)
                start = part.stop

    def _episode(
        self, table: pa.Table, frames: NDArray[np.uint8], row: dict[str, Any], path: Path
    ) -> Episode:
        length, views = row["length"], len(self.views)

        def read(column: str) -> NDArray[np.float32]:
            values = table[column].combine_chunks()
            return values.flatten().to_numpy(zero_copy_only=False).reshape(length, -1).astype(np.float32)

        try:
            return Episode(
                frames=frames,
                c2w=read("observation.camera.c2w").reshape(length, views, 4, 4),
                objects=read("observation.objects").reshape(length, -1, OBJECT_DIM),
                intrinsic=read("observation.camera.intrinsic")[0].reshape(views, 3, 3),
                states=read("observation.state"),
                commands=read("observation.command"),
                achieved=read("observation.eef_pose"),
                success=table["success"].to_numpy().astype(bool),
                progress=table["progress"].to_numpy().astype(np.float32),
                instruction=row["tasks"][0],
                seed=row["seed"],
                behaviour=row["behaviour"],
                views=self.views,
                fps=self.fps,
                # type: ignore[arg-type]
                seen=table["observation.seen"].to_numpy().astype(bool)
                if "observation.seen" in table.column_names
                else None,
                recorded=read("action.recorded") if "action.recorded" in table.column_names else None,
                recorded_layout=row.get("recorded_layout") or "",
            )
        except (EpisodeError, KeyError, ValueError) as error:
            raise EpisodeError(f"{path}: episode {row['episode_index']}: {error}") from error


def _read_table(path: Path) -> pa.Table:
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise EpisodeError(f"{path}: {error}; restore the file or collect its shard again") from error


def _read_rows(root: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for path in sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet")):
        rows += _read_table(path).to_pylist()
    return rows


def _flat(values: NDArray[Any]) -> pa.Array:
    width = values.shape[1]
    return pa.FixedSizeListArray.from_arrays(
        pa.array(np.ascontiguousarray(values, np.float32).reshape(-1)), width
    )


def _stats(values: NDArray[Any]) -> dict[str, Any]:
    return {
        "min": values.min(0).tolist(),
        "max": values.max(0).tolist(),
        "mean": values.mean(0, dtype=np.float64).tolist(),
        "std": values.std(0, dtype=np.float64).tolist(),
        "count": [len(values)],
    }


def _image_stats(frames: NDArray[np.uint8]) -> dict[str, Any]:
    pixels = frames[:: max(1, len(frames) // 4)].transpose(1, 0, 2, 3).reshape(3, -1).T / 255.0
    stats = _stats(pixels)
    # LeRobot keeps image statistics as [channels, 1, 1].
    return {name: value if name == "count" else [[[v]] for v in value] for name, value in stats.items()}
