"""Recorded episodes as rollouts, and what critics learn from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, Judgement
from envs.specs import IMAGE, Rewards, Status
from envs.targets import build
from learners.rl.recorded.rollout import dataset_rollout
from tests.embodiments import ARM_DELTAS, ARM_JOINTS
from tests.sampling import every
from tests.sections import section

Stores = Callable[[Embodiment], ClipStore]


def _policy(store: ClipStore, name: str = "chunk_gaussian", **changes: Any) -> Any:
    torch.manual_seed(0)
    return build(section(f"policy/{name}", "absolute", **changes), "policy", spec=store.spec)


class Bright(Judge):
    """Progress is how bright a picture is; of pictures brighter than `blind` it knows nothing."""

    def __init__(self, blind: float = 2.0):
        super().__init__(1)
        self.blind = blind

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        instruction: list[str],
        features: torch.Tensor | None = None,
    ) -> Judgement:
        assert len(instruction) == len(first) == len(frames)
        progress = frames.float().mean((2, 3, 4, 5)) / 255
        bad = (progress > self.blind).any(1)
        status = torch.where(bad, Status.ABSTAIN.value, Status.OK.value)
        return Judgement(progress, torch.where(bad[:, None], torch.nan, progress), status)


class ByFeatures(Bright):
    """Progress is what the features of a frame's chunk say."""

    reads_features = True

    def __init__(self, chunk: int):
        super().__init__()
        self.chunk = chunk

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        instruction: list[str],
        features: torch.Tensor | None = None,
    ) -> Judgement:
        assert features is not None
        progress = features[..., 0].repeat_interleave(self.chunk, 1)[:, : frames.shape[1]]
        return Judgement(progress, progress, torch.zeros(len(frames), dtype=torch.int64))


def _ends(store: ClipStore, episodes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The last frame of each episode, and whether it was a success."""
    last = store.start[episodes] + store.length[episodes] - 1
    return last, store.arrays["success"][last] > 0.5


def _total(rollout: Any) -> torch.Tensor:
    return (rollout["next", "reward"].squeeze(-1) * rollout["valid"]).sum(1)


def _brightness(store: ClipStore, rows: torch.Tensor) -> torch.Tensor:
    return store.frames(rows).float().mean((1, 2, 3, 4)) / 255


@pytest.mark.parametrize("robot", [ARM_DELTAS, ARM_JOINTS], ids=lambda robot: robot.robot)
def test_recorded_rewards_add_up_to_progress_and_success(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    chunk = store.spec.chunk
    episodes = store.arrays["labelled"].nonzero().flatten()
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(2.0, 1.0), Bright())
    assert rollout["valid"].sum(1).tolist() == [
        -(-(int(length) - 1) // chunk) for length in store.length[episodes]
    ]
    last, won = _ends(store, episodes)
    assert bool(won.any()) and not bool(won.all())
    begun, ended = _brightness(store, store.start[episodes]), _brightness(store, last)
    expected = torch.where(won, 2.0 * (1.0 - begun) + 1.0, 2.0 * (ended - begun))
    assert torch.allclose(_total(rollout), expected, atol=1e-5)
    ends = (rollout["valid"] & rollout["next", "done"].squeeze(-1)).sum(1)
    assert ends.tolist() == [1] * len(episodes)
    told = (rollout["next", "terminated"].squeeze(-1) & rollout["valid"]).any(1)
    assert torch.equal(told, won)


def test_what_a_decision_is_measured_against_knows_nothing_of_what_it_leads_to(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    episodes = store.arrays["labelled"].nonzero().flatten()
    _, won = _ends(store, episodes)
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(2.0, 1.0), Bright())
    flipped = tiny_store(ARM_DELTAS)
    flipped.arrays = {**flipped.arrays, "success": torch.zeros_like(flipped.arrays["success"])}
    other = dataset_rollout(_policy(store), flipped, episodes, Rewards(2.0, 1.0), Bright())
    before_the_end = rollout["valid"] & ~rollout["next", "done"].squeeze(-1)
    assert bool(won.any()) and bool(before_the_end.any())
    same = rollout["next", "reward"].squeeze(-1) == other["next", "reward"].squeeze(-1)
    assert bool(same[before_the_end].all())


@pytest.mark.parametrize(("progress", "judge"), [(2.0, None), (0.0, Bright(-1.0))])
def test_without_a_judge_of_progress_success_alone_is_paid(
    tiny_store: Stores, progress: float, judge: Judge | None
) -> None:
    store = tiny_store(ARM_DELTAS)
    episodes = store.arrays["labelled"].nonzero().flatten()
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(progress, 1.0), judge)
    assert torch.equal(_total(rollout), _ends(store, episodes)[1].float())


def test_where_a_judge_knows_nothing_progress_stays_what_it_was(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    episodes = store.arrays["labelled"].nonzero().flatten()
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(2.0, 1.0), Bright(-1.0))
    assert torch.equal(_total(rollout), 3.0 * _ends(store, episodes)[1].float())
    store = tiny_store(ARM_DELTAS)  # of the last frames there is no picture
    last, won = _ends(store, episodes)
    store.arrays = {**store.arrays, "present": store.arrays["present"].clone()}
    store.arrays["present"][last] = False
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(2.0, 1.0), Bright())
    at_end = (rollout["valid"] & rollout["next", "done"].squeeze(-1)).nonzero()
    ending = rollout["next", "reward"].squeeze(-1)[at_end[:, 0], at_end[:, 1]]
    assert bool((ending[~won] == 0).all()) and bool((ending[won] > 1).all())


def test_a_judge_that_reads_features_is_asked_of_whole_chunks(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    episodes = store.arrays["labelled"].nonzero().flatten()
    chunks = -(-(int(store.length[episodes].max()) - 1) // store.spec.chunk)
    features = torch.arange(1 + chunks).float().expand(len(episodes), -1)[..., None] / 10
    judge = ByFeatures(store.spec.chunk)
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(1.0, 0.0), judge, features)
    _, won = _ends(store, episodes)
    steps = rollout["valid"].sum(1)
    assert torch.allclose(_total(rollout), torch.where(won, 1.0, steps / 10))


@pytest.mark.parametrize("name", every(2, ["chunk_gaussian", "tiny_vla"]))
def test_a_warmed_up_critic_explains_returns(tiny_store: Stores, name: str) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = _policy(store, name)
    rollout = dataset_rollout(
        policy, store, store.arrays["labelled"].nonzero().flatten(), Rewards(1.0, 1.0), Bright()
    )
    assert (IMAGE in rollout.keys(True, True)) == (name == "tiny_vla")  # features stand for pictures
    explained = []
    for passes in (1, 30):
        torch.manual_seed(0)
        ppo = build(
            section("algorithm/ppo", warmup_passes=passes), "algorithm", policy=policy, spec=store.spec
        )
        explained.append(ppo.warm_up(rollout, 0, minibatch=16)[1])
    assert explained[1] > max(0.5, explained[0])
