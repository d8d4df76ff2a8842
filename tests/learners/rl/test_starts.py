"""Where episodes of RL begin, and which of them meet the same noise."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from actors.fleets.fleet import LocalFleet
from actors.rollouts.host import Host, Job
from envs.initial_states import shared_out
from envs.physics.toy_tracking import ToyTrackingEnv
from envs.specs import EPISODE
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from pipeline.config import load_config
from pipeline.stages.rl import starts_of
from tests.learners.rl.test_algorithms import algorithm_of, policy_of, settings

GROUP = 4


class Noting(LocalFleet):
    """A fleet that notes which episodes it is asked for."""

    def __init__(self, host: Host):
        super().__init__(host)
        self.asked: list[list[int]] = []

    def submit(self, job: Job) -> None:
        self.asked.append(list(job.seeds))
        super().submit(job)


def asked_for(starts: Starts, folder: Path) -> list[list[int]]:
    """Episode seeds [iterations, envs] of GRPO in a world with 7 starts."""
    env = ToyTrackingEnv(2 * GROUP, actions=1, tolerance=0.15, starts=7)
    policy, replica = policy_of("chunk_gaussian", env.spec), policy_of("chunk_gaussian", env.spec)
    fleet = Noting(Host(env, replica, bootstrap=False))
    algorithm = algorithm_of("grpo", policy, env.spec, group=GROUP)
    train_rl(fleet, policy, algorithm, settings(envs=2 * GROUP), folder, starts)
    return fleet.asked


@pytest.mark.parametrize(
    "pool", [range(7), shared_out(range(4), range(4, 7), 0.5)], ids=["plain", "with extra starts"]
)
def test_groups_meet_noise_of_their_own_only_where_it_is_not_shared(pool: list[int], tmp_path: Path) -> None:
    shared, own = (asked_for(Starts(pool, count), tmp_path / str(count)) for count in (0, 7))
    for alike, apart in zip(shared, own, strict=True):
        assert [seed % 7 for seed in apart] == alike  # the same starts
        assert all(len(set(alike[n : n + GROUP])) == 1 for n in (0, GROUP))
    assert len({seed for seeds in own for seed in seeds}) == 2 * 2 * GROUP  # no noise twice


def test_the_config_says_whether_noise_is_shared() -> None:
    for words, count in (([], 0), (["simulator.shared_noise=false"], 7)):
        cfg = load_config(words)
        share = cfg["extra_starts"]["share"]
        assert starts_of(cfg, 7, range(7), 0) == Starts(range(7), count)
        assert starts_of(cfg, 4, [0, 2], 3) == Starts(shared_out([0, 2], range(4, 7), share), count)


def test_a_group_that_was_torn_apart_is_found() -> None:
    def rollout(seeds: list[int]) -> TensorDict:
        return TensorDict({EPISODE: torch.tensor(seeds)[:, None, None]}, [len(seeds), 1])

    Starts(range(5), 5).check_groups(rollout([1, 6, 2, 17]), 2)
    Starts([40, 50]).check_groups(rollout([40, 40, 50, 50]), 2)
    for starts in (Starts(range(5), 5), Starts(range(5))):
        with pytest.raises(AssertionError, match="different starts"):
            starts.check_groups(rollout([1, 1, 2, 3]), 2)


def test_what_goes_on_after_early_endings_begins_where_episodes_may() -> None:
    env = ToyTrackingEnv(2, actions=1, tolerance=0.15, starts=100)
    env.schedule([3, 7, 11])
    begun = [env.reset()[EPISODE].flatten().tolist() for _ in range(4)]
    assert begun == [[3, 7], [11, 3], [7, 11], [3, 7]]
