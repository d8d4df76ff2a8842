"""One worker or two: the same losses, and checkpoints that either reads, in a network that loads fast."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from learners.training.fit import FitConfig, fit
from tests.learners.training.workers import gathered, two

pytestmark = pytest.mark.slow

STEPS = 8


class Net(nn.Module):
    """Blocks large enough to be gathered one by one, a frozen layer, a buffer, and a parameter shared by two
    layers.
    """

    shift: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.leave = nn.Linear(6, 750), nn.Linear(750, 1)
        self.blocks = nn.ModuleList(nn.Linear(750, 750) for _ in range(2))
        self.frozen = nn.Linear(1, 1).requires_grad_(False)
        self.twin = nn.Linear(750, 1)
        self.twin.weight = self.leave.weight
        self.register_buffer("shift", torch.tensor(0.5))

    def score(self, x: Tensor) -> Tensor:
        """Not named forward: losses call what they like."""
        h = self.enter(x)
        for block in self.blocks:
            h = h + torch.tanh(block(h))
        return self.frozen(self.leave(h) + self.twin(h)) + self.shift


def train(folder: Path, stop_after: int | None = None, optimiser: str = "adamw") -> list[float]:
    """Losses of all steps, then figures of the weights at the end."""
    torch.manual_seed(0)
    net = Net()

    def batch(step: int, generator: torch.Generator) -> Tensor:
        if step == stop_after:
            raise KeyboardInterrupt
        return torch.randn(4, 6, generator=generator)

    def loss(data: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        noise = torch.randn(4, 1, generator=generator)
        return (net.score(data) - data.sum(1, keepdim=True) + 0.1 * noise).square().mean(), {}

    try:
        fit(
            "toy",
            net,
            batch,
            loss,
            FitConfig(
                STEPS,
                8,
                microbatches=2,
                lr=1e-3,
                warmup=2,
                bf16=False,
                checkpoint_every=3,
                optimiser=optimiser,
            ),
            folder,
        )
    except KeyboardInterrupt:
        return []
    assert (
        type(net.blocks[0]) is nn.Linear
        and type(net.leave.weight) is nn.Parameter
        and net.leave.weight is net.twin.weight
    )
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(STEPS))
    return [row["toy/loss"] for row in rows] + [float(p.detach().abs().sum()) for p in net.parameters()]


def whole_and_cut(folder: Path) -> list[float]:
    """A run, and the first half of another."""
    values = train(folder / "whole")
    assert train(folder / "cut", 5) == []
    return values


def test_two_workers_follow_one_which_goes_on_from_their_checkpoint(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone")
    leader, follower = two(whole_and_cut, tmp_path / "two")
    assert leader == follower == pytest.approx(alone, rel=1e-4)
    assert gathered(tmp_path / "two") == {"Linear"}
    assert train(tmp_path / "two" / "cut") == pytest.approx(alone, rel=1e-4)


@pytest.mark.long
def test_two_workers_go_on_from_the_checkpoint_of_one(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone")
    assert train(tmp_path / "from-one", 5) == []
    assert two(train, tmp_path / "from-one")[1] == pytest.approx(alone, rel=1e-4)


@pytest.mark.long
def test_two_workers_follow_one_with_muon(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone", optimiser="muon")
    leader, follower = two(train, tmp_path / "two", None, "muon")
    assert leader == follower == pytest.approx(alone, rel=1e-3)  # orthogonalising magnifies rounding
