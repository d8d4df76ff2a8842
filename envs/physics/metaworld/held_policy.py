"""One command a frame in the place of a scripted policy that was written to be asked eight times as often."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from envs.physics.suite import Array

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all that the next step depends on
# How far the commands tried lie on the way from the policy's first to the mean of what it says in a frame.
# Proportional controllers that hold their first swing; where one acts by jerks, as pulling a handle does, its
# mean does nothing.
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_SAME = 1e-3  # commands that differ by less are one


class HeldPolicy:
    """Says which command, held for a frame, does most nearly what a policy would in it at its own rate.

    Both are tried out on data of its own, so the episode's physics stays as it is, bit for bit.

    Args:
        env: Meta-World's, laid out; with one made anew a held policy is, too.
        steps: of the environment in a frame.
    """

    def __init__(self, env: Any, steps: int):
        self._env, self._steps = env, steps
        self._data = mujoco.MjData(env.model)
        # Observes and acts as the environment does, on that data; what it remembers is not the environment's.
        self._twin = object.__new__(type(env))
        vars(self._twin).update(vars(env), data=self._data)
        self._space = env.sawyer_observation_space
        self._now = np.empty(mujoco.mj_stateSize(env.model, _STATE))

    def __call__(self, policy: Callable[[Array], Array], sight: Array) -> Array:
        """The command [4] in -1..1 to hold from now on.

        Args:
            policy: full observation [39], which it leaves as it is -> action [4].
            sight: the full observation now.
        """
        mujoco.mj_getState(self._env.model, self._env.data, self._now, _STATE)
        said, places = self._follow(policy, sight)
        first, mean = said[0], said.mean(0)
        if np.ptp(said, 0).max() < _SAME:
            return first
        tried = [first + share * (mean - first) for share in _SHARES]
        apart = [np.linalg.norm(self._hold(command) - places, axis=-1).sum() for command in tried]
        return tried[int(np.argmin(apart))]

    def _follow(self, policy: Callable[[Array], Array], sight: Array) -> tuple[Array, Array]:
        """What the policy says [steps, 4] when it is asked in every step, and where all bodies [n, 3] then
        are, in metres.
        """
        twin, said = self._twin, []
        twin._prev_obs = self._env._prev_obs
        mujoco.mj_setState(twin.model, self._data, self._now, _STATE)
        for _ in range(self._steps):
            said.append(np.clip(np.asarray(policy(sight), dtype=np.float64), -1.0, 1.0))
            self._step(said[-1])
            mujoco.mj_forward(twin.model, self._data)
            sight = np.clip(twin._get_obs(), self._space.low, self._space.high)
        return np.stack(said), self._data.xpos.copy()

    def _hold(self, command: Array) -> Array:
        """Where all bodies [n, 3] are after a frame of one command, in metres."""
        mujoco.mj_setState(self._twin.model, self._data, self._now, _STATE)
        for _ in range(self._steps):
            self._step(command)
        mujoco.mj_kinematics(self._twin.model, self._data)
        return self._data.xpos.copy()

    def _step(self, command: Array) -> None:
        """Meta-World's step less its reward, on which no action depends."""
        self._twin.set_xyz_action(command[:3])
        self._twin.do_simulation([command[3], -command[3]], self._twin.frame_skip)
