"""GE-Sim 2.0's own state expert: its released weights, sampled as its video is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from envs.commanded_states import joints_are_states
from envs.embodiment import Embodiment
from envs.simulators.dit.prediction import Velocity
from envs.simulators.dit.state_network import StateDiT
from envs.simulators.gesim.checkpoint import JOINTS, CheckpointError, load_state_network
from envs.simulators.gesim.engine import GESimulator
from envs.simulators.state_experts.flow import FlowStateDecoder


class GESimStateExpert(FlowStateDecoder):
    """The released state expert, or an untrained one of its form where there are no weights (GE-Sim 1, or
    none). Commanded grippers are told to it as 0 open .. 1 closed, whatever the robot's own values are;
    states as they are read, as its own are.

    Args:
        simulator: whose features it reads.
        checkpoint: as of the simulator.

    Raises:
        CheckpointError: if the weights are of another robot, or of another order of its numbers.
    """

    def __init__(self, simulator: GESimulator, checkpoint: str | None):
        robot = simulator.spec.embodiment
        self.check({"checkpoint": checkpoint}, robot)
        found = load_state_network(Path(checkpoint)) if checkpoint else None
        width = max(robot.action_dim, robot.state_dim)
        if found is not None and found[0].shape.pose_in_channels != JOINTS:
            raise CheckpointError(
                f"the state expert of simulator.checkpoint={checkpoint} reads"
                f" {found[0].shape.pose_in_channels} numbers, not the released one's {JOINTS} joints; train"
                " another with simulator.state_expert.checkpoint=null"
            )
        untrained = replace(simulator.net.shape, pose_in_channels=width, pose_out_channels=robot.state_dim)
        every = simulator.spec.chunk if simulator.parity.thins_history else 1
        super().__init__(
            simulator,
            StateDiT(untrained) if found is None else found[0],
            simulator.diffusion.sampler,
            simulator.diffusion.time_scale,
            Velocity(),
            every=every,
        )
        if found is not None:
            stats = found[1]
            for name, units in (("action", self.tokens.actions), ("state", self.tokens.states)):
                units.mean.copy_(stats[name][0])
                units.std.copy_(stats[name][1])
            for arm in robot.arms:  # released actions have grippers of 0 open .. 1 closed
                if arm.gripper is not None:
                    opened, closed = arm.gripper_range
                    mean, std = self.tokens.actions.mean, self.tokens.actions.std
                    mean[arm.gripper] = opened + (closed - opened) * mean[arm.gripper]
                    std[arm.gripper] *= closed - opened  # below 0 where open is the larger value
            self.normalised = True

    @classmethod
    def check(cls, options: Mapping[str, Any], robot: Embodiment) -> None:
        """See StateDecoder.check; released weights know one robot.

        Raises:
            CheckpointError: if they are asked to decode another's states, or the same in another order.
        """
        if not options["checkpoint"]:
            return
        expert = f"the state expert of simulator.checkpoint={options['checkpoint']}"
        if (robot.action_dim, robot.state_dim) != (JOINTS,) * 2:
            raise CheckpointError(
                f"{expert} knows {JOINTS} joints, but {robot.robot} has actions of {robot.action_dim} and"
                f" states of {robot.state_dim}; train one of that size with"
                " simulator.state_expert.checkpoint=null"
            )
        arms = sorted(robot.arms, key=lambda arm: arm.name == "right")
        order = [n for arm in arms for n in (*arm.numbers, arm.gripper)]
        alike = joints_are_states(robot) and robot.state_names == robot.action_names
        if not alike or (order and order != list(range(JOINTS))):
            raise CheckpointError(
                f"{expert} takes joint targets and joint states in one order, seven of the left arm, its"
                f" gripper, seven of the right arm, its gripper, but {robot.robot} has actions"
                f" {list(robot.action_names)} ({robot.action_kind.value}, delta={robot.delta}) and states"
                f" {list(robot.state_names)}; bring action and observation.state into that order, with the"
                " same names, or train one for yours with simulator.state_expert.checkpoint=null"
            )
