"""Writes LeRobot v3.0 data sets shard by shard, so that nothing finished is lost.

A shard is one data file, one video per camera and one episodes file, all with a file index that nothing in
the data set has yet. A journal names the files of the shard that is being written; the episodes file comes
last and by rename, so a shard without it does not exist, and its files, which are ours, are removed when
writing goes on. No other file is touched but info.json, stats.json and tasks.parquet, which describe the
whole.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from envs.embodiment import Embodiment, EmbodimentError
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.lerobot import columns as names
from envs.episodes.formats.lerobot.columns import (
    CHUNK_FILES,
    DATA_PATH,
    EPISODES_PATH,
    VERSION,
    VIDEO_PATH,
    arrow_table,
    features_of,
    indexed_columns,
    plain_rate,
)
from envs.episodes.formats.lerobot.files import (
    open_parquet,
    read_episode_rows,
    read_info,
    read_tasks,
    write_groups,
    write_tasks,
)
from envs.episodes.formats.lerobot.info import IMAGE_PREFIX
from envs.episodes.formats.lerobot.robot import agreed_robot
from envs.episodes.formats.lerobot.stats import column_stats, merge_stats, picture_stats
from envs.episodes.splits import TRAIN, extend_splits
from envs.episodes.video import write_video
from envs.files import files_below, write_atomically

_JOURNAL = "meta/worldloop.writing.json"
_FILE = re.compile(r"chunk-(\d+)/file-(\d+)\.")


class LeRobotWriter:
    """Appends shards of episodes to a LeRobot v3.0 data set.

    All episodes of a data set have the same features: those of its first one, or of the existing data set.

    Args:
        root: folder of the data set; an existing one is continued, whoever began it.
        embodiment: the robot; its name becomes LeRobot's robot_type. Pictures have the size that the first
            episode's have.

    Raises:
        EpisodeError: if `root` holds a data set of another robot.
    """

    def __init__(self, root: Path, embodiment: Embodiment):
        self.root, self.embodiment = Path(root), embodiment
        # Metadata of finished episodes with their statistics; reading them for every shard would take longer
        # than writing it.
        self._rows: list[dict[str, Any]] = []
        if not (self.root / "meta/info.json").exists():
            return
        info = read_info(self.root)
        try:
            agreed_robot(info, embodiment)
        except EmbodimentError as error:
            raise EpisodeError(f"{root}: {error}. Choose another folder.") from error
        for key, kind in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
            if info.get(key) != kind:
                raise EpisodeError(
                    f"{root}: info.json says {key}={info.get(key)!r}; Worldloop writes {kind!r} and"
                    " appends to nothing else. Choose another folder."
                )
        split = self._finish_journal()
        self._rows = read_episode_rows(self.root, stats=True)
        if len(self._rows) != info.get("total_episodes"):  # interrupted before the description was rewritten
            self._describe(info["features"], split)

    @property
    def shards(self) -> int:
        """Number of finished episodes files."""
        return len(list((self.root / "meta/episodes").glob("chunk-*/file-*.parquet")))

    @property
    def episodes(self) -> int:
        """Number of finished episodes."""
        return len(self._rows)

    def shard_files(self) -> list[Path]:
        """The files of finished shards, which nothing writes again."""
        kinds = ("data", "videos", "meta/episodes")
        found = [path for kind in kinds for path in files_below(self.root / kind)]
        return [path for path in found if path.match("file-*.*")]

    def write(self, episodes: Sequence[Episode], split: str = TRAIN) -> None:
        """Add one shard; afterwards the data set on disk is complete and consistent.

        Args:
            split: to which info.json counts the shard's episodes; those that are there stay where they are.

        Raises:
            EpisodeError: if an episode has other features than the data set.
        """
        if not episodes:
            return
        features = self._check(episodes)
        self._finish_journal()
        rows = self._rows
        shard = self._fresh_shard()
        place = {"chunk_index": shard // CHUNK_FILES, "file_index": shard % CHUNK_FILES}
        videos = {view: IMAGE_PREFIX + view for view in self.embodiment.views}
        paths = {view: VIDEO_PATH.format(video_key=key, **place) for view, key in videos.items()}
        data, listing = DATA_PATH.format(**place), EPISODES_PATH.format(**place)
        journal = {"listing": listing, "files": [data, *paths.values()], "split": split}
        self._write_json(_JOURNAL, journal)
        tasks = self._write_tasks(episodes)
        for k, view in enumerate(self.embodiment.views):
            stream = (frame.transpose(1, 2, 0) for episode in episodes for frame in episode.frames[:, k])
            write_atomically(
                self.root / paths[view],
                lambda path, stream=stream: write_video(path, stream, self.embodiment.fps),  # type: ignore[misc]
            )
        first_row = int(rows[-1]["dataset_to_index"]) if rows else 0
        tables, records, clock, row = [], [], 0, first_row
        for number, episode in enumerate(episodes, len(rows)):
            columns = indexed_columns(episode, number, row, tasks[episode.instruction], features)
            tables.append(arrow_table(columns))
            record: dict[str, Any] = {
                "episode_index": number,
                "tasks": [episode.instruction],
                "length": len(episode),
                **{f"data/{name}": value for name, value in place.items()},
                "dataset_from_index": row,
                "dataset_to_index": row + len(episode),
                **{f"meta/episodes/{name}": value for name, value in place.items()},
            }
            for key in videos.values():
                record |= {f"videos/{key}/{name}": value for name, value in place.items()}
                record[f"videos/{key}/from_timestamp"] = clock / self.embodiment.fps
                record[f"videos/{key}/to_timestamp"] = (clock + len(episode)) / self.embodiment.fps
            records.append(record | _stats(episode, columns))
            row, clock = row + len(episode), clock + len(episode)
        write_atomically(self.root / data, lambda path: write_groups(path, tables))
        if not rows:
            self._write_json("meta/info.json", self._info(features, [], {}))
        table = self._like_existing(pa.Table.from_pylist(records))
        write_atomically(self.root / listing, lambda path: write_groups(path, [table]))
        self._rows = [*rows, *records]
        self._describe(features, split)
        (self.root / _JOURNAL).unlink()

    # -- what is there already
    def _check(self, episodes: Sequence[Episode]) -> dict[str, Any]:
        """The features of the data set, which all episodes must have."""
        existing = (self.root / "meta/info.json").exists()
        own = features_of(episodes[0])
        if any(not episode.present.all() for episode in episodes):
            own[names.PRESENT] = {"dtype": "bool", "shape": [1], "names": None}
        features = read_info(self.root)["features"] if existing else own
        wanted = {name: _signature(feature) for name, feature in features.items()}
        for episode in episodes:
            other = episode.embodiment.differs(self.embodiment)
            if other:
                raise EpisodeError(f"episode {episode.seed} is of another robot: {other}")
            found = {name: _signature(feature) for name, feature in features_of(episode).items()}
            if names.PRESENT in wanted:
                found[names.PRESENT] = wanted[names.PRESENT]
            differing = sorted(
                name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)
            )
            if differing:
                name = differing[0]
                fix = "write it to another data set"
                if name.startswith(names.PRIVILEGED):
                    fix = "shapes of what TaskSuite.privileged gives are the suite's, whatever the task"
                raise EpisodeError(
                    f"{self.root}: feature {name} is {wanted.get(name, 'absent')} in the data set, but"
                    f" {found.get(name, 'absent')} in episode {episode.seed} of {episode.source}; {fix}"
                )
        return dict(features)

    def _fresh_shard(self) -> int:
        """A file index that no file of the data set has."""
        used = [-1]
        for path in self.shard_files():
            found = _FILE.search(path.as_posix())
            if found:
                used.append(int(found[1]) * CHUNK_FILES + int(found[2]))
        return max(used) + 1

    def _finish_journal(self) -> str:
        """Remove what an interrupted shard left: the journal's files, if their episodes file is missing.

        Returns:
            the split of a shard that was interrupted when only the description was missing.
        """
        path = self.root / _JOURNAL
        if not path.exists():
            return TRAIN
        journal = json.loads(path.read_text())
        if not (self.root / journal["listing"]).exists():
            for name in journal["files"]:
                (self.root / name).unlink(missing_ok=True)
        path.unlink()
        return str(journal.get("split", TRAIN))

    def _like_existing(self, table: pa.Table) -> pa.Table:
        """The table with columns, order and types of existing episodes files: LeRobot reads them as one."""
        paths = sorted((self.root / "meta/episodes").glob("chunk-*/file-*.parquet"))
        if not paths:
            return table
        schema = open_parquet(paths[0]).schema_arrow.remove_metadata()
        missing = [name for name in schema.names if name not in table.column_names]
        if missing:
            raise EpisodeError(
                f"{paths[0]}: has columns {missing} that Worldloop cannot fill; write to another data set"
            )
        return table.select(schema.names).cast(schema)

    # -- what describes the whole
    def _write_json(self, name: str, value: Any) -> None:
        text = json.dumps(value, indent=4, allow_nan=False)
        write_atomically(self.root / name, lambda path: path.write_text(text))

    def _write_tasks(self, episodes: Sequence[Episode]) -> dict[str, int]:
        tasks = read_tasks(self.root)
        known = len(tasks)
        for episode in episodes:
            tasks.setdefault(episode.instruction, len(tasks))
        if len(tasks) > known:
            write_atomically(self.root / "meta/tasks.parquet", lambda path: write_tasks(path, tasks))
        return tasks

    def _describe(self, features: dict[str, Any], split: str) -> None:
        """Rewrite stats.json and info.json from the finished shards; what is new belongs to `split`."""
        if self._rows:
            self._write_json("meta/stats.json", merge_stats(self._rows))
        info = self._info(features, self._rows, read_tasks(self.root))
        before = int(read_info(self.root)["total_episodes"])
        info["splits"] = extend_splits(info["splits"], split, before, len(self._rows))
        self._write_json("meta/info.json", info)

    def _info(
        self, features: dict[str, Any], rows: list[dict[str, Any]], tasks: dict[str, int]
    ) -> dict[str, Any]:
        path = self.root / "meta/info.json"
        info = read_info(self.root) if path.exists() else {}
        new = {
            "codebase_version": VERSION,
            "robot_type": self.embodiment.robot,
            "fps": plain_rate(self.embodiment.fps),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "splits": {TRAIN: f"0:{info.get('total_episodes', 0)}"},
        }
        counts = {
            "total_episodes": len(rows),
            "total_frames": sum(int(row["length"]) for row in rows),
            "total_tasks": len(tasks),
        }
        return {**new, **info, **counts, "features": features}


def _signature(feature: dict[str, Any]) -> tuple[Any, ...]:
    return feature["dtype"], tuple(feature["shape"]), tuple(feature.get("names") or ())


def _stats(episode: Episode, columns: dict[str, NDArray[Any]]) -> dict[str, Any]:
    shown = episode.frames[episode.present] if episode.present.any() else episode.frames
    parts = {
        IMAGE_PREFIX + view: picture_stats(shown[:, k]) for k, view in enumerate(episode.embodiment.views)
    }
    parts |= {name: column_stats(value) for name, value in columns.items() if value.dtype != object}
    return {f"stats/{name}/{stat}": value for name, part in parts.items() for stat, value in part.items()}
