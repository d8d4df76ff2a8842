"""worldloop bench gesim: seconds a chunk of a GE-Sim world and its state expert with random weights, where
they go, and what the silicon would allow.

On a GPU (launch.device) it is the 2B configuration at 3 x 384 x 512 and 25 frames; elsewhere the same code at
a small size, and for the 2B one its floor: floating-point operations and bytes, counted on the network itself
without computing it.
"""

from __future__ import annotations

import resource
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict

from actors.process import device_of
from envs.embodiment import ActionKind, Arm, Camera, Embodiment, Robot
from envs.precision import mixed_precision
from envs.rng import constant_generator, seed_process
from envs.simulators.gesim.engine import GESimulator
from envs.simulators.gesim.state_expert import GESimStateExpert
from envs.specs import WorldSpec
from pipeline.benches.gesim_floor import GOAL, PROMPT, floor

_JOINTS = tuple(f"{side}_joint_{k}" for side in ("left", "right") for k in range(8))
# GE-Sim's robot; what its kinematics are does not matter where pose maps are given.
_ROBOT = Embodiment(
    robot="gesim",
    action_names=_JOINTS,
    action_kind=ActionKind.JOINTS,
    delta=False,
    arms=(Arm("left", tuple(range(7)), 7), Arm("right", tuple(range(8, 15)), 15)),
    state_names=_JOINTS,
    cameras=tuple(Camera(name, (384, 512), calibrated=True) for name in ("head", "left", "right")),
    fps=30.0,
    kinematics=Robot("", ((), ()), ("", "")),
)
_MEMORY = 4
FULL = WorldSpec(_ROBOT, (384, 512), 25, pose_map=True, ray_map=True)
SMALL = WorldSpec(_ROBOT, (96, 128), 25, pose_map=True, ray_map=True)
SMALL_NET: dict[str, Any] = {
    "num_attention_heads": 4,
    "attention_head_dim": 64,
    "num_layers": 6,
    "text_embed_dim": 64,
    "adaln_lora_dim": 64,
    "pose_num_attention_heads": 4,
    "pose_attention_head_dim": 32,
}
SMALL_VAE: dict[str, Any] = {"base_dim": 16}
_TRAINING = {"shift": 1.0, "foreground": 0.0, "augment": 0.0, "checkpointing": False}


def build(spec: WorldSpec, net: dict[str, Any], vae: dict[str, Any]) -> GESimulator:
    """GE-Sim with random weights, the released sampler and a prompt as long as the floor's."""
    sampling = {"kind": "distilled", "steps": 0}
    world = GESimulator(spec, _MEMORY, None, "right", sampling, _TRAINING, {"net": net, "vae": vae})
    world.prompt = torch.zeros(1, PROMPT, world.net.shape.text_embed_dim)
    return world


def _inputs(world: GESimulator, batch: int, device: torch.device) -> tuple[TensorDict, TensorDict]:
    """Sessions that have begun, and the next chunk's future."""
    spec = world.spec
    generator = constant_generator(0)
    height, width = spec.size

    def pictures(*lead: int) -> torch.Tensor:
        return torch.randint(
            0, 255, (*lead, spec.views, 3, height, width), dtype=torch.uint8, generator=generator
        )

    intrinsic = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    first = TensorDict(
        {
            "frames": pictures(batch),
            "command": torch.zeros(batch, spec.action_dim),
            "state": torch.zeros(batch, spec.state_dim),
            "intrinsic": intrinsic.expand(batch, spec.views, 3, 3).contiguous(),
            "c2w": torch.eye(4).expand(batch, spec.views, 4, 4).contiguous(),
            "pose_map": pictures(batch),
        },
        [batch],
    )
    future = TensorDict(
        {
            "commands": torch.zeros(batch, spec.chunk, spec.action_dim),
            "pose_map": pictures(batch, spec.chunk),
            "c2w": torch.eye(4).expand(batch, spec.chunk, spec.views, 4, 4).contiguous(),
        },
        [batch],
    )
    state = world.reset(first.to(device), torch.arange(batch, device=device))
    return state, future.to(device)


class Watch:
    """Seconds spent in named methods, by wrapping them; waits for the GPU at either end."""

    def __init__(self, device: torch.device):
        self.device, self.spent = device, dict[str, float]()

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def wrap(self, owner: Any, method: str, name: str) -> Callable[[], None]:
        """Time a method from now on; returns what undoes it."""
        call = getattr(owner, method)

        def timed(*args: Any, **more: Any) -> Any:
            began = self._now()
            out = call(*args, **more)
            self.spent[name] = self.spent.get(name, 0.0) + self._now() - began
            return out

        setattr(owner, method, timed)
        return lambda: setattr(owner, method, call)

    def measure(self, work: Callable[[], Any], repeats: int) -> float:
        """Least seconds of a run, after one to warm up."""
        work()
        times = []
        for _ in range(repeats):
            began = self._now()
            work()
            times.append(self._now() - began)
        return min(times)


