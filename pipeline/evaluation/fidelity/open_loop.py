"""A simulator under the true actions of recorded episodes, measured frame by frame."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.judges.perceptual import PerceptualDistance
from envs.simulators.base import Simulator
from envs.simulators.replay import replay, side_by_side
from pipeline.evaluation.fidelity.end_effector import EndEffectorRuler, end_effector_summary
from pipeline.evaluation.fidelity.extractors import Extractor
from pipeline.evaluation.fidelity.frames import by_frame, frame_errors, summary
from pipeline.evaluation.fidelity.frechet import Moments, frechet
from pipeline.evaluation.fidelity.verdicts import judged
from pipeline.evaluation.judging import thinned
from pipeline.evaluation.objects.error import object_offsets, object_summary
from pipeline.graph.kept import Kept, Tensors

_SIDE_BY_SIDE = 16  # episodes at most, whose frames are held at once
_AT_ONCE = {False: 256, True: 32}  # pictures, or clips, that an extractor is shown
_SIDES = ("made", "true")


@dataclass
class OpenLoop:
    """What simulators are measured on.

    Args:
        store: of the episodes.
        episodes: int64 [N].
        bf16: generate in bfloat16 where the device computes in it.
        labels: uint8 [n, T, V, H, W] of n of the episodes, see masks.part_labels, asked for as these are
            measured, for those of all would fill the memory; None if nobody knows any.
        extractors: of Frechet distances.
        clip: frames of a clip.
        hands: measures end effectors, or why nothing can.
        stride: recorded frames from one generated frame to the next.
        judge: is asked about what was generated; None for nobody.
        kept: where what was measured of each batch is kept; None for nowhere.
        identity: what that depends on beside these, with the judge's weights.
    """

    store: ClipStore
    episodes: Tensor
    bf16: bool
    labels: Callable[[Tensor], Tensor] | None = None
    extractors: Sequence[Extractor] = ()
    clip: int = 8
    hands: EndEffectorRuler | str = "nobody asked"
    stride: int = 1
    judge: Judge | None = None
    distance: PerceptualDistance = field(default_factory=PerceptualDistance)
    kept: Kept | None = None
    identity: Mapping[str, Any] = field(default_factory=dict)

    def measure(self, simulator: Simulator, about: Mapping[str, Any] | None = None) -> Measured:
        """Roll it out over all episodes.

        Args:
            about: what tells it from others of the same identity.
        """
        out = Measured()
        sides = [(Moments(e), Moments(e)) for e in self.extractors]
        for some in tqdm(self.batches(), desc="rolled out", unit="batch", dynamic_ncols=True, leave=False):
            part = self._part(simulator, some, about or {})
            out.add(_named(part, "error"), part["valid"])
            out.seconds += float(part["seconds"])
            for number, pair in enumerate(sides):
                for moments, side in zip(pair, _SIDES, strict=True):
                    if (features := part.get(f"{side}/{number}")) is not None:
                        for few in features.split(_AT_ONCE[moments.extractor.clips]):
                            moments.take(few)
            out.objects.append(_named(part, "object"))
            if isinstance(self.hands, EndEffectorRuler):
                out.hands.append(_named(part, "hand"))
            if self.judge is not None:
                out.judged.append(_named(part, "judge"))
        out.frechet = [self._distance(*pair) for pair in sides]
        out.end_effector = end_effector_summary(self.hands, out.hands)
        return out

    def _distance(self, made: Moments, true: Moments) -> dict[str, Any]:
        """See Measured.frechet."""
        extractor, count = made.extractor, min(made.count, true.count)
        name = f"{extractor.name}, clips of {self.clip} frames" if extractor.clips else extractor.name
        if count > 1:
            return {**frechet(made, true), "extractor": name}
        lasting = f" that last {self.clip} frames (fidelity.clip)" if extractor.clips else ""
        why = f"a covariance needs two samples{lasting}, and there is {count or 'none'}"
        return {"extractor": name, "value": None, "dim": None, "samples": count, "unknown": why}

    def held_still(self) -> Measured:
        """Errors of a world that shows each episode's first frame for ever: what is to be beaten."""
        return self._held(lambda first: first)

    def held_coded(self, simulator: Simulator) -> Measured | None:
        """The same where the first frame is shown as the simulator's autoencoder keeps it, which is as far as
        decoding alone gets; None if it has none.
        """
        first = self.store.frames(self.store.start[self.episodes[:1]])[:, None]
        if simulator.coded(first.to(simulator.device)) is None:
            return None

        def shown(first: Tensor) -> Tensor:
            coded = simulator.coded(first.to(simulator.device))
            assert coded is not None
            return coded.cpu()

        return self._held(shown)

    def _held(self, shown: Callable[[Tensor], Tensor]) -> Measured:
        """Errors of what is shown for ever of first frames uint8 [N, 1, V, 3, H, W]."""
        out = Measured()
        for some in self.batches():
            rows, valid = self.store.whole(self.episodes[some])
            first = shown(self.store.first(self.episodes[some])["frames"][:, None])
            frames = first.expand(-1, rows.shape[1], -1, -1, -1, -1)
            marks = _fitted(self._labels(some), rows.shape[1], 1)
            errors = frame_errors(frames, self.store.frames(rows), self.distance, marks)
            out.add(_known(errors, self.store.arrays["present"][rows]), valid)
        return out

    def batches(self) -> list[slice]:
        """Which episodes are measured together; the same whatever measures them."""
        longest = int(self.store.length[self.episodes].max())
        size = side_by_side(self.store, longest, _SIDE_BY_SIDE)
        return [slice(begin, begin + size) for begin in range(0, len(self.episodes), size)]

    def _part(self, simulator: Simulator, some: slice, about: Mapping[str, Any]) -> Tensors:
        """What is measured of some episodes, now or at some earlier time."""
        labels = self._labels(some)
        if self.kept is None:
            return self._rolled_out(simulator, some, labels)
        identity = {
            **self.identity,
            **about,
            "episodes": self.episodes[some].tolist(),
            "labels": hashlib.sha256(b"" if labels is None else labels.numpy().tobytes()).hexdigest(),
            "extractors": [extractor.name for extractor in self.extractors],
            "clip": self.clip,
            "stride": self.stride,
            "hands": self.hands if isinstance(self.hands, str) else self.hands.ruler.identity,
            "distance": self.distance.name,
        }
        name = f"rolled-out-{some.start}"
        return self.kept.get(name, identity, lambda: self._rolled_out(simulator, some, labels))

    def _labels(self, some: slice) -> Tensor | None:
        return None if self.labels is None else self.labels(self.episodes[some])

    def _rolled_out(self, simulator: Simulator, some: slice, labels: Tensor | None) -> Tensors:
        """Errors and valid, see Measured.add; seconds that generating took; features of generated and true
        samples by the extractor's number; offsets of objects and hands; scores of the judge.
        """
        episodes, began = self.episodes[some], time.perf_counter()
        made = replay(simulator, self.store, episodes, bf16=self.bf16, stride=self.stride)
        out = {"valid": made.valid, "seconds": torch.tensor(time.perf_counter() - began)}
        shown, true = made.pictured(self.store), self.store.frames(made.rows)
        marks = _fitted(labels, made.rows.shape[1], self.stride)
        errors = _known(frame_errors(made.frames, true, self.distance, marks), shown.valid)
        out |= {f"error/{name}": values for name, values in errors.items()}
        for number, extractor in enumerate(self.extractors):
            for side, video in zip(_SIDES, (made.frames, true), strict=True):
                if samples := _samples(video, shown.valid, extractor.clips, self.clip):
                    out[f"{side}/{number}"] = torch.cat([extractor(few) for few in samples])
        found = object_offsets(self.store, episodes, shown, true)
        out |= {f"object/{name}": values for name, values in found.items()}
        if isinstance(self.hands, EndEffectorRuler):
            hands = self.hands.measure(self.store, episodes, shown, true)
            out |= {f"hand/{name}": values for name, values in hands.items()}
        if self.judge is not None:
            with thinned(self.judge, self.stride) as judge:
                said = judged(judge, self.store, episodes, made)
            out |= {f"judge/{name}": values for name, values in said.items()}
        return out


