"""The loop, students and serving, where networks lie on another device than physics and recordings do."""

from __future__ import annotations

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
from pipeline.config import load_config
from pipeline.loop import build_loop
from tests.actors.serving import Running, Stranger, serve_config, tiny_expert, tiny_world
from tests.embodiments import ARM_DELTAS
from tests.learners.models import stepwise_pair
from tests.second_device import DEVICE, second_device
from tests.sections import section


def test_what_a_gpu_would_refuse_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with second_device(monkeypatch):
        there, here = torch.ones(2, requires_grad=True).to(DEVICE), torch.ones(2)
        with pytest.raises(RuntimeError, match=r"tensors elsewhere and of \[\(2,\)\] on the CPU"):
            there + here
        with pytest.raises(TypeError, match="numpy"):
            there.detach().numpy()
        layer = torch.nn.Linear(2, 1).to(DEVICE)
        layer(there * 2).sum().backward()
        assert layer.weight.grad is not None and layer.weight.grad.tolist() == [[2.0, 2.0]]
        assert there[torch.tensor([1])].cpu().tolist() == [1.0]


def test_serving(monkeypatch: pytest.MonkeyPatch) -> None:
    with second_device(monkeypatch):
        world = tiny_world()
        expert = tiny_expert(world).to(DEVICE)
        server = Running(SessionHost(world.to(DEVICE), expert, serve_config()))
        try:
            client = Stranger(server.url)
            client.prepare(frames=12)
            frames, state = client.step(np.full((4, 14), 0.2, np.float32))
            assert frames.shape == (4, 3, 3, 32, 32) and state is not None and np.isfinite(state).all()
        finally:
            server.stop()


def test_a_student_of_few_steps(
    tiny_store: Callable[[Embodiment], ClipStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tiny_store(ARM_DELTAS)
    clips, options = SimulatorFitConfig(1.0, 1, (1,), 0.0, 0), FitConfig(2, 2, 1e-3, warmup=1, bf16=False)
    teacher, student = stepwise_pair("dit_small", store.spec)
    begun = {name: value.clone() for name, value in student.state_dict().items()}
    with second_device(monkeypatch):
        teacher, student = teacher.to(DEVICE), student.to(DEVICE)
        batches = ClipBatches(student, store, torch.arange(4), clips, options)
        train_student(teacher, section("distiller/dmd2", critic_updates=1), batches, tmp_path)
        assert {world.device for world in (teacher, student)} == {DEVICE}
        assert any(not torch.equal(part.cpu(), begun[name]) for name, part in student.state_dict().items())


@pytest.mark.slow
@pytest.mark.parametrize(
    "choices",
    [
        (),
        (
            "policy=chunk_tokens",
            "algorithm=grpo",
            "algorithm.group=2",
            "simulator=dit_small",
            "judge=embedding",
        ),
    ],
)
@pytest.mark.long
def test_a_round_of_the_loop(
    choices: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = ("task.suite.cameras=[head]", "launch.device=cpu", "launch.workers=2")
    cfg = load_config(["experiment=soak", f"runs={tmp_path}", *small, *choices])
    graph = build_loop(cfg, tmp_path / "soak")
    with second_device(monkeypatch):
        made = graph.run("gap-1") | graph.run("rl-1")
    assert made["rl-1"]["result"]["episodes"] > 0 and made["gap-1"]["result"]["imagined"]["episodes"] > 0
