"""Watches a run of reinforcement learning for the ways it goes wrong quietly."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tqdm import tqdm

from learners.training.fit import TrainingDiverged

_FEW = 0.15  # of the planned updates


@dataclass
class Alarms:
    """Watches an RL run for the ways it goes wrong quietly.

    Args:
        patience: iterations in a row without reward variance, or of hardly any step, before the alarm.
        kl: KL per iteration that counts as exploding.
        entropy_drop: fall of entropy (nats) from the first iteration that counts as collapse.
    """

    patience: int = 3
    kl: float = 0.5
    entropy_drop: float = 12.0
    silent: int = 0
    short: int = 0
    entropy: float | None = None
    raised: list[str] = field(default_factory=list)

    def check(self, figures: dict[str, float], iteration: int) -> None:
        """Look at one iteration's figures; warns once per kind.

        Raises:
            TrainingDiverged: on numbers that are not finite.
        """
        bad = [key for key, value in figures.items() if not math.isfinite(value)]
        if bad:
            raise TrainingDiverged(
                f"rl: {bad} not finite at iteration {iteration}; lower rl.lr or raise algorithm clipping; the"
                " last checkpoint is kept"
            )
        # without a rollout there are no rewards
        self.silent = self.silent + 1 if figures.get("reward_std", 1.0) < 1e-6 else 0
        if self.silent == self.patience:
            self._warn(
                "no reward variance",
                iteration,
                "every episode scores the same; check the judge, or start from a policy that succeeds"
                " sometimes",
            )
        few = figures.get("updates", 0.0) <= _FEW * figures.get("planned_updates", 0.0)
        self.short = self.short + 1 if few and figures.get("kl_reached", 0.0) > 0.0 else 0
        if self.short == self.patience:
            self._warn(
                "hardly any step",
                iteration,
                f"{figures['updates']:.0f} of {figures['planned_updates']:.0f} updates an iteration, then KL"
                f" {figures['kl_reached']:.2g} is above rl.kl_stop: one step changes too much of what the"
                " policy does; lower rl.lr, or see whether its cloning diverged",
            )
        if figures.get("kl", 0.0) > self.kl:
            self._warn(
                "exploding KL",
                iteration,
                f"KL {figures['kl']:.3g} in one iteration; lower rl.lr or rl.epochs",
            )
        if "entropy" in figures:
            self.entropy = figures["entropy"] if self.entropy is None else self.entropy
            if self.entropy - figures["entropy"] > self.entropy_drop:
                self._warn(
                    "collapsed entropy",
                    iteration,
                    "exploration is gone; raise algorithm.entropy or policy.head.std",
                )

    def _warn(self, kind: str, iteration: int, advice: str) -> None:
        if kind not in [text.split(" at ")[0] for text in self.raised]:
            self.raised.append(f"{kind} at iteration {iteration}: {advice}")
            tqdm.write(f"ALARM rl: {self.raised[-1]}")
