"""Reads any LeRobot data set of v3.0, and of v2.1 and v2.0 (version2.py), whoever wrote it.

Pictures, `action` and `observation.state` are needed; success, reward, calibration and all else are read
where they are there (columns.py). Files are found as LeRobot finds them: by the path templates of
info.json and the file indices and timestamps of meta/episodes, so episodes may share files in any way.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from envs.embodiment import Embodiment, EmbodimentError
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.lerobot import columns as names
from envs.episodes.formats.lerobot import version2
from envs.episodes.formats.lerobot.columns import PRIVILEGED
from envs.episodes.formats.lerobot.files import (
    column_array,
    open_parquet,
    read_episode_rows,
    read_info,
    read_tasks,
    stored_picture,
)
from envs.episodes.formats.lerobot.info import camera_features, depth_features
from envs.episodes.formats.lerobot.numbers import is_read, numbers_of, seed_of, shape_of, source_of
from envs.episodes.formats.lerobot.robot import agreed_robot
from envs.episodes.pictures import resize_picture
from envs.episodes.video import read_clip
from envs.machine import available_cores

log = logging.getLogger(__name__)
_DRIFT = 0.02  # of an episode's length, by which its video may be longer or shorter


class LeRobotDataset:
    """The episodes of a LeRobot data set, decoded one at a time.

    Args:
        root: folder of the data set.
        size: (height, width) to which all pictures are brought, intrinsics with them; None keeps the recorded
            size.
        privileged: whether to read what only physics knows, too.
        embodiment: the robot, where the reader knows more of it than the data set says; it must have the same
            cameras and as many numbers.

    Attributes:
        info: the contents of meta/info.json.
        embodiment: the robot; its cameras have the size of the episodes' pictures.
        rows: metadata of every episode, in order, without statistics.

    Raises:
        EpisodeError: if the folder is not such a data set; the message says what is missing.
    """

    def __init__(
        self,
        root: Path,
        size: tuple[int, int] | None = None,
        privileged: bool = False,
        embodiment: Embodiment | None = None,
    ):
        self.root, self.privileged = Path(root), privileged
        self.info = read_info(self.root)
        self.features: dict[str, dict[str, Any]] = self.info["features"]
        try:
            recorded = agreed_robot(self.info, embodiment)
        except (EmbodimentError, KeyError, ValueError, TypeError) as error:
            raise EpisodeError(f"{self.root / 'meta/info.json'}: {error}") from error
        sizes = {camera.name: camera.size for camera in recorded.cameras}
        if size is None and len(set(sizes.values())) > 1:
            raise EpisodeError(
                f"{self.root}: cameras record pictures of different sizes {sizes}; give one size to bring"
                f" them to, such as size={list(recorded.cameras[recorded.main_view].size)}"
            )
        self.recorded = recorded
        self.size: tuple[int, int] = size or next(iter(sizes.values()))
        self.embodiment = recorded.at(self.size)
        self._cameras = camera_features(self.features)
        self._version2 = version2.is_version2(self.info)
        self.rows = (
            version2.episode_rows(self.root, self.info) if self._version2 else read_episode_rows(self.root)
        )
        self._check_rate()
        self._warn()
        tasks = version2.tasks(self.root) if self._version2 else read_tasks(self.root)
        self._tasks = {index: task for task, index in tasks.items()}
        self._cached: tuple[Path, pa.Table] | None = None
        self._reading = Lock()  # of what is cached

    def _check_rate(self) -> None:
        """See that videos are as long as their episodes at the rate that info.json says: at another one all
        pictures but the first would be those of other moments.
        """
        videos = [key for key in self._cameras.values() if self.features[key]["dtype"] == "video"]
        for row in self.rows:
            for key in videos:
                begin, end = row.get(f"videos/{key}/from_timestamp"), row.get(f"videos/{key}/to_timestamp")
                if begin is None or end is None or not end > begin:  # said of the episode when it is read
                    continue
                length, seconds = int(row["length"]), float(end) - float(begin)
                if abs(seconds * self.fps - length) > max(1.5, _DRIFT * length):
                    raise EpisodeError(
                        f"{self.root / 'meta/info.json'}: fps is {self.fps:g}, but meta/episodes gives the"
                        f" {length} frames of episode {row['episode_index']} {seconds:.4g} s of {key}, which"
                        f" is {length / seconds:.4g} a second; correct fps, or to_timestamp in meta/episodes"
                    )

    def _warn(self) -> None:
        """Say what is there and not used."""
        if depth := depth_features(self.features):
            log.warning(
                "%s: %s are left out as depth, having one channel or more than 8 bits; pictures to learn from"
                " have three channels of 8 bits",
                *(self.root, depth),
            )
        several = sum(len(row.get("tasks") or ()) > 1 for row in self.rows)
        if several:
            log.warning(
                "%s: %d of %d episodes have several instructions, of which only the one of their first frame"
                " is used; divide them into episodes of one each",
                *(self.root, several, len(self.rows)),
            )

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.embodiment.fps

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Episode]:
        """Every episode in order, decoded ahead by as many threads as there are cores."""
        threads = available_cores()
        pool, ahead = ThreadPoolExecutor(threads, "episodes"), deque[Future[Episode]]()
        try:
            for number in range(len(self)):
                ahead.append(pool.submit(self.episode, number))
                if len(ahead) > 2 * threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def episode(self, number: int) -> Episode:
        """Read one episode.

        Raises:
            EpisodeError: naming the file that is missing or damaged.
        """
        row = self.rows[number]
        table, path = self._table(row)
        try:
            known = numbers_of(table, self.embodiment, self.recorded, self.features)
            present = known["present"]
            frames = np.stack(
                [self._pictures(key, row, path, len(table)) for key in self._cameras.values()], axis=1
            )
            if present is not None:
                frames[~present] = 0
            return Episode(
                frames=frames,
                instruction=self._instruction(row, table),
                embodiment=self.embodiment,
                seed=seed_of(table, number),
                source=source_of(table, self.root.resolve().name),
                **known,
            )
        except (EpisodeError, ValueError, pa.ArrowInvalid) as error:
            raise EpisodeError(f"{path}: episode {row['episode_index']}: {error}") from error

    def column(self, name: str) -> NDArray[Any]:
        """A column of numbers of all episodes, [N, ...] in their order.

        Raises:
            EpisodeError: if there is none of that name, or it is privileged and was not asked for.
        """
        if name.startswith(PRIVILEGED) and not self.privileged:
            raise EpisodeError(
                f"{self.root}: column {name} is asked for, which only physics knows and no robot does. Learn"
                " from pictures, action and observation.state; pipeline/evaluation opens it with"
                " privileged=True"
            )
        parts = []
        for row in self.rows:
            table = self._table(row)[0]
            if name not in table.column_names:
                raise EpisodeError(
                    f"{self.root}: there is no column {name}; record it, or ask for one of"
                    f" {table.column_names}"
                )
            parts.append(column_array(table, name).reshape(len(table), *shape_of(name, self.features)))
        return np.concatenate(parts)

    def seeds(self) -> list[int]:
        """Seeds of the episodes, in their order.

        Raises:
            EpisodeError: if nobody recorded them.
        """
        return list(dict.fromkeys(self.column(names.SEED).flatten().tolist()))

    # -- numbers
    def _table(self, row: dict[str, Any]) -> tuple[pa.Table, Path]:
        """The rows of an episode, without pictures, and the file they are from."""
        path = self.root / self._format("data_path", row, "data")
        table = self._numbers(path)
        mine = np.asarray(table["episode_index"]) == row["episode_index"]
        table = table.filter(pa.array(mine))
        if len(table) != int(row["length"]):
            raise EpisodeError(
                f"{path}: holds {len(table)} rows of episode {row['episode_index']}, meta/episodes says"
                f" {row['length']}; the file is damaged"
            )
        return table, path

    def _format(self, template: str, row: dict[str, Any], prefix: str, **keys: str) -> str:
        usual = version2 if self._version2 else names
        path: str = self.info.get(template) or getattr(usual, template.upper())
        chunk, file = int(row[f"{prefix}/chunk_index"]), int(row[f"{prefix}/file_index"])
        # v3.0 has chunks of files that hold several episodes, v2 chunks of episodes
        return str(
            path.format(chunk_index=chunk, file_index=file, episode_chunk=chunk, episode_index=file, **keys)
        )

    def _numbers(self, path: Path) -> pa.Table:
        """`_read` of a data file; the last one is kept."""
        with self._reading:
            if self._cached is None or self._cached[0] != path:
                self._cached = (path, self._read(path))
            return self._cached[1]

    def _read(self, path: Path) -> pa.Table:
        """All columns of a data file but pictures and what is not asked for."""
        pictures = set(self._cameras.values())
        file = open_parquet(path)
        columns = [
            name
            for name in file.schema_arrow.names
            if name not in pictures and is_read(name, self.features, self.privileged)
        ]
        missing = {"action", "observation.state", "episode_index"} - set(columns)
        if missing:
            raise EpisodeError(f"{path}: columns {sorted(missing)} are missing")
        try:
            return file.read(columns=columns)
        except (OSError, pa.ArrowInvalid) as error:
            raise EpisodeError(f"{path}: {error}; restore the file") from error

    def _instruction(self, row: dict[str, Any], table: pa.Table) -> str:
        tasks = row.get("tasks")
        if tasks is not None and len(tasks) == 1:
            return str(tasks[0])
        index = int(table["task_index"][0].as_py()) if "task_index" in table.column_names else -1
        return str(self._tasks.get(index, tasks[0] if tasks else ""))

    # -- pictures
    def _pictures(self, key: str, row: dict[str, Any], path: Path, length: int) -> NDArray[np.uint8]:
        """One camera's pictures uint8 [T, 3, H, W] of an episode."""
        if self.features[key]["dtype"] == "video":
            video = self.root / self._format("video_path", row, f"videos/{key}", video_key=key)
            start = float(row[f"videos/{key}/from_timestamp"])
            return read_clip(video, start, length, self.fps, self.size)
        try:
            part = pq.read_table(path, columns=[key], filters=[("episode_index", "=", row["episode_index"])])
        except (OSError, pa.ArrowInvalid) as error:
            raise EpisodeError(f"{path}: {error}; restore the file") from error
        pictures = [stored_picture(self.root, key, cell) for cell in part[key].to_pylist()]
        return np.stack([resize_picture(picture, self.size).transpose(2, 0, 1) for picture in pictures])
