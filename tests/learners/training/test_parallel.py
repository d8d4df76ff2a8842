"""One worker or two: the same losses, the same policy, and checkpoints that either reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor, nn

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.specs import ActionMode
from learners.stages.distill.stage import train_student
from learners.stages.film import Film
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.judge import train_judge
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.training.fit import FitConfig, fit
from tests.embodiments import ARM_DELTAS, world_spec
from tests.learners.models import decoder_of, distilled, judge_of, policy_of, simulator_of
from tests.moving_square import SIZE
from tests.sections import section

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
    """Losses of the first steps of every supervised stage, in a diffusion transformer."""
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
    cloning = Cloning(policy, store, every, ActionMode.ABSOLUTE)
    train_imitation(cloning, options, folder / "imitation")
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
    return [
        json.loads(line)[f"{name}/loss"]
        for name in ("imitation", "simulator", "state", "judge", "distill")
        for line in (folder / name / "metrics.jsonl").read_text().splitlines()
    ]


def worker(
    rank: int, rendezvous: str, folder: str, work: Callable[..., list[float]], given: tuple[Any, ...]
) -> None:
    dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=2)
    values = work(Path(folder), *given)
    if values:
        (Path(folder) / f"values-{rank}.json").write_text(json.dumps(values))
    dist.destroy_process_group()


def two(work: Callable[..., list[float]], folder: Path, *given: Any) -> list[list[float]]:
    """What two workers say."""
    folder.mkdir(exist_ok=True)
    rendezvous = folder / "rendezvous"
    rendezvous.unlink(missing_ok=True)
    mp.spawn(worker, (str(rendezvous), str(folder), work, given), nprocs=2)
    return [json.loads(path.read_text()) for path in sorted(folder.glob("values-*.json"))]


def test_two_workers_follow_one_and_either_goes_on_from_the_others_checkpoint(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone")
    leader, follower = two(whole_and_cut, tmp_path / "two")
    assert leader == follower == pytest.approx(alone, rel=1e-4)
    assert train(tmp_path / "two" / "cut") == pytest.approx(alone, rel=1e-4)
    assert train(tmp_path / "from-one", 5) == []
    assert two(train, tmp_path / "from-one")[1] == pytest.approx(alone, rel=1e-4)


def test_two_workers_follow_one_with_muon(tmp_path: Path) -> None:
    alone = train(tmp_path / "alone", optimiser="muon")
    leader, follower = two(train, tmp_path / "two", None, "muon")
    assert leader == follower == pytest.approx(alone, rel=1e-3)  # orthogonalising magnifies rounding


def test_two_workers_follow_one_in_every_supervised_stage(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    dataset = tiny_data(ARM_DELTAS)
    alone = stages(tmp_path / "alone", dataset)
    assert len(alone) == 15 and two(stages, tmp_path / "two", dataset)[0] == pytest.approx(alone, rel=1e-3)


def test_microbatches_that_cannot_be_shared_out_are_refused() -> None:
    with pytest.raises(ValueError, match="microbatches"):
        FitConfig(1, 8, 1e-3, microbatches=3)
