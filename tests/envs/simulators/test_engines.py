"""Every engine that configs offer, for every robot: the same in any slot, resumable, learning, no idle
weights, under any conditioning that it can be given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from envs.embodiment import Embodiment, Robot
from envs.simulators import memory
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.inputs import build_inputs
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import WorldSpec
from envs.targets import ConfigError, build
from tests.embodiments import BIMANUAL_JOINTS, BIMANUAL_POSES, EMBODIMENTS, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of, history_of
from tests.sampling import every
from tests.sections import offered

CONFIGS = Path(__file__).resolve().parents[3] / "configs/simulator"
BATCH = 3
CHUNK = 5  # 1 + 4 k, as GE-Sim's autoencoder wants it
# It generates nothing: a server does, whose engine is tested here; tests/actors/test_remote.py has the rest.
SERVED = ("remote",)
# Of a published size, which is counted on the meta device (tests/pipeline/benches/test_size.py).
FULL = "_full"
# Conditioned on pose and ray maps alone, as released: whoever cannot draw them is refused.
MAPS_ALONE = ("gesim_tiny",)
# What its kinematics are does not matter where pose maps are given.
_KINEMATICS = Robot("robot.urdf", (("a",) * 7, ("b",) * 7), ("left", "right"))
ROBOTS = EMBODIMENTS | {BIMANUAL_JOINTS.robot: replace(BIMANUAL_JOINTS, kinematics=_KINEMATICS)}


def parents_of(name: str) -> list[str]:
    """The configs of configs/simulator that one builds on."""
    return [base for base in OmegaConf.load(CONFIGS / f"{name}.yaml").get("defaults", []) if base != "_self_"]


def engines() -> list[str]:
    """What configs/simulator offers: of an engine with a config that builds on another's, the smaller one."""
    names = [name for name in offered("simulator") if name not in SERVED and not name.endswith(FULL)]
    larger = {parent for name in names for parent in parents_of(name)}
    return [name for name in names if name not in larger]


ENGINES = engines()
DRAWN = [name for name, robot in ROBOTS.items() if robot.calibrated and robot.commands_poses]
SERVES = [(name, robot) for name in ENGINES for robot in (DRAWN if name in MAPS_ALONE else ROBOTS)]


# Every engine with some robots, every robot with some engines; what knows maps alone with its first robot.
SAMPLED = [
    *every(3, [(pair,) for pair in SERVES if pair[0] not in MAPS_ALONE]),
    *every(len(DRAWN), [(pair,) for pair in SERVES if pair[0] in MAPS_ALONE]),
]


def section_of(name: str) -> dict[str, Any]:
    """A config of configs/simulator with the one it builds on."""
    own = OmegaConf.load(CONFIGS / f"{name}.yaml")
    own.pop("defaults", None)
    parents = [OmegaConf.load(CONFIGS / f"{base}.yaml") for base in parents_of(name)]
    whole = OmegaConf.create({"simulator": OmegaConf.merge(*parents, own)})
    out = OmegaConf.to_container(whole, resolve=True)
    return {str(key): value for key, value in out["simulator"].items()}  # type: ignore[call-overload, index]


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


@pytest.mark.parametrize("chunk", [1, 2, 3, 4, 8, 16, 30])
@pytest.mark.parametrize(
    "name",
    [n for n in offered("simulator") if n not in SERVED and not n.startswith("gesim") and FULL not in n],
)
def test_engines_fit_a_task_of_any_chunk_as_they_are_configured(name: str, chunk: int) -> None:
    own = {key: value for key, value in section_of(name).items() if key not in WORLD_OPTIONS}
    with torch.device("meta"):
        world: Simulator = build(own, "simulator", spec=world_spec(BIMANUAL_POSES, chunk=chunk))
    assert world.spec.chunk == chunk and world.memory_frames >= 1


@pytest.fixture(scope="module", params=SAMPLED, ids="-".join)
def engine(request: pytest.FixtureRequest) -> Iterator[tuple[Simulator, StateDecoder]]:
    name, robot = request.param
    yield build_engine(name, world_spec(ROBOTS[robot], chunk=CHUNK))


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


