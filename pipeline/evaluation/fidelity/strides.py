"""Strides at inference: one world asked for every frame, or for one in so many, under the same actions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from pipeline.evaluation.fidelity.frames import summary
from pipeline.evaluation.fidelity.open_loop import Measured, OpenLoop
from pipeline.evaluation.fidelity.verdicts import verdict_tables, verdict_text
from pipeline.evaluation.judging import thinned

HEADINGS = ("stride", "a chunk covers", "s per episode", "frames reached")
VERDICTS = ("verdicts right", "of the same recorded frames")


def common_stride(strides: Sequence[int]) -> int:
    """The frames that worlds of all these strides show: every so many."""
    return math.lcm(*strides)


def by_stride(loop: OpenLoop, simulator: Simulator, strides: Sequence[int]) -> list[dict[str, Any]]:
    """A row for each stride.

    Returns:
        stride; covers, the seconds of a chunk; seconds of wall time for an episode; frames, the recorded
        frame that is reached, a mean over episodes; errors as of frames.summary at the times that all of
        them show; verdicts, see verdicts.verdict_tables, {} without a judge.
    """
    common, spec = common_stride(strides), loop.store.spec
    # the first call is slower than all others
    replay(simulator, loop.store, loop.episodes[:1], bf16=loop.bf16, stride=strides[0], most=1)
    rows = []
    for stride in strides:
        own = replace(loop, stride=stride)
        found, every = own.measure(simulator), common // stride
        errors = {name: values[:, every - 1 :: every] for name, values in found.errors.items()}
        rows.append(
            {
                "stride": stride,
                "covers": stride * spec.chunk / loop.store.fps,
                "seconds": found.seconds / len(loop.episodes),
                "frames": stride * float(found.valid.sum(1).float().mean()),
                **summary(errors, found.valid[:, every - 1 :: every]),
                "verdicts": _verdicts(own, found),
            }
        )
    return rows


def _verdicts(loop: OpenLoop, found: Measured) -> dict[str, Any]:
    if loop.judge is None:
        return {}
    with thinned(loop.judge, loop.stride) as judge:
        return verdict_tables(judge, loop.store, loop.episodes, found.judged, found.valid)


def stride_cells(row: Mapping[str, Any], texts: Sequence[str]) -> list[str]:
    """The cells under HEADINGS, those of the errors, and VERDICTS.

    Args:
        texts: of the errors.
    """
    return [
        *(f"{row['stride']}", f"{row['covers']:.1f} s", f"{row['seconds']:.3f}", f"{row['frames']:.1f}"),
        *texts,
        *(verdict_text(row["verdicts"], video) for video in ("generated", "recorded")),
    ]
