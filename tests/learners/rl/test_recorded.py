"""True decisions beside imagined ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.policies.contract import (
    VISUAL_FEATURES,
    distribution,
    freeze_perception,
    inputs_for,
    trained_part,
)
from actors.rollouts.host import Weights
from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.specs import C2W, CHUNK, COMMAND, IMAGE, INTRINSIC, LOG_PROB, STATE, ActionMode, Rewards
from learners.rl.algorithm import Algorithm
from learners.rl.loop import train_rl
from learners.rl.recorded.decisions import RecordedDecisions, TrueExperience
from learners.rl.recorded.rollout import dataset_rollout
from learners.rl.starts import Starts
from learners.rl.update import update
from learners.rl.watch import Watch
from learners.stages.imitation import chunks_ahead
from learners.stages.observed import observe
from learners.training.parallel import Trainee
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES
from tests.learners.models import policy_of
from tests.learners.rl.test_algorithms import algorithm_of, settings

Stores = Callable[[Embodiment], ClipStore]
KEYS = ("advantage", "value_target", "state_value")


def known(store: ClipStore, policy: TensorDictModuleBase) -> tuple[Algorithm, RecordedDecisions]:
    """PPO whose critic has seen all labelled episodes, and their decisions."""
    ppo = algorithm_of("ppo", policy, store.spec)
    rollout = dataset_rollout(policy, store, _labelled(store), Rewards(1.0, 1.0))
    rollout, _ = ppo.warm_up(rollout, 0)  # type: ignore[attr-defined]
    return ppo, RecordedDecisions(policy, store, rollout, ActionMode.ABSOLUTE)


def _labelled(store: ClipStore) -> torch.Tensor:
    return store.arrays["labelled"].nonzero().flatten()


def like(policy: TensorDictModuleBase, algorithm: Any) -> TensorDict:
    """The keys that transitions of an iteration have."""
    keys = {*policy.in_keys, *algorithm.critic.in_keys, CHUNK, LOG_PROB, *KEYS}
    return TensorDict({key: torch.zeros(1, 1) for key in keys}, [1])


@pytest.mark.parametrize("robot", [ARM_DELTAS, BIMANUAL_POSES], ids=lambda robot: robot.robot)
def test_frames_are_seen_as_they_were_recorded(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    rows = store.start[3] + torch.tensor([0, 2])
    seen = observe(store, rows)
    assert torch.equal(seen[STATE], store.arrays["states"][rows])
    assert torch.equal(seen[COMMAND], store.arrays["commands"][rows])
    assert torch.equal(seen[IMAGE], store.frames(rows))
    assert (C2W in seen.keys(True, True)) == (INTRINSIC in seen.keys(True, True)) == robot.calibrated


def test_whole_chunks_that_the_policy_might_have_said(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    with torch.no_grad():
        for value in trained(policy):
            value.fill_(-2.0)  # as wide as the recorded chunks differ from its mode
    _, every = known(store, policy)
    ends = store.start + store.length - 1
    last = ends[torch.searchsorted(store.start, every.known["row"], right=True) - 1]
    assert len(every) and bool((every.known["row"] + store.spec.chunk <= last).all())
    with torch.no_grad():
        for value in trained(policy):
            value.fill_(-4.0)  # a policy this sure would hardly have said any of them
    assert len(known(store, policy)[1]) < len(every)


def trained(policy: TensorDictModuleBase) -> list[torch.Tensor]:
    """The log of the policy's spread."""
    return [value for name, value in policy.named_parameters() if name.endswith("log_std")]


def test_a_sample_repeats_itself_and_is_scored_by_the_policy_that_rl_began_with(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    state = torch.get_rng_state()
    ppo, decisions = known(store, policy)
    keys = like(policy, ppo)
    one = decisions.sample(6, keys, torch.Generator().manual_seed(3))
    assert set(one.keys(True, True)) == set(keys.keys(True, True))
    expected = distribution(policy, inputs_for(one, policy)).log_prob(one[CHUNK])
    assert torch.allclose(one[LOG_PROB], expected, atol=1e-4)
    with torch.no_grad():
        for value in trained(policy):
            value.sub_(0.3)
    assert bool((decisions.sample(6, keys, torch.Generator().manual_seed(3)) == one).all())
    torch.set_rng_state(state)
    again = known(store, policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE))[1]
    assert bool((again.known[LOG_PROB] == decisions.known[LOG_PROB]).all())  # so a resumed run goes on alike


