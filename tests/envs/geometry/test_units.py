"""Angles may be counted in any turn: networks are told the same."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from actors.policies.proprioception import Proprioception
from envs.conditioning.units import UNTOLD, Units
from envs.simulators.inputs import build_inputs
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip, history_of
from tests.envs.simulators.test_engines import build_engine

ANGLES = [3, 4, 5, 10, 11, 12]


def wrapped(angles: torch.Tensor) -> torch.Tensor:
    return torch.remainder(angles + math.pi, 2 * math.pi) - math.pi


def test_which_numbers_are_angles() -> None:
    angles = tuple((number,) for number in ANGLES)
    assert BIMANUAL_POSES.action_rotations == BIMANUAL_POSES.state_rotations == angles
    for robot in (ARM_DELTAS, ARM_JOINTS):
        assert not robot.action_rotations and not robot.state_rotations


def test_an_angle_around_pi_has_the_spread_that_it_has_around_zero() -> None:
    values = 0.1 * torch.randn(500, 2, generator=torch.Generator().manual_seed(0))
    around, zero = Units(2, [[0], [1]]), Units(2, [[0], [1]])
    zero.normalise(values)
    turned = wrapped(values + math.pi)
    assert turned.std(0).min() > 3  # as numbers they lie at both ends
    around.normalise(turned)
    assert torch.allclose(around.std, zero.std, atol=1e-5)
    assert torch.allclose(around(turned), zero(values), atol=1e-4)
    assert torch.allclose(around(turned + 4 * math.pi), zero(values), atol=1e-4)
    assert torch.allclose(wrapped(around.values(around(turned)) - turned), torch.zeros(500, 2), atol=1e-5)
    assert torch.allclose(around.change(turned, turned - 2 * math.pi), torch.zeros(500, 2), atol=1e-4)


def test_degrees_and_numbers_that_are_no_angles_are_taken_as_they_are() -> None:
    degrees = torch.tensor([[-179.0, 5.0], [179.0, 5.0]])
    units = Units(2, [[0]], least=0.5, still=UNTOLD)
    units.normalise(degrees)
    assert units.mean.tolist() == [0, 5] and units.std.tolist() == [179, UNTOLD]
    assert torch.allclose(units(torch.tensor([358.0, 100.0])), torch.tensor([2.0, 0.0]), atol=1e-6)


@pytest.mark.parametrize("start", [-5.0, -3.6, -1.0])
def test_a_few_degrees_are_no_radians(start: float) -> None:
    sweep = torch.linspace(start, 5, 40)
    for episodes in ((sweep, sweep.flip(0)), (sweep, sweep), (-sweep, sweep, sweep)):
        told = torch.cat(episodes)[:, None]
        units = Units(1, [[0]])
        units.normalise(told)
        assert torch.allclose(units.values(units(told)), told, atol=1e-4)
        vector = Units(3, [[0, 1, 2]])
        vectors = told * torch.tensor([0.6, 0.0, 0.8])
        vector.normalise(vectors)
        assert torch.allclose(vector.values(vector(vectors)), vectors, atol=1e-4)


def test_angles_that_were_counted_on_beyond_pi_are_radians() -> None:
    swing = 3.1 + 0.7 * torch.linspace(0, 2 * math.pi, 40).sin()
    for episodes in ((swing, swing), (swing, swing - 2 * math.pi, swing), (swing.remainder(2 * math.pi),)):
        units = Units(1, [[0]])
        units.normalise(torch.cat(episodes)[:, None])
        assert torch.allclose(units(wrapped(swing)[:, None]), units(swing[:, None]), atol=1e-4)


def turned_clips(frames: int) -> tuple[TensorDict, TensorDict]:
    """Clips that remember so many frames, whose angles lie around pi, counted on, and the same as a robot
    tells them.
    """
    spec, plain = world_spec(BIMANUAL_POSES), []
    for tell in (False, True):
        clips = clip(spec, 4, frames)
        for part in ("future", "history", "memory"):
            for name in ("commands", "states"):
                if name not in clips[part].keys():
                    continue
                angles = math.pi + 0.1 * clips[part, name][..., ANGLES]
                # commands of an episode are counted on from wherever it begins
                turns = (
                    2 * math.pi * torch.tensor([0.0, -1.0, 0.0, -1.0]).reshape(-1, *[1] * (angles.ndim - 1))
                )
                told = wrapped(angles) if name == "states" else angles + turns
                clips[part, name][..., ANGLES] = told if tell else angles
        for name, old in (("command", "commands"), ("state", "states")):
            clips["now", name] = clips["history", old][:, -1]
        plain.append(clips)
    return plain[0], plain[1]


@pytest.mark.parametrize("name", ["unet_small", "dit_small", "tokens_small", "forcing_small"])
def test_engines_and_state_experts_learn_the_same_in_whatever_turn_angles_are_counted(name: str) -> None:
    spec = world_spec(BIMANUAL_POSES)
    simulator, decoder = build_engine(name, spec)
    losses = []
    for clips in turned_clips(simulator.memory_frames):
        commands = torch.cat((clips["history", "commands"], clips["future", "commands"]), 1)
        states = torch.cat((clips["history", "states"], clips["future", "states"]), 1)
        told = (
            commands.flatten(0, 1),
            (commands[:, 1:] - commands[:, :-1]).flatten(0, 1),
            states.flatten(0, 1),
        )
        for part in (simulator, decoder):
            part.normalise(*told)
        loss, _ = simulator.loss(clips, torch.Generator().manual_seed(0))
        features = decoder.read(decoder.look(simulator, build_inputs(spec, clips, 0)))
        history = history_of(clips, decoder.memory_frames)
        taught = decoder.loss(features, history, clips["future"], torch.Generator().manual_seed(1))
        losses.append(torch.stack((loss.detach(), taught.detach())))
    assert torch.allclose(*losses, rtol=1e-3), losses


def test_policies_are_told_the_same() -> None:
    told = []
    for clips in turned_clips(4):
        body = Proprioception(BIMANUAL_POSES, True)
        seen = clips["future", "states"].flatten(0, 1), clips["future", "commands"].flatten(0, 1)
        body.normalise(*seen)
        told.append(body(*seen))
    assert torch.allclose(*told, atol=1e-3)
