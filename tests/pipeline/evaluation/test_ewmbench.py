"""EWMBench's figures against hand-worked cases and reference implementations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import directed_hausdorff
from scipy.stats import wasserstein_distance

from envs.rng import constant_generator
from envs.targets import ConfigError
from pipeline.evaluation.ewmbench.choose import Paths, choose
from pipeline.evaluation.ewmbench.coverage import least_overlap, mean_overlap, overlaps, voxels
from pipeline.evaluation.ewmbench.features import PyramidPatches, WordGrams, fingerprint
from pipeline.evaluation.ewmbench.records import Record, Records
from pipeline.evaluation.ewmbench.result import Scoring, overall
from pipeline.evaluation.ewmbench.scene import Scene, diversity, scene_consistency, video_embedding
from pipeline.evaluation.ewmbench.semantics import (
    VideoReport,
    bleu,
    logic,
    paired_in_order,
    parse_caption,
    parse_errors,
    parse_steps,
    read_errors,
    step_similarity,
)
from pipeline.evaluation.ewmbench.trajectory import (
    CAPS,
    best_of,
    dynamics,
    fill_gaps,
    hausdorff,
    normalised_dtw,
    scores,
)
from tests.moving_square import picture

Floats = NDArray[np.float64]
SIZE = (50, 100)  # height, width
NAN = math.nan


def line(*x: float) -> Floats:
    """A track [T, 2] along the first axis."""
    return np.stack((np.array(x, float), np.zeros(len(x))), -1)


def walk(seed: int, frames: int = 7) -> Floats:
    return np.random.default_rng(seed).normal(size=(frames, 2)).cumsum(0)


def arms(*tracks: Floats) -> Floats:
    return np.stack(tracks, 1)


# -- trajectories
def test_hausdorff_is_the_larger_of_scipys_directed_ones() -> None:
    one, other = walk(0), walk(1, 5)
    both = directed_hausdorff(one, other)[0], directed_hausdorff(other, one)[0]
    assert hausdorff(one, other) == pytest.approx(max(both)) and both[0] != both[1]
    assert hausdorff(line(0, 1, 2), line(0, 1, 4)) == 2.0


def all_paths(n: int, m: int) -> list[list[tuple[int, int]]]:
    """Every warping path from (0, 0) to (n, m)."""
    if (n, m) == (0, 0):
        return [[(0, 0)]]
    before = [(a, b) for a, b in ((n - 1, m - 1), (n - 1, m), (n, m - 1)) if a >= 0 and b >= 0]
    return [[*path, (n, m)] for at in before for path in all_paths(*at)]


def test_time_warping_finds_the_least_of_all_paths() -> None:
    one, other = walk(2, 4), walk(3, 5)
    cost = {
        sum(float(np.linalg.norm(one[i] - other[j])) for i, j in path): len(path) for path in all_paths(3, 4)
    }
    least = min(cost)
    assert normalised_dtw(one, other) == pytest.approx(least / cost[least])
    # A pause costs nothing; the path is as long as the longer track.
    assert normalised_dtw(line(0, 1, 1, 1, 2), line(0, 1, 2)) == 0.0
    assert normalised_dtw(line(0, 1, 2), line(0, 2)) == pytest.approx(1 / 3)


def test_dynamics_by_hand_and_by_scipy() -> None:
    # Speeds 1, 2 and 1, 1; changes 1 and 0. No span of speed on one side, none of changes on either.
    assert dynamics(line(0, 1, 3), line(0, 1, 2), True) == pytest.approx(0.003, rel=1e-6)
    one, other = walk(4), walk(5, 9)
    speeds = [np.linalg.norm(np.diff(track, axis=0), axis=1) for track in (one, other)]
    wanted = 0.0
    for weight, pair in ((0.007, speeds), (0.003, [np.diff(speed) for speed in speeds])):
        low, high = sorted(float(np.ptp(values)) for values in pair)
        wanted += weight * low / high / wasserstein_distance(*pair)
    assert dynamics(one, other, True) == pytest.approx(wanted, rel=1e-6)
    # A perfect match is 0 in the public code, and as much as the cap allows in ours; half a match is its
    # half.
    assert dynamics(one, one, True) == 0.0 and dynamics(one, one, False) == pytest.approx(CAPS["dyn"])
    shifted = line(0, 2, 5, 9)  # speeds 2, 3, 4 beside 1, 2, 3: equal changes
    half = dynamics(shifted, line(0, 1, 3, 6), False)
    assert half == pytest.approx(0.007 + 0.3 * CAPS["dyn"])


def test_gaps_are_filled_along_straight_lines() -> None:
    filled = fill_gaps(line(NAN, 1, NAN, NAN, 4, NAN) + np.array([0, 1.0]))
    assert filled is not None and filled[:, 0].tolist() == [1, 1, 2, 3, 4, 4] and (filled[:, 1] == 1).all()
    assert fill_gaps(line(1, *[NAN] * 5)) is None and fill_gaps(line(1, *[NAN] * 4)) is not None
    assert fill_gaps(line(NAN, NAN)) is None


def test_scores_are_shares_of_the_caps() -> None:
    true = line(10, 20, 30, 50)
    away = true + np.array([0.0, 10.0])  # a tenth of the width, a fifth of the height
    sane, public = (scores(arms(away), arms(true), SIZE, strict) for strict in (False, True))
    assert sane is not None and public is not None
    assert [sane.hsd, sane.ndtw, public.hsd] == pytest.approx([0.1, 0.1, 0.2])
    assert sane.sa == pytest.approx(10 / 24.979) and sane.ta == pytest.approx(10 / 50.202, rel=1e-6)
    assert public.sa == pytest.approx(5 / 24.979)
    assert sane.dyn == pytest.approx(1) and public.dyn == 0.0  # it moves alike
    perfect = scores(arms(true), arms(true), SIZE, False)
    assert perfect is not None and perfect.hsd == 0.0
    assert [perfect.sa, perfect.ta, perfect.dyn] == pytest.approx([1, 1, 1])


def test_every_arm_counts_but_in_the_public_code() -> None:
    far, near = line(0, 20, 40, 80), line(0, 5, 10, 20)
    made = arms(far, near + np.array([0.0, 10.0]))
    sane, public = (scores(made, arms(far, near), SIZE, strict) for strict in (False, True))
    assert sane is not None and public is not None
    assert sane.hsd == pytest.approx(0.05) and public.hsd == 0.0 and public.sa == 1.0
    # It counts arms among those that have a true track: the second stands for the first where that has none.
    lost = arms(line(NAN, NAN, NAN, NAN), near)
    assert scores(made, lost, SIZE, True).missing == 0.0  # type: ignore[union-attr]
    fault = scores(made, arms(far * NAN, near), SIZE, True)
    assert fault is not None and fault.hsd == pytest.approx(math.hypot(1.8, 1))  # to (-1, -1)
    kept = scores(made, arms(far * NAN, near), SIZE, False)
    assert kept is not None and kept.hsd == pytest.approx(0.1)


def test_trajectories_with_gaps_and_of_unequal_length() -> None:
    true, gone = line(*range(0, 60, 10)), line(10, *[NAN] * 5)
    found = scores(arms(gone), arms(true), SIZE, False)
    assert found is not None and (found.sa, found.ta, found.dyn, found.hsd) == (0.0, 0.0, 0.0, None)
    assert found.missing == pytest.approx(5 / 6)
    assert scores(arms(true), arms(gone), SIZE, False) is None  # nobody knows the truth
    shorter = scores(arms(true[:4]), arms(true), SIZE, False)
    assert shorter is not None and shorter.hsd == pytest.approx(0.2)
    with pytest.raises(ValueError, match="three frames at least, not 2 and 6"):
        scores(arms(true[:2]), arms(true), SIZE, False)
    with pytest.raises(ValueError, match="of the same arms"):
        scores(arms(true, true), arms(true), SIZE, False)
    rows = [scores(arms(true + np.array([0.0, off])), arms(true), SIZE, False) for off in (9.0, 3.0, 6.0)]
    assert best_of([found, *rows]) == 2  # type: ignore[list-item]


def record(*cameras: Floats) -> Record:
    """A video of cameras [T, 2] in which one arm's gripper was found."""
    tracks = torch.from_numpy(np.stack(cameras, 1))[:, :, None].float()
    return Record((), torch.zeros(1), tracks, None)