@dataclass(frozen=True)
class Served:
    """A world and its state expert, as they are served, on the watch's device."""

    world: GESimulator
    expert: GESimStateExpert
    watch: Watch

    def step(self, state: TensorDict, future: TensorDict) -> None:
        """One chunk of sessions that stay as they are."""
        _, features, after = self.world.step(state.clone(), future)
        with torch.no_grad():
            self.expert.follow(after, self.world.spec.chunk, features)

    def seconds(self, batch: int, repeats: int) -> float:
        """Least seconds of a chunk of so many sessions."""
        state, future = _inputs(self.world, batch, self.watch.device)
        with mixed_precision(self.watch.device, True):
            return self.watch.measure(partial(self.step, state, future), repeats)


def gesim(cfg: Mapping[str, Any]) -> None:
    """Seconds a chunk and frames per second at batch 1, 2, 4, 8, memory, parts, and variants, each as a ratio
    to the plain run; on launch.device.

    Raises:
        ConfigError: if launch.device asks for a GPU that is not there.
    """
    device = device_of(cfg)
    big = device.type == "cuda"
    seed_process(0)
    spec, sizes = (FULL, ({}, {})) if big else (SMALL, (SMALL_NET, SMALL_VAE))
    world = build(spec, *sizes)
    expert = GESimStateExpert(world, None)
    for part in (world, expert):
        part.to(device, torch.bfloat16 if big else torch.float32).eval()
    served = Served(world, expert, Watch(device))
    count = sum(p.numel() for part in (world.net, expert) for p in part.parameters())
    chip = torch.cuda.get_device_name(device) if big else "CPU"
    size = f"{spec.views} x {spec.size[0]} x {spec.size[1]}"
    print(f"{count / 1e6:.0f}M parameters, {size}, {spec.chunk} frames, {chip}")
    repeats = 5 if big else 2
    plain = 0.0
    for batch in (1, 2, 4, 8):
        if big:
            torch.cuda.reset_peak_memory_stats(device)
        seconds = served.seconds(batch, repeats)
        memory = (
            torch.cuda.max_memory_allocated(device) / 2**30
            if big
            else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        )
        plain = plain or seconds
        note = f" (goal {GOAL} s on an H200)" if big and batch == 1 else ""
        print(
            f"batch {batch}: {seconds:.2f} s a chunk{note}, {batch * spec.chunk / seconds:.1f} frames/s,"
            f" {plain * batch / seconds:.2f}x the frames per second of batch 1, {memory:.1f} GiB at most"
        )
    _parts(served)
    _variants(served, plain, repeats)
    floor(FULL, _MEMORY, chip)


def _parts(served: Served) -> None:
    """Where the seconds of one chunk go at batch 1."""
    world, watch = served.world, served.watch
    state, future = _inputs(world, 1, watch.device)
    names = (
        (world, "encode_stills", "memory encoded"),
        (world, "conditioning", "conditioning"),
        (world.net, "text_keys", "prompt read"),
        (world, "noise", "noise"),
        (world, "_run", "trunk"),
        (world, "decode", "chunk decoded"),
        (served.expert, "follow", "state expert"),
    )
    with mixed_precision(watch.device, True):
        served.step(state, future)
        undo = [watch.wrap(*name) for name in names]
        watch.spent.clear()
        began = watch._now()
        served.step(state, future)
        total = watch._now() - began
    for call in undo:
        call()
    parts = {**watch.spent, "bookkeeping": total - sum(watch.spent.values())}
    print(
        "of a chunk: "
        + ", ".join(
            f"{name} {100 * seconds / total:.0f}%"
            for name, seconds in sorted(parts.items(), key=lambda part: -part[1])
        )
    )


def _variants(served: Served, plain: float, repeats: int) -> None:
    """What single changes are worth at batch 1."""
    world = served.world

    def ratio(name: str) -> None:
        seconds = served.seconds(1, repeats)
        print(f"  {name}: {seconds:.2f} s, {plain / seconds:.2f}x")

    print("one change at a time, against the plain run:")
    net: Any = world.net
    blocks, keys = list(net.transformer_blocks), net.text_keys
    net.text_keys = lambda text: [text.repeat(world.spec.views, 1, 1)] * len(blocks)
    ratio("the text's keys computed anew for every view, block and step")
    net.text_keys = keys
    codec: Any = world.codec
    pixels, codec.pixels = codec.pixels, 1
    ratio("views encoded and decoded one after another")
    codec.pixels = pixels
    if served.watch.device.type == "cuda" or shutil.which("g++"):
        for number, block in enumerate(blocks):
            net.transformer_blocks[number] = torch.compile(block)
        ratio("blocks compiled (torch.compile)")
        for number, block in enumerate(blocks):
            net.transformer_blocks[number] = block
    else:
        print("  torch.compile was not tried: this machine has no C++ compiler")