class Measured:
    """Errors of all frames of episodes that were rolled out part by part.

    Attributes:
        errors: float32 [N, T, V] by name, see frames.frame_errors; NaN too where no picture was recorded.
        valid: bool [N, T].
        seconds: of wall time in which everything was generated.
        frechet: see frechet.frechet, one for each extractor, named with the length of its clips; where there
            are too few samples, value is None and `unknown` says why.
        objects: see objects.error.object_offsets, of each part.
        hands: see end_effector.EndEffectorRuler.measure, of each part; end_effector: what they come to.
        judged: see verdicts.judged, of each part; [] without a judge.
    """

    def __init__(self) -> None:
        self.errors: dict[str, Tensor] = {}
        self.valid = torch.zeros(0, 0, dtype=torch.bool)
        self.seconds = 0.0
        self.frechet: list[dict[str, Any]] = []
        self.objects: list[dict[str, Tensor]] = []
        self.hands: list[dict[str, Tensor]] = []
        self.judged: list[dict[str, Tensor]] = []
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
        without_picture counts the frames that are left out because none was recorded of them; locator_cm and
        locator_px are what object_cm would be of recorded video, and object_unknown says why it is unknown.
        """
        one = {
            view: {name: values[..., k : k + 1] for name, values in self.errors.items()}
            for k, view in enumerate(views)
        }
        objects = object_summary(self.objects)
        return {
            "episodes": len(self.valid),
            "without_picture": int(self.errors["mse"][self.valid].isnan().all(-1).sum()),
            "overall": self.overall,
            "by_frame": self.by_frame,
            "views": {view: summary(errors, self.valid) for view, errors in one.items()},
            "groups": {
                name: summary({k: v[which] for k, v in self.errors.items()}, self.valid[which])
                for name, which in groups.items()
            },
            "frechet": self.frechet,
            "object_cm": _median(objects.get("object_cm")),
            "object_lost": objects.get("object_lost"),
            "object_unknown": objects.get("object_unknown"),
            "locator_cm": _median(objects.get("locator_cm")),
            "locator_px": _median(objects.get("locator_px")),
            "end_effector": self.end_effector,
        }


def _samples(video: Tensor, valid: Tensor, clips: bool, length: int) -> list[Tensor]:
    """Pictures [n, 3, H, W], or clips [n, length, 3, H, W], of the frames that exist; every view is one."""
    if not clips:
        return [some for some in video[valid].flatten(0, 1).split(_AT_ONCE[clips])]
    count = video.shape[1] // length
    if not count:
        return []
    whole = video[:, : count * length].unflatten(1, (count, length)).transpose(2, 3)  # [N, c, V, L, ...]
    there = valid[:, : count * length].unflatten(1, (count, length)).all(2)
    return [some for some in whole[there].flatten(0, 1).split(_AT_ONCE[clips]) if len(some)]


def _known(errors: Mapping[str, Tensor], shown: Tensor) -> dict[str, Tensor]:
    """Errors [N, T, V] with NaN in the frames that no recorded picture shows, bool [N, T]."""
    return {name: torch.where(shown[..., None], values, torch.nan) for name, values in errors.items()}


def _named(part: Tensors, kind: str) -> Tensors:
    """Those of a part whose names begin so, without that."""
    return {name.partition("/")[2]: value for name, value in part.items() if name.startswith(f"{kind}/")}


def _fitted(labels: Tensor | None, frames: int, stride: int) -> Tensor | None:
    """Labels, if any, of generated frames, one in `stride`; unknown (255) beyond those that there are."""
    if labels is None:
        return None
    some = labels[:, stride - 1 :: stride][:, :frames]
    return pad(some, (0, 0, 0, 0, 0, 0, 0, frames - some.shape[1]), value=255)


def _longer(values: Tensor, frames: int) -> Tensor:
    """Values [N, T, ...] with zeros (False) up to a number of frames."""
    more = values.new_zeros(len(values), frames - values.shape[1], *values.shape[2:])
    return torch.cat((values, more), 1)


def _median(found: Mapping[str, float] | None) -> float | None:
    """That of quantiles; None where nothing was found."""
    return None if found is None else found["median"]
