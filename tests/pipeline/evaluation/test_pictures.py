"""Frames of which no picture was recorded are no truth; and how many pictures are held at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes import EpisodeError, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.initial_states import InitialStates
from envs.judges.perceptual import PerceptualDistance
from envs.simulators import replay as replaying
from envs.simulators.replay import replay, side_by_side
from learners.stages.film import Film
from pipeline.evaluation.ewmbench.choose import in_pictures
from pipeline.evaluation.ewmbench.features import PyramidPatches
from pipeline.evaluation.ewmbench.measure import Instruments
from pipeline.evaluation.ewmbench.records import Records
from pipeline.evaluation.ewmbench.samples import Samples, without_picture
from pipeline.evaluation.ewmbench.scene import scene_consistency
from pipeline.evaluation.fidelity.end_effector import EndEffectorRuler
from pipeline.evaluation.fidelity.extractors import PyramidFrames
from pipeline.evaluation.fidelity.long import drift
from pipeline.evaluation.fidelity.open_loop import OpenLoop
from pipeline.evaluation.fidelity.page import pictures_text
from pipeline.evaluation.grippers.detecting import Sights, build_detector, detector_error
from pipeline.evaluation.grippers.end_effectors import known_end_effectors
from pipeline.evaluation.grippers.ruler import GripperRuler
from pipeline.evaluation.measurement import rollout_error, speed
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, episodes_of, moving_square
from tests.pipeline.evaluation.fidelity.test_measures import Drawing

SPEC = world_spec(BIMANUAL_POSES.at(SIZE), SIZE)
DARK = (5, 8, 11)  # frames of each episode of 13 without a picture
SOME = torch.arange(8)


def store_of(folder: Path, dark: tuple[int, ...]) -> ClipStore:
    """The moving square, not photographed now and then."""
    made = []
    for episode in episodes_of(BIMANUAL_POSES):
        present = ~np.isin(np.arange(len(episode)), dark)
        frames = episode.frames * present[:, None, None, None, None]
        made.append(replace(episode, frames=frames.astype(np.uint8), present=present))
    LeRobotWriter(folder, BIMANUAL_POSES.at(SIZE)).write(made)
    return ClipStore([folder], SPEC)


@pytest.fixture(scope="module")
def dark(tmp_path_factory: pytest.TempPathFactory) -> ClipStore:
    return store_of(tmp_path_factory.mktemp("dark"), DARK)


def test_frames_without_a_picture_are_not_compared(dark: ClipStore) -> None:
    loop = OpenLoop(dark, SOME, False, None, (PyramidFrames(),))
    result = loop.measure(Drawing(SPEC, "right")).result(SPEC.embodiment.views, {})
    assert result["overall"]["psnr"] > 50 and result["overall"]["ssim"] > 0.99
    psnr = result["by_frame"]["psnr"]
    assert [n for n, value in enumerate(psnr, 1) if value is None] == list(DARK)
    assert min(value for value in psnr if value is not None) > 49
    assert result["frechet"][0]["samples"] == 8 * (12 - len(DARK)) * 3
    assert result["without_picture"] == 8 * len(DARK)
    assert pictures_text(result) == "24 frames are left out, for no picture was recorded of them."
    still = loop.held_still()
    assert [still.by_frame["mse"][n - 1] for n in DARK] == [None] * len(DARK)
    made = replay(Drawing(SPEC, "right"), dark, SOME, bf16=False)
    found = rollout_error(dark, SOME, made)
    assert found["psnr_first_frames"] > 49 and found["psnr_last_frames"] > 49


def test_long_rollouts_do_without_them_too(dark: ClipStore) -> None:
    found = drift(Drawing(SPEC, "right"), dark, SOME, False, PerceptualDistance())
    assert found["collapsed"] is False and found["end"]["psnr"] > 49 and found["frames"] == 12
    assert [found["by_frame"]["psnr"][n - 1] for n in DARK] == [None] * len(DARK)
    assert [found[name][DARK[0] - 1] for name in ("sharpness", "still", "unrelated")] == [None] * 3


def test_nor_are_grippers_looked_for_in_them(dark: ClipStore, tmp_path: Path) -> None:
    ends = known_end_effectors(dark, 0.15)
    sights = Sights.of(dark, ends, (0,))
    detector = build_detector({"width": 8, "side": 32}, 1, 2).eval()
    assert detector_error(detector, sights, SOME)["top"]["frames"] == 8 * (13 - len(DARK))
    ruler = GripperRuler(detector, (0,), None, tmp_path)
    assert {len(path) for path in in_pictures(dark, ruler, SOME).paths} == {13 - len(DARK)}
    made = replay(Drawing(SPEC, "right"), dark, SOME, bf16=False).pictured(dark)
    hands = EndEffectorRuler(ruler, ends, ("top",)).measure(dark, SOME, made, dark.frames(made.rows))
    assert not hands["valid"][:, [n - 1 for n in DARK]].any()


def test_ewmbench_leaves_them_out_of_either_video(dark: ClipStore, tmp_path: Path) -> None:
    looking = Instruments(PyramidPatches(), PyramidFrames(), (0,), None, (), None, False)
    records = (Records(tmp_path / name, {}) for name in ("made", "true"))
    samples = Samples(Drawing(SPEC, "right"), dark, looking, *records, tmp_path / "films", False)
    some, done = torch.arange(2), lambda count: None
    true = samples.recorded(some, done)
    made = samples.generated(some, 0, true, done)
    rows = dark.rows(some[:1])
    seen = dark.frames(rows[[n for n in range(13) if n not in DARK]])[:, 0]
    assert true[0].scene[0] == scene_consistency(looking.patches(seen), False)
    assert made[0].scene[0].score == pytest.approx(true[0].scene[0].score, abs=0.01)
    assert without_picture(dark, some) == ["6 frames are left out, for no picture was recorded of them."]


def test_video_is_not_generated_from_a_frame_without_a_picture(tmp_path: Path, dark: ClipStore) -> None:
    begun = store_of(tmp_path / "set", (0, 3))
    for ask in (
        lambda: replay(Drawing(SPEC, "right"), begun, SOME, bf16=False),
        lambda: OpenLoop(begun, SOME, False).held_still(),
        lambda: InitialStates.of(begun),
    ):
        with pytest.raises(
            EpisodeError, match=r"set: \d+ episodes, .*number 0, have no picture at their first"
        ):
            ask()
    assert begun.pictures(SOME).tolist() == [11] * 8 and dark.pictures(SOME).tolist() == [10] * 8
    assert without_picture(store_of(tmp_path / "whole", ()), SOME) == []


def test_films_and_speed_are_of_episodes_that_begin_with_a_picture(tmp_path: Path) -> None:
    begun = store_of(tmp_path / "set", (0,))
    present, first = begun.arrays["present"], begun.start
    film = Film(Drawing(SPEC, "right"), begun, tmp_path, False)
    film(1)  # nothing can be drawn, and training goes on
    assert not (tmp_path / "media").exists()
    with pytest.raises(EpisodeError, match="have no picture at their first"):
        speed(Drawing(SPEC, "right"), begun, 4, 1, False)
    present[first[begun.split("held_out")[1]]] = True
    film(2)
    assert (tmp_path / "media/held-out-step000002.mp4").is_file()
    assert speed(Drawing(SPEC, "right"), begun, 4, 1, False) > 0


class Counting(Drawing):
    """Keeps how many episodes it was asked to go on with each time."""

    def __init__(self) -> None:
        super().__init__(SPEC, "right")
        self.asked: list[int] = []

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        self.asked.append(len(inputs))
        return super().predict(inputs)


def test_as_many_episodes_are_held_at_once_as_have_room(
    store: ClipStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert side_by_side(store, 13) == 32 and side_by_side(store, 10**9) == 1
    large = replace(store.spec, size=(384, 512))  # of GE-Sim, whose pose maps take as much again
    picture = 2 * 3 * 3 * 384 * 512
    with monkeypatch.context() as patched:
        patched.setattr(store, "spec", large)
        assert side_by_side(store, 301) == 2**32 // (301 * picture) < 16
    whole, loop = Counting(), OpenLoop(store, SOME, False)
    together = replay(whole, store, SOME, bf16=False).frames
    once = loop.measure(whole).overall
    monkeypatch.setattr(replaying, "_ROOM", 3 * 13 * 2 * 3 * 3 * 32 * 32)  # of three episodes
    few = Counting()
    assert torch.equal(replay(few, store, SOME, bf16=False).frames, together)
    assert set(whole.asked) == {8} and few.asked == [3] * 3 + [3] * 3 + [2] * 3
    assert loop.measure(few).overall == pytest.approx(once)
    apart = drift(few, store, SOME, False, PerceptualDistance())
    monkeypatch.undo()
    assert apart == drift(whole, store, SOME, False, PerceptualDistance())


def test_speed_is_measured_over_a_few_chunks_at_the_batch_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    LeRobotWriter(tmp_path, BIMANUAL_POSES.at(SIZE)).write(
        [moving_square(BIMANUAL_POSES, seed, length=120) for seed in range(2)]
    )
    store, world = ClipStore([tmp_path], SPEC), Counting()
    assert speed(world, store, 4, 1, False) > 0
    assert world.asked == [1] + [4] * 10  # of 30 chunks
    monkeypatch.setattr(replaying, "_ROOM", 4 * 13 * 2 * 3 * 3 * 32 * 32)  # of four times three chunks
    world.asked.clear()
    speed(world, store, 4, 20, False)
    assert world.asked == [1] + [4] * 6
