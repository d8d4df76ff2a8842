"""The loop, fine-tuning, students and serving on a GPU; algorithms alone: learners/rl/test_algorithms.py."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from actors.serving.sessions import SessionHost
from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from learners.stages.distill.stage import train_student
from learners.stages.simulator import ClipBatches, SimulatorFitConfig
from learners.training.fit import FitConfig
from pipeline.evaluation.fidelity.extractors import Inception
from tests.actors.serving import Running, Stranger, serve_config, tiny_expert, tiny_world
from tests.embodiments import ARM_JOINTS
from tests.learners.models import stepwise_pair
from tests.sections import section

ROOT = Path(__file__).resolve().parent.parent
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def worldloop(*words: str) -> None:
    """Run a command on the GPU; it must end well."""
    line = [sys.executable, "-m", "pipeline", *words, "launch.device=cuda", "track=disabled"]
    out = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert out.returncode == 0, out.stderr[-3000:]


def test_the_loop_at_its_smallest(tmp_path: Path) -> None:
    worldloop("run", "experiment=smoke", f"runs={tmp_path}")
    result = json.loads((tmp_path / "smoke/result.json").read_text())
    assert result["physics_after"]["episodes"] == 20 and len(result["rounds"]) == 2


@pytest.mark.parametrize(
    ("simulator", "compiled"), [("unet_small", "null"), ("dit_small", "null"), ("dit_small", "graphs")]
)
def test_finetune(
    simulator: str, compiled: str, tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    data = tiny_data(ARM_JOINTS)
    worldloop(
        *("finetune", f"simulator={simulator}", "task=lerobot", f"task.data=[{data}]"),
        f"launch.compile={compiled}",
        *(f"finetune.data=[{data}]", "task.size=[32,32]", f"runs={tmp_path}", "name=tuned"),
        *("finetune.simulator.fit.steps=2", "finetune.state.fit.steps=2"),
    )
    made = {
        path.parent.name.split("-")[0] for path in (tmp_path / "tuned/finetune").glob("*/weights.safetensors")
    }
    assert made == {"simulator", "state"} | ({"tokenizer"} if simulator == "dit_small" else set())


@pytest.mark.parametrize("method", ["dmd2", "trajectory"])
def test_a_student_of_few_steps(
    method: str, tiny_store: Callable[[Embodiment], ClipStore], tmp_path: Path
) -> None:
    store = tiny_store(ARM_JOINTS)
    clips, options = SimulatorFitConfig(1.0, 1, (1,), 0.0, 0), FitConfig(5, 2, 1e-3, warmup=1)
    teacher, student = (world.cuda() for world in stepwise_pair("dit_small", store.spec))
    begun = {name: value.clone() for name, value in student.state_dict().items()}
    batches = ClipBatches(student, store, torch.arange(4), clips, options)
    train_student(teacher, section(f"distiller/{method}"), batches, tmp_path)
    assert any(not torch.equal(value, begun[name]) for name, value in student.state_dict().items())


class Coloured(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(3, 2048)

    def forward(self, x: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return self.layer(x.mean([2, 3]))  # type: ignore[no-any-return]


def test_extractors_compute_there_and_features_come_back(tmp_path: Path) -> None:
    torch.jit.script(Coloured()).save(str(tmp_path / "inception.pt"))
    extractor = Inception(str(tmp_path / "inception.pt"))
    pictures = torch.arange(3 * 3 * 64).reshape(3, 3, 8, 8).to(torch.uint8)
    near = extractor(pictures)
    extractor.compute_on(torch.device("cuda"))
    far = extractor(pictures)
    assert next(extractor._network.parameters()).is_cuda and not far.is_cuda
    assert torch.allclose(far, near, rtol=1e-3, atol=0.1)


def test_serve() -> None:
    world = tiny_world()
    expert = tiny_expert(world).cuda()
    server = Running(SessionHost(world.cuda(), expert, serve_config()))
    try:
        client = Stranger(server.url)
        client.prepare(frames=12)
        for _ in range(2):
            actions = np.full((4, 14), 0.2, np.float32)
            frames, state = client.step(actions)
            assert frames.shape == (4, 3, 3, 32, 32) and state is not None and np.isfinite(state).all()
    finally:
        server.stop()
