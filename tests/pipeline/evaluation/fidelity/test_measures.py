"""Errors of generated video against hand-worked cases and reference implementations."""

from __future__ import annotations

import json
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, Judgement
from envs.judges.perceptual import PerceptualDistance
from envs.rng import constant_generator
from envs.simulators.base import Simulator
from envs.specs import Status, WorldSpec
from envs.targets import ConfigError
from pipeline.evaluation.fidelity.extractors import PyramidClips, PyramidFrames
from pipeline.evaluation.fidelity.frames import by_frame, check_pair, frame_errors, psnr, summary
from pipeline.evaluation.fidelity.grid import combinations, optimum, with_settings
from pipeline.evaluation.fidelity.long import drift
from pipeline.evaluation.fidelity.masks import read_labels
from pipeline.evaluation.fidelity.open_loop import OpenLoop
from pipeline.evaluation.fidelity.page import collapse_text
from pipeline.evaluation.fidelity.strides import by_stride, stride_cells
from pipeline.evaluation.judging import thinned
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square, picture


class Drawing(Simulator):
    """A world of tests/moving_square.py that is right, or wrong in a known way.

    Args:
        how: frames uint8 [B, K, V, 3, H, W] that it makes of the right ones.
    """

    def __init__(self, spec: WorldSpec, how: str):
        super().__init__(spec, 1)
        self.how, self.feature_shape = how, (1,)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        places = inputs["future", "commands"][..., :2].double().numpy()
        frames = torch.from_numpy(
            np.stack([np.stack([picture(place, self.spec.views) for place in row]) for row in places])
        )
        if self.how == "noise":
            frames = torch.randint(0, 255, frames.shape, generator=constant_generator(0), dtype=torch.uint8)
        if self.how == "grey":
            frames = torch.full_like(frames, 60)
        return frames, torch.zeros(len(frames), 1)


def video(*values: float) -> Tensor:
    """One episode of one view whose frames are of one grey level each, 16 x 16."""
    frames = torch.tensor(values).mul(255).round().to(torch.uint8)
    return frames[None, :, None, None, None, None].expand(1, len(values), 1, 3, 16, 16).contiguous()


def test_errors_of_plain_frames_are_known_by_hand() -> None:
    made, true = video(0.2, 0.4), video(0.2, 0.6)
    errors = frame_errors(made, true, PerceptualDistance())
    assert errors["mse"].flatten().tolist() == pytest.approx([0.0, 0.04], abs=1e-6)
    # Of plain pictures the structural part is 1, and the rest is the textbook's comparison of means.
    light = (2 * 0.4 * 0.6 + 0.01**2) / (0.4**2 + 0.6**2 + 0.01**2)
    assert errors["ssim"].flatten().tolist() == pytest.approx([1.0, light], abs=1e-3)
    assert errors["perceptual"][0, 0, 0] == 0.0 < errors["perceptual"][0, 1, 0]
    both = torch.ones(1, 2, dtype=torch.bool)
    assert psnr(torch.tensor(0.04)) == pytest.approx(13.979, abs=1e-3)
    assert summary(errors, both)["mse"] == pytest.approx(0.02, abs=1e-6)
    assert by_frame(errors, torch.tensor([[True, False]]))["mse"] == [pytest.approx(0.0), None]


def test_parts_are_measured_where_they_truly_are() -> None:
    true = video(0.0)
    made, labels = true.clone(), torch.zeros(1, 1, 1, 16, 16, dtype=torch.uint8)
    labels[..., :4, :] = 1  # an arm above, nothing else known of
    made[..., :2, :] = 255  # half of it is wrong
    errors = frame_errors(made, true, PerceptualDistance(), labels)
    assert float(errors["arm_mse"]) == 0.5 and float(errors["mse"]) == 0.125
    assert torch.isnan(errors["object_mse"]).all()
    assert summary(errors, torch.ones(1, 1, dtype=torch.bool))["object_mse"] is None


def test_videos_of_unequal_length_are_refused() -> None:
    with pytest.raises(ValueError, match=r"2 frames and 3.*cut both"):
        check_pair(video(0.1, 0.2), video(0.1, 0.2, 0.3))
    with pytest.raises(ValueError, match="labels are"):
        frame_errors(
            video(0.1), video(0.1), PerceptualDistance(), torch.zeros(1, 1, 1, 8, 8, dtype=torch.uint8)
        )


