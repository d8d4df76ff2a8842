"""EWMBench with strict parity against numbers that the public code's own functions gave (AgibotTech/EWMBench
at 3a5531c, fastdtw 0.3.4, scipy 1.17.1), run unchanged: `farthest_distance`, `HAUSDORFF`, `NDTW`, `DYNAMICS`
after `traj_interpo_fill`, and `scene_consistency`.
"""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.evaluation.ewmbench.features import WordGrams
from pipeline.evaluation.ewmbench.parity import public_travel
from pipeline.evaluation.ewmbench.records import Record
from pipeline.evaluation.ewmbench.result import Scoring, overall, scene_by_frame
from pipeline.evaluation.ewmbench.scene import scene_consistency
from pipeline.evaluation.ewmbench.trajectory import CAPS, Scores, scores, travel

Floats = NDArray[np.float64]
NAN = math.nan
# Sides 20 and 20 sqrt(2), from any corner to the next but one 20 sqrt(5), and 20 sqrt(10) right across.
OCTAGON = np.array([(20, 40), (40, 20), (60, 20), (80, 40), (80, 60), (60, 80), (40, 80), (20, 60)], float)
WEDGE = np.array([(10, 10), (60, 12), (35, 14), (10, 10), (60, 12), (35, 14), (10, 10), (60, 12)], float)
# Bit n: whether the public code takes the second of the pair of tracks that Random(n) walks.
SECOND = 0x4F4B6F0104F13DF2A42B0228055BC06565945F7D42825A4A35C84777EA524C7E


def arms(*tracks: Floats) -> Floats:
    return np.stack(tracks, 1)


def walk(rng: random.Random, frames: int) -> Floats:
    """A track [frames, 2] in pixels of a picture of 100 x 100."""
    at, out = [0.5, 0.5], []
    for _ in range(frames):
        at = [value + (rng.random() - 0.5) / 20 for value in at]
        out.append(at)
    return np.array(out) * 100


def strict(made: Floats, true: Floats, size: tuple[int, int]) -> Scores:
    found = scores(made, true, size, True)
    assert found is not None
    return found


def shares(hsd: float, ndtw: float, dyn: float) -> list[float]:
    """SA, TA and DYN of what the public functions return."""
    found = {"sa": hsd, "ta": ndtw, "dyn": dyn}
    return [min(score, CAPS[name]) / CAPS[name] for name, score in found.items()]


def test_travel_is_a_side_or_the_way_from_the_first_corner_to_the_third() -> None:
    assert public_travel(OCTAGON) == pytest.approx(44.721359549995796)
    assert travel(OCTAGON) == pytest.approx(20 * math.sqrt(10))
    assert public_travel(WEDGE) == pytest.approx(50.039984012787215) == travel(WEDGE)
    still, straight = np.ones((5, 2)), np.arange(8.0).reshape(4, 2)  # there the public code stops
    assert public_travel(still) == 0.0 and public_travel(straight) == travel(straight) == math.hypot(6, 6)


def test_another_arm_counts_than_the_one_that_travels_farthest() -> None:
    moved = np.array([[0, 5], [1, 6], [-2, 3], [0, 8]] * 2)
    found = strict(arms(OCTAGON + [1, 0], WEDGE + moved), arms(OCTAGON, WEDGE), (100, 100))
    assert found.hsd == pytest.approx(0.08)  # the wedge's; the octagon's is .01
    wanted = shares(12.499999115243616, 17.630220774455875, 0.4341194753516635)
    assert [found.sa, found.ta, found.dyn] == pytest.approx(wanted, rel=1e-5)


def test_the_arm_is_the_one_that_the_public_code_takes_of_256_pairs() -> None:
    others = 0
    for seed in range(256):
        rng = random.Random(seed)
        first, second = walk(rng, 12), walk(rng, 12)
        found = strict(arms(first, second + 10.0), arms(first, second), (100, 100))
        assert (found.hsd != 0.0) == bool(SECOND >> seed & 1), seed
        others += (found.hsd != 0.0) != (travel(second) > travel(first))
    assert others == 37  # and in so many it is not the one that travels farthest


def test_scores_with_gaps_and_pictures_that_are_not_square() -> None:
    rng = random.Random(7)
    true = arms(walk(rng, 9), walk(rng, 9))
    made = true + arms(walk(rng, 9), walk(rng, 9)) - [42, 56]
    made[3:5], true[6], true[0, 1] = NAN, NAN, NAN
    found = strict(made, true, (80, 100))
    wanted = shares(8.074624054074487, 8.630355369126168, 1.0722276698490725)
    assert [found.sa, found.ta, found.dyn] == pytest.approx(wanted, rel=1e-5)


def test_of_an_arm_that_is_nowhere_in_truth_the_public_code_compares_nowhere() -> None:
    # The second arm is the first that has a true track, so the first one counts, whose truth is (-1, -1).
    near = np.array([(0, 0), (5, 3), (10, 0), (20, 1)], float)
    made = arms(np.array([(0, 0), (20, 0), (40, 0), (80, 0)], float), near)
    found = strict(made, arms(np.full((4, 2), NAN), near), (50, 100))
    assert found.hsd == pytest.approx(math.hypot(1.8, 1)) and found.lost == 0.0
    wanted = shares(0.4856429287209041, 0.5920790542090013, 2.81249959127735e-09)
    assert [found.sa, found.ta, found.dyn] == pytest.approx(wanted, rel=1e-5)
    gone = strict(arms(np.full((4, 2), NAN), near), arms(np.full((4, 2), NAN), near), (50, 100))
    assert (gone.sa, gone.ta, gone.dyn, gone.hsd, gone.lost) == (0.0, 0.0, 0.0, None, 1.0)


def test_scenes_by_video_as_in_the_public_table_and_by_frame_as_its_function_returns_them() -> None:
    short = torch.tensor([[[1.0, 0], [2, 0]], [[1, 0], [0, 3]], [[1, 0], [1, 0]]])
    long = torch.tensor([[1.0, 1, 2, 0], [1, 3, 1, 3], [1, 0, 1, 1], [0, 1, 1, 2], [1, 1, 1, 0]])

    def record(patches: Tensor) -> Record:
        return Record((scene_consistency(patches, True),), torch.ones(1), None, None)

    made = [[record(short)], [record(long.unflatten(1, (2, 2)))]]
    scenes = [some[0].scene[0] for some in made]
    assert [scene.score for scene in scenes] == pytest.approx([0.3901650309562683, 0.7742904499173164])
    assert [scene.frames for scene in scenes] == [2, 4]
    assert scene_by_frame(made) == pytest.approx(0.6462486435969671)  # (2 * .390 + 4 * .774) / 6
    scoring = Scoring((50, 100), True, WordGrams(), ())
    rows = [scoring.episode(some, some[0], "") for some in made]
    assert overall(rows)["mean"]["scene"] == pytest.approx(0.582228, abs=1e-6)
    assert scene_by_frame([]) is None
