"""One worker or two: the same losses in every supervised stage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

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
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.simulators.test_text_world import section as text_world_section
from tests.learners.models import decoder_of, distilled, judge_of, policy_of, simulator_of
from tests.learners.training.workers import gathered, two
from tests.moving_square import SIZE
from tests.sections import section

pytestmark = pytest.mark.slow


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
