"""Generated frames lie beside the recorded ones that the same actions led to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.replay import future_of, replay
from envs.specs import WorldSpec
from envs.targets import ConfigError
from learners.stages.generated import generated_frames
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES
from tests.learners.models import decoder_of, simulator_of

Stores = Callable[[Embodiment], ClipStore]


def test_every_frame_but_the_first_has_its_recorded_one(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    some = torch.tensor([3, 1])
    made = generated_frames(simulator_of("unet_small", store.spec), store, some, bf16=False)
    count = int(store.length[3]) - 1
    assert len(made) == count + int(store.length[1]) - 1
    assert made["frames"].shape[1:] == (3, 3, *store.spec.size) and made["frames"].dtype == torch.uint8
    assert torch.equal(made["row"][:count], int(store.start[3]) + torch.arange(1, count + 1))
    assert made["episode"][:count].tolist() == [3] * count and made["episode"][count:].unique().tolist() == [
        1
    ]


def test_frames_without_a_picture_and_no_episodes_at_all_are_left_out(tiny_store: Stores) -> None:
    store = tiny_store(ARM_JOINTS)
    simulator = simulator_of("unet_small", store.spec)
    present = store.arrays["present"].clone()
    store.arrays["present"][int(store.start[2]) + 5] = False
    made = generated_frames(simulator, store, torch.tensor([2]), bf16=False)
    store.arrays["present"] = present
    assert len(made) == int(store.length[2]) - 2 and int(store.start[2]) + 5 not in made["row"].tolist()
    none = generated_frames(simulator, store, torch.zeros(0, dtype=torch.int64), bf16=False)
    assert len(none) == 0 and none["frames"].shape[1:] == made["frames"].shape[1:]


def test_frames_may_go_on_from_true_ones_again(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    simulator, some, chunk = simulator_of("unet_small", store.spec), torch.tensor([3, 1]), store.spec.chunk
    for parameter in simulator.parameters():  # an untrained one repeats its last frame
        torch.nn.init.normal_(parameter, std=0.2, generator=torch.Generator().manual_seed(0))
    whole = replay(simulator, store, some, bf16=False)
    skipping = replay(simulator, store, some, bf16=False, stride=2)
    assert torch.equal(skipping.rows[:, 0], store.start[some] + 2)
    assert 2 * (skipping.rows.shape[1] - store.spec.chunk) < whole.rows.shape[1]
    short = replay(simulator, store, some, bf16=False, alone=1)
    assert torch.equal(whole.rows, short.rows)
    assert torch.equal(whole.frames[:, :chunk], short.frames[:, :chunk])
    assert not torch.equal(whole.frames[:, chunk:], short.frames[:, chunk:])
    # Each chunk is what a session would show that had only seen true frames.
    past = store.at(some[:, None].expand(-1, 1 + chunk), torch.arange(1 + chunk))
    state = simulator.resume(past, torch.full_like(some, 1 + chunk), some)
    frames = simulator.step(state, future_of(simulator, store, short.rows[:, chunk : 2 * chunk]))[0]
    assert torch.equal(frames, short.frames[:, chunk : 2 * chunk])


class Listening(Simulator):
    """Keeps the commands that it is told of all frames up to each chunk, and makes black frames."""

    def __init__(self, spec: WorldSpec):
        super().__init__(spec, 1 + spec.chunk)
        self.feature_shape, self.told = (1,), []

    def predict(self, inputs: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
        self.told.append(inputs["memory", "commands"].clone())
        shape = (len(inputs), self.spec.chunk, self.spec.views, 3, *self.spec.size)
        return torch.zeros(shape, dtype=torch.uint8), torch.zeros(len(inputs), 1)


def test_true_frames_stand_with_commands_of_the_same_stride_as_generated_ones(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)  # of which changes are summed between two frames
    told = []
    for alone in (None, 1):
        simulator = Listening(store.spec)
        replay(simulator, store, torch.tensor([3, 1]), bf16=False, alone=alone, stride=2)
        told.append(simulator.told[1])
    assert torch.equal(*told)


def test_states_are_decoded_at_the_stride_that_their_expert_has_learned(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    simulator, some = simulator_of("unet_small", store.spec), torch.tensor([1])
    expert = decoder_of("unet_small", simulator)
    assert torch.isfinite(replay(simulator, store, some, expert, bf16=False, most=1).states).all()
    with pytest.raises(
        ConfigError, match=r"simulator\.state_expert: StateHead .*stride=2 .*without a decoder"
    ):
        replay(simulator, store, some, expert, bf16=False, stride=2, most=1)


class Counting(Listening):
    """Counts the sessions that are open, and how many ever were at once."""

    open = most = 0

    def resume(self, past: TensorDict, length: torch.Tensor, *more: Any) -> TensorDict:
        self.open += len(past)
        self.most = max(self.most, self.open)
        return super().resume(past, length, *more)

    def release(self, state: TensorDict, mask: torch.Tensor) -> None:
        self.open -= int(mask.sum())


def test_sessions_end_before_others_go_on_from_true_frames(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    simulator = Counting(store.spec)
    replay(simulator, store, torch.tensor([3, 1]), bf16=False, alone=1)
    assert (simulator.open, simulator.most) == (0, 2)


def test_the_robot_is_where_it_was_recorded_unless_its_states_are_decoded(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)  # of changes nothing but the state says where the robot is
    simulator, some, chunk = simulator_of("unet_small", store.spec), torch.tensor([3, 1]), store.spec.chunk
    for parameter in simulator.parameters():
        torch.nn.init.normal_(parameter, std=0.2, generator=torch.Generator().manual_seed(0))
    made = replay(simulator, store, some, bf16=False)
    assert torch.equal(made.states, store.arrays["states"][made.rows])
    chunks = [slice(n * chunk, (n + 1) * chunk) for n in range(2)]

    def second(states: torch.Tensor) -> torch.Tensor:
        """The second chunk of a session that was told these states in the first."""
        state = simulator.reset(store.first(some), some)
        _, _, state = simulator.step(state, future_of(simulator, store, made.rows[:, chunks[0]]))
        memory.write_states(state, states)
        return simulator.step(state, future_of(simulator, store, made.rows[:, chunks[1]]))[0]

    assert torch.equal(made.frames[:, chunks[1]], second(made.states[:, chunks[0]]))
    assert not torch.equal(made.frames[:, chunks[1]], second(made.states[:, chunks[0]] + 1))
