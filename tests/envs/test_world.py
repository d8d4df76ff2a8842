"""Learned worlds: determinism in any slot, partial resets, specs with and without transforms, judges and
rewards.
"""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs.episodes.clips import ClipSpec, ClipStore
from envs.judges import LearnedJudge, RuleJudge
from envs.judges.base import Verdict, frame_labels
from envs.simulators.replay import replay
from envs.simulators.state_experts.head import StateHead
from envs.simulators.unet.engine import UNetConfig, UNetSimulator
from envs.specs import CHUNK, COMMAND, EPISODE, IMAGE, JUDGE_STATUS, PROGRESS, STATE, SUCCESS, Rewards, Status
from envs.transforms import world_transforms
from envs.world import InitialStates, WorldEnv

VIEWS = ("head", "hand_left", "hand_right")


def world(
    simulator: UNetSimulator,
    store: ClipStore,
    batch: int,
    judge: LearnedJudge | None = None,
    horizon: int = 12,
) -> TransformedEnv:
    torch.manual_seed(1)
    decoder = StateHead(simulator.feature_shape[0], 4).eval()
    base = WorldEnv(simulator, InitialStates.of(store), batch, horizon, bf16=False)
    return TransformedEnv(base, world_transforms(decoder, judge or LearnedJudge().eval(), Rewards(), VIEWS))


def play(env: TransformedEnv, seeds: list[int], steps: int = 2) -> torch.Tensor:
    env.base_env.schedule(seeds)
    td = env.reset()
    for _ in range(steps):
        chunk = torch.sin(td[EPISODE].float()[..., None] + torch.arange(56).reshape(4, 14)) * 0.01
        td[CHUNK] = chunk
        td = env.step(td)["next"]
    return td


def test_specs_hold(simulator: UNetSimulator, store: ClipStore) -> None:
    check_env_specs(WorldEnv(simulator, InitialStates.of(store), 2, 8, bf16=False))
    env = world(simulator, store, 2, horizon=8)
    check_env_specs(env)
    assert sorted(map(str, env.action_keys)) == ["('vla_action', 'chunk')"]


def test_an_episode_is_the_same_in_any_slot_and_batch(simulator: UNetSimulator, store: ClipStore) -> None:
    wide, narrow = play(world(simulator, store, 3), [5, 2, 7]), play(world(simulator, store, 1), [2])
    again = play(world(simulator, store, 3), [7, 5, 2])
    assert torch.equal(wide[IMAGE], again[IMAGE][[1, 2, 0]])
    assert torch.equal(wide[STATE], again[STATE][[1, 2, 0]])
    # other batch sizes may round otherwise
    assert (wide[IMAGE][1].int() - narrow[IMAGE][0].int()).abs().max() <= 1


def test_partial_reset_touches_only_its_slots(simulator: UNetSimulator, store: ClipStore) -> None:
    env = world(simulator, store, 2)
    env.base_env.schedule([0, 1, 6])
    td = env.reset()
    td[CHUNK] = torch.zeros(2, 4, 14)
    after = env.step(td)["next"]
    after["_reset"] = torch.tensor([[False], [True]])
    fresh = env.reset(after.clone())
    assert fresh[EPISODE].flatten().tolist() == [0, 6]
    assert torch.equal(fresh[IMAGE][0], after[IMAGE][0])
    assert torch.equal(fresh[IMAGE][1], store.frames(store.start[6]))
    assert env.base_env.session["length"].tolist() == [5, 1]


def test_policy_sees_the_decoded_state(simulator: UNetSimulator, store: ClipStore) -> None:
    env = world(simulator, store, 1)
    with torch.no_grad():
        env.transform[1].decoder.layers[-1].bias.fill_(0.5)
    first = store.arrays["states"][store.start[0]]
    td = play(env, [0], 1)
    assert not torch.allclose(td[STATE][0], first) and bool(td[STATE].any())
    assert torch.equal(env.base_env.session["history", "states"][0, 4], td[STATE][0])


def test_commands_accumulate_and_horizon_truncates(simulator: UNetSimulator, store: ClipStore) -> None:
    env = world(simulator, store, 1, Fixed(0.1), horizon=8)
    env.base_env.schedule([3])
    td = env.reset()
    begin = td[COMMAND].clone()
    for step in range(2):
        td[CHUNK] = torch.full((1, 4, 14), 0.01)
        td = env.step(td)["next"]
        assert torch.allclose(td[COMMAND], begin + 0.01 * (step + 1), atol=1e-5)
    assert bool(td["truncated"]) and bool(td["done"]) and not bool(td["terminated"])


