"""The gripper detector of a run: trained once, then used on generated and recorded video alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from actors.process import device_of
from actors.weights import load
from actors.world_config import pose_style
from envs.embodiment import EmbodimentError
from envs.episodes.clips import ClipStore
from envs.manifest import digest_of
from envs.targets import ConfigError
from pipeline.evaluation.grippers.detecting import (
    WEIGHTS,
    Sights,
    build_detector,
    detector_error,
    fixed_views,
    train_detector,
    unseen,
)
from pipeline.evaluation.grippers.detector import GripperDetector
from pipeline.evaluation.grippers.end_effectors import EndEffectors, arm_names, known_end_effectors
from pipeline.graph.code_version import code_of, json_digest
from pipeline.outside import KINEMATICS, files_at, fingerprint

_MODULE = "pipeline.evaluation.grippers.detecting"


@dataclass(frozen=True)
class GripperRuler:
    """What finds grippers in pictures.

    Args:
        detector: looks through cameras `views`, in this order.
        views: their positions.
        sights: what it was taught by; None if its weights were given and nobody knows.
        weights: its file.
    """

    detector: GripperDetector
    views: tuple[int, ...]
    sights: Sights | None
    weights: Path

    @property
    def source(self) -> str:
        """What taught it, in words."""
        return f"weights {self.weights}" if self.sights is None else self.sights.ends.source

    @property
    def identity(self) -> str:
        """What tells it from others."""
        return digest_of(self.weights)

    def error(self, episodes: Tensor) -> dict[str, Any]:
        """Its own error, by camera, on those of `episodes` [N] that it has not learned from; {} if there are
        none, or if nobody knows where end effectors are.
        """
        if self.sights is None:
            return {}
        episodes = unseen(self.sights.store, episodes)
        return detector_error(self.detector, self.sights, episodes) if len(episodes) else {}


def known_ends(cfg: Mapping[str, Any], store: ClipStore) -> EndEffectors:
    """See known_end_effectors; fingertips are as far from flanges as in pose maps.

    Raises:
        EmbodimentError: if nothing says where they are.
    """
    return known_end_effectors(store, pose_style(cfg).tool_offset)


def looked_through(cfg: Mapping[str, Any], store: ClipStore) -> tuple[int, ...]:
    """Positions of the cameras of ewmbench.cameras.

    Raises:
        ConfigError: if the robot has not all of them.
    """
    try:
        return store.spec.embodiment.views_of(cfg["ewmbench"]["cameras"])
    except ValueError as error:
        raise ConfigError(f"ewmbench.{error}") from error


def gripper_ruler(cfg: Mapping[str, Any], store: ClipStore, data: Sequence[Path], root: Path) -> GripperRuler:
    """The detector of section ewmbench.detector: its weights if they are given, else the one that the run's
    folder holds for these data, trained first if it is not there.

    Args:
        data: folders of the store's data sets.
        root: of the run.

    Raises:
        EmbodimentError: if kinematics or calibration do not say where grippers are in pictures, and no
            weights are given.
        ConfigError: if weights are given that are not there, or of other cameras or arms.
    """
    section = cfg["ewmbench"]["detector"]
    robot = store.spec.embodiment
    views = looked_through(cfg, store)
    sights: Sights | None = None
    try:
        sights = Sights.of(store, known_ends(cfg, store), views)
    except EmbodimentError:
        if section["weights"] is None:
            raise
    if section["weights"] is not None:
        path, fixed = Path(section["weights"]), fixed_views(store, views)
        if not path.is_file():
            raise ConfigError(f"ewmbench.detector.weights={path} is not there")
        detector = build_detector(section, len(fixed), len(arm_names(robot)))
        if sights is not None and sights.views != fixed:
            sights = None  # it looks through cameras of which nobody knows where they are
        return GripperRuler(load(detector, path).to(device_of(cfg)).eval(), fixed, sights, path)
    assert sights is not None
    about = {
        "data": fingerprint([str(folder) for folder in data], "imagined.data"),
        "robot": [robot.robot, list(store.spec.size), list(sights.views)],
        "ends": [sights.ends.source, pose_style(cfg).tool_offset],
        "kinematics": [cfg["simulator"].get("kinematics"), files_at(cfg, KINEMATICS)],
        "section": section,
        "code": code_of(_MODULE, {}),
    }
    key = json_digest(about)
    folder = root / "ewmbench" / f"detector-{key}"
    detector = train_detector(sights, section, folder, device_of(cfg))
    return GripperRuler(detector, sights.views, sights, folder / WEIGHTS)
