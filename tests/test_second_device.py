"""The loop, and serving, where networks lie on another device than physics and recordings do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from actors.serving.sessions import SessionHost
from pipeline.config import load_config
from pipeline.loop import build_loop
from tests.actors.serving import Running, Stranger, serve_config, tiny_expert, tiny_world
from tests.second_device import DEVICE, second_device


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "choices", [(), ("policy=chunk_tokens", "algorithm=grpo", "simulator=dit_small", "judge=embedding")]
)
def test_a_round_of_the_loop(
    choices: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = ("task.size=[32,32]", "task.suite.cameras=[head]", "launch.device=cpu", "launch.workers=2")
    cfg = load_config(["experiment=smoke", f"runs={tmp_path}", *small, *choices])
    graph = build_loop(cfg, tmp_path / "smoke")
    with second_device(monkeypatch):
        made = graph.run("gap-1") | graph.run("rl-1")
    assert made["rl-1"]["result"]["episodes"] > 0 and made["gap-1"]["result"]["imagined"]["episodes"] > 0
