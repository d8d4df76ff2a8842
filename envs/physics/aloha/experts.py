"""A script carried out by both arms, and noise that bends it towards chance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from envs.physics.aloha.arms import ArmKinematics, Array, Hand, Hands, facing
from envs.physics.aloha.scripts import Script, Sight
from envs.physics.noise import Drift, Interruptions

SPEED = 0.35  # m/s that fingertips move at most
TURN_SPEED = 2.5  # rad/s
JOINT_SPEED = 3.0  # rad/s that joints turn at most, such as when a wrist passes its singularity
BIAS = 0.01  # m, standard deviation of where things are believed to be, at noise 1
DRIFT = 0.01  # m, of the slowly varying offset of each hand, at noise 1
_ARRIVED = (0.004, 0.05)  # m and rad from a goal at which a phase's time begins to run
_WAYPOINT = 1.0  # s of a random way-point


class NoisyScript:
    """Joint commands that follow a script, whatever the task.

    Noise moves where things are believed to be, adds a slowly varying offset to both hands, and interrupts
    the script by random way-points about the things; at 1 nothing else is left.

    Args:
        script: of the task.
        arms: kinematics.
        look: () -> poses [n, 7] of the things, and both hands, as they are now.
        command: [14], the joint command in force.
        noise_level: 0 is the script itself, 1 pays no heed to the task.
        rng: of the noise.
        period: seconds between two calls.

    Raises:
        ValueError: if the noise level lies outside [0, 1].
    """

    def __init__(
        self,
        script: Script,
        arms: ArmKinematics,
        look: Callable[[], tuple[Array, Hands]],
        command: Array,
        noise_level: float,
        rng: np.random.Generator,
        period: float,
    ):
        self.script, self.arms, self.look = script, arms, look
        self.rng, self.period = rng, period
        self.joints = command.reshape(2, 7)[:, :6].copy()
        self.hands: Hands = arms.forward(self.joints, command.reshape(2, 7)[:, 6])
        self.phase, self.waited = 0, 0.0
        self.interruptions = Interruptions[Hands](noise_level, _WAYPOINT, rng, period)
        self.bias = rng.normal(0.0, BIAS * noise_level, (2, 2))  # m, of the things' places on the table
        self.drift = Drift(DRIFT * noise_level, (2, 3), rng, period)

    def __call__(self) -> Array:
        """The next joint command [14]."""
        sight = Sight(*self.look(), self.hands)
        goals = self.interruptions(lambda: self._wander(sight)) or self._follow(sight)
        left, right = (
            _towards(hand, goal, SPEED * self.period, TURN_SPEED * self.period)
            for hand, goal in zip(self.hands, goals, strict=True)
        )
        self.hands = (left, right)
        bent = [
            replace(hand, position=hand.position + off)
            for hand, off in zip(self.hands, self.drift(), strict=True)
        ]
        self.joints = self.arms.solve(bent, self.joints, JOINT_SPEED * self.period)
        openings = [[hand.opening] for hand in self.hands]
        return np.concatenate((self.joints, openings), 1).flatten()

    def _follow(self, sight: Sight) -> Hands:
        """The script's goals, after going on to its next phase if this one's time is over."""
        things = sight.objects.copy()
        things[:, :2] += self.bias[: len(things)]
        sight = replace(sight, objects=things)
        if self.script.lost(self.phase, sight):
            self.phase, self.waited = 0, 0.0
        goals = self.script.goals(self.phase, sight)
        pairs = zip(self.hands, goals, strict=True)
        near = all(_distance(*pair) < _ARRIVED[0] and _angle(*pair) < _ARRIVED[1] for pair in pairs)
        self.waited += self.period if near else 0.0
        if near and self.waited > self.script.phases[self.phase] and self.phase + 1 < len(self.script.phases):
            self.phase, self.waited = self.phase + 1, 0.0
            goals = self.script.goals(self.phase, sight)
        return goals

    def _wander(self, sight: Sight) -> Hands:
        """A random goal for each hand, about the things."""
        goals = []
        for side in range(2):
            thing = sight.objects[self.rng.integers(len(sight.objects)), :3]
            position = thing + self.rng.normal(0.0, 0.1, 3)
            position[2] = max(position[2], 0.02)
            rotation = facing(side, *self.rng.normal((0.6, 0.0, 0.0), (0.4, 0.3, 0.5)))
            goals.append(Hand(position, rotation, float(self.rng.choice((0.0, 1.0)))))
        return goals[0], goals[1]


def _distance(one: Hand, two: Hand) -> float:
    return float(np.linalg.norm(one.position - two.position))


def _angle(one: Hand, two: Hand) -> float:
    return float(Rotation.from_matrix(two.rotation @ one.rotation.T).magnitude())


def _towards(hand: Hand, goal: Hand, stride: float, turn: float) -> Hand:
    """`goal`, or a hand at most `stride` metres and `turn` radians on the way to it."""
    move = goal.position - hand.position
    rotation = Rotation.from_matrix(goal.rotation @ hand.rotation.T).as_rotvec()
    part = min(1.0, turn / max(float(np.linalg.norm(rotation)), 1e-9))
    turned = Rotation.from_rotvec(rotation * part).as_matrix() @ hand.rotation
    move = move * min(1.0, stride / max(float(np.linalg.norm(move)), 1e-9))
    return Hand(hand.position + move, turned, goal.opening)