def test_a_right_world_is_measured_as_right(store: ClipStore) -> None:
    labels = torch.ones(20, store.whole(torch.arange(20))[0].shape[1], 3, 32, 32, dtype=torch.uint8)
    extractors = PyramidFrames(), PyramidClips()
    loop = OpenLoop(store, torch.arange(8), False, labels.__getitem__, extractors, clip=4)
    right = loop.measure(Drawing(store.spec, "right")).result(store.spec.embodiment.views, {})
    wrong = loop.measure(Drawing(store.spec, "grey")).result(store.spec.embodiment.views, {})
    assert right["episodes"] == 8 and len(right["by_frame"]["mse"]) == 12 and len(right["views"]) == 3
    assert right["overall"]["psnr"] > 25 > wrong["overall"]["psnr"]  # recordings are encoded with loss
    assert right["overall"]["arm_mse"] == pytest.approx(right["overall"]["mse"])
    for one, other in zip(right["frechet"], wrong["frechet"], strict=True):
        assert one["extractor"] == other["extractor"] and one["value"] < other["value"] / 10
    assert {one["samples"] for one in right["frechet"]} == {8 * 12 * 3, 8 * 3 * 3}
    still = loop.held_still()
    assert still.by_frame["mse"][-1] > 5 * right["by_frame"]["mse"][-1]
    assert still.overall["arm_mse"] == pytest.approx(still.overall["mse"])
    assert loop.held_coded(Drawing(store.spec, "right")) is None


def test_labels_are_held_of_no_more_episodes_than_are_measured_at_once(store: ClipStore) -> None:
    held: list[weakref.ref[Tensor]] = []

    def told(episodes: Tensor) -> Tensor:
        assert all(one() is None for one in held)  # those of earlier batches
        rows, _ = store.whole(episodes)
        labels = torch.ones(*rows.shape, 3, 32, 32, dtype=torch.uint8)
        held.append(weakref.ref(labels))
        asked.append(len(episodes))
        return labels

    asked: list[int] = []
    loop = OpenLoop(store, torch.arange(20), False, told)
    found = loop.measure(Drawing(store.spec, "right"))
    assert asked == [16, 4] and found.overall["arm_mse"] == pytest.approx(found.overall["mse"])
    assert loop.held_still().overall["arm_mse"] is not None and asked == [16, 4] * 2


def test_strides_are_compared_at_the_frames_that_all_of_them_show(store: ClipStore) -> None:
    labels = torch.zeros(8, 12, 3, 32, 32, dtype=torch.uint8)
    labels[:, 3::4] = 1  # the arm is seen in every fourth frame alone
    loop = OpenLoop(store, torch.arange(8), False, labels.__getitem__)
    rows = by_stride(loop, Drawing(store.spec, "right"), [1, 2, 4])
    assert [row["frames"] for row in rows] == [12, 12, 12]  # the square's places are what is commanded
    assert len({row["psnr"] for row in rows}) == 1 and rows[0]["psnr"] > 25
    assert len({row["arm_mse"] for row in rows}) == 1 and rows[0]["arm_mse"] is not None
    assert all(row["seconds"] > 0 and row["verdicts"] == {} for row in rows)
    assert stride_cells(rows[0], ["x"])[3:] == ["12.0", "x", "-", "-"]