def test_a_bad_decision_pushes_the_policy_away_only_so_far(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    ppo, decisions = known(store, policy)
    bad = decisions.sample(8, like(policy, ppo), torch.Generator().manual_seed(3))
    bad["advantage"] = -1.0 - torch.rand(8, 1, generator=torch.Generator().manual_seed(4))
    ppo.objective.normalize_advantage = False  # type: ignore[attr-defined]
    optimiser = torch.optim.SGD(policy.parameters(), lr=1e-3)
    for _ in range(300):
        optimiser.zero_grad()
        ppo.loss(bad)[0].backward()
        optimiser.step()
    ratio = (distribution(policy, inputs_for(bad, policy)).log_prob(bad[CHUNK]) - bad[LOG_PROB]).exp()
    assert 0.5 < float(ratio.detach().mean()) < 0.85  # PPO clips at .8


def test_with_frozen_perception_features_stand_for_pictures(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    whole, _ = (known(store, policy)[1], freeze_perception(policy))
    ppo, decisions = known(store, policy)
    keys = like(trained_part(policy), ppo)
    assert VISUAL_FEATURES in keys.keys(True, True) and IMAGE not in keys.keys(True, True)
    some = decisions.sample(4, keys, torch.Generator().manual_seed(3))
    assert len(decisions) == len(whole) and set(some.keys(True, True)) == set(keys.keys(True, True))


def test_chunks_are_the_recorded_commands(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    _, decisions = known(store, policy)
    rows = decisions.known["row"]
    assert torch.equal(decisions.known[CHUNK], chunks_ahead(store, rows, ActionMode.ABSOLUTE))


def test_policies_scored_on_tokens_are_refused(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = policy_of("tiny_vla", store.spec, ActionMode.ABSOLUTE)
    with pytest.raises(ValueError, match="tokens"):
        known(store, policy)


@pytest.mark.parametrize("imagined", [0.0, 1.0])
def test_updates_learn_from_both_and_without_imagination_from_true_ones_alone(
    tiny_store: Stores, tmp_path: Path, imagined: float
) -> None:
    store = tiny_store(ARM_DELTAS)

    def learned(count: int, flip: float) -> tuple[torch.Tensor, dict[str, float]]:
        policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
        ppo, decisions = known(store, policy)
        batch = dataset_rollout(policy, store, _labelled(store), Rewards(1.0, 1.0))
        batch["next", "reward"] *= flip
        rows = batch["row"].flatten()
        batch[IMAGE] = store.frames(rows).unflatten(0, batch.shape)
        batch.update(observe(store, rows, pictures=False).reshape(batch.shape))
        batch[CHUNK] = chunks_ahead(store, rows, ActionMode.ABSOLUTE).unflatten(0, batch.shape)
        with torch.no_grad():
            seen = distribution(policy, inputs_for(batch.flatten(0, 1), policy))
            batch[LOG_PROB] = seen.log_prob(batch[CHUNK].flatten(0, 1)).reshape(batch.shape)
        batch["next", "success"] = batch["next", "terminated"]
        optimiser = torch.optim.Adam(ppo.groups(1e-3))
        config = settings(recorded=count, imagined=imagined, epochs=1)
        figures = update(
            batch, ppo, Trainee(ppo.modules()), optimiser, config, 0, TrueExperience(None, decisions)
        )
        return torch.nn.utils.parameters_to_vector(policy.parameters()).detach(), figures

    with_true, figures = learned(16, 1.0)
    assert "recorded_clip_fraction" in figures
    without, figures = learned(0, 1.0)
    assert "recorded_clip_fraction" not in figures
    assert not torch.equal(with_true, without)
    other, _ = learned(16, -1.0)  # imagined rewards turned round
    assert torch.equal(with_true, other) == (imagined == 0.0)


class Stop(Exception):
    """A learner that dies."""


def stopping(iteration: int, weights: Weights) -> tuple[dict[str, float], bool]:
    raise Stop


def test_without_a_rollout_recorded_decisions_alone_are_learned_from(
    tiny_store: Stores, tmp_path: Path
) -> None:
    store = tiny_store(ARM_DELTAS)

    def learned(name: str, killed: bool = False) -> tuple[torch.Tensor, dict[str, Any]]:
        policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
        ppo, decisions = known(store, policy)
        true = TrueExperience(None, decisions, alone=40)
        plan = settings(recorded=16, imagined=0.0, epochs=2, minibatch=20, iterations=3, checkpoint_every=1)
        if killed:
            with pytest.raises(Stop):
                watch = Watch(2, stopping)
                train_rl(None, policy, ppo, plan, tmp_path / name, Starts(range(4)), true=true, watch=watch)
            return learned(name)
        stats = train_rl(None, policy, ppo, plan, tmp_path / name, Starts(range(4)), true=true)
        return torch.nn.utils.parameters_to_vector(policy.parameters()).detach(), stats

    policy = policy_of("chunk_gaussian", store.spec, ActionMode.ABSOLUTE)
    before = torch.nn.utils.parameters_to_vector(policy.parameters()).detach()
    after, stats = learned("one")
    assert not torch.equal(before, after)
    assert stats["ledger"]["requested"] == stats["episodes"] == 0 and not stats["alarms"]
    last = stats["last"]
    assert last["planned_updates"] == 4 and last["transitions"] == 40 and last["kl"] != 0.0
    resumed, _ = learned("two", killed=True)
    assert torch.equal(after, resumed)