def test_a_resumed_session_goes_on_as_the_one_that_went_there(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    spec = simulator.spec
    clips, seeds = clip(spec, BATCH, simulator.memory_frames, chunks=3), torch.tensor([4, 5, 6])
    state = simulator.reset(first_of(spec, clips), seeds)
    for number in range(2):
        _, _, state = simulator.step(state, future_of(spec, clips, number))
    length = torch.full_like(seeds, 1 + 2 * spec.chunk)
    names = {"commands": "command", "states": "state"}
    past = TensorDict(
        {names.get(name, name): value.clone() for name, value in state["history"].items()},
        state["history"].shape,
    )
    past["frames"][:, int(length[0]) :] = 77  # beyond the length anything may stand
    if "intrinsic" in state.keys():
        past["intrinsic"] = state["intrinsic"][:, None].expand(-1, past.shape[1], -1, -1, -1)
    resumed = simulator.resume(past, length, seeds)
    assert resumed["chunk_index"].tolist() == [0] * BATCH  # noise is counted from where imagination begins
    resumed["chunk_index"] = state["chunk_index"].clone()
    future = future_of(spec, clips, 2)
    went, come = simulator.step(state, future), simulator.step(resumed, future)
    assert torch.equal(come[0], went[0]) and torch.equal(come[1], went[1])
    assert torch.equal(come[2]["length"], went[2]["length"])
    for name, value in memory.newest(went[2]).items():
        assert torch.equal(memory.newest(come[2])[name], value), name


def test_a_session_resumed_from_one_frame_is_a_new_one(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    spec, seeds = simulator.spec, torch.tensor([4, 5, 6])
    clips = clip(spec, BATCH, simulator.memory_frames)
    first, future = first_of(spec, clips), future_of(spec, clips)
    begun = simulator.step(simulator.reset(first, seeds), future)
    one = torch.ones(BATCH, dtype=torch.int64)
    resumed = simulator.step(simulator.resume(first.unsqueeze(1), one, seeds, 40), future)
    assert torch.equal(resumed[0], begun[0]) and torch.equal(resumed[1], begun[1])


def test_the_loss_falls_and_every_weight_is_used(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, _ = engine
    clips = clip(simulator.spec, 8, simulator.memory_frames, chunks=2)
    clips["stride"] = 1 + torch.arange(8) % 4
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
        if losses[-1] < 0.9 * losses[0] and all(touched):
            break
    simulator.eval()
    names = [name for name, p in simulator.named_parameters() if p.requires_grad]
    assert losses[-1] < 0.9 * losses[0], losses
    unused = [name for name, seen in zip(names, touched, strict=True) if not seen]
    assert not unused
    with torch.no_grad():
        for parameter, value in zip(trained, before, strict=True):
            parameter.copy_(value)


def test_a_state_expert_learns_from_frozen_features(engine: tuple[Simulator, StateDecoder]) -> None:
    simulator, decoder = engine
    clips = clip(simulator.spec, 8, simulator.memory_frames)
    future, commands = clips["future"], clips["future", "commands"]
    moves = (commands - clips["now", "command"][:, None]).flatten(0, 1)
    decoder.normalise(commands.flatten(0, 1), moves, future["states"].flatten(0, 1))
    history = history_of(clips, decoder.memory_frames)
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


MAPS = ("pose_map", "ray_map")


@pytest.mark.parametrize(
    "given", [(), ("pose_map",), ("ray_map",), MAPS], ids=lambda given: "+".join(given) or "none"
)
@pytest.mark.parametrize("name", [name for name in ENGINES if name not in MAPS_ALONE])
def test_any_subset_of_conditioning_is_read_and_learned(name: str, given: tuple[str, ...]) -> None:
    robot: Embodiment = BIMANUAL_POSES
    spec = replace(world_spec(robot, chunk=CHUNK), **{kind: kind in given for kind in MAPS})
    simulator, _ = build_engine(name, spec)
    clips = clip(spec, 2, simulator.memory_frames)
    assert ("pose_map" in clips["future"].keys()) == spec.pose_map
    inputs = build_inputs(spec, clips, 0)
    with torch.no_grad():
        features = simulator.features(inputs)
    turned = {"pose_map": ("future", "pose_map"), "ray_map": ("future", "c2w")}
    for kind, key in turned.items():
        if key in inputs.keys(True, True):
            other = inputs.clone()
            other[key] = inputs[key].flip(2)  # of the views
            with torch.no_grad():
                assert torch.equal(simulator.features(other), features) != (kind in given), kind
    simulator.train()
    loss, _ = simulator.loss(clips, torch.Generator().manual_seed(0))
    loss.backward()
    assert bool(loss.isfinite())
    unread = [key for key, p in simulator.named_parameters() if p.requires_grad and p.grad is None]
    assert not unread


@pytest.mark.parametrize("name", ENGINES)
def test_networks_are_told_how_much_time_passes_between_frames(name: str) -> None:
    simulator, _ = build_engine(name, world_spec(BIMANUAL_POSES, chunk=CHUNK))
    clips = clip(simulator.spec, 2, simulator.memory_frames)
    inputs = build_inputs(simulator.spec, clips, 0)
    inputs[1] = inputs[0]
    with torch.no_grad():
        alike = simulator.features(inputs)
        inputs["stride"] = torch.tensor([1, 3])
        mixed = simulator.features(inputs)
    assert torch.equal(alike[0], alike[1])
    assert torch.allclose(mixed[0], alike[0], atol=1e-4) and not torch.allclose(mixed[1], alike[1], atol=1e-3)


@pytest.mark.parametrize("lacking", MAPS)
@pytest.mark.parametrize("name", MAPS_ALONE)
def test_engines_conditioned_on_maps_alone_refuse_to_go_without(name: str, lacking: str) -> None:
    spec = replace(world_spec(BIMANUAL_POSES, chunk=CHUNK), **{lacking: False})
    with pytest.raises(ConfigError, match=r"needs calibrated cameras.*simulator\.pose_map=true"):
        build_engine(name, spec)