def test_a_sample_that_loses_its_gripper_in_a_camera_is_not_the_best() -> None:
    true, gone = line(10, 20, 30, 50), line(10, NAN, NAN, NAN)
    near, far = true + np.array([0.0, 1.0]), true + np.array([0.0, 8.0])
    scoring = Scoring(SIZE, False, WordGrams(), ())
    found = scoring.episode([record(near, gone), record(far, far), record(far, near)], record(true, true), "")
    assert [row["lost"] for row in found["samples"]] == [0.5, 0.0, 0.0] and found["best"] == 2
    assert [found[row]["hsd"] for row in ("generated", "mean")] == pytest.approx([0.045, (1 + 8 + 4.5) / 300])


def test_the_given_first_frame_counts_in_the_public_code_alone() -> None:
    # It lies 30 pixels away from all others: speeds 30, 10, 20 beside 30, 10, 10.
    true, made = line(0, 30, 40, 50), line(0, 30, 40, 60)
    sane, public = (
        Scoring(SIZE, strict, WordGrams(), ()).episode([record(made)], record(true), "")["generated"]
        for strict in (False, True)
    )
    assert [sane["hsd"], public["hsd"]] == pytest.approx([0.1, 0.1])
    # warped in order: only the last pair is apart, of three frames or of four
    assert (sane["ndtw"], public["ndtw"]) == pytest.approx((0.1 / 3, 0.1 / 4))
    # Spans of speed 20 and 20, sorted 10, 20, 30 and 10, 10, 30: 10 / 3 apart. Changes -20, 10 and -20, 0:
    # spans 30 and 20, and 10 / 2 apart.
    wanted = 0.007 / (0.1 / 3) + 0.003 * (20 / 30) / (0.1 / 2)
    assert public["dyn"] == pytest.approx(wanted / CAPS["dyn"], rel=1e-5)


