"""One worker or two: the same losses, the same policy, and checkpoints that either reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.specs import ActionMode
from envs.targets import build
from learners.stages.distill.stage import train_student
from learners.stages.film import Film
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.judge import train_judge
from learners.stages.perception import train_perception
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.stages.text_world import train_text_world
from learners.stages.traces import Hands
from learners.training.fit import FitConfig, fit
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.simulators.test_text_world import section as text_world_section
from tests.learners.models import decoder_of, distilled, judge_of, policy_of, simulator_of
from tests.learners.training.workers import gathered, two
from tests.moving_square import SIZE
from tests.sections import section

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


def stages(folder: Path, dataset: Path) -> list[float]:
    """Losses of the first steps of every supervised stage, in a diffusion transformer and in a text world."""
    torch.set_num_threads(1)
    spec = world_spec(ARM_DELTAS.at(SIZE), SIZE)
    store = ClipStore([dataset], spec)
    every = torch.arange(len(store))
    options = FitConfig(3, 4, 1e-3, microbatches=2, warmup=1, bf16=False, checkpoint_every=2)
    policy, simulator = (
        policy_of("chunk_gaussian", spec, ActionMode.ABSOLUTE),
        simulator_of("dit_small", spec),
    )
    decoder, judge = decoder_of("dit_small", simulator), judge_of(spec)
    clips = SimulatorFitConfig(1.0, 1, (1,), 0.0, 0)
    learned = (policy, store, every, ActionMode.ABSOLUTE)
    train_perception(*learned, options, folder / "perception", 0.9, Hands(0.0, None))
    train_imitation(Cloning(*learned), options, folder / "imitation")
    film = Film(simulator, store, folder / "simulator", False)
    train_simulator(simulator, store, every, clips, options, folder / "simulator", look=film)
    train_state(decoder, simulator, store, every, options, folder / "state")
    train_judge(judge, store, every, options, folder / "judge")
    teacher, student = simulator_of("dit_small", spec), distilled(spec)
    student.load_state_dict(teacher.state_dict())
    method = section("distiller/dmd2", critic_updates=2)
    film = Film(student, store, folder / "distill", False)
    batches = ClipBatches(student, store, every, clips, options)
    train_student(teacher, method, batches, folder / "distill", look=film)
    for stage in ("simulator", "distill"):
        names = [path.name for path in sorted((folder / stage / "media").iterdir())]
        assert [name.rpartition("-")[2] for name in names] == ["step000002.mp4", "step000003.mp4"]
    torch.manual_seed(0)
    text_world = build(text_world_section(), "judge.text_world", spec=spec)
    train_text_world(text_world, store, every, 1, options, folder / "text_world", tokenizer=options)
    logs = sorted(folder.rglob("metrics.jsonl"))
    return [
        json.loads(line)[f"{log.parent.name}/loss"] for log in logs for line in log.read_text().splitlines()
    ]


@pytest.mark.long
def test_two_workers_follow_one_and_either_goes_on_from_the_others_checkpoint(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone")
    leader, follower = two(whole_and_cut, tmp_path / "two")
    assert leader == follower == pytest.approx(alone, rel=1e-4)
    assert gathered(tmp_path / "two") == {"Linear"}
    assert train(tmp_path / "two" / "cut") == pytest.approx(alone, rel=1e-4)
    assert train(tmp_path / "from-one", 5) == []
    assert two(train, tmp_path / "from-one")[1] == pytest.approx(alone, rel=1e-4)


@pytest.mark.long
def test_two_workers_follow_one_with_muon(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone", optimiser="muon")
    leader, follower = two(train, tmp_path / "two", None, "muon")
    assert leader == follower == pytest.approx(alone, rel=1e-3)  # orthogonalising magnifies rounding


def test_two_workers_follow_one_in_every_supervised_stage(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    dataset = tiny_data(ARM_DELTAS)
    alone = stages(tmp_path / "alone", dataset)
    leader, follower = two(stages, tmp_path / "two", dataset, limit=2_000)
    assert len(alone) == 8 * 3 and leader == follower == pytest.approx(alone, rel=1e-3)
    assert gathered(tmp_path / "two") >= {"VisionBlock", "StateBlock"}


def test_microbatches_that_cannot_be_shared_out_are_refused() -> None:
    with pytest.raises(ValueError, match="microbatches"):
        FitConfig(1, 8, 1e-3, microbatches=3)
