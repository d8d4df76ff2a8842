"""Conformance: what every algorithm that configs offer does, with every policy that they offer."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.fleets.fleet import FleetError, LocalFleet
from actors.policies.contract import action_key, distribution, freeze_perception, trained_part
from actors.policies.safe import SafePolicyWrapper
from actors.rollouts.host import Host, Job, Weights
from envs.physics.toy_tracking import ToyTrackingEnv
from envs.specs import (
    EPISODE,
    IMAGE,
    INSTRUCTION_UTF8,
    JUDGE_STATUS,
    LOG_PROB,
    SUCCESS,
    ActionMode,
    Status,
    WorldSpec,
)
from envs.targets import build, options
from learners.rl.algorithm import Algorithm, RLConfig
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from learners.rl.watch import Watch
from tests.embodiments import ARM_DELTAS, observations, world_spec
from tests.sampling import every
from tests.sections import offered, section

RL = {
    **{
        "iterations": 2,
        "envs": 8,
        "shards": 1,
        "threads": 2,
        "schedule": "sync",
        "max_policy_lag": 2,
        "queue": 8,
    },
    **{"max_dropped": 0.05, "epochs": 2, "minibatch": 16, "microbatches": 1, "lr": 1e-3, "clip": 1.0},
    **{
        "kl_stop": 10.0,
        "imagined": 1.0,
        "recorded": 0,
        "anchor": 0.0,
        "recorded_rounds": None,
        "anchor_batch": 8,
        "rewards_later": False,
    },
    **{"starts": "first", "horizon": None, "freeze_perception": False, "checkpoint_every": 5, "seed": 0},
    **{"evaluate_every": 0, "evaluate_episodes": 1},
}
POLICIES = [name for name in offered("policy") if name != "openpi"]  # that one needs a server
SMALL = {"chunk_gaussian": {"width": 32}, "chunk_tokens": {"width": 32, "head": {"bins": 8}}}
CHANGES: dict[str, dict[str, Any]] = {"grpo": {"group": 4}}


def toy(envs: int) -> ToyTrackingEnv:
    """A task that policies which have learned nothing solve now and then."""
    return ToyTrackingEnv(envs, actions=1, tolerance=0.15, starts=4)


def settings(**changes: Any) -> RLConfig:
    """Options of the loop at smoke size."""
    return options(RLConfig, {**RL, **changes}, "rl")


def policy_of(name: str, spec: WorldSpec) -> TensorDictModuleBase:
    torch.manual_seed(0)
    chosen = section(f"policy/{name}", "absolute", **SMALL.get(name, {}))
    policy: TensorDictModuleBase = build(chosen, "policy", spec=spec)
    return policy


def algorithm_of(name: str, policy: TensorDictModuleBase, spec: WorldSpec, **changes: Any) -> Algorithm:
    torch.manual_seed(1)
    chosen = section(f"algorithm/{name}", **{**CHANGES.get(name, {}), **changes})
    algorithm: Algorithm = build(chosen, "algorithm", policy=policy, spec=spec)
    return algorithm


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Figures of a run, without those that no two runs share."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if "/time/" not in k} for row in rows]


@pytest.mark.parametrize(("name", "policy_name"), every(4, product(offered("algorithm"), POLICIES)))
def test_trains_every_policy_and_repeats_itself(name: str, policy_name: str, tmp_path: Path) -> None:
    runs = []
    for number in range(2):
        env = toy(8)
        policy, replica = policy_of(policy_name, env.spec), policy_of(policy_name, env.spec)
        before = {key: value.clone() for key, value in policy.named_parameters()}
        algorithm = algorithm_of(name, policy, env.spec)
        fleet = LocalFleet(Host(env, replica, algorithm.bootstraps))
        folder = tmp_path / str(number)
        stats = train_rl(fleet, policy, algorithm, settings(), folder, Starts(range(4)))
        fleet.close()
        assert stats["ledger"]["learned"] == stats["ledger"]["requested"] == 16
        assert stats["last"]["updates"] > 0
        assert any(not torch.equal(value, before[key]) for key, value in policy.named_parameters())
        assert all(bool(value.isfinite().all()) for value in policy.parameters())
        runs.append((rows_of(folder), {key: value.clone() for key, value in policy.state_dict().items()}))
    assert runs[0][0] == runs[1][0]
    assert all(torch.equal(value, runs[1][1][key]) for key, value in runs[0][1].items())


def rollout(policy: TensorDictModuleBase, spec: WorldSpec, rewards: list[list[float]]) -> TensorDict:
    """A rollout [B, T] of whole episodes with given rewards, from equal starts."""
    reward = torch.tensor(rewards).unsqueeze(-1)
    size = reward.shape[:2]
    torch.manual_seed(2)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        actor = SafePolicyWrapper(policy, spec, ActionMode.ABSOLUTE)
        td = torch.stack([actor(observations(spec, size[0], seed=step)) for step in range(size[1])], 1)
    done = torch.zeros(*size, 1, dtype=torch.bool)
    done[:, -1] = True
    td[EPISODE] = (torch.arange(size[0]) * 5).reshape(-1, 1, 1).expand(*size, 1)
    td["next"] = td.exclude("vla_action").clone()
    td["next"].update({"reward": reward, "done": done, "terminated": done, SUCCESS: (reward > 0.5) & done})
    return td


def learn(algorithm: Algorithm, data: TensorDict, steps: int = 40) -> list[float]:
    """Losses of some steps on one batch."""
    optimiser = torch.optim.Adam(algorithm.groups(3e-3))
    losses = []
    for _ in range(steps):
        loss, _ = algorithm.loss(data)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return losses


@pytest.mark.parametrize(("name", "policy_name"), every(4, product(offered("algorithm"), POLICIES)))
def test_loss_falls_and_good_chunks_get_likelier(name: str, policy_name: str) -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of(policy_name, spec)
    algorithm = algorithm_of(name, policy, spec)
    # PPO's second half is worse; GRPO compares neighbours.
    rewards = [[1.0, 1.0]] * 4 + [[0.0, 0.0]] * 4 if name == "ppo" else [[1.0, 1.0], [0.0, 0.0]] * 4
    batch = rollout(policy, spec, rewards)
    data, _ = algorithm.prepare(batch)
    losses = learn(algorithm, data)
    assert losses[-1] < losses[0]
    with torch.no_grad():
        part = trained_part(policy)
        new = distribution(part, batch.flatten()).log_prob(batch[action_key(policy)].flatten(0, 1))
    gain = new - batch[LOG_PROB].flatten()
    good = torch.tensor(rewards).flatten() > 0.5
    assert float(gain[good].mean()) > float(gain[~good].mean())


def test_grpo_compares_within_groups_and_drops_equal_ones() -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", spec)
    algorithm = algorithm_of("grpo", policy, spec, group=2, normalise=False, shaped=False)
    seeds = algorithm.seeds(5, 4, torch.Generator().manual_seed(0))
    assert seeds[0] == seeds[1] and seeds[2] == seeds[3]
    rewards = [[0.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]
    data, figures = algorithm.prepare(rollout(policy, spec, rewards))
    assert figures["groups_dropped"] == 0.5
    assert data["advantage"].flatten().tolist() == [0.5, 0.5, -0.5, -0.5]
    with pytest.raises(ValueError, match=r"algorithm\.group"):
        algorithm.seeds(5, 3, torch.Generator())


def test_grpo_drops_groups_whose_living_are_alike() -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", spec)
    algorithm = algorithm_of("grpo", policy, spec, group=4, shaped=False)
    data = rollout(policy, spec, [[0.0, 1.0]] * 4 + [[0.0, 1.0]] + [[0.0, 0.0]] * 3)
    status = torch.zeros(8, 2, 1, dtype=torch.int64)
    status[0, 1] = Status.ERROR.value  # whose return counts for nothing
    data["next", JUDGE_STATUS] = status
    transitions, figures = algorithm.prepare(data)
    assert figures["groups_dropped"] == 0.5 and len(transitions) == 8
    assert bool(transitions["advantage"].abs().min() > 0)


def test_grpo_compares_whole_returns_also_with_episodes_that_have_ended() -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", spec)
    algorithm = algorithm_of("grpo", policy, spec, group=2, normalise=False, shaped=False)
    batch = rollout(policy, spec, [[1.0, 0.0], [0.0, 0.2]])
    batch["next", "done"][0, 0] = True  # what its slot does after that belongs to no group
    data, figures = algorithm.prepare(batch)
    assert data["advantage"].flatten().tolist() == pytest.approx([0.4, -0.4, -0.4])
    assert figures["groups_dropped"] == 0.0


def test_grpo_stays_near_the_policy_it_began_with() -> None:
    spec = world_spec(ARM_DELTAS)
    distances = []
    for weight in (1e-6, 10.0):
        policy = policy_of("chunk_gaussian", spec)
        algorithm = algorithm_of("grpo", policy, spec, kl=weight)
        data, _ = algorithm.prepare(rollout(policy, spec, [[1.0, 1.0], [0.0, 0.0]] * 4))
        learn(algorithm, data, 15)
        distances.append(algorithm.loss(data)[1]["kl_start"])
    assert 0 < distances[1] < distances[0]


def test_filtered_bc_keeps_successes_and_the_spread() -> None:
    spec = world_spec(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", spec)
    algorithm = algorithm_of("filtered_bc", policy, spec)
    data, figures = algorithm.prepare(rollout(policy, spec, [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]))
    assert figures["episodes_kept"] == 2.0 and len(data) == 4
    algorithm.loss(data)[0].backward()
    assert policy.head.log_std.grad is None or not bool(policy.head.log_std.grad.any())


@pytest.mark.parametrize("name", ["ppo", "grpo"])
def test_with_frozen_perception_no_picture_is_carried_or_encoded_again(name: str, tmp_path: Path) -> None:
    env = toy(8)
    policy, replica = policy_of("chunk_tokens", env.spec), policy_of("chunk_tokens", env.spec)
    freeze_perception(policy), freeze_perception(replica)
    before = {key: value.clone() for key, value in policy.named_parameters()}
    host = Host(env, replica, bootstrap=name == "ppo")
    batch = host.run(Job(0, tuple(range(8)), 0))
    assert IMAGE not in batch.keys(True, True) and ("next", *IMAGE) not in batch.keys(True, True)
    encoded: list[int] = []
    policy.perception.register_forward_hook(lambda *_: encoded.append(1))
    algorithm = algorithm_of(name, policy, env.spec)
    train_rl(LocalFleet(host), policy, algorithm, settings(), tmp_path, Starts(range(4)))
    assert not encoded
    changed = {key for key, value in policy.named_parameters() if not torch.equal(value, before[key])}
    assert changed and not any(key.startswith("module.0.") for key in changed)


@pytest.mark.long
def test_looking_at_a_policy_changes_nothing_that_it_learns(tmp_path: Path) -> None:
    looked: list[int] = []

    def look(iteration: int, weights: Weights) -> tuple[dict[str, float], bool]:
        looked.append(iteration)
        torch.rand(3)
        return {"true_success": float(iteration)}, iteration == 3

    rows = {}
    for name, watch in (("blind", None), ("watched", Watch(2, look))):
        env = toy(8)
        policy, replica = policy_of("chunk_gaussian", env.spec), policy_of("chunk_gaussian", env.spec)
        algorithm = algorithm_of("ppo", policy, env.spec)
        fleet, plan = LocalFleet(Host(env, replica)), settings(iterations=5)
        train_rl(fleet, policy, algorithm, plan, tmp_path / name, Starts(range(4)), watch=watch)
        rows[name] = rows_of(tmp_path / name)
    assert looked == [1, 3] and len(rows["watched"]) == 4  # enough after the second look
    assert [row.pop("rl/true_success", None) for row in rows["watched"]] == [None, 1.0, None, 3.0]
    assert rows["watched"] == rows["blind"][:4]


def test_end_to_end_pictures_travel_and_the_encoder_learns(tmp_path: Path) -> None:
    env = toy(8)
    policy, replica = policy_of("chunk_tokens", env.spec), policy_of("chunk_tokens", env.spec)
    host = Host(env, replica)
    batch = host.run(Job(0, tuple(range(8)), 0))
    assert IMAGE in batch.keys(True, True) and INSTRUCTION_UTF8 in batch.keys(True, True)
    assert ("next", *IMAGE) not in batch.keys(True, True)  # critics read features
    before = policy.perception.views.stem.weight.clone()
    train_rl(
        LocalFleet(host),
        policy,
        algorithm_of("ppo", policy, env.spec),
        settings(),
        tmp_path,
        Starts(range(4)),
    )
    assert not torch.equal(policy.perception.views.stem.weight, before)


def test_next_features_are_those_of_the_next_observation(monkeypatch: pytest.MonkeyPatch) -> None:
    env = ToyTrackingEnv(4, starts=4, actions=1, tolerance=0.5, success_steps=1)  # ends come often
    policy = policy_of("chunk_gaussian", env.spec)
    host = Host(env, policy)
    seen: list[torch.Tensor] = []
    step = ToyTrackingEnv._step

    def spying(self: ToyTrackingEnv, td: TensorDict) -> TensorDict:
        out = step(self, td)
        with torch.no_grad():
            seen.append(policy.perception(*(out[key] for key in policy.perception.in_keys)))
        return out

    monkeypatch.setattr(ToyTrackingEnv, "_step", spying)
    batch = host.run(Job(0, (0, 1, 2, 3), 0))
    assert bool(batch["next", "done"][:, :-1].any()) and not bool(batch["next", "done"].all())
    assert torch.allclose(batch["next", "policy", "visual_features"], torch.stack(seen, 1), atol=1e-5)


@pytest.mark.parametrize("policy_name", ["chunk_gaussian", "chunk_tokens"])
def test_episodes_with_nan_are_dropped_and_counted_until_they_are_too_many(
    policy_name: str, tmp_path: Path
) -> None:
    env = toy(8)
    policy = policy_of(policy_name, env.spec)
    share = 0.0

    def spoil(module: nn.Module, given: Any, said: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        first = said[0].clone()
        if not torch.is_grad_enabled():  # while acting, not while learning
            first[: int(share * len(first))] = float("nan")
        return (first, *said[1:])

    policy.head.register_forward_hook(spoil)
    for part, dropped in ((0.25, 2), (1.0, 8)):
        share = part
        fleet = LocalFleet(Host(toy(8), policy, bootstrap=False))
        algorithm = algorithm_of("grpo", policy, env.spec)
        limit = settings(iterations=1, epochs=1, max_dropped=0.4 if dropped == 2 else 0.04)
        if dropped == 2:
            stats = train_rl(fleet, policy, algorithm, limit, tmp_path / "few", Starts(range(4)))
            assert stats["ledger"]["dropped"] == {"NaN actions": 2} and stats["ledger"]["learned"] == 6
            assert all(bool(p.isfinite().all()) for p in policy.parameters())
        else:
            with pytest.raises(FleetError, match=r"the last: a policy that says NaN$"):
                train_rl(fleet, policy, algorithm, limit, tmp_path / "all", Starts(range(4)))


class Stop(Exception):
    """Stands for a power failure."""


@pytest.mark.parametrize(
    ("name", "policy_name"),
    every(4, [("ppo", "chunk_tokens"), *((name, "chunk_gaussian") for name in offered("algorithm"))]),
)
def test_killed_and_resumed_rl_equals_the_uninterrupted(
    name: str, policy_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(folder: Path) -> tuple[list[dict[str, Any]], dict[str, torch.Tensor]]:
        env = toy(4)
        policy, replica = policy_of(policy_name, env.spec), policy_of(policy_name, env.spec)
        algorithm = algorithm_of(name, policy, env.spec)
        fleet = LocalFleet(Host(env, replica, algorithm.bootstraps))
        plan = settings(iterations=3, shards=2, checkpoint_every=1)
        stats = train_rl(fleet, policy, algorithm, plan, folder, Starts(range(4)))
        fleet.close()
        assert stats["ledger"]["learned"] == stats["ledger"]["requested"] == 24
        return rows_of(folder), {
            key: value.clone() for key, value in algorithm.modules().state_dict().items()
        }

    rows, weights = run(tmp_path / "whole")
    import learners.rl.loop as module

    original, calls = module.update, []

    def failing(*args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            raise Stop
        return original(*args)

    monkeypatch.setattr(module, "update", failing)
    with pytest.raises(Stop):
        run(tmp_path / "cut")
    monkeypatch.setattr(module, "update", original)
    resumed_rows, resumed = run(tmp_path / "cut")
    assert resumed_rows == rows and resumed.keys() == weights.keys()
    assert [key for key, value in resumed.items() if not torch.equal(value, weights[key])] == []
    before = algorithm_of(name, policy_of(policy_name, toy(4).spec), toy(4).spec).modules().state_dict()
    assert any(not torch.equal(value, before[key]) for key, value in weights.items())  # it did learn


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("policy_name", POLICIES)
@pytest.mark.parametrize("name", offered("algorithm"))
def test_trains_on_a_gpu_in_a_world_on_the_cpu(name: str, policy_name: str, tmp_path: Path) -> None:
    env = toy(8)
    policy, replica = policy_of(policy_name, env.spec).cuda(), policy_of(policy_name, env.spec).cuda()
    algorithm = algorithm_of(name, policy, env.spec)
    fleet = LocalFleet(Host(env, replica, algorithm.bootstraps))
    stats = train_rl(fleet, policy, algorithm, settings(), tmp_path, Starts(range(4)))
    assert stats["ledger"]["learned"] == 16 and stats["last"]["updates"] > 0
