"""A simulator under the true actions of recorded episodes, measured frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.perceptual import PerceptualDistance
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from pipeline.evaluation.fidelity.end_effector import EndEffectorRuler, end_effector_summary
from pipeline.evaluation.fidelity.extractors import Extractor
from pipeline.evaluation.fidelity.frames import by_frame, frame_errors, summary
from pipeline.evaluation.fidelity.frechet import Moments, frechet
from pipeline.evaluation.objects.error import object_error

_SIDE_BY_SIDE = 16  # episodes, whose frames are held at once


@dataclass
class OpenLoop:
    """What simulators are measured on.

    Args:
        store: of the episodes.
        episodes: int64 [N].
        bf16: generate in bfloat16 where the device computes in it.
        labels: uint8 [N, T, V, H, W], see masks.part_labels; None if nobody knows.
        extractors: of Frechet distances.
        clip: frames of a clip.
        hands: measures end effectors, or why nothing can.
    """

    store: ClipStore
    episodes: Tensor
    bf16: bool
    labels: Tensor | None = None
    extractors: Sequence[Extractor] = ()
    clip: int = 8
    hands: EndEffectorRuler | str = "nobody asked"
    distance: PerceptualDistance = field(default_factory=PerceptualDistance)

    def measure(self, simulator: Simulator) -> Measured:
        """Roll it out over all episodes."""
        out = Measured()
        sides = {e.name: (Moments(e), Moments(e)) for e in self.extractors}
        parts = range(0, len(self.episodes), _SIDE_BY_SIDE)
        for begin in tqdm(parts, desc="rolled out", unit="batch", dynamic_ncols=True, leave=False):
            some = slice(begin, begin + _SIDE_BY_SIDE)
            made = replay(simulator, self.store, self.episodes[some], bf16=self.bf16)
            true = self.store.frames(made.rows)
            marks = None if self.labels is None else _fitted(self.labels[some], made.rows.shape[1])
            out.add(frame_errors(made.frames, true, self.distance, marks), made.valid)
            for extractor in self.extractors:
                for moments, video in zip(sides[extractor.name], (made.frames, true), strict=True):
                    for pictures in _samples(video, made.valid, extractor.clips, self.clip):
                        moments.add(pictures)
            out.objects.append(object_error(self.store, self.episodes[some], made, true))
            if isinstance(self.hands, EndEffectorRuler):
                out.hands.append(self.hands.measure(self.store, self.episodes[some], made, true))
        enough = {name: pair for name, pair in sides.items() if min(one.count for one in pair) > 1}
        out.frechet = [frechet(*pair) for pair in enough.values()]
        out.end_effector = end_effector_summary(self.hands, out.hands)
        return out


class Measured:
    """Errors of all frames of episodes that were rolled out part by part.

    Attributes:
        errors: float32 [N, T, V] by name, see frames.frame_errors.
        valid: bool [N, T].
        frechet: see frechet.frechet, one for each extractor that had samples enough.
        objects: see objects.error.object_error, of each part.
        hands: see end_effector.EndEffectorRuler.measure, of each part; end_effector: what they come to.
    """

    def __init__(self) -> None:
        self.errors: dict[str, Tensor] = {}
        self.valid = torch.zeros(0, 0, dtype=torch.bool)
        self.frechet: list[dict[str, Any]] = []
        self.objects: list[dict[str, Any]] = []
        self.hands: list[dict[str, Tensor]] = []
        self.end_effector: dict[str, Any] = {}

    def add(self, errors: Mapping[str, Tensor], valid: Tensor) -> None:
        """Take in further episodes, of any number of frames."""
        most = max(self.valid.shape[1], valid.shape[1])
        for name, values in errors.items():
            before = self.errors.get(name, torch.zeros(0, 0, values.shape[2]))
            self.errors[name] = torch.cat([_longer(part, most) for part in (before, values)])
        self.valid = torch.cat([_longer(part, most) for part in (self.valid, valid)])

    @property
    def overall(self) -> dict[str, Any]:
        """See frames.summary."""
        return summary(self.errors, self.valid)

    @property
    def by_frame(self) -> dict[str, list[float | None]]:
        """See frames.by_frame."""
        return by_frame(self.errors, self.valid)

    def result(self, views: Sequence[str], groups: Mapping[str, Tensor]) -> dict[str, Any]:
        """In numbers: overall, by_frame, views (overall of each), groups (overall of some episodes, positions
        int64 by name), frechet, and the errors of objects and end effectors where physics knows them.
        """
        one = {
            view: {name: values[..., k : k + 1] for name, values in self.errors.items()}
            for k, view in enumerate(views)
        }
        known = [part for part in self.objects if part]
        return {
            "episodes": len(self.valid),
            "overall": self.overall,
            "by_frame": self.by_frame,
            "views": {view: summary(errors, self.valid) for view, errors in one.items()},
            "groups": {
                name: summary({k: v[which] for k, v in self.errors.items()}, self.valid[which])
                for name, which in groups.items()
            },
            "frechet": self.frechet,
            "object_cm": _mean([part["object_cm"]["median"] for part in known if "object_cm" in part]),
            "object_lost": _mean([part["object_lost"] for part in known if "object_lost" in part]),
            "end_effector": self.end_effector,
        }


def _samples(video: Tensor, valid: Tensor, clips: bool, length: int) -> list[Tensor]:
    """Pictures [n, 3, H, W], or clips [n, length, 3, H, W], of the frames that exist; every view is one."""
    if not clips:
        return [some for some in video[valid].flatten(0, 1).split(256)]
    count = video.shape[1] // length
    if not count:
        return []
    whole = video[:, : count * length].unflatten(1, (count, length)).transpose(2, 3)  # [N, c, V, L, ...]
    there = valid[:, : count * length].unflatten(1, (count, length)).all(2)
    return [some for some in whole[there].flatten(0, 1).split(32)]


def _fitted(labels: Tensor, frames: int) -> Tensor:
    """Labels of as many frames as were generated; unknown (255) beyond those that there are."""
    missing = max(0, frames - labels.shape[1])
    more = labels.new_full((len(labels), missing, *labels.shape[2:]), 255)
    return torch.cat((labels[:, :frames], more), 1)


def _longer(values: Tensor, frames: int) -> Tensor:
    """Values [N, T, ...] with zeros (False) up to a number of frames."""
    more = values.new_zeros(len(values), frames - values.shape[1], *values.shape[2:])
    return torch.cat((values, more), 1)


def _mean(values: list[float]) -> float | None:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else None


def held_still(store: ClipStore, episodes: Tensor, distance: PerceptualDistance) -> Measured:
    """Errors of a world that shows each episode's first frame for ever: what is to be beaten."""
    return _held(store, episodes, distance, lambda first: first)


def held_coded(
    store: ClipStore, episodes: Tensor, distance: PerceptualDistance, simulator: Simulator
) -> Measured | None:
    """The same where the first frame is shown as the simulator's autoencoder keeps it, which is as far as
    decoding alone gets; None if it has none.
    """
    if simulator.coded(store.frames(store.start[episodes[:1]])[:, None].to(simulator.device)) is None:
        return None

    def shown(first: Tensor) -> Tensor:
        coded = simulator.coded(first.to(simulator.device))
        assert coded is not None
        return coded.cpu()

    return _held(store, episodes, distance, shown)


def _held(
    store: ClipStore,
    episodes: Tensor,
    distance: PerceptualDistance,
    shown: Callable[[Tensor], Tensor],
) -> Measured:
    """Errors of what is shown for ever of first frames uint8 [N, 1, V, 3, H, W]."""
    out = Measured()
    for some in episodes.split(_SIDE_BY_SIDE):
        rows, valid = store.whole(some)
        first = shown(store.frames(store.start[some])[:, None])
        frames = first.expand(-1, rows.shape[1], -1, -1, -1, -1)
        out.add(frame_errors(frames, store.frames(rows), distance), valid)
    return out
