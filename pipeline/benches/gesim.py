"""worldloop bench gesim: seconds a chunk of a GE-Sim world with random weights, where they go, and what the
silicon would allow.

On a GPU it is the 2B configuration at 3 x 384 x 512 and 25 frames; elsewhere the same code at a small size,
and for
the 2B one its floor: floating-point operations and bytes, counted on the network itself without computing it.
"""

from __future__ import annotations

import resource
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from diffusers import AutoencoderKLWan
from tensordict import TensorDict
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from envs.layouts import CommandLayout
from envs.precision import mixed_precision
from envs.simulators.base import WorldShape
from envs.simulators.dit.network import DiTShape, MultiViewDiT
from envs.simulators.gesim.engine import GESimConfig, GESimulator

FULL = WorldShape(
    views=3, size=(384, 512), chunk=25, memory=4, fps=30.0, sides=(), layout=CommandLayout.JOINTS
)
SMALL = replace(FULL, size=(96, 128))
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
# Dense bf16 FLOP/s and bytes/s of what the goal is set for (NVIDIA's data sheets).
CHIPS = {"H100": (989e12, 3.35e12), "H200": (989e12, 4.8e12)}
GOAL = 1.15  # s a chunk at batch 1 on one H200


def _inputs(
    world: GESimulator, batch: int, device: torch.device
) -> tuple[TensorDict, tuple[Tensor, Tensor, Tensor]]:
    """Sessions that have made a chunk, and the next chunk's arguments."""
    shape = world.shape
    generator = torch.Generator().manual_seed(0)

    def pictures(*lead: int) -> Tensor:
        return torch.randint(
            0, 255, (*lead, shape.views, 3, *shape.size), dtype=torch.uint8, generator=generator
        ).to(device)

    intrinsic = torch.tensor(
        [[shape.size[1] * 0.5, 0, shape.size[1] / 2], [0, shape.size[1] * 0.5, shape.size[0] / 2], [0, 0, 1]],
        device=device,
    ).expand(batch, shape.views, 3, 3)
    c2w = torch.eye(4, device=device).expand(batch, shape.chunk, shape.views, 4, 4).contiguous()
    zeros = torch.zeros(batch, 16, device=device)
    state = world.reset(
        pictures(batch),
        intrinsic,
        c2w[:, 0],
        zeros,
        zeros,
        pictures(batch),
        torch.arange(batch, device=device),
    )
    return state, (torch.zeros(batch, shape.chunk, 16, device=device), pictures(batch, shape.chunk), c2w)


class Watch:
    """Seconds spent in named methods, by wrapping them; waits for the GPU at either end."""

    def __init__(self, device: torch.device):
        self.device, self.spent = device, dict[str, float]()

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
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


