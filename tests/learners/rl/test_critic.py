"""Value networks read robots of any unit."""

from __future__ import annotations

import pytest
import torch

from actors.policies.contract import VISUAL_FEATURES
from envs.embodiment import Embodiment
from envs.specs import IMAGE, INSTRUCTION_UTF8, STATE, ActionMode, text_to_bytes
from learners.rl.critic import build_critic
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, world_spec
from tests.learners.models import policy_of


@pytest.mark.parametrize("robot", [ARM_DELTAS, ARM_JOINTS], ids=lambda robot: robot.robot)
@pytest.mark.parametrize("name", ["chunk_gaussian", "tiny_vla"])
def test_values_do_not_hang_on_the_units_of_states(robot: Embodiment, name: str) -> None:
    spec = world_spec(robot)
    policy = policy_of(name, spec, ActionMode.RELATIVE)
    generator = torch.Generator().manual_seed(0)
    states = torch.rand(64, robot.state_dim, generator=generator)
    seen = {
        VISUAL_FEATURES: torch.randn(64, getattr(policy, "visual_dim", 1), generator=generator),
        IMAGE: torch.randint(256, (64, spec.views, 3, *spec.size), generator=generator, dtype=torch.uint8),
        INSTRUCTION_UTF8: text_to_bytes(["push"] * 64),
    }
    told = []
    for unit in (1.0, 100.0):
        torch.manual_seed(0)
        critic = build_critic(policy, spec, 16)
        critic.module.take_units(unit * states)
        critic.module.take_units(torch.zeros_like(states))  # later ones change nothing
        values = {**seen, STATE: unit * states}
        told.append(critic(*(values[key] for key in critic.in_keys)))
    assert not robot.state_rotations  # angles in another unit are other angles
    assert told[0].shape == (64, 1) and float(told[0].std()) > 1e-3
    assert torch.allclose(told[0], told[1], atol=1e-4)
