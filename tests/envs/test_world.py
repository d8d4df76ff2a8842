"""Imagined environments of any robot: specs, determinism in any slot, partial resets, states and rewards."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs.initial_states import InitialStates
from envs.judges.base import Judge, Judgement
from envs.specs import (
    CHUNK,
    COMMAND,
    EPISODE,
    IMAGE,
    INSTRUCTION_UTF8,
    JUDGE_STATUS,
    PROGRESS,
    STATE,
    SUCCESS,
    ActionMode,
    Rewards,
    Status,
    bytes_to_text,
)
from envs.transforms import world_transforms
from envs.world import WorldEnv
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, EMBODIMENTS, world_spec
from tests.envs.simulators.clips import clip, first_of
from tests.envs.simulators.test_engines import build_engine

STARTS = 8


class Reader(Judge):
    """A judge that reads features and notes them."""

    reads_features = True

    def __init__(self) -> None:
        super().__init__(hold=1)
        self.read: list[torch.Tensor] = []

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        instruction: list[str],
        features: torch.Tensor | None = None,
    ) -> Judgement:
        assert features is not None
        self.read.append(features)
        nothing = torch.zeros(frames.shape[:2])
        return Judgement(nothing, nothing, torch.zeros(len(frames), dtype=torch.int64))


class Fixed(Judge):
    """A judge whose judgements are given, to test what becomes of them; it notes what it was shown."""

    def __init__(self, success: float, status: Status = Status.OK, hold: int = 1):
        super().__init__(hold)
        self.value, self.said = success, status
        self.shown: list[torch.Tensor] = []
        self.asked: list[list[str]] = []

    def score(self, frames: torch.Tensor, first: torch.Tensor, instruction: list[str]) -> Judgement:
        self.shown.append(first)
        self.asked.append(list(instruction))
        filled = torch.full(frames.shape[:2], self.value)
        return Judgement(filled, filled, torch.full(frames.shape[:1], self.said.value))


class Charging(Fixed):
    """The same, and what episodes of task 3 show is a success; each clip costs, if it `charges`."""

    def __init__(self, charges: bool):
        super().__init__(0.1)
        self.charges = charges

    def score(self, frames: torch.Tensor, first: torch.Tensor, instruction: list[str]) -> Judgement:
        said = super().score(frames, first, instruction)
        won = torch.tensor([text == "do task 3" for text in instruction])[:, None]
        return Judgement(torch.where(won, 0.9, said.success), said.progress, said.status)


def world(
    name: str, batch: int, judge: Judge | None = None, horizon: int = 12, progress: float = 1.0
) -> TransformedEnv:
    spec = world_spec(EMBODIMENTS[name])
    simulator, decoder = build_engine("unet_small", spec)
    first = first_of(spec, clip(spec, STARTS, simulator.memory_frames))
    starts = InitialStates(first, [f"do task {k}" for k in range(STARTS)])
    mode = ActionMode.ABSOLUTE if spec.embodiment.delta else ActionMode.RELATIVE
    base = WorldEnv(simulator, starts, batch, horizon, mode, shared_noise=False, bf16=False)
    return TransformedEnv(base, world_transforms(spec, decoder, judge or Fixed(0.1), Rewards(progress, 1.0)))


def play(env: TransformedEnv, seeds: list[int], steps: int = 2) -> torch.Tensor:
    env.base_env.schedule(seeds)
    td = env.reset()
    shape = env.action_spec["vla_action", "chunk"].shape[1:]
    for _ in range(steps):
        wave = torch.arange(shape.numel()).reshape(shape)
        td[CHUNK] = torch.sin(td[EPISODE].float()[..., None] + wave) * 0.1
        td = env.step(td)["next"]
    return td


ROBOTS = [
    name for name in sorted(EMBODIMENTS) if name != "two_arms_joints"
]  # whose kinematics these tests lack


@pytest.mark.parametrize("name", sorted(EMBODIMENTS))
def test_specs_hold(name: str) -> None:
    env = world(name, 2, horizon=8)
    check_env_specs(env.base_env)
    check_env_specs(env)
    assert sorted(map(str, env.action_keys)) == ["('vla_action', 'chunk')"]


@pytest.mark.parametrize("name", ROBOTS)
def test_an_episode_is_the_same_in_any_slot_and_batch(name: str) -> None:
    wide, narrow = play(world(name, 3), [5, 2, 7]), play(world(name, 1), [2])
    again = play(world(name, 3), [7, 5, 2])
    assert torch.equal(wide[IMAGE], again[IMAGE][[1, 2, 0]])
    assert torch.equal(wide[STATE], again[STATE][[1, 2, 0]])
    # Other batch sizes may round otherwise.
    assert (wide[IMAGE][1].int() - narrow[IMAGE][0].int()).abs().max() <= 1


def test_partial_reset_touches_only_its_slots() -> None:
    env = world("two_arms_poses", 2)
    env.base_env.schedule([0, 1, 6])
    td = env.reset()
    td[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
    after = env.step(td)["next"]
    after["_reset"] = torch.tensor([[False], [True]])
    begun = env.reset(after.clone())
    assert begun[EPISODE].flatten().tolist() == [0, 6]
    assert bytes_to_text(begun[INSTRUCTION_UTF8]) == ["do task 0", "do task 6"]
    assert torch.equal(begun[IMAGE][0], after[IMAGE][0])
    assert torch.equal(begun[IMAGE][1], env.base_env.starts.first["frames"][6])
    assert env.base_env.session["length"].tolist() == [5, 1]


def test_policies_see_the_decoded_state() -> None:
    env = world("one_arm_joints", 1)
    first = env.base_env.starts.first["state"][0]
    td = play(env, [0], 1)
    assert not torch.allclose(td[STATE][0], first) and bool(td[STATE].any())
    assert torch.equal(env.base_env.session["history", "states"][0, 4], td[STATE][0])


def test_relative_chunks_accumulate_deltas_do_not_and_the_horizon_truncates() -> None:
    for robot, grows in ((BIMANUAL_POSES, True), (ARM_DELTAS, False)):
        env = world(robot.robot, 1, horizon=8)
        env.base_env.schedule([3])
        td = env.reset()
        begin = td[COMMAND].clone()
        for step in range(2):
            td[CHUNK] = torch.full_like(env.action_spec.zero()[CHUNK], 0.01)
            td = env.step(td)["next"]
            wanted = begin + 0.01 * (step + 1) if grows else torch.full_like(begin, 0.01)
            assert torch.allclose(td[COMMAND], wanted, atol=1e-5)
        assert bool(td["truncated"]) and bool(td["done"]) and not bool(td["terminated"])


def test_success_ends_the_episode_and_pays() -> None:
    td = play(world("two_arms_poses", 2, Fixed(0.9)), [0, 1], 1)
    assert bool(td[SUCCESS].all()) and bool(td["terminated"].all())
    assert torch.allclose(td["reward"], torch.full((2, 1), 1.1))  # from .9 to 1, and the bonus
    assert torch.equal(td[PROGRESS], torch.ones(2, 1))


def test_a_judges_error_is_no_zero_reward() -> None:
    td = play(world("two_arms_poses", 1, Fixed(0.9, Status.ERROR)), [0], 1)
    assert int(td[JUDGE_STATUS]) == Status.ERROR.value and bool(td["done"]) and not bool(td[SUCCESS])


def test_the_judge_hears_the_words_and_sees_the_episodes_own_first_frame() -> None:
    judge = Fixed(0.1)
    env = world("one_arm_deltas", 2, judge)
    play(env, [3, 1], 2)
    assert torch.equal(judge.shown[-1], env.base_env.starts.first["frames"][[3, 1]])
    assert judge.asked[-1] == ["do task 3", "do task 1"]


@pytest.mark.parametrize("name", ROBOTS)
def test_a_judge_that_reads_features_is_given_those_of_the_chunk_and_before_it_of_holding_still(
    name: str,
) -> None:
    judge = Reader()
    env = world(name, 2, judge)
    env.base_env.schedule([3, 1])
    td = env.reset()
    robot, command = env.base_env.spec.embodiment, td[COMMAND]
    still = torch.zeros_like(env.action_spec.zero()[CHUNK])
    if robot.delta:
        grippers = list(robot.grippers)
        still[..., grippers] = command[:, None, grippers]
    td[CHUNK] = still
    session = env.base_env.session.clone()
    td = env.step(td)["next"]
    if not env.base_env.spec.pose_map:  # the pose maps of these starts are made up
        assert torch.allclose(judge.read[1], judge.read[0], atol=1e-4)  # a chunk that holds still, again
    td[CHUNK] = still + 0.3
    env.step(td)
    assert judge.read[2].shape == (2, 1, *env.base_env.simulator.feature_shape)
    assert not torch.allclose(judge.read[2], judge.read[1], atol=1e-3)
    assert torch.equal(session["length"], torch.ones(2, dtype=torch.int64))  # asking changes no session


def test_episodes_from_a_beginning_that_nobody_could_judge_are_dropped() -> None:
    judge = Fixed(0.1, Status.ABSTAIN)
    env = world("one_arm_deltas", 2, judge)
    env.base_env.schedule([0, 1])
    td = env.reset()
    judge.said = Status.OK
    td[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
    after = env.step(td)["next"]
    assert after[JUDGE_STATUS].flatten().tolist() == [Status.ABSTAIN.value] * 2 and bool(after["done"].all())


def test_nobody_is_asked_how_far_a_beginning_is_where_progress_is_worth_nothing() -> None:
    judge = Fixed(0.9, Status.ABSTAIN)
    env = world("one_arm_deltas", 2, judge, progress=0.0)
    env.base_env.schedule([0, 1])
    assert not bool(env.reset()[PROGRESS].any()) and not judge.asked
    judge.said = Status.OK
    after = play(env, [0, 1], 1)
    assert torch.allclose(after["reward"], torch.ones(2, 1)) and len(judge.asked) == 1


def test_success_must_hold_across_chunks() -> None:
    judge = Fixed(0.9, hold=6)
    env = world("one_arm_deltas", 1, judge)
    assert not bool(play(env, [0], 1)[SUCCESS]) and bool(play(env, [0], 2)[SUCCESS])


def test_a_judge_that_charges_is_not_asked_about_episodes_that_have_succeeded() -> None:
    asked, found = [], []
    for charges in (True, False):
        judge = Charging(charges)
        env = world("one_arm_deltas", 3, judge, progress=0.0)
        env.base_env.schedule([3, 1, 11, 2])
        now, won = env.reset(), torch.zeros(3, dtype=torch.bool)
        for _ in range(2):
            now[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
            now = env.step(now)["next"]
            won |= now[SUCCESS].squeeze(-1)
        found.append((won, now[PROGRESS][1], now[JUDGE_STATUS]))
        now["_reset"] = torch.tensor([[True], [False], [False]])
        now = env.reset(now.clone())
        now[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
        assert env.step(now)["next", SUCCESS].flatten().tolist() == [False, False, True]
        play(env, [3, 11, 3], 2)
        asked.append([[int(text[-1]) for text in texts] for texts in judge.asked])
    assert asked[0] == [[3, 1, 3], [1], [2, 1], [3, 3, 3]]
    assert asked[1] == [[3, 1, 3], [3, 1, 3], [2, 1, 3], [3, 3, 3], [3, 3, 3]]
    assert found[0][0].tolist() == [True, False, True]
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_initial_states_of_other_views_are_refused() -> None:
    spec, other = world_spec(ARM_DELTAS), world_spec(BIMANUAL_POSES)
    simulator, _ = build_engine("unet_small", spec)
    first = first_of(other, clip(other, 2, simulator.memory_frames))
    with pytest.raises(ValueError, match="train it on these views"):
        starts = InitialStates(first, ["a", "b"])
        WorldEnv(simulator, starts, 1, 8, ActionMode.ABSOLUTE, shared_noise=False, bf16=False)
