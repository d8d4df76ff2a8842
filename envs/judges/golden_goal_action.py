"""RoboScape-R's success: nearness to a golden goal is as in golden_goal.py, but that the task is done is the
action world's own word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from torch import Tensor

from envs.judges.base import features_of_all
from envs.judges.golden_goal import GoldenGoalJudge
from envs.ranges import Count, Share
from envs.simulators.base import Simulator
from envs.simulators.tokens.done import ChunkDone
from envs.specs import WorldSpec


class ActionGoldenGoalJudge(GoldenGoalJudge):
    """A golden-goal judge whose success is what the simulator under it says of its frames.

    The simulator learns that by recorded success, failures among it, and by what it made of commands; the
    text world has seen successes alone. The head is the simulator's: the judge's stage takes it over.

    Args:
        spec: what frames show.
        feature_shape: of the simulator's features of a chunk.
        hold, threshold, metric, cameras, text_world, fallback, cache: see GoldenGoalJudge.

    Raises:
        ConfigError: if the simulator does not say it.
    """

    needs_labels = True
    reads_features = True
    asks_world = True

    def __init__(
        self,
        spec: WorldSpec,
        feature_shape: Sequence[int],
        hold: Count,
        threshold: Share,
        metric: Mapping[str, Any],
        cameras: str | Sequence[str],
        text_world: Mapping[str, Any],
        fallback: Literal["drop", "last_frame", "progress_only"],
        cache: Count,
    ):
        super().__init__(spec, hold, threshold, metric, cameras, text_world, fallback, cache)
        self.chunk, self.says = spec.chunk, ChunkDone(spec, feature_shape)
        self.says.requires_grad_(False)

    def attach(self, simulator: Simulator) -> None:
        """See Judge.attach."""
        self.says.load_state_dict(simulator.done_head().state_dict())

    def done(
        self, frames: Tensor, instruction: list[str], progress: Tensor, features: Tensor | None = None
    ) -> Tensor:
        """See GoalJudge.done.

        Raises:
            MissingFeatures: without features of all frames.
        """
        count = frames.shape[1]
        features = features_of_all(features, count, self.chunk, "golden_goal_action", "golden_goal")
        each = features.shape[1]
        done = self.says(features.flatten(0, 1).to(progress.device)).unflatten(0, (-1, each))
        return done.flatten(1, 2)[:, :count]

    def facts(self) -> dict[str, Any]:
        """See Judge.facts."""
        return {**super().facts(), "success_by": "done of the simulator"}
