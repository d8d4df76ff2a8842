"""Two workers follow one where blocks are gathered one by one, as those of large networks are."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from envs.specs import WorldSpec
from learners.stages.distill.stage import train_student
from learners.stages.film import Film
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.training.fit import FitConfig
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.envs.simulators.gesim_tiny import build, write_checkpoint
from tests.learners.models import decoder_of, simulator_of, stepwise_engines, stepwise_pair
from tests.learners.training.workers import gathered, two
from tests.moving_square import SIZE
from tests.sections import section

pytestmark = [pytest.mark.slow, pytest.mark.long]

Figures = dict[str, list[float]]
STUDENTS = [f"{engine}-{method}" for engine in stepwise_engines() for method in ("dmd2", "trajectory")]
UNROLLED = (*stepwise_engines(), "tokens_small", "unet_small")
LIMIT = 6_000  # parameters of a block that is gathered by itself, or with the one around it
SINGLE = SimulatorFitConfig(single_chunk_fraction=1.0, unroll=1, strides=(1,), recent_fraction=0.0, lora=0)
FIT = FitConfig(3, 4, 1e-3, microbatches=2, warmup=1, bf16=False, checkpoint_every=3)


def prompted(engine: str, spec: WorldSpec) -> tuple[Simulator, Simulator]:
    """A teacher and a student, who read a text of several tokens, if any."""
    pair = stepwise_pair(engine, spec)
    for world in pair:
        if getattr(world, "prompt", None) is not None:
            torch.manual_seed(0)
            world.prompt = torch.randn(1, 4, world.prompt.shape[-1])
    return pair


def losses(folder: Path, name: str) -> list[float]:
    """Of all steps."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [row[f"{name}/loss"] for row in rows]


def student(engine: str, name: str, store: ClipStore, episodes: Tensor, folder: Path) -> list[float]:
    """Losses of a student, the released form's with adapters, and figures of its weights at the end."""
    method = section(f"distiller/{name}", **({"critic_updates": 1} if name == "dmd2" else {}))
    teacher, made = prompted(engine, store.spec)
    torch.manual_seed(7)  # adapters are drawn
    clips = replace(SINGLE, lora=2 if engine == "gesim_tiny" else 0)
    train_student(teacher, method, ClipBatches(made, store, episodes, clips, FIT), folder)
    return losses(folder, "distill") + [float(p.detach().abs().sum()) for p in made.parameters()]


def unrolled(engine: str, store: ClipStore, episodes: Tensor, folder: Path) -> list[float]:
    """Losses of a simulator that learns from its own frames; it comes back as it lay in memory."""
    steps = engine in stepwise_engines()
    simulator = prompted(engine, store.spec)[1] if steps else simulator_of(engine, store.spec)
    laid = {name: p.stride() for name, p in simulator.named_parameters()}
    clips = replace(SINGLE, single_chunk_fraction=0.0, unroll=2)
    train_simulator(simulator, store, episodes, clips, FIT, folder)
    assert {name: p.stride() for name, p in simulator.named_parameters()} == laid
    return losses(folder, "simulator")


def filmed(checkpoint: Path, store: ClipStore, episodes: Tensor, folder: Path) -> list[float]:
    """Losses of a released world and how bright it draws at two films, then those of its state expert."""
    simulator, drawn = build(checkpoint, store.spec), list[float]()
    film = Film(simulator, store, folder / "simulator", bf16=False)

    def look(step: int) -> None:
        film(step)
        drawn.append(float(replay(simulator, store, episodes[:1], bf16=False).frames.float().mean()))

    options = replace(FIT, lr=1e-2, checkpoint_every=2)
    train_simulator(simulator, store, episodes, SINGLE, options, folder / "simulator", look=look)
    assert len(list((folder / "simulator/media").iterdir())) == 2 and drawn[0] != drawn[1]
    train_state(decoder_of("gesim_tiny", simulator), simulator, store, episodes, FIT, folder / "state")
    return losses(folder / "simulator", "simulator") + drawn + losses(folder / "state", "state")


def everything(folder: Path, dataset: Path, checkpoint: Path) -> Figures:
    """Figures of all of these."""
    torch.set_num_threads(1)
    # In chunks of five, which every autoencoder can take.
    store = ClipStore([dataset], replace(world_spec(BIMANUAL_POSES.at(SIZE), SIZE), chunk=5))
    episodes, out = torch.arange(len(store)), Figures()
    for case in STUDENTS:
        out[case] = student(*case.split("-"), store, episodes, folder / case)
    for engine in UNROLLED:
        out[engine] = unrolled(engine, store, episodes, folder / engine)
    return out | {"released": filmed(checkpoint, store, episodes, folder / "released")}


@pytest.fixture(scope="module")
def figures(
    tmp_path_factory: pytest.TempPathFactory, tiny_data: Callable[[Embodiment], Path]
) -> tuple[Figures, Figures, Figures, set[str]]:
    """Figures of one process, of the first of two and of the second, and what these gathered block by
    block. One start of processes serves all cases, for it takes longer than most of them.
    """
    root, dataset = tmp_path_factory.mktemp("sharded"), tiny_data(BIMANUAL_POSES)
    checkpoint, threads = write_checkpoint(root / "checkpoint"), torch.get_num_threads()
    alone = everything(root / "alone", dataset, checkpoint)
    torch.set_num_threads(threads)
    leader, follower = two(everything, root / "two", dataset, checkpoint, limit=LIMIT)
    return alone, leader, follower, gathered(root / "two")


@pytest.mark.parametrize("case", [*STUDENTS, *UNROLLED, "released"])
def test_two_workers_follow_one(case: str, figures: tuple[Figures, Figures, Figures, set[str]]) -> None:
    alone, leader, follower, _ = figures
    assert leader[case] == follower[case] == pytest.approx(alone[case], rel=1e-3)


def test_blocks_of_every_kind_were_gathered_by_themselves(
    figures: tuple[Figures, Figures, Figures, set[str]],
) -> None:
    assert figures[3] >= {"VisionBlock", "SpaceBlock", "TimeBlock", "StateBlock", "STBlock", "WanUpBlock"}
