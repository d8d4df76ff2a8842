"""What has been measured of each video, a file each: an interrupted command goes on where it was."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from envs.files import write_json
from pipeline.evaluation.ewmbench.scene import Scene
from pipeline.evaluation.ewmbench.semantics import VideoReport
from pipeline.graph.code_version import json_digest


@dataclass(frozen=True)
class Record:
    """Measurements of one video, its first frame included.

    Args:
        scene: of each view that is looked at.
        embedding: float32 [D] of the whole video.
        tracks: float32 [T, V, arms, 2] pixels of the grippers that were found, V the cameras of the detector;
            None without one.
        report: by the vision-language model; None without one.
    """

    scene: tuple[Scene, ...]
    embedding: Tensor
    tracks: Tensor | None
    report: VideoReport | None

    @property
    def whole(self) -> bool:
        """Whether nothing is left to be asked."""
        return self.report is None or self.report.whole


class Records:
    """Files of records by what they depend on.

    Args:
        folder: made if it is not there.
        identity: what all of them depend on.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]):
        self.folder, self.identity, self.reused = folder, identity, 0

    def path(self, name: str, about: Mapping[str, Any]) -> Path:
        """The file of a video."""
        key = json_digest([self.identity, about])
        return self.folder / f"{re.sub(r'[^A-Za-z0-9_.+-]+', '_', name)}-{key}.json"

    def get(self, name: str, about: Mapping[str, Any]) -> Record | None:
        """What is known of a video; None if nothing is."""
        path = self.path(name, about)
        if not path.is_file():
            return None
        self.reused += 1
        kept = json.loads(path.read_text())
        report = kept["report"]
        return Record(
            tuple(Scene(**row) for row in kept["scene"]),
            torch.tensor(kept["embedding"]),
            None if kept["tracks"] is None else _read(kept["tracks"]),
            None
            if report is None
            else VideoReport(report["caption"], _tuple(report["steps"]), _tuple(report["errors"])),
        )

    def put(self, name: str, about: Mapping[str, Any], record: Record) -> None:
        """Keep what is known of a video; one of which answers are missing is asked about again next time."""
        if not record.whole:
            return
        kept = {
            "scene": [asdict(row) for row in record.scene],
            "embedding": record.embedding.tolist(),
            "tracks": None if record.tracks is None else _written(record.tracks),
            "report": None if record.report is None else asdict(record.report),
        }
        write_json(self.path(name, about), kept)


def _written(tracks: Tensor) -> dict[str, Any]:
    """Shape and numbers with all digits, so that figures stay when they are read; null for nothing found."""
    flat = [value if np.isfinite(value) else None for value in tracks.flatten().tolist()]
    return {"shape": list(tracks.shape), "pixels": flat}


def _read(kept: Mapping[str, Any]) -> Tensor:
    flat = [float("nan") if value is None else value for value in kept["pixels"]]
    return torch.tensor(flat).reshape(kept["shape"])


def _tuple(values: list[str] | None) -> tuple[str, ...] | None:
    return None if values is None else tuple(values)