def test_a_still_picture_has_no_scene_of_its_own_in_the_public_code() -> None:
    # where light is all that patches show, no patch shows a colour, and such features count 0
    picture = torch.full((4, 3, 64, 64), 128, dtype=torch.uint8)
    picture[..., 20:30, 20:30] = 255
    patches = PyramidPatches()(picture)
    assert scene_consistency(patches, False).score == pytest.approx(1)
    assert scene_consistency(patches, True).score < 0.5
    true = record(line(10, 20, 30, 50))
    rows = [Scoring(SIZE, strict, WordGrams(), ()).episode([true], true, "") for strict in (False, True)]
    assert [overall([row])["still"]["scene"] for row in rows] == [1.0, None]
    assert all(row["still"]["hsd"] for row in rows)


# -- the set
def test_voxels_are_passed_without_gaps() -> None:
    path = torch.tensor([[[0.1, 0.1]], [[3.5, 0.1]]])
    assert voxels(path, 1.0).tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0]]
    two = voxels(path.expand(2, 2, 2), 1.0)
    assert len(two) == 8 and two[:, 0].tolist() == [0] * 4 + [1] * 4  # arms do not meet
    assert len(voxels(path * NAN, 1.0)) == 0


def test_the_set_is_chosen_for_least_overlap() -> None:
    cells = [np.array([[0, n] for n in some]) for some in ((0, 1, 2, 3), (0, 1, 2), (2, 3), (8, 9))]
    iou = overlaps(cells)
    assert iou[0].tolist() == pytest.approx([1, 3 / 4, 2 / 4, 0]) and iou[1, 2] == pytest.approx(1 / 4)
    # The lonely one first; then of those that overlap with it equally the first; then what overlaps least.
    assert least_overlap(iou, 3) == [3, 0, 2] and least_overlap(iou, 9) == [3, 0, 2, 1]
    assert least_overlap(iou, 0) == [] and mean_overlap(iou, [0, 2]) == 0.5 and mean_overlap(iou, [3]) == 0.0