class Done(Judge):
    """Takes every frame for a success."""

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score."""
        sure = torch.ones(frames.shape[:2])
        return Judgement(sure, sure, torch.full((len(frames),), Status.OK.value))


def test_so_many_fewer_frames_of_a_stride_make_an_episode_a_success(store: ClipStore) -> None:
    judge = Done(hold=4)
    loop = OpenLoop(store, torch.arange(8), False, judge=judge)
    rows = by_stride(loop, Drawing(store.spec, "right"), [1, 4])  # 12 frames, and 3
    for row in rows:
        counts = [
            {name: found[name] for name in ("tp", "fp", "fn", "tn")} for found in row["verdicts"].values()
        ]
        assert counts == [{"tp": 4, "fp": 4, "fn": 0, "tn": 0}] * 2
    assert judge.hold == 4
    for every, hold in ((1, 4), (2, 2), (3, 1), (8, 1)):
        with thinned(judge, every) as same:
            assert same is judge and judge.hold == hold


def test_collapse_is_seen_and_nothing_else_taken_for_it(store: ClipStore) -> None:
    episodes = torch.arange(0, 20, 2)

    def of(how: str, count: int = 10) -> dict[str, object]:
        return drift(Drawing(store.spec, how), store, episodes[:count], False, PerceptualDistance())

    right, noise, grey = of("right"), of("noise"), of("grey")
    assert not right["collapsed"] and noise["collapsed"] and grey["collapsed"]
    assert right["frames"] == 12 and len(right["still"]) == len(right["unrelated"]) == 12  # type: ignore[arg-type]
    assert right["end"]["sharpness"] == pytest.approx(1, abs=0.2)  # type: ignore[index]
    alone = of("right", 1)  # errors of one episode have nothing to be compared with
    assert alone["collapsed"] is None and of("grey", 1)["collapsed"]
    assert "collapse unknown" in collapse_text({**alone, "wanted": 12})
    assert noise["end"]["sharpness"] > 2 and grey["end"]["sharpness"] < 0.1  # type: ignore[index]


@pytest.mark.parametrize(
    ("chunk", "lengths"), [(5, [13, 13, 13]), (25, [41, 41, 41]), (25, [41, 34, 27]), (4, [42, 38, 30])]
)
def test_the_end_of_an_episode_is_its_own(chunk: int, lengths: list[int], tmp_path: Path) -> None:
    """However many frames fill up the last chunk, and however long others are."""
    robot = BIMANUAL_POSES.at(SIZE)
    made = [moving_square(robot, seed, "random", length=length) for seed, length in enumerate(lengths)]
    LeRobotWriter(tmp_path, robot).write(made)
    store = ClipStore([tmp_path], replace(world_spec(robot, SIZE), chunk=chunk))
    episodes = torch.arange(len(lengths))
    right, grey = (
        drift(Drawing(store.spec, how), store, episodes, False, PerceptualDistance())
        for how in ("right", "grey")
    )
    assert right["collapsed"] is False and grey["collapsed"] is True
    assert right["end"]["psnr"] > 49 and right["end"]["sharpness"] == pytest.approx(1, abs=0.1)
    assert right["frames"] == len(right["by_frame"]["psnr"]) == max(lengths) - 1
    json.dumps(right, allow_nan=False)


def test_masks_of_real_video_come_from_a_file(store: ClipStore, tmp_path: Path) -> None:
    length = int(store.length[3])
    good = {str(n): np.zeros((length, 3, 16, 16), np.uint8) for n in (3, 5)}
    good["5"][:, :, :8] = 2
    np.savez(tmp_path / "good.npz", **good)
    labels = read_labels(tmp_path / "good.npz", store, torch.tensor([3, 5]))
    assert labels.shape == (2, length - 1, 3, 32, 32)
    assert (labels[1, :, :, :16] == 2).all() and not labels[0].any() and not labels[1, :, :, 16:].any()
    with pytest.raises(ConfigError, match="holds no array '4'"):
        read_labels(tmp_path / "good.npz", store, torch.tensor([4]))
    np.savez(tmp_path / "short.npz", **{"3": good["3"][1:]})
    with pytest.raises(ConfigError, match=rf"takes whole numbers \[{length}, 3, h, w\]"):
        read_labels(tmp_path / "short.npz", store, torch.tensor([3]))
    odd = np.full((length, 3, 16, 16), np.nan, np.float32), good["3"].astype(np.int8) - 1, good["3"] + 0.5
    for n, array in enumerate(odd):
        np.savez(tmp_path / f"odd_{n}.npz", **{"3": array})
        with pytest.raises(ConfigError, match="takes whole numbers"):
            read_labels(tmp_path / f"odd_{n}.npz", store, torch.tensor([3]))
    whole = (tmp_path / "good.npz").read_bytes()
    np.save(tmp_path / "array.npy", good["3"])
    damaged = {
        "no.npz": b"no",
        "empty.npz": b"",
        "short_by_half.npz": whole[: len(whole) // 2],
        "changed.npz": whole.replace(bytes(64), b"\1" * 64, 1),
        "array.npz": (tmp_path / "array.npy").read_bytes(),
    }
    for name, held in damaged.items():
        (tmp_path / name).write_bytes(held)
        with pytest.raises(ConfigError, match=rf"fidelity\.masks=.*{name} is no \.npz file, or damaged"):
            read_labels(tmp_path / name, store, torch.tensor([3]))


def test_options_at_inference_in_all_combinations() -> None:
    grid = {"simulator.context": [1, 2], "simulator.net.horizon": [4]}
    assert list(combinations(grid)) == [
        {"simulator.context": 1, "simulator.net.horizon": 4},
        {"simulator.context": 2, "simulator.net.horizon": 4},
    ]
    cfg = {"simulator": {"context": 9, "net": {"horizon": 9}}}
    changed = with_settings(cfg, {"simulator.net.horizon": 4})
    assert changed["simulator"] == {"context": 9, "net": {"horizon": 4}} and cfg["simulator"]["net"] == {
        "horizon": 9
    }
    for key in ("simulator.contexts", "simulator.nets.horizon"):
        with pytest.raises(ConfigError, match="did you mean"):
            with_settings(cfg, {key: 1})
    with pytest.raises(ConfigError, match="options of the simulator"):
        with_settings(cfg, {"task.horizon": 1})
    assert optimum([{"mse": 0.2}, {"mse": 0.1}, {"mse": None}], "mse") == 1
    assert optimum([{"mse": None}], "mse") is None
