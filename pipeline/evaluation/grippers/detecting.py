"""Teaches a gripper detector what kinematics and calibration say, and measures its own error.

Its targets are end effectors projected into recorded pictures. From some pictures a gripper is taken away, by
pasting what the same camera saw there at another time, so that it learns to say "nowhere" of a gripper that
has melted; blur, noise and light are varied, so that generated pictures do not surprise it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from actors.weights import load
from envs.embodiment import EmbodimentError
from envs.episodes.clips import ClipStore
from envs.geometry.cameras import project
from envs.rng import seed_process
from envs.targets import options as options_of
from learners.training.fit import FitConfig, fit
from pipeline.evaluation.grippers.detector import GripperDetector
from pipeline.evaluation.grippers.end_effectors import EndEffectors
from pipeline.evaluation.statistics import quantiles
from pipeline.graph.artefact import save_weights

WEIGHTS = "weights.safetensors"
_TAKEN = 0.25  # share of training pictures from which a gripper is taken away
_REACH = 0.09  # metres around an end effector that are taken away with it
_SMALLEST = 4.0  # pixels of that, at least
_BLURRED, _NOISE, _LIGHT = 0.3, 6.0, 0.1  # share; grey levels; of the range
_MEASURED = 512  # held-out frames


@dataclass(frozen=True)
class Sights:
    """What the cameras that are looked through see of end effectors.

    Args:
        store: of the episodes.
        ends: their end effectors.
        views: positions of cameras that are calibrated and not on a wrist.
    """

    store: ClipStore
    ends: EndEffectors
    views: tuple[int, ...]

    @classmethod
    def of(cls, store: ClipStore, ends: EndEffectors, views: tuple[int, ...]) -> Sights:
        """Through those of `views` that can be looked through.

        Raises:
            EmbodimentError: if none can.
        """
        robot = store.spec.embodiment
        known = tuple(view for view in views if view in robot.calibrated_views)
        if not known:
            raise EmbodimentError(
                f"none of the cameras {[robot.views[view] for view in views]} of {robot.robot} is calibrated,"
                " so end effectors cannot be projected into pictures; record calibration.c2w and"
                " calibration.intrinsic (task.suite.calibrated=true where a suite can tell them)"
            )
        return cls(store, ends, fixed_views(store, known))

    def pixels(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Where end effectors are, float32 [N, V, arms, 2], in rows int64 [N] of `episodes` [N]; NaN where
        one is outside the picture or behind the camera.
        """
        height, width = self.store.spec.size
        out = []
        for view in self.views:
            at, depth = project(
                self.ends.positions[rows],
                self.store.intrinsic[episodes, view],
                self.store.arrays["c2w"][rows, view],
            )
            inside = (at >= 0).all(-1) & (at < torch.tensor([width, height])).all(-1) & (depth > 0)
            out.append(torch.where(inside[..., None], at, torch.nan))
        return torch.stack(out, 1)

    def reach(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Pixels [N, V, arms] that a gripper reaches around its end effector, about."""
        out = []
        for view in self.views:
            intrinsic = self.store.intrinsic[episodes, view]
            _, depth = project(self.ends.positions[rows], intrinsic, self.store.arrays["c2w"][rows, view])
            out.append(_REACH * intrinsic[:, :1, 0] / depth.clamp(min=0.05))
        return torch.stack(out, 1).clamp(min=_SMALLEST)


def fixed_views(store: ClipStore, views: tuple[int, ...]) -> tuple[int, ...]:
    """Those of `views` that are not on a wrist, where a gripper hardly moves in the picture.

    Raises:
        EmbodimentError: if all are.
    """
    robot = store.spec.embodiment
    fixed = tuple(view for view in views if robot.wrists[view] is None)
    if not fixed:
        raise EmbodimentError(
            f"cameras {[robot.views[view] for view in views]} of {robot.robot} are all on wrists, in whose"
            " pictures no trajectory can be seen; name others by ewmbench.cameras"
        )
    return fixed


def build_detector(section: Mapping[str, Any], views: int, arms: int) -> GripperDetector:
    """An untrained one of a section ewmbench.detector; its first weights are always the same."""
    with torch.random.fork_rng(devices=[]):
        seed_process(0)
        return GripperDetector(views, arms, section["width"], section["side"])


def train_detector(
    sights: Sights, section: Mapping[str, Any], folder: Path, device: torch.device
) -> GripperDetector:
    """The detector that `folder` holds, trained first if it is not there; goes on where it was stopped.

    Args:
        section: ewmbench.detector.
        folder: one for each thing that it depends on.
    """
    detector = build_detector(section, len(sights.views), len(sights.ends.arms)).to(device)
    if (folder / WEIGHTS).is_file():
        return load(detector, folder / WEIGHTS).eval()
    key = "ewmbench.detector.fit"
    store, config = sights.store, options_of(FitConfig, {**section["fit"], "key": key}, key)
    episodes = learned_from(store)
    rows, owner = _shown(store, episodes)

    def batch(step: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        pick, other = torch.randint(len(rows), (2, config.part), generator=generator)
        view = torch.randint(len(sights.views), (config.part,), generator=generator)
        here = torch.arange(config.part)
        cameras = torch.tensor(sights.views)[view]
        seen, away = (store.frames(rows[some])[here, cameras] for some in (pick, other))
        wanted, off = (sights.pixels(rows[some], owner[some])[here, view] for some in (pick, other))
        reach = sights.reach(rows[pick], owner[pick])[here, view]
        take = torch.rand(config.part, generator=generator) < _TAKEN
        arm = torch.randint(wanted.shape[1], (config.part,), generator=generator)
        seen, wanted = taken_away(seen, away, wanted, off, reach, torch.where(take, arm, -1))
        return varied(seen, generator), view, wanted

    def loss(
        data: tuple[Tensor, Tensor, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Any]]:
        pictures, view, wanted = (part.to(device) for part in data)
        return detector.loss(pictures, view, wanted), {}

    fit("detector", detector, batch, loss, config, folder)
    save_weights(detector, folder)
    return detector.eval()


def taken_away(
    seen: Tensor, away: Tensor, wanted: Tensor, off: Tensor, reach: Tensor, arm: Tensor
) -> tuple[Tensor, Tensor]:
    """Pictures from which a gripper is gone, and what is left to be found in them.

    Args:
        seen, away: uint8 [B, 3, H, W] of the same cameras at two times.
        wanted, off: pixels [B, arms, 2] of end effectors in either.
        reach: pixels [B, arms] that a gripper reaches around it.
        arm: int64 [B], whose gripper to take; -1 for none. It stays where another gripper would be cut or
            pasted.
    """
    height, width = seen.shape[-2:]
    here, index = torch.arange(len(seen)), arm.clamp(min=0)
    centre, radius = wanted[here, index], reach[here, index]
    both = torch.cat((wanted, off), 1)
    near = (both - centre[:, None]).abs().amax(-1) < 2 * radius[:, None]  # of NaN False
    near[here, index] = False
    take = (arm >= 0) & torch.isfinite(centre).all(-1) & ~near.any(1)
    v = (torch.arange(height) + 0.5 - centre[:, 1:]).abs() < radius[:, None]
    u = (torch.arange(width) + 0.5 - centre[:, :1]).abs() < radius[:, None]
    square = (v[:, :, None] & u[:, None, :] & take[:, None, None])[:, None]
    left = wanted.clone()
    left[here[take], index[take]] = torch.nan
    return torch.where(square, away, seen), left


def varied(pictures: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures float32 in -1..1 of uint8 [B, 3, H, W], some blurred, all with noise and in other light."""
    count, (height, width) = len(pictures), pictures.shape[-2:]
    out = pictures.float()
    small = F.interpolate(out, (max(1, height // 2), max(1, width // 2)), mode="area")
    blurred = F.interpolate(small, (height, width), mode="bilinear", align_corners=False)
    blur = torch.rand(count, generator=generator) < _BLURRED
    out = torch.where(blur[:, None, None, None], blurred, out)
    light = 1 + _LIGHT * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    noise = _NOISE * torch.rand(count, 1, 1, 1, generator=generator)
    out = out * light + noise * torch.randn(out.shape, generator=generator)
    return out.clamp(0, 255) / 127.5 - 1


def detector_error(detector: GripperDetector, sights: Sights, episodes: Tensor) -> dict[str, Any]:
    """Its own error on the recorded pictures of episodes int64 [N] that it has not learned from, by camera.

    Returns:
        For each camera, by name: px (median and 90th percentile of the distance to the projected end
        effector; None where none was found), missed (share of end effectors in the picture that it calls
        nowhere), imagined (share of those outside that it finds; None where none is outside) and frames.
    """
    store = sights.store
    rows, owner = _shown(store, episodes)
    some = torch.linspace(0, len(rows) - 1, min(_MEASURED, len(rows))).round().long()
    rows, owner = rows[some], owner[some]
    parts = [
        detector.detect(store.frames(part)[:, list(sights.views)], torch.arange(len(sights.views)))
        for part in rows.split(64)
    ]
    found, wanted = torch.cat(parts), sights.pixels(rows, owner)
    out = {}
    for n, view in enumerate(sights.views):
        there = torch.isfinite(wanted[:, n]).all(-1)
        seen = torch.isfinite(found[:, n]).all(-1)
        off = (found[:, n] - wanted[:, n]).norm(dim=-1)
        out[store.spec.embodiment.views[view]] = {
            "px": quantiles(off[there & seen]),
            "missed": float((~seen)[there].float().mean()) if there.any() else None,
            "imagined": float(seen[~there].float().mean()) if (~there).any() else None,
            "frames": len(rows),
        }
    return out


def _shown(store: ClipStore, episodes: Tensor) -> tuple[Tensor, Tensor]:
    """Rows int64 [n] of the frames of episodes int64 [N] of which there is a picture, and their episodes."""
    rows, owner = store.rows(episodes), torch.repeat_interleave(episodes, store.length[episodes])
    shown = store.arrays["present"][rows]
    return rows[shown], owner[shown]


def learned_from(store: ClipStore) -> Tensor:
    """Episodes int64 [N] that a detector learns from: those for training, or where a store holds none, every
    second one.
    """
    chosen = store.split("train")
    return chosen if len(chosen) else torch.arange(0, len(store), 2)


def unseen(store: ClipStore, episodes: Tensor) -> Tensor:
    """Those of `episodes` [N] that a detector has not learned from."""
    return episodes[~torch.isin(episodes, learned_from(store))]
