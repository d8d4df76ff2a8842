"""Every engine that configs offer, for every robot: the same in any slot, resumable, learning, no idle
weights.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from envs.simulators import memory
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.inputs import build_inputs
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import WorldSpec
from envs.targets import build
from tests.embodiments import EMBODIMENTS, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of

CONFIGS = Path(__file__).resolve().parents[3] / "configs/simulator"
SMALL = sorted(path.stem for path in CONFIGS.glob("*_small.yaml"))
BATCH = 3


def section_of(name: str) -> dict[str, Any]:
    """A config of configs/simulator with the one it builds on."""
    own = OmegaConf.load(CONFIGS / f"{name}.yaml")
    parents = [
        OmegaConf.load(CONFIGS / f"{base}.yaml") for base in own.pop("defaults", []) if base != "_self_"
    ]
    out = OmegaConf.to_container(OmegaConf.merge(*parents, own))
    assert isinstance(out, dict)
    return {str(key): value for key, value in out.items()}


def build_engine(name: str, spec: WorldSpec) -> tuple[Simulator, StateDecoder]:
    """A tiny untrained engine whose output is not trivial, and its state expert."""
    section = section_of(name)
    torch.manual_seed(0)
    own = {key: value for key, value in section.items() if key not in WORLD_OPTIONS}
    simulator: Simulator = build(own, "simulator", spec=spec)
    decoder: StateDecoder = build(section["state_expert"], "simulator.state_expert", simulator=simulator)
    with torch.no_grad():
        for parameter in [*simulator.parameters(), *decoder.parameters()]:
            # what begins at zero, so that training starts gently, would hide mistakes
            if not parameter.any():
                parameter.normal_(std=0.05)
    return simulator.eval(), decoder.eval()


@pytest.fixture(scope="module", params=list(product(SMALL, sorted(EMBODIMENTS))), ids="-".join)
def engine(request: pytest.FixtureRequest) -> Iterator[tuple[Simulator, StateDecoder]]:
    name, robot = request.param
    yield build_engine(name, world_spec(EMBODIMENTS[robot]))


def run(simulator: Simulator, clips: TensorDict, seeds: torch.Tensor, chunks: int) -> torch.Tensor:
    """Frames [B, chunks * K, V, 3, H, W] of sessions under the clips' commands."""
    state, out = simulator.reset(first_of(simulator.spec, clips), seeds), []
    for number in range(chunks):
        frames, _, state = simulator.step(state, future_of(simulator.spec, clips, number))
        out.append(frames)
    return torch.cat(out, 1)


def test_shapes_and_dtypes(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, decoder = engine
    spec = simulator.spec
    clips = clip(spec, BATCH, simulator.memory_frames)
    state = simulator.reset(first_of(spec, clips), torch.arange(BATCH))
    frames, features, state = simulator.step(state, future_of(spec, clips))
    assert frames.shape == (BATCH, spec.chunk, spec.views, 3, *spec.size) and frames.dtype == torch.uint8
    assert features.shape == (BATCH, *simulator.feature_shape) and torch.isfinite(features).all()
    states = decoder.follow(state, spec.chunk, features)
    assert states.shape == (BATCH, spec.chunk, spec.state_dim) and torch.isfinite(states).all()
    assert torch.equal(memory.newest(state)["states"], states[:, -1])


def test_an_episode_is_the_same_in_any_slot_of_any_batch(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    clips, seeds = clip(simulator.spec, BATCH, simulator.memory_frames, chunks=2), torch.tensor([5, 6, 7])
    together = run(simulator, clips, seeds, 2)
    turned = run(simulator, clips.flip(0), seeds.flip(0), 2)
    assert torch.equal(turned.flip(0), together)
    alone = run(simulator, clips[1:2], seeds[1:2], 2)
    # Other batch sizes may choose other kernels: a grey level of rounding is allowed, not more.
    assert (alone.int() - together[1:2].int()).abs().max() <= 1


def test_a_partial_reset_leaves_the_others_alone(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    spec = simulator.spec
    clips, seeds = clip(spec, BATCH, simulator.memory_frames, chunks=3), torch.tensor([1, 2, 3])
    whole = run(simulator, clips, seeds, 3)
    state = simulator.reset(first_of(spec, clips), seeds)
    for number in range(2):
        frames, _, state = simulator.step(state, future_of(spec, clips, number))
    mask = torch.tensor([False, True, False])
    begun = simulator.reset(first_of(spec, clips)[mask], seeds[mask])
    state = memory.replace(state, mask, begun)
    assert state["length"].tolist() == [1 + 2 * spec.chunk, 1, 1 + 2 * spec.chunk]
    future = future_of(spec, clips, 2)
    for name in future.keys():
        future[name][1] = future_of(spec, clips, 0)[name][1]
    frames, _, _ = simulator.step(state, future)
    assert torch.equal(frames[[0, 2]], whole[[0, 2], 2 * spec.chunk :])
    assert torch.equal(frames[1], whole[1, : spec.chunk])


def test_the_loss_falls_and_every_weight_is_used(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    clips = clip(simulator.spec, 8, simulator.memory_frames, chunks=2)
    commands = clips["future", "commands"]
    moves = (commands - clips["now", "command"][:, None]).flatten(0, 1)
    units = (commands.flatten(0, 1), moves, clips["future", "states"].flatten(0, 1))
    simulator.normalise(*units)
    trained = [p for p in simulator.parameters() if p.requires_grad]
    before = [p.detach().clone() for p in trained]
    optimiser = torch.optim.AdamW(trained, lr=2e-3)
    simulator.train()
    losses, touched = [], [False] * len(trained)
    for _ in range(25):
        loss, _ = simulator.loss(clips, torch.Generator().manual_seed(0))
        optimiser.zero_grad()
        loss.backward()
        touched = [
            seen or (p.grad is not None and bool(p.grad.any()))
            for seen, p in zip(touched, trained, strict=True)
        ]
        optimiser.step()
        losses.append(float(loss.detach()))
    simulator.eval()
    names = [name for name, p in simulator.named_parameters() if p.requires_grad]
    assert min(losses[-5:]) < 0.9 * losses[0], losses
    assert all(touched), [name for name, seen in zip(names, touched, strict=True) if not seen]
    with torch.no_grad():
        for parameter, value in zip(trained, before, strict=True):
            parameter.copy_(value)


def test_a_state_expert_learns_from_frozen_features(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, decoder = engine
    clips = clip(simulator.spec, 8, simulator.memory_frames)
    future, commands = clips["future"], clips["future", "commands"]
    moves = (commands - clips["now", "command"][:, None]).flatten(0, 1)
    decoder.normalise(commands.flatten(0, 1), moves, future["states"].flatten(0, 1))
    missing = decoder.memory_frames - clips["history", "commands"].shape[1]
    history = TensorDict(
        {
            name: torch.cat(
                [value[:, :1].expand(-1, max(0, missing), -1), value[:, -decoder.memory_frames :]], 1
            )
            for name, value in clips["history"].items()
        },
        clips.shape,
    )
    shown = decoder.look(simulator, build_inputs(simulator.spec, clips, 0))
    trained = [p for p in decoder.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(trained, lr=3e-3)
    losses = []
    for _ in range(30):
        loss = decoder.loss(decoder.read(shown), history, future, torch.Generator().manual_seed(0))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.8 * losses[0], losses
    unused = [name for name, p in decoder.named_parameters() if p.grad is None]
    assert not unused
