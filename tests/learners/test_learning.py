"""Training resumes exactly; algorithms compute what they say; alarms ring."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from actors.fleets.fleet import FleetError, LocalFleet
from actors.policies.chunk_gaussian import ChunkGaussian, ChunkGaussianHead, knot_basis
from actors.policies.chunk_tokens import ChunkTokenHead
from actors.policies.vla import VISUAL_FEATURES, ChunkPolicy
from actors.rollouts.host import Host, seen_next
from envs.episodes.clips import ClipStore
from envs.judges import LearnedJudge
from envs.physics.env import PhysicsEnv
from envs.physics.tabletop.bench import BenchConfig
from envs.physics.toy_tracking import ToyTrackingEnv
from envs.specs import CHUNK, EPISODE, IMAGE, JUDGE_STATUS, LOG_PROB, STATE, SUCCESS, TOKENS, Status
from learners.rl.alarms import Alarms
from learners.rl.algorithm import RLConfig, first_episode, judged
from learners.rl.filtered_bc import FilteredBC, FilteredBCConfig
from learners.rl.grpo import GRPO, GRPOConfig
from learners.rl.loop import train_rl
from learners.rl.ppo import PPO, PPOConfig
from learners.stages.imitation import train_imitation
from learners.stages.judge import calibrate
from learners.training.fit import FitConfig, TrainingDiverged, fit


class Stop(Exception):
    """Stands for a power failure."""


def run_fit(folder: Path, stop_at: int | None = None) -> list[float]:
    torch.manual_seed(0)
    model = nn.Linear(4, 1)

    def batch(step: int, generator: torch.Generator) -> torch.Tensor:
        if step == stop_at:
            raise Stop
        return torch.randn(8, 4, generator=generator)

    def loss(data: torch.Tensor, generator: torch.Generator) -> tuple[torch.Tensor, dict[str, Any]]:
        noise = torch.randn(8, 1, generator=generator)
        return (model(data) - data.sum(1, keepdim=True) + 0.1 * noise).square().mean(), {}

    options = FitConfig(steps=20, batch=8, lr=1e-2, checkpoint_every=6, bf16=False)
    try:
        fit("toy", model, batch, loss, options, folder)
    except Stop:
        return []
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [row["toy/loss"] for row in rows] + model.weight.flatten().tolist()


def test_killed_and_resumed_training_equals_the_uninterrupted(tmp_path: Path) -> None:
    whole = run_fit(tmp_path / "whole")
    run_fit(tmp_path / "cut", stop_at=15)
    assert (tmp_path / "cut/checkpoint-000000012").exists()
    assert run_fit(tmp_path / "cut") == whole
    assert len(whole) == 24


def test_divergence_stops_with_advice(tmp_path: Path) -> None:
    model = nn.Linear(1, 1)
    with pytest.raises(TrainingDiverged, match=r"toy\.lr"):
        fit(
            "toy",
            model,
            lambda s, g: torch.ones(1, 1),
            lambda d, g: (model(d).sum() * float("nan"), {}),
            FitConfig(steps=2, bf16=False),
            tmp_path,
        )


def small_policy() -> ChunkPolicy:
    torch.manual_seed(0)
    return ChunkPolicy(3, partial(ChunkGaussianHead, chunk=4, std=0.4), width=32, points=4)


def test_chunk_gaussian_is_smooth_and_its_density_consistent() -> None:
    gain = torch.tensor([1.0, 0.0, 2.0])
    dist = ChunkGaussian(
        torch.zeros(5, 2, 3),
        torch.full((5, 2, 3), 0.5),
        knot_basis(4, 2),
        gain,
        torch.tensor([0.0, 7.0, 0.0]),
    )
    chunk = dist.sample()
    assert chunk.shape == (5, 4, 3) and bool((chunk[..., 1] == 7.0).all())
    assert torch.allclose(chunk[:, 0, 0] * 2, chunk[:, 1, 0], atol=1e-6)  # linear from rest to the first knot
    knots = torch.stack((chunk[:, 1], chunk[:, 3]), 1)[..., [0, 2]] / gain[[0, 2]]
    expected = torch.distributions.Normal(0.0, 0.5).log_prob(knots).sum((-2, -1))
    assert torch.allclose(dist.log_prob(chunk), expected, atol=1e-4)


def test_policy_writes_what_it_later_scores() -> None:
    policy = small_policy()
    policy.head.gain.data[2] = 0.0
    td = TensorDict(
        {
            IMAGE: torch.randint(0, 255, (6, 3, 3, 64, 64), dtype=torch.uint8),
            STATE: torch.randn(6, 16),
            TOKENS: torch.randint(0, 99, (6, 12)),
        },
        [6],
    )
    out = policy(td.clone())
    assert out[CHUNK].shape == (6, 4, 14)
    assert torch.allclose(policy.get_dist(td.clone()).log_prob(out[CHUNK]), out[LOG_PROB], atol=1e-3)


def test_first_episode_and_judged_mask() -> None:
    done = torch.tensor([[False, True, False, True], [False, False, False, True]])
    assert first_episode(done).tolist() == [[True, True, False, False], [True] * 4]
    status = torch.full((2, 4, 1), Status.OK.value)
    status[0, 3] = Status.ERROR.value
    batch = TensorDict(
        {"next": TensorDict({JUDGE_STATUS: status, "done": done.unsqueeze(-1)}, [2, 4])}, [2, 4]
    )
    assert judged(batch).tolist() == [[True, True, False, False], [True] * 4]


@pytest.mark.parametrize(
    "head",
    [partial(ChunkTokenHead, chunk=4, bins=8, actions=2), partial(ChunkGaussianHead, chunk=4, actions=2)],
)
def test_episodes_with_nan_are_dropped_and_counted_until_they_are_too_many(tmp_path: Path, head: Any) -> None:
    torch.manual_seed(0)
    policy = ChunkPolicy(1, head, width=16, points=4, states=4, channels=16)
    share = 0.0

    def spoil(module: nn.Module, given: Any, said: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        first = said[0].clone()
        if not torch.is_grad_enabled():  # while acting, not while learning
            first[: int(share * len(first))] = float("nan")
        return (first, *said[1:])

    policy.head.register_forward_hook(spoil)
    config = RLConfig(iterations=1, envs=8, minibatch=16, epochs=1, max_dropped=0.4)
    for share, dropped in ((0.25, 2), (1.0, 8)):
        fleet = LocalFleet(Host(ToyTrackingEnv(8, starts=4), policy, bootstrap=False))
        folder = tmp_path / str(share)
        if dropped == 2:
            stats = train_rl(fleet, policy, GRPO(policy, GRPOConfig(group=4)), config, folder, starts=4)
            assert stats["ledger"]["dropped"] == {"NaN actions": 2} and stats["ledger"]["learned"] == 6
            assert all(bool(p.isfinite().all()) for p in policy.parameters())
        else:
            with pytest.raises(FleetError, match="NaN"):
                train_rl(
                    fleet,
                    policy,
                    GRPO(policy, GRPOConfig(group=4)),
                    RLConfig(**{**asdict(config), "max_dropped": 0.04}),
                    folder,
                    starts=4,
                )


def rollout(rewards: list[list[float]], policy: ChunkPolicy) -> TensorDict:
    """A rollout [B, T] of whole episodes with given rewards, from one start."""
    reward = torch.tensor(rewards).unsqueeze(-1)
    size = reward.shape[:2]
    done = torch.zeros(*size, 1, dtype=torch.bool)
    done[:, -1] = True
    obs = {
        IMAGE: torch.randint(0, 255, (*size, 3, 3, 64, 64), dtype=torch.uint8),
        STATE: torch.randn(*size, 16),
        TOKENS: torch.zeros(*size, 12, dtype=torch.int64),
    }
    td = TensorDict({**obs, EPISODE: torch.arange(size[0]).reshape(-1, 1, 1).expand(*size, 1) * 5}, size)
    with torch.no_grad():
        td = policy(td)
    td["next"] = TensorDict(
        {
            **obs,
            "reward": reward,
            "done": done,
            "terminated": done,
            "truncated": torch.zeros_like(done),
            SUCCESS: (reward > 0.5) & done,
        },
        size,
    )
    td["next", VISUAL_FEATURES] = seen_next(td, policy.perception)
    return td


def test_grpo_compares_within_groups_and_drops_equal_ones() -> None:
    policy = small_policy()
    algorithm = GRPO(policy, GRPOConfig(group=2, normalise=False, shaped=False))
    seeds = algorithm.seeds(5, 4, torch.Generator().manual_seed(0))
    assert seeds[0] % 5 == seeds[1] % 5 and seeds[0] != seeds[1]
    data, figures = algorithm.prepare(rollout([[0.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]], policy))
    assert figures["groups_dropped"] == 0.5
    assert data["advantage"].flatten().tolist() == [0.5, 0.5, -0.5, -0.5]
    with pytest.raises(ValueError, match=r"algorithm\.group"):
        algorithm.seeds(5, 3, torch.Generator())


@pytest.mark.parametrize("name", ["ppo", "grpo"])
def test_update_makes_better_chunks_likelier(name: str) -> None:
    policy = small_policy()
    algorithm = PPO(policy, PPOConfig()) if name == "ppo" else GRPO(policy, GRPOConfig(group=4, kl=0.01))
    batch = rollout([[1.0, 1.0]] * 4 + [[0.0, 0.0]] * 4, policy)
    if name == "grpo":
        batch = rollout([[1.0, 1.0], [0.0, 0.0]] * 4, policy)
    data, _ = algorithm.prepare(batch)
    optimiser = torch.optim.Adam(algorithm.groups(1e-3))
    for _ in range(10):
        loss, _ = algorithm.loss(data)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    new = policy.get_dist(data.clone(False)).log_prob(data[CHUNK]) - data[LOG_PROB]
    good = data["advantage"].flatten() > data["advantage"].mean()
    assert float(new[good].mean()) > float(new[~good].mean())


def test_frozen_perception_is_neither_trained_nor_run_again() -> None:
    policy = small_policy()
    policy.freeze_perception()
    algorithm = PPO(policy, PPOConfig())
    data, _ = algorithm.prepare(rollout([[1.0, 1.0]] * 4 + [[0.0, 0.0]] * 4, policy))
    assert IMAGE not in data.keys(True, True)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    optimiser = torch.optim.Adam(algorithm.groups(1e-2))
    loss, _ = algorithm.loss(data)
    loss.backward()
    optimiser.step()
    changed = {name for name, value in policy.state_dict().items() if not torch.equal(value, before[name])}
    assert changed and not any(name.startswith("module.0.") for name in changed)


def test_threshold_is_where_success_is_as_likely_as_failure() -> None:
    draw = torch.Generator().manual_seed(0)
    judge = LearnedJudge(hold=2)
    best = torch.rand(4000, generator=draw)
    frames = torch.zeros(4000, 8)
    frames[:, 3], frames[:, 5:] = 0.99, best[:, None]  # one bright frame alone is no success
    likely = torch.sigmoid(2 * (torch.logit(best) - torch.logit(torch.tensor(0.7))))
    succeeded = torch.rand(4000, generator=draw) < likely
    assert calibrate(judge, frames, succeeded)
    assert abs(float(judge.threshold) - 0.7) < 0.02
    # A handful that scores part without fail: somewhere between them.
    assert calibrate(judge, frames[best.argsort()][::400], torch.arange(10) >= 6)
    assert 0.5 < float(judge.threshold) < 0.65


def test_threshold_stays_where_scores_tell_nothing() -> None:
    judge = LearnedJudge(hold=2)
    frames = torch.linspace(0.1, 0.9, 20)[:, None].expand(20, 8)
    before = float(judge.threshold)
    for succeeded in (torch.zeros(20).bool(), torch.ones(20).bool(), torch.arange(20) < 10):
        assert not calibrate(judge, frames, succeeded)
        assert float(judge.threshold) == before


def test_filtered_bc_keeps_successes_only() -> None:
    policy = small_policy()
    algorithm = FilteredBC(policy, FilteredBCConfig())
    data, figures = algorithm.prepare(rollout([[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]], policy))
    assert figures["episodes_kept"] == 2.0 and len(data) == 4
    loss, _ = algorithm.loss(data)
    loss.backward()
    assert policy.head.log_std.grad is None or not bool(policy.head.log_std.grad.any())


def test_alarms() -> None:
    alarms = Alarms(patience=2)
    for iteration in range(2):
        alarms.check({"reward_std": 0.0, "kl": 0.0, "entropy": 1.0}, iteration)
    alarms.check({"reward_std": 1.0, "kl": 3.0, "entropy": -50.0}, 3)
    assert [text.split(" at ")[0] for text in alarms.raised] == [
        "no reward variance",
        "exploding KL",
        "collapsed entropy",
    ]
    with pytest.raises(TrainingDiverged, match="kl"):
        alarms.check({"reward_std": 1.0, "kl": float("nan")}, 4)


def test_imitation_sets_units_and_learns(store: ClipStore, tmp_path: Path) -> None:
    policy = small_policy()
    train_imitation(
        policy, store, torch.tensor([0, 4]), FitConfig(steps=40, batch=16, lr=3e-3, bf16=False), tmp_path
    )
    rows = [
        json.loads(line)["imitation/loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()
    ]
    assert sum(rows[-5:]) < 0.7 * sum(rows[:5])
    gain = policy.head.gain
    # heights, angles and grippers never move
    assert bool((gain[[2, 3, 4, 5, 6]] == 0).all()) and bool((gain > 0).any())


def rl_run(folder: Path, iterations: int, grouped: bool = False) -> list[dict[str, float]]:
    policy = small_policy()
    fleet = LocalFleet(
        Host(PhysicsEnv(BenchConfig(), batch=2, chunk=4, horizon=8, workers=1), small_policy())
    )
    settings = RLConfig(
        iterations=iterations, envs=4, shards=2, epochs=1, minibatch=8, checkpoint_every=1, lr=1e-3
    )
    algorithm = GRPO(policy, GRPOConfig(group=2)) if grouped else PPO(policy, PPOConfig())
    stats = train_rl(fleet, policy, algorithm, settings, folder, seed_pool=range(100))
    fleet.close()
    assert stats["ledger"]["learned"] == stats["ledger"]["asked"]
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if "/time/" not in k} for row in rows]


def test_groups_of_real_rollouts_share_their_start(tmp_path: Path) -> None:
    assert len(rl_run(tmp_path, 2, grouped=True)) == 2  # GRPO itself refuses groups of different starts


def test_killed_and_resumed_rl_equals_the_uninterrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = rl_run(tmp_path / "whole", 3)
    import learners.rl.loop as module

    original, calls = module.update, []

    def failing(*args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            raise Stop
        return original(*args)

    monkeypatch.setattr(module, "update", failing)
    with pytest.raises(Stop):
        rl_run(tmp_path / "cut", 3)
    monkeypatch.setattr(module, "update", original)
    assert rl_run(tmp_path / "cut", 3) == whole
