"""The judge's stage: labels, balance, generated frames, calibration, and that it learns."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import envs.simulators.replay as replaying
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.judges import MissingFeatures, RuleJudge
from envs.judges.fitted import FittedJudge
from envs.simulators.features import features_of_episodes
from learners.stages.generated import generated_frames, recorded_features
from learners.stages.judge import JudgeData, calibrate, frame_targets, judge_recordings, train_judge
from learners.stages.pictures import augment, augmented
from learners.stages.simulator import units
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, EMBODIMENTS, world_spec
from tests.learners.models import judge_of, simulator_of
from tests.moving_square import SIZE, moving_square
from tests.sampling import every

Stores = Callable[[Embodiment], ClipStore]


@pytest.mark.parametrize(
    ("robot", "name"),
    every(2, [*((robot, "learned") for robot in EMBODIMENTS.values()), (ARM_DELTAS, "proxy")]),
    ids=[*EMBODIMENTS, "proxy"],
)
def test_a_judge_learns_who_succeeded(
    robot: Embodiment, name: str, tiny_store: Stores, tmp_path: Path
) -> None:
    store = tiny_store(robot)
    judge = judge_of(store.spec, name=name)
    options = FitConfig(steps=60, batch=32, lr=3e-3, warmup=5, ema=0.9, bf16=False)
    train_judge(judge, store, store.split("train"), options, tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").open()]
    assert rows[-1]["judge/progress_error"] < 0.7 * rows[0]["judge/progress_error"]
    unseen = torch.cat([store.split("calibration"), store.split("held_out")])
    success = judge_recordings(judge, store, unseen)
    right = judge.episode(success, store.whole(unseen)[1])
    truth = torch.tensor([store.episodes[n]["success"] for n in unseen.tolist()])
    assert float((right == truth).float().mean()) >= 0.8


def test_as_many_recordings_are_judged_at_once_as_have_room(
    tiny_store: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, read = tiny_store(ARM_DELTAS), list[tuple[int, ...]]()
    judge, every, frames = judge_of(store.spec), torch.arange(5), store.frames

    def reading(rows: torch.Tensor) -> torch.Tensor:
        read.append(tuple(rows.shape))
        return frames(rows)

    together = judge_recordings(judge, store, every)
    monkeypatch.setattr(store, "frames", reading)
    monkeypatch.setattr(replaying, "_ROOM", 1)
    assert torch.allclose(judge_recordings(judge, store, every), together, atol=1e-5)
    assert read == [(1,), (1, together.shape[1])] * 5


def test_a_judge_learns_who_succeeded_from_a_simulators_features(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    simulator, train = simulator_of("unet_small", store.spec), store.split("train")
    simulator.normalise(*units(store, train, store.spec.chunk))
    simulator.fit_camera_statistics(store.frames(store.start))
    judge = judge_of(store.spec, name="embedding", feature_shape=simulator.feature_shape)
    with pytest.raises(MissingFeatures, match="recorded_features"):
        train_judge(judge, store, train, FitConfig(steps=1, batch=2, lr=1e-3), tmp_path)
    options = FitConfig(steps=150, batch=32, lr=1e-2, warmup=5, ema=0.9, bf16=False)
    recorded = recorded_features(simulator, store, train, bf16=False)
    generated = generated_frames(simulator, store, train[:4], bf16=False)
    train_judge(judge, store, train, options, tmp_path, generated, recorded)
    unseen = torch.cat([store.split("calibration"), store.split("held_out")])
    seen = features_of_episodes(simulator, store, unseen, bf16=False)
    right = judge.episode(judge_recordings(judge, store, unseen, seen), store.whole(unseen)[1])
    truth = torch.tensor([store.episodes[n]["success"] for n in unseen.tolist()])
    assert float((right == truth).float().mean()) >= 0.8


def test_every_recorded_frame_has_the_features_of_its_chunk(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    simulator, some = simulator_of("unet_small", store.spec), torch.tensor([3, 4])
    table = recorded_features(simulator, store, some, bf16=False)
    whole = features_of_episodes(simulator, store, some, bf16=False)
    begins = -(-(store.length[some] - 1) // store.spec.chunk)
    assert len(table) == int((store.length[some] - 1).sum() + begins.sum())
    for row in table[: int((store.length[some] - 1).sum())]:
        owner = int(torch.searchsorted(store.start, row["row"], right=True)) - 1
        frame = int(row["row"] - store.start[owner]) - 1
        assert int(row["offset"]) == frame % store.spec.chunk
        wanted = whole[some.tolist().index(owner), frame // store.spec.chunk]
        assert torch.allclose(row["features"], wanted, atol=1e-5)


def test_batches_are_balanced_and_labelled_by_time_and_success(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    data = JudgeData(store, torch.arange(20), hold=2, discount=0.5)
    batch = data.sample(30, torch.Generator().manual_seed(0))
    assert float(batch["label"].sum()) == 10
    assert bool((batch["progress"][batch["label"] > 0.5] == 1).all())
    failed = JudgeData(store, store.select(succeeded=False), hold=2, discount=0.5)
    assert not bool(failed.sample(30, torch.Generator().manual_seed(0))["progress"].any())


def test_failures_are_as_late_as_successes(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    data = JudgeData(store, torch.arange(20), hold=2, discount=0.5)
    pool = data.pools[0]
    rows = pool.draw(300, torch.Generator().manual_seed(0))["row"]
    won, beside = data.labels[rows[:100]], data.labels[rows[100:200]]
    assert bool((won == 1).all()) and not bool(beside.any())
    owner = torch.searchsorted(store.start, rows, right=True) - 1
    when = rows - store.start[owner]
    possible = torch.isin(when[:100], pool.when[pool.negative])
    assert torch.equal(when[:100][possible], when[100 : 100 + int(possible.sum())])


def test_generated_frames_are_labelled_by_what_truly_happened(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    rows = store.rows(torch.arange(20))
    made = TensorDict({"frames": torch.full_like(store.frames(rows), 7), "row": rows}, [len(rows)])
    data = JudgeData(store, torch.arange(20), 2, 0.5, made)
    batch = data.sample(20, torch.Generator().manual_seed(0))
    generated = (batch["frames"] == 7).flatten(1).all(1)
    assert generated.tolist() == [False] * 10 + [True] * 10
    assert 0 < float(batch["label"][generated].sum()) < 10
    assert not bool((batch["first"] == 7).flatten(1).all(1).any())


def test_episodes_that_nobody_labelled_teach_nothing(tmp_path: Path) -> None:
    robot = ARM_DELTAS.at(SIZE)
    spec = world_spec(robot, SIZE)
    for name, labelled in (("mixed", True), ("bare", False)):
        writer = LeRobotWriter(tmp_path / name, robot)
        writer.write([moving_square(ARM_DELTAS, seed, labelled=labelled) for seed in range(3)])
    store = ClipStore([tmp_path / "mixed", tmp_path / "bare"], spec, tmp_path / "cache")
    labels, progress = frame_targets(store, 2, 0.9)
    bare = store.rows(torch.tensor([3, 4, 5]))
    assert bool(torch.isnan(labels[bare]).all()) and bool(torch.isnan(progress[bare]).all())
    drawn = JudgeData(store, torch.arange(6), 2, 0.9).sample(64, torch.Generator().manual_seed(0))
    assert bool(torch.isfinite(drawn["label"]).all())
    with pytest.raises(ValueError, match=r"no episode .* succeeded \(next\.success"):
        JudgeData(store, torch.tensor([3, 4, 5]), 2, 0.9)
    alone = ClipStore([tmp_path / "bare"], spec, tmp_path / "cache")
    assert bool(torch.isnan(frame_targets(alone, 2, 0.9)[0]).all())


def test_a_frame_without_label_moves_no_weight(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    judge = judge_of(store.spec)
    batch = JudgeData(store, torch.arange(8), 2, 0.9).sample(6, torch.Generator().manual_seed(0))
    batch["label"][:] = torch.nan
    batch["progress"][:] = torch.nan
    value, figures = judge.loss(batch)
    value.backward()
    assert float(figures["success"]) == 0.0
    assert not any(bool(p.grad.any()) for p in judge.parameters() if p.grad is not None)


def runs(best: list[float]) -> torch.Tensor:
    """Episodes [N, 6] whose best run of two frames is as given."""
    out = torch.full((len(best), 6), 0.01)
    out[:, 2:4] = torch.tensor(best)[:, None]
    return out


def test_the_threshold_lies_where_success_is_as_likely_as_not() -> None:
    judge = RuleJudge(hold=2)
    generator = torch.Generator().manual_seed(0)
    logit = 6 * torch.rand(4000, generator=generator) - 3
    succeeded = torch.rand(4000, generator=generator) < (2 * (logit - 0.8)).sigmoid()
    assert calibrate(judge, runs(logit.sigmoid().tolist()), succeeded)
    assert float(torch.logit(judge.threshold)) == pytest.approx(0.8, abs=0.1)


@pytest.mark.parametrize("mostly", [True, False])
def test_examples_that_mostly_succeed_make_no_judge_lenient(mostly: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    succeeded = torch.rand(8000, generator=generator) < (0.9 if mostly else 0.1)
    logit = (2.0 * succeeded - 1 + torch.randn(8000, generator=generator)).clamp(-4, 4)
    judge = RuleJudge(hold=2)
    assert calibrate(judge, runs(logit.sigmoid().tolist()), succeeded)
    # logit of success = 2 x + log odds of these examples, which count for nothing where they speak for it
    as_likely = 0.0 if mostly else 0.5 * math.log(9)
    assert float(torch.logit(judge.threshold)) == pytest.approx(as_likely, abs=0.1)


def test_scores_that_part_the_outcomes_still_give_a_finite_threshold() -> None:
    judge = RuleJudge(hold=2)
    assert calibrate(judge, runs([0.1, 0.2, 0.8, 0.9]), torch.tensor([False, False, True, True]))
    assert 0.2 < float(judge.threshold) < 0.8


@pytest.mark.parametrize(
    ("best", "succeeded"),
    [
        ([0.2, 0.8], [True, True]),
        ([0.2, 0.8], [False, False]),
        ([0.9, 0.1], [False, True]),
        ([float("nan"), float("nan")], [False, True]),
    ],
)
def test_scores_that_do_not_tell_set_no_threshold(best: list[float], succeeded: list[bool]) -> None:
    judge = RuleJudge(hold=2)
    assert not calibrate(judge, runs(best), torch.tensor(succeeded))
    assert float(judge.threshold) == 0.5


def test_episodes_that_nobody_could_judge_set_no_threshold() -> None:
    judge, alone = RuleJudge(hold=2), RuleJudge(hold=2)
    best, succeeded = [0.1, 0.2, 0.8, 0.9], [False, False, True, True]
    assert calibrate(alone, runs(best), torch.tensor(succeeded))
    more = runs([*best, float("nan"), float("nan")])
    assert calibrate(judge, more, torch.tensor([*succeeded, True, False]))
    assert torch.equal(judge.threshold, alone.threshold)


def test_pictures_are_disturbed_alike_in_all_views_and_by_the_generator_alone() -> None:
    pictures = torch.randint(60, 200, (8, 1, 3, 32, 32), dtype=torch.uint8).expand(-1, 2, -1, -1, -1)
    out = augment(pictures, torch.Generator().manual_seed(0), shift=0.1)
    assert out.dtype == torch.uint8 and out.shape == pictures.shape
    assert torch.equal(out[:, 0], out[:, 1]) and not torch.equal(out, pictures)
    assert torch.equal(out, augment(pictures, torch.Generator().manual_seed(0), shift=0.1))
    still = augment(pictures, torch.Generator().manual_seed(0), shift=0.0)
    assert float((still.float() - pictures.float()).abs().mean()) < 20


def test_it_is_told_where_things_in_shifted_pictures_have_gone() -> None:
    dot = torch.zeros(32, 1, 3, 40, 80, dtype=torch.uint8)
    dot[..., 20, 50] = 255
    out, by = augmented(dot, torch.Generator().manual_seed(0), shift=0.1)
    place = out[:, 0].float().sum(1).flatten(1).argmax(1)
    seen = torch.stack(((place % 80) / 80, (place // 80) / 40), 1)
    assert torch.allclose(seen, torch.tensor([50 / 80, 20 / 40]) + by) and len(by.unique(dim=0)) > 10


def test_shifts_move_by_whole_pixels_and_repeat_the_border() -> None:
    ramp = torch.arange(32, dtype=torch.uint8).expand(64, 1, 3, 32, 32)
    colourless = torch.Generator().manual_seed(3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("learners.stages.pictures.COLOUR", 0.0)
        out = augment(ramp, colourless, shift=0.1)[:, 0, 0, 0].long()
    moved = out[:, 16] - 16
    assert moved.abs().max() == 3 and len(moved.unique()) == 7
    assert torch.equal(out, (torch.arange(32) + moved[:, None]).clamp(0, 31))


class Blind(FittedJudge):
    """Says the same of every frame."""

    def __init__(self) -> None:
        super().__init__(hold=1, margin=0.0, discount=0.9)
        self.said = torch.nn.Parameter(torch.zeros(2))

    def forward(self, data: TensorDict) -> torch.Tensor:
        """See FittedJudge."""
        return self.said.expand(len(data), 2)


def test_a_judge_that_sees_nothing_learns_to_say_as_likely_as_not(tiny_store: Stores) -> None:
    batch = JudgeData(tiny_store(ARM_DELTAS), torch.arange(20), 1, 0.9).sample(
        30, torch.Generator().manual_seed(0)
    )
    judge = Blind()
    judge.loss(batch)[0].backward()
    assert judge.said.grad is not None and float(judge.said.grad[0]) == pytest.approx(0.0, abs=1e-6)