def test_each_task_has_its_part_of_the_set() -> None:
    episodes, tasks = torch.arange(10, 16), ["a", "b"] * 3
    spread = choose(episodes, tasks, 2, 1.0, None)
    assert spread.episodes.tolist() == [10, 14, 11, 15] and spread.overlap is None
    ends = (2.0, 9.0, 3.0, 9.0, -4.0, -9.0)  # of straight paths from the middle
    paths = [torch.tensor([[[0.5, 0.0]], [[end + 0.5, 0.0]]]) for end in ends]
    chosen = choose(episodes, tasks, 2, 1.0, Paths(paths, "by hand"))
    assert chosen.episodes.tolist() == [14, 12, 15, 11] and chosen.of == 6 and chosen.by == "by hand"
    assert chosen.overlap == pytest.approx((1 / 8 + 1 / 19) / 2) and chosen.overlap < chosen.overlap_of_all  # type: ignore[operator]


# -- scenes
def test_scene_consistency_by_hand() -> None:
    # Two patches: one stays, one turns by a right angle, then back.
    patches = torch.tensor([[[1.0, 0], [2, 0]], [[1, 0], [0, 3]], [[1, 0], [1, 0]]])
    assert scene_consistency(patches, False) == Scene(0.5, 0.75, 0.625, 2)
    still = patches[:1].expand(4, -1, -1)
    assert scene_consistency(still, False).score == pytest.approx(1)
    # The public code compares all patches feature by feature: (1, 1) with (1, 0), and (0, 0) with (0, 1).
    public = scene_consistency(patches[:2], True)
    assert public.previous == public.first == pytest.approx(math.sqrt(0.5) / 2)
    with pytest.raises(ValueError, match="there are 1"):
        scene_consistency(patches[:1], False)


def test_diversity_by_hand() -> None:
    assert diversity(torch.tensor([[1.0, 0], [3, 0], [0, 2]])) == pytest.approx(2 / 3)
    assert diversity(torch.ones(3, 4)) == pytest.approx(0) and diversity(torch.ones(1, 4)) is None


def test_each_frame_counts_alike_in_the_public_codes_embedding() -> None:
    features = torch.tensor([[[3.0, 0.0]], [[0.0, 1.0]]])
    assert video_embedding(features, False).tolist() == [1.5, 0.5]
    assert video_embedding(features, True).tolist() == [0.5, 0.5]


def test_patches_tell_a_moving_scene_from_light() -> None:
    frames = torch.from_numpy(np.stack([picture(np.array([x, 0.3]), 1)[0] for x in (0.1, 0.1, 0.5)]))
    brighter = (frames[1].int() + 12).clamp(0, 255).to(torch.uint8)
    extract = PyramidPatches()
    light, moved = (
        scene_consistency(extract(torch.stack((frames[0], other))), False).score
        for other in (brighter, frames[2])
    )
    assert moved < light - 0.05 and light > 0.95 and "no learned weights" in extract.name


