"""The numbers of a clip store by name, and why a name is not among them."""

from __future__ import annotations

from torch import Tensor

from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot.columns import PRIVILEGED


class Columns(dict[str, Tensor]):
    """Arrays by name, one row per frame or per episode.

    Raises:
        EpisodeError: where a name is asked for that a store does not hold; it says why, and the fix.
    """

    def __missing__(self, name: str) -> Tensor:
        if name.startswith(PRIVILEGED):
            fix = (
                "only physics knows it and no robot does, so nothing that learns, acts or judges may open it."
                f" Learn from pictures and {sorted(self)}; evaluation opens it by envs/episodes/privileged.py"
            )
        elif name == "success":
            fix = "no episode is labelled. Record next.success, or choose a judge= that needs no labels"
        elif name == "c2w":
            fix = "the robot is not calibrated. Record calibration.c2w and calibration.intrinsic"
        else:
            fix = f"there are {sorted(self)}"
        raise EpisodeError(f"column {name!r} is asked for; {fix}")
