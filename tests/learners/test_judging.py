"""The judge's stage: what its key-points aim at, and data that do not say where things are."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from envs.simulators.in_view import in_view
from tensordict import TensorDict

from envs.encoders import Gaze, to_signed
from envs.episodes.clips import ClipStore
from envs.judges import LearnedJudge
from learners.stages.judge import close_calls, train_judge, unseen_by_judge
from learners.stages.pictures import sights, survey
from learners.training.fit import FitConfig


def test_sights_are_where_objects_are_drawn(store: ClipStore) -> None:
    rows = store.start + 2
    objects = store.arrays["objects"][rows]
    where = sights(store, objects, rows, 2)
    seen = in_view(objects[:, None], store.intrinsic, store.arrays["c2w"][rows][:, None], store.size)
    assert torch.allclose(where, seen.where[:, 0, 0], atol=1e-5)
    assert bool(torch.isnan(sights(store, objects * torch.nan, rows, 3)).all())


def test_a_surveyed_gaze_tells_gaps_in_metres(store: ClipStore) -> None:
    gaze, rows = Gaze(4, 8, 2), torch.arange(len(store.arrays["success"]))
    survey(gaze, store, rows)
    objects = store.arrays["objects"][rows]
    where = sights(store, objects, rows, 2)
    known = torch.isfinite(where).flatten(1).all(1)
    gaps = gaze.gaps_between(where[known]) / Gaze.GAIN * Gaze.SPAN
    truth = objects[known, 0, :2] - objects[known, 1, :2]
    # a few were toppled
    assert known.sum() > 20 and float((gaps[:, :2] - truth).norm(dim=-1).median()) < 2e-3
    assert torch.allclose(gaps[:, 2], gaps[:, :2].norm(dim=-1), atol=1e-6)
    before = gaze.plane.clone()
    gaze.survey(where * torch.nan, objects[:, :2, :2])  # of data that know nothing nothing is learned
    assert torch.equal(gaze.plane, before)
    blind = Gaze(4, 8, 2)
    blind.survey(where * torch.nan, objects[:, :2, :2])
    assert bool(gaze.surveyed.all()) and not bool(blind.surveyed.any())


def test_where_places_are_known_the_gap_alone_decides() -> None:
    torch.manual_seed(0)
    judge = LearnedJudge(hold=2, width=8, points=4).eval()
    frames, words = torch.randint(0, 256, (8, 3, 3, 64, 64), dtype=torch.uint8), torch.randint(1, 20, (8, 12))

    def success() -> torch.Tensor:
        with torch.no_grad():
            return judge(frames, frames, words)[0]

    by_progress = success()
    judge.main.surveyed.fill_(True)
    by_gap = success()
    with torch.no_grad():
        pair = torch.cat((to_signed(frames)[:, 0], to_signed(frames)[:, 0]), 1)
        gaps = judge.main(pair)[0][:, -1]
    assert torch.equal(by_gap.argsort(), gaps.argsort(descending=True))
    words = words.flip(0)  # it is as near whatever things are called
    assert torch.equal(success(), by_gap)
    judge.main.surveyed[1] = False  # of one of them nobody knows
    assert not torch.equal(success(), by_progress)  # progress hears the words
    words = words.flip(0)
    assert torch.equal(success(), by_progress)


def test_words_choose_the_two_things() -> None:
    torch.manual_seed(0)
    judge = LearnedJudge(hold=2, width=8, points=4, aims=3).eval()
    judge.main.surveyed.fill_(True)
    frames, words = (
        torch.randint(0, 256, (6, 3, 3, 64, 64), dtype=torch.uint8),
        torch.tensor([[1] * 12] * 3 + [[2] * 12] * 3),
    )
    with torch.no_grad():
        heard = judge.words(words)[[0, 3]]
        # one names the first pair, two the last
        judge.pair.copy_(torch.linalg.pinv(heard) @ torch.tensor([[100.0, 0.0, 0.0], [0.0, 0.0, 100.0]]))
        pictures = to_signed(frames)[:, 0]
        gaps = judge.main(torch.cat((pictures, pictures), 1))[0][:, -3:]
        logits = judge(frames, frames, words)[0]
    chosen = torch.cat((gaps[:3, 0], gaps[3:, 2]))
    assert torch.allclose(logits, judge.strictness.exp() * (1 - chosen), atol=1e-4)


def test_judge_learns_to_aim(store: ClipStore, tmp_path: Path) -> None:
    torch.manual_seed(0)
    judge = LearnedJudge(hold=2, width=8, points=4)
    train_judge(
        judge, store, torch.arange(len(store)), FitConfig(steps=60, batch=16, lr=5e-3, bf16=False), tmp_path
    )
    rows = [
        json.loads(line)["judge/aim_error"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()
    ]
    assert sum(rows[-5:]) < 0.5 * sum(rows[:5])


def test_close_calls_lie_around_where_successes_begin() -> None:
    labels = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    progress = torch.tensor([0.1, 0.75, 0.81, 0.99, 0.0, 0.88, 0.5, 0.83])
    assert close_calls(labels, progress, torch.arange(8)).tolist() == [1, 2, 5, 7]
    assert close_calls(labels, progress, torch.tensor([0, 4, 6])).tolist() == []


def test_objects_nobody_placed_leave_the_aims_alone() -> None:
    judge = LearnedJudge(hold=2, width=8, points=4)
    frames = torch.randint(0, 256, (4, 3, 3, 64, 64), dtype=torch.uint8)
    value, figures = judge.loss(batch_of(frames, torch.tensor([0.0, 1.0, 0.0, 1.0])), 0.5)
    value.backward()
    assert float(figures["aim_error"]) == 0.0
    assert all(bool(torch.isfinite(p.grad).all()) for p in judge.parameters() if p.grad is not None)


def test_what_nobody_labelled_teaches_no_verdict() -> None:
    judge = LearnedJudge(hold=2, width=8, points=4)
    frames = torch.randint(0, 256, (4, 3, 3, 64, 64), dtype=torch.uint8)
    value, figures = judge.loss(
        batch_of(frames, torch.full((4,), torch.nan), where=torch.zeros(4, 2, 2)), 0.5
    )
    value.backward()
    assert float(figures["success"]) == 0.0 and float(figures["aim_error"]) > 0.0
    assert not bool(judge.apart[-1].weight.grad.any())


def batch_of(frames: torch.Tensor, label: torch.Tensor, where: torch.Tensor | None = None) -> TensorDict:
    """A training batch of a judge with progress like success, in which nobody knows where things are unless
    told.
    """
    unknown = torch.full((len(frames), 2, 2), torch.nan)
    pictures = {"frames": to_signed(frames), "first": to_signed(frames), "drill": to_signed(frames[:, :2])}
    return TensorDict(
        {
            **pictures,
            "tokens": torch.zeros(len(frames), 12, dtype=torch.int64),
            "label": label,
            "progress": label,
            "where": unknown if where is None else where,
            "drilled": unknown,
        },
        [len(frames)],
    )


def test_a_judge_without_aims_judges() -> None:
    judge = LearnedJudge(hold=2, width=8, points=4, aims=0).eval()
    frames = torch.randint(0, 256, (2, 3, 3, 3, 64, 64), dtype=torch.uint8)
    verdict = judge.score(frames, frames[:, 0], torch.zeros(2, 12, dtype=torch.int64))
    assert verdict.success.shape == (2, 3) and bool(torch.isfinite(verdict.success).all())


def test_no_judge_learns_from_what_it_is_calibrated_on(store: ClipStore) -> None:
    unseen = unseen_by_judge(store)
    assert [store.episodes[n]["seed"] for n in unseen.tolist()] == [2, 6]