def test_weights_that_differ_anywhere_have_another_name(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    weights = tmp_path / "model.safetensors"
    names = []
    for last in (b"0", b"1", b"0"):
        weights.write_bytes(bytes(3 << 20) + last)
        names.append(fingerprint(str(tmp_path)))
    assert names[0] == names[2] != names[1] and len(names[0]) == 8


# -- semantics
def test_bleu_by_hand() -> None:
    wanted = "Push the red block to the disc."
    assert bleu("push the red block to the disc", wanted, False) == pytest.approx(1)
    assert bleu("push the red block", wanted, False) == pytest.approx(math.exp(1 - 7 / 4))  # brevity alone
    # Two of three words; 0 + 1 of 2 + 1 pairs; 0 + 1 of 1 + 1 triples.
    assert bleu("put a cup", "put the cup", False) == pytest.approx((2 / 3 / 3 / 2) ** (1 / 3))
    assert bleu("put a cup", "put the cup", True) == 0.0  # no 4-gram
    # a caption of two words has no triples: they are no hits
    assert bleu("red cup", "put the cup", False) == pytest.approx((1 / 2 / 2) ** 0.5 * math.exp(-1 / 2))
    assert bleu("a b c d", "a b c d", True) == pytest.approx(1) and bleu("?", wanted, False) == 0.0


def test_steps_are_paired_in_order() -> None:
    table = torch.tensor([[0.9, 0.1, 0.0], [0.8, 0.2, 0.3]])
    assert paired_in_order(table) == pytest.approx(0.9 + 0.3)
    crossed = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    assert paired_in_order(crossed) == 1.0
    texts = WordGrams()
    same = ("grasp the cup", "lift it")
    assert step_similarity(same, same, texts) == pytest.approx(1)
    assert step_similarity((*same, "dance"), same, texts) == pytest.approx(2 / 3)
    # One word and no pair in common, of 3 + 2 and 2 + 1 grams.
    found = texts.similarity(["grasp the cup"], ["the plate"])
    assert float(found) == pytest.approx(1 / math.sqrt(5 * 3))


def test_answers_are_read_strictly() -> None:
    known = read_errors("errors")
    assert parse_caption('\n "Put it down." \n more') == "Put it down." and parse_caption(" \n--") is None
    assert parse_steps("Sure:\n1. Go.\n **2) Grasp it**\nend") == ("Go.", "Grasp it")
    assert parse_steps("It goes.") is None
    said = "The cup is gone.\n**Errors:** vanishing object, wrong order."
    assert parse_errors(said, known) == ("vanishing object", "wrong order")
    assert logic(("vanishing object", "wrong order"), known) == pytest.approx(0.4)
    assert logic([error.name for error in known], known) == 0.0
    assert parse_errors("Errors: none", known) == () and logic((), known) == 1.0
    for text in ("Errors: ghosts", "none", "Errors: none\nor not", "Errors:"):
        assert parse_errors(text, known) is None


def test_lists_of_errors_say_what_is_wrong_with_them(tmp_path: Path) -> None:
    mine = tmp_path / "mine.txt"
    mine.write_text("# none\n\nghost | 2 | walks\n")
    with pytest.raises(ConfigError, match=r"mine\.txt:3 should be: name \| penalty"):
        read_errors(str(mine))
    mine.write_text("#\n")
    with pytest.raises(ConfigError, match="holds no error"):
        read_errors(str(mine))
    with pytest.raises(ConfigError, match="did you mean errors"):
        read_errors("error")


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    tracks = torch.tensor([[[[1.2345678, 200 / 3], [NAN, NAN]]]])  # a second run gives the same figures
    said = VideoReport("go", ("a", "b"), ())
    seen = (Scene(0.5, 0.25, 0.375, 4),)
    record = Record(seen, torch.randn(3, generator=constant_generator(0)), tracks, said)
    records = Records(tmp_path, {"world": 1})
    assert records.get("7-0", {"draw": 0}) is None
    records.put("7-0", {"draw": 0}, record)
    again = records.get("7-0", {"draw": 0})
    assert again is not None and again.scene == record.scene and again.report == said
    assert torch.equal(again.embedding, record.embedding) and again.tracks is not None
    assert torch.equal(again.tracks.nan_to_num(-1), tracks.nan_to_num(-1)) and records.reused == 1
    assert Records(tmp_path, {"world": 2}).get("7-0", {"draw": 0}) is None
    records.put("7-1", {}, Record(record.scene, record.embedding, None, VideoReport("go", None, ())))
    assert records.get("7-1", {}) is None  # something is left to be asked
