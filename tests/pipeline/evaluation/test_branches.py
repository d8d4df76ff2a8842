"""Futures of one moment: carried out as they were recorded, and correlated within moments alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.factory import build_physics, build_policy, build_pool, open_clips
from actors.policies.safe import SafePolicyWrapper
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.initial_states import DecisionPoints
from envs.judges.base import Judge, Judgement
from envs.specs import Status, to_chunk
from pipeline.config import load_config
from pipeline.evaluation.branches import Branches, agreement, carry_out


class Unmoved(Judge):
    """Progress .3 of whatever it is shown; success in its third and fourth look, and never again."""

    def __init__(self, hold: int):
        super().__init__(hold)
        self.looks = 0

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score."""
        self.looks += 1
        same = torch.ones(frames.shape[:2])
        status = torch.full((len(frames),), Status.OK.value)
        return Judgement(0.9 * same if self.looks in (3, 4) else 0 * same, 0.3 * same, status)


def test_what_was_recorded_is_carried_out_again(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", "task.size=[32,32]"])
    spec = world_spec(cfg)
    pool = build_pool(cfg)
    try:
        tracks = pool.script([(1, 0.0), (2, 0.0), (4, 1.0)], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(tmp_path / "set", spec.embodiment).write(
        [Episode.from_track(track, "scripted", spec.embodiment) for track in tracks]
    )
    store = open_clips(cfg, [tmp_path / "set"])
    points = DecisionPoints(store, torch.arange(3))
    which = (points.frame == 4).nonzero().flatten()
    policy, judge = build_policy(cfg), Unmoved(hold=spec.chunk + 1).eval()
    physics = build_physics(cfg, 4)
    try:
        actor = SafePolicyWrapper(policy, spec, physics.mode)
        depth = int(store.length.max() - 2) // spec.chunk
        commands = store.arrays["commands"]
        begins = 4 + torch.arange(depth) * spec.chunk
        start, last = store.start[points.episode[which]], store.length[points.episode[which]] - 1
        ahead = begins[:, None, None] + torch.arange(1, spec.chunk + 1)
        rows = start[:, None] + torch.minimum(ahead, last[:, None])  # [D, N, K]
        now = commands[start + torch.minimum(begins[:, None], last)]
        chunks = to_chunk(commands[rows], now, physics.mode)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            seen, outcome = carry_out(physics, actor, judge, points, which, chunks)
    finally:
        physics.close()
    recorded = [bool(store.episodes[int(number)]["success"]) for number in points.episode[which]]
    assert outcome.bool().tolist() == recorded == [True, True, False]
    # Nothing of the outcome is in what the judge has seen, and what it took for a success stays one.
    assert depth == 4 and seen.tolist() == [pytest.approx([value] * 3) for value in (0.3, 0.3, 1.0, 1.0)]


def test_only_what_differs_within_a_moment_counts() -> None:
    draw = torch.randn(3, 40, 8, generator=torch.Generator().manual_seed(0))
    moments = 10 * torch.arange(40.0)[:, None]
    signal, noise, outcome = draw + moments
    same, unlike = agreement(Branches(torch.stack((outcome, noise)), torch.stack((signal, outcome)), outcome))
    assert same["imagined"][0] == pytest.approx(1.0, abs=1e-3)
    assert unlike["judged"][0] == pytest.approx(1.0, abs=1e-3)
    for value, low, high in (same["frames"], unlike["imagined"]):
        assert low < value < high and abs(value) < 0.2  # though moments differ far more than futures
    nobody_won = Branches(torch.stack((outcome, noise)), torch.stack((signal, outcome)), torch.zeros(40, 8))
    silent = agreement(nobody_won)[0]
    assert silent["judged"] == silent["imagined"] == [None, None, None] and silent["frames"][0] is not None