class Fixed(LearnedJudge):
    """A judge whose verdicts are given, to test what becomes of them."""

    def __init__(self, success: float, status: Status = Status.OK):
        super().__init__()
        self.value, self.said = success, status

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        tokens: torch.Tensor,
        objects: torch.Tensor | None = None,
    ) -> Verdict:
        batch, count = frames.shape[:2]
        filled = torch.full((batch, count), self.value)
        return Verdict(filled, filled, torch.full((batch,), self.said.value))


def test_success_ends_the_episode_and_pays(simulator: UNetSimulator, store: ClipStore) -> None:
    td = play(world(simulator, store, 2, Fixed(0.9)), [0, 1], 1)
    assert (
        bool(td[SUCCESS].all())
        and bool(td["terminated"].all())
        and torch.allclose(td["reward"], torch.ones(2, 1))
    )


def test_a_judges_error_is_no_zero_reward(simulator: UNetSimulator, store: ClipStore) -> None:
    td = play(world(simulator, store, 1, Fixed(0.9, Status.ERROR)), [0], 1)
    assert int(td[JUDGE_STATUS]) == Status.ERROR.value and bool(td["done"]) and not bool(td[SUCCESS])


def test_success_streak_crosses_chunks(simulator: UNetSimulator) -> None:
    judge = LearnedJudge(hold=4)
    done, run = judge.streak(torch.tensor([[0.1, 0.9, 0.9]]), torch.tensor([3]))
    assert done.tolist() == [[False, False, False]] and run.tolist() == [2]
    done, _ = judge.streak(torch.tensor([[0.9, 0.9, 0.1]]), run)
    assert done.tolist() == [[False, True, False]]


def test_judge_compares_with_the_episodes_own_first_frame(simulator: UNetSimulator, store: ClipStore) -> None:
    seen = []

    class Watching(Fixed):
        def score(
            self,
            frames: torch.Tensor,
            first: torch.Tensor,
            tokens: torch.Tensor,
            objects: torch.Tensor | None = None,
        ) -> Verdict:
            seen.append(first)
            return super().score(frames, first, tokens, objects)

    env = world(simulator, store, 2, Watching(0.1))
    play(env, [3, 1], 2)
    assert torch.equal(seen[-1], env.base_env.starts.image[[3, 1]])


def test_frame_labels_begin_where_the_hold_begins() -> None:
    success = torch.tensor([[0, 0, 0, 0, 0, 0, 1.0]])
    assert frame_labels(success, 4).tolist() == [[0, 0, 0, 1, 1, 1, 1]]


def test_rule_judge_agrees_with_physics(store: ClipStore) -> None:
    judge = RuleJudge()
    rows = store.start[0] + torch.arange(int(store.length[0]))
    objects = store.arrays["objects"][rows][None]
    verdict = judge.score(
        store.frames(rows)[None], store.frames(rows[:1]), torch.zeros(1, 12, dtype=torch.int64), objects
    )
    assert torch.allclose(verdict.progress[0], store.arrays["progress"][rows], atol=1e-4)
    assert (
        bool(judge.episode(verdict.success, torch.ones_like(verdict.success).bool()))
        == store.episodes[0]["success"]
    )
    with pytest.raises(ValueError, match="judge=learned"):
        judge.score(store.frames(rows)[None], store.frames(rows[:1]), torch.zeros(1, 12, dtype=torch.int64))


def test_replay_covers_every_frame(simulator: UNetSimulator, store: ClipStore) -> None:
    made = replay(simulator, store, torch.tensor([0, 3]), bf16=False)
    assert made.valid.sum(1).tolist() == (store.length[[0, 3]] - 1).tolist()
    assert torch.equal(made.rows[0][made.valid[0]], store.start[0] + torch.arange(1, int(store.length[0])))


def test_training_on_own_predictions_uses_them(simulator: UNetSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([1, 2]), torch.tensor([0, 0]), ClipSpec(4, 4, 2))
    loss, figures = simulator.loss(clip, torch.Generator())
    true = clip.clone()
    true["memory", "frames"][:, 1] = 0  # the second chunk must not look at true frames it could not have seen
    true["memory", "frames"][:, 1, 0] = clip["memory", "frames"][:, 1, 0]
    again, _ = simulator.loss(true, torch.Generator())
    assert torch.equal(loss, again) and float(figures["last_chunk"]) > 0


def test_wrong_number_of_views_is_named() -> None:
    from envs.simulators.base import WorldShape

    with pytest.raises(ValueError, match=r"simulator\.shrink"):
        UNetSimulator(WorldShape(views=2), UNetConfig())


def test_progress_is_in_the_observation(simulator: UNetSimulator, store: ClipStore) -> None:
    td = world(simulator, store, 2).reset()
    assert td[PROGRESS].shape == (2, 1) and bool((td[PROGRESS] > 0).all())
