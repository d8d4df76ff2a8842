"""Pictures and calibration that are not what a suite's embodiment says, found before anything is recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.embodiment import Camera
from envs.episodes import Episode
from envs.physics.pool import TaskPool
from envs.physics.suite import Observation
from envs.targets import ConfigError
from tests.envs.physics.sections import Counting

COUNTING = {"_target_": "tests.envs.physics.sections.Counting", "fault": ""}


def test_pictures_that_are_not_those_of_the_embodiment_are_refused_before_they_are_recorded() -> None:
    said = r"Counting\.render gives uint8 \[1, 3, 4, 6\], but its embodiment's .* \[1, 3, 4, 4\]"
    for ask in (lambda pool: pool.script([(0, 0.0)], 1), lambda pool: pool.reset({0: 0}, False)):
        pool = TaskPool({**COUNTING, "shows": [4, 6]}, "count", 2, 8, 2)
        with pytest.raises(ConfigError, match=said):
            ask(pool)
        assert not pool.lost
        pool.close()


class TwoCameras(Counting):
    """Counts; of its cameras the first is calibrated, and `tells` names what it says of them: "" what is
    due, or a mistake.
    """

    def __init__(self, tells: str):
        super().__init__("")
        eyes = (Camera("eye", (4, 4), calibrated=True), Camera("other", (4, 4)))
        self.embodiment, self.tells = replace(self.embodiment, cameras=eyes), tells

    def render(self) -> Any:
        return np.repeat(super().render(), 2, 0)

    def observe(self) -> Observation:
        seen = super().observe()
        seen.intrinsic, seen.c2w = (np.stack([np.eye(n), np.full((n, n), np.nan)]) for n in (3, 4))
        if self.tells == "nothing":
            seen.c2w = seen.intrinsic = None
        elif self.tells == "no poses":
            seen.c2w = None
        elif self.tells == "one camera":
            seen.intrinsic = seen.intrinsic[:1]
        elif self.tells == "nan":
            seen.c2w[0, 1, 2] = np.nan
        elif self.tells == "zeros":
            seen.c2w[1] = 0.0
        return seen


@pytest.mark.parametrize(
    ("tells", "said"),
    [
        ("nothing", r"gives no intrinsic, .* calibrated=True of camera eye; give intrinsic \[2, 3, 3\], NaN"),
        ("no poses", r"gives no c2w, .* calibrated=True of camera eye; give c2w \[2, 4, 4\], NaN of"),
        (
            "one camera",
            r"gives intrinsic \[1, 3, 3\] for cameras eye, other, which make it \[2, 3, 3\];",
        ),
        ("nan", r"gives c2w with NaN .* for camera eye, .*; give finite ones, or say calibrated=False"),
        ("zeros", r"gives c2w for camera other, .* does not say calibrated=True; say so, or give NaN"),
    ],
)
def test_calibration_that_is_not_what_the_embodiment_says_is_refused_at_the_start(
    tells: str, said: str
) -> None:
    suite = {"_target_": f"{__name__}.TwoCameras", "tells": tells}
    for ask in (lambda pool: pool.script([(0, 0.0)], 1), lambda pool: pool.reset({0: 0}, False)):
        pool = TaskPool(suite, "count", 1, 8, 1)
        with pytest.raises(ConfigError, match=rf"task\.suite: TwoCameras\.observe {said}"):
            ask(pool)
        assert not pool.lost
        pool.close()


def test_cameras_that_are_not_calibrated_are_nan_among_others() -> None:
    pool = TaskPool({"_target_": f"{__name__}.TwoCameras", "tells": ""}, "count", 1, 8, 1)
    (track,) = pool.script([(0, 0.0)], 1)
    assert pool.reset({0: 0}, False)[0]["c2w"].shape == (2, 4, 4)
    pool.close()
    episode = Episode.from_track(track, "expert", TwoCameras("").embodiment)
    assert episode.c2w is not None and np.isnan(episode.c2w[:, 1]).all() and len(episode) == 9