def gesim(cfg: Mapping[str, Any]) -> None:
    """Seconds a chunk and frames per second at batch 1, 2, 4, 8, memory, parts, and variants, each as a ratio
    to the plain run.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    big = device.type == "cuda"
    shape = FULL if big else SMALL
    torch.manual_seed(0)
    world = (
        GESimulator.build(shape, GESimConfig() if big else GESimConfig(net=SMALL_NET, vae=SMALL_VAE), None)
        .to(device)
        .eval()
    )
    if big:
        world.to(torch.bfloat16)
    count = sum(p.numel() for p in world.net.parameters())
    # type: ignore[attr-defined]
    print(
        f"{count / 1e6:.0f}M parameters, {shape.views} x {shape.size[0]} x {shape.size[1]}, {shape.chunk} frames, {len(world.sampler.sigmas)} steps, {torch.cuda.get_device_name() if big else 'CPU'}"
    )
    watch = Watch(device)
    repeats = 5 if big else 2
    plain = 0.0
    for batch in (1, 2, 4, 8):
        if big:
            torch.cuda.reset_peak_memory_stats()
        state, arguments = _inputs(world, batch, device)
        with mixed_precision(device, True):
            # type: ignore[misc]
            seconds = watch.measure(
                lambda state=state, arguments=arguments: world.step(state, *arguments), repeats
            )
        memory = (
            torch.cuda.max_memory_allocated() / 2**30
            if big
            else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        )
        plain = plain or seconds
        note = f" (goal {GOAL} s on an H200)" if big and batch == 1 else ""
        print(
            f"batch {batch}: {seconds:.2f} s a chunk{note}, {batch * shape.chunk / seconds:.1f} frames/s, {plain * batch / seconds:.2f}x the frames per second of batch 1, {memory:.1f} GiB at most"
        )
    _parts(world, device, watch)
    _variants(world, device, watch, plain, repeats)
    floor()


def _parts(world: GESimulator, device: torch.device, watch: Watch) -> None:
    """Where the seconds of one chunk go at batch 1."""
    state, arguments = _inputs(world, 1, device)
    names = (
        (world, "remember", "memory encoded"),
        (world, "conditioning", "conditioning"),
        (world, "_says", "trunk"),
        (world, "decode", "chunk decoded"),
        (world, "_noise", "noise"),
    )
    with mixed_precision(device, True):
        world.step(state.clone(), *arguments)
        undo = [watch.wrap(*name) for name in names]
        watch.spent.clear()
        began = watch._now()
        world.step(state, *arguments)
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


def _variants(world: GESimulator, device: torch.device, watch: Watch, plain: float, repeats: int) -> None:
    """What single changes are worth at batch 1."""
    state, arguments = _inputs(world, 1, device)

    def ratio(name: str) -> None:
        with mixed_precision(device, True):
            seconds = watch.measure(lambda: world.step(state, *arguments), repeats)
        print(f"  {name}: {seconds:.2f} s, {plain / seconds:.2f}x")

    print("one change at a time, against the plain run:")
    known = world.net._known
    # type: ignore[method-assign, assignment]
    world.net._known = lambda text, batch: [text[:1].repeat(batch, 1, 1)] * len(world.net.transformer_blocks)
    ratio("the text's keys computed anew for every view, block and step")
    world.net._known = known  # type: ignore[method-assign]
    codec: Any = world.codec
    pixels, codec.pixels = codec.pixels, 1
    ratio("views encoded and decoded one after another")
    codec.pixels = pixels
    if device.type == "cuda" or shutil.which("g++"):
        blocks = list(world.net.transformer_blocks)
        for number, block in enumerate(blocks):
            world.net.transformer_blocks[number] = torch.compile(block)  # type: ignore[assignment]
        ratio("blocks compiled (torch.compile)")
        for number, block in enumerate(blocks):
            world.net.transformer_blocks[number] = block
    else:
        print("  torch.compile was not tried: this machine has no C++ compiler")


def count_flops(shape: WorldShape, net: DiTShape, steps: int, vae: dict[str, Any]) -> dict[str, float]:
    """Floating-point operations of the parts of one chunk at batch 1, counted by tracing shapes without
    computing.
    """
    latents = 1 + (shape.chunk - 1) // 4
    height, width = shape.size[0] // 8, shape.size[1] // 8
    with torch.device("meta"):
        trunk = MultiViewDiT(net)  # not eval: what it keeps between steps has no meaning without numbers
        codec = AutoencoderKLWan(**vae).eval()
        z = torch.zeros(shape.views, net.in_channels, shape.memory + latents, height, width)
        times, text = (
            torch.zeros(shape.views, shape.memory + latents),
            torch.zeros(1, 512, net.text_embed_dim),
        )
        states, state_times = (
            torch.zeros(1, 2 * shape.memory + 2 * shape.chunk, net.pose_in_channels),
            torch.zeros(1, 2 * shape.memory + 2 * shape.chunk),
        )
        still, clip = (
            torch.zeros(1, 3, 1, *shape.size),
            torch.zeros(1, int(codec.config.z_dim), latents, height, width),
        )

    def counted(work: Callable[[], Any]) -> tuple[float, Any]:
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            out = work()
        return float(counter.get_total_flops()), out

    once, (_, fused) = counted(lambda: trunk(z, times, text, shape.views, shape.fps))
    keys, known = counted(lambda: trunk.feature_keys(fused, shape.views))
    expert, _ = counted(lambda: trunk.decode_states(states, state_times, known, shape.views))
    encoded, _ = counted(lambda: codec.encode(still).latent_dist.mode())
    decoded, _ = counted(lambda: codec.decode(clip))
    return {
        "trunk": steps * once,
        "state expert": keys + steps * expert,
        "memory encoded": shape.views * shape.memory * encoded,
        "chunk decoded": shape.views * decoded,
    }


def floor() -> None:
    """Operations and bytes of the 2B configuration, and the seconds below which no dense bf16 run of it can
    go.
    """
    net = DiTShape()
    flops = count_flops(FULL, net, 4, {})
    with torch.device("meta"):
        weights = 2.0 * sum(p.numel() for p in MultiViewDiT(net).parameters())
    total = sum(flops.values())
    print(
        f"the 2B configuration, one chunk at batch 1: {total / 1e12:.0f} TFLOP ("
        + ", ".join(f"{name} {value / 1e12:.1f}" for name, value in flops.items())
        + f"), {4 * weights / 1e9:.0f} GB of weights read"
    )
    for chip, (speed, bandwidth) in CHIPS.items():
        print(
            f"  {chip}: at least {total / speed:.2f} s of arithmetic in dense bf16, {4 * weights / bandwidth * 1e3:.0f} ms of reading weights; {100 * total / speed / GOAL:.0f}% of its peak would meet {GOAL} s"
        )
