"""The judge's stage: what its key-points aim at, and data that do not say where things are."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from envs.episodes.clips import ClipStore
from envs.judges import LearnedJudge
from envs.simulators.in_view import in_view
from learners.fit import FitConfig
from learners.stages.judge import train_judge, unseen_by_judge
from learners.stages.pictures import sights


def test_sights_are_where_objects_are_drawn(store: ClipStore) -> None:
    rows = store.start + 2
    objects = store.arrays["objects"][rows]
    where = sights(store, objects, rows, 2)
    seen = in_view(objects[:, None], store.intrinsic, store.arrays["c2w"][rows][:, None], store.size)
    assert torch.allclose(where, seen.where[:, 0, 0], atol=1e-5)
    assert bool(torch.isnan(sights(store, objects * torch.nan, rows, 3)).all())


def test_judge_learns_to_aim(store: ClipStore, tmp_path: Path) -> None:
    torch.manual_seed(0)
    judge = LearnedJudge(hold=2, width=8, points=4)
    train_judge(judge, store, torch.arange(len(store)), FitConfig(steps=60, batch=16, lr=5e-3, bf16=False), tmp_path)
    rows = [json.loads(line)["judge/aim_error"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert sum(rows[-5:]) < 0.5 * sum(rows[:5])


def test_objects_nobody_placed_leave_the_aims_alone() -> None:
    judge = LearnedJudge(hold=2, width=8, points=4)
    frames = torch.randint(0, 256, (4, 3, 3, 64, 64), dtype=torch.uint8)
    tokens, label = torch.zeros(4, 12, dtype=torch.int64), torch.tensor([0.0, 1.0, 0.0, 1.0])
    value, figures = judge.loss(frames, frames, tokens, label, label, torch.full((4, 2, 2), torch.nan), 0.5)
    value.backward()
    assert float(figures["aim_error"]) == 0.0
    assert all(bool(torch.isfinite(p.grad).all()) for p in judge.parameters() if p.grad is not None)


def test_a_judge_without_aims_judges() -> None:
    judge = LearnedJudge(hold=2, width=8, points=4, aims=0).eval()
    frames = torch.randint(0, 256, (2, 3, 3, 3, 64, 64), dtype=torch.uint8)
    verdict = judge.score(frames, frames[:, 0], torch.zeros(2, 12, dtype=torch.int64))
    assert verdict.success.shape == (2, 3) and bool(torch.isfinite(verdict.success).all())


def test_no_judge_learns_from_what_it_is_calibrated_on(store: ClipStore) -> None:
    unseen = unseen_by_judge(store)
    assert [store.episodes[n]["seed"] % 8 for n in unseen.tolist()] == [4] * len(unseen) and len(unseen) == 1
