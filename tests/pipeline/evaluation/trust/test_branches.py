"""Futures of one moment: carried out as recorded, judged as imagined ones, and correlated within moments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.factory import (
    build_judge,
    build_physics,
    build_policy,
    build_pool,
    build_simulator,
    build_state_decoder,
    build_world,
    open_clips,
)
from actors.policies.safe import SafePolicyWrapper
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.initial_states import DecisionPoints
from envs.judges.base import Judge, Judgement, ask
from envs.specs import PROGRESS, SUCCESS, Rewards, Status, to_chunk
from envs.transforms.judge_reward import JudgeReward
from pipeline.config import load_config
from pipeline.evaluation.trust.branches import Branches, Branching, agreement, carry_out, watched
from pipeline.graph.kept import Kept
from tests.worlds import scripted_set


class Brightness(Judge):
    """Takes a frame's brightness for success, half of it for progress; clips that begin dark it leaves."""

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score."""
        bright = frames.float().mean((-4, -3, -2, -1)) / 255
        status = torch.where(bright[:, 0] > 0, Status.OK.value, Status.ABSTAIN.value)
        return Judgement(bright, bright / 2, status)


def shown(*chunks: list[int]) -> Tensor:
    """One episode's chunks of frames of these grey levels, uint8 [D, 1, K, 1, 3, 2, 2]."""
    grey = torch.tensor(chunks, dtype=torch.uint8)[:, None, :, None, None, None, None]
    return grey.expand(-1, -1, -1, 1, 3, 2, 2)


@pytest.mark.parametrize(
    ("chunks", "progress"),
    [
        (([51, 204, 204, 51], [102] * 4), [1.0, 1.0]),  # over before the chunk ends
        (([51, 51, 51, 204], [204, 51, 51, 102]), [0.4, 1.0]),  # from one chunk into the next
        (([51, 204, 51, 204], [51, 204, 51, 51]), [0.4, 0.1]),  # never two in a row
        (([51] * 4, [0, 204, 204, 204], [51] * 4), [0.1, 0.1, 0.1]),
        (([0, 204, 204, 204], [51, 51, 51, 102]), [0.25, 0.2]),
    ],
)
def test_true_frames_are_judged_by_the_rule_of_imagined_ones(
    chunks: tuple[list[int], ...], progress: list[float]
) -> None:
    judge, frames, first = Brightness(hold=2), shown(*chunks), shown([0])[0, :, 0]
    found = watched(judge, frames, first, ["do"], torch.tensor([0.25]))
    assert found.squeeze(-1).tolist() == pytest.approx(progress)
    rule, won = JudgeReward(judge, Rewards(progress=1.0, success=1.0)), False
    rule._run, rule._begun = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    rule._progress = torch.tensor([[0.25]])
    for chunk, value in zip(frames, progress, strict=True):
        after = TensorDict({"truncated": torch.zeros(1, 1, dtype=torch.bool)}, [1])
        rule._decide(ask(judge, chunk, first, ["do"]), after)
        won = won or bool(after[SUCCESS])
        assert (1.0 if won else float(after[PROGRESS])) == pytest.approx(value)


@pytest.mark.long
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
    policy = build_policy(cfg)
    physics = build_physics(cfg, 4, record=True)
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
            frames, outcome = carry_out(physics, actor, points, which, chunks)
    finally:
        physics.close()
    recorded = [bool(store.episodes[int(number)]["success"]) for number in points.episode[which]]
    assert outcome.bool().tolist() == recorded == [True, True, False]
    assert depth == 4
    for number, track in enumerate(tracks):
        last = len(track) - 1
        made = frames[:, number].flatten(0, 1).float()
        errors = [
            float((made - torch.from_numpy(np.stack(true))).abs().mean())
            for shift in (0, 1)
            if (true := [track.rows["frames"][min(5 + shift + k, last)] for k in range(len(made))])
        ]
        assert errors[0] < 0.01 < 1 < errors[1]  # the frames of the same times, and of the next


def test_futures_are_imagined_and_carried_out(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", "task.size=[32,32]", "judge=learned"])
    store = open_clips(cfg, [scripted_set(cfg, tmp_path / "set", 2)])
    simulator, judge = build_simulator(cfg).eval(), build_judge(cfg).eval()
    points = DecisionPoints(store, torch.arange(2))
    decoder = build_state_decoder(cfg, simulator)
    world = build_world(cfg, simulator, decoder, judge, points, 4, horizon=2 * int(cfg["task"]["chunk"]))
    physics = build_physics(cfg, 4, record=True)
    try:
        actor = SafePolicyWrapper(build_policy(cfg), physics.spec, physics.mode)
        branching = Branching(world, physics, actor, judge, 0, Kept(tmp_path / "trust"), {})
        found = branching.branches(torch.tensor([0, 3, 1]), 2)
    finally:
        physics.close()
    assert found.imagined.shape == found.seen.shape == (2, 3, 2) and found.outcome.shape == (3, 2)
    for part in (found.imagined, found.seen):
        assert bool(((part >= 0) & (part <= 1)).all())
    assert len(agreement(found)) == 2


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
