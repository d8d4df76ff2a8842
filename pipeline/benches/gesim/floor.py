"""What the silicon allows a 2B GE-Sim: operations and bytes of one chunk, counted on the network itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from diffusers import AutoencoderKLWan
from torch.utils.flop_counter import FlopCounterMode

from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.shape import DiTShape
from envs.simulators.dit.state_network import StateDiT
from envs.specs import WorldSpec

PROMPT = 512  # tokens of the text that GE-Sim's trunk reads
# Dense bf16 FLOP/s and bytes/s of what the goal is set for (NVIDIA's data sheets).
CHIPS = {"H100": (989e12, 3.35e12), "H200": (989e12, 4.8e12)}
GOAL, _GOAL_CHIP = 1.15, "H200"  # s a chunk at batch 1 on one of these
COMMAND = "worldloop bench gesim launch.device=cuda"


def count_flops(
    spec: WorldSpec, memory: int, net: DiTShape, steps: int, vae: dict[str, Any]
) -> dict[str, float]:
    """Floating-point operations of the parts of one chunk at batch 1, counted by tracing shapes without
    computing.
    """
    latents = 1 + (spec.chunk - 1) // 4
    height, width = spec.size[0] // 8, spec.size[1] // 8
    with torch.device("meta"):
        expert = StateDiT(net)
        trunk = MultiViewDiT(net)
        codec = AutoencoderKLWan(**vae).eval()
        z = torch.zeros(spec.views, net.in_channels, memory + latents, height, width)
        times, text = (
            torch.zeros(spec.views, memory + latents),
            torch.zeros(1, PROMPT, net.text_embed_dim),
        )
        states, state_times = (
            torch.zeros(1, 2 * memory + 2 * spec.chunk, net.pose_in_channels),
            torch.zeros(1, 2 * memory + 2 * spec.chunk),
        )
        still, clip = (
            torch.zeros(1, 3, 1, *spec.size),
            torch.zeros(1, int(codec.config.z_dim), latents, height, width),
        )

    def counted(work: Callable[[], Any]) -> tuple[float, Any]:
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            out = work()
        return float(counter.get_total_flops()), out

    read, prompt = counted(lambda: trunk.text_keys(text))
    once, (_, fused) = counted(lambda: trunk(z, times, prompt, spec.fps))
    keys, known = counted(lambda: expert.feature_keys(fused.unflatten(0, (-1, spec.views))))
    decoding, _ = counted(lambda: expert(states, state_times, known))
    encoded, _ = counted(lambda: codec.encode(still).latent_dist.mode())
    decoded, _ = counted(lambda: codec.decode(clip))
    return {
        "trunk": read + steps * once,
        "state expert": keys + steps * decoding,
        "memory encoded": spec.views * memory * encoded,
        "chunk decoded": spec.views * decoded,
    }


def floor(spec: WorldSpec, memory: int, chip: str) -> None:
    """Operations and bytes of the 2B configuration, the seconds below which no dense bf16 run of it can go,
    and whether the goal was measured just now.

    Args:
        chip: what the bench ran on.
    """
    net = DiTShape()
    flops = count_flops(spec, memory, net, 4, {})
    with torch.device("meta"):
        weights = 2.0 * sum(p.numel() for p in MultiViewDiT(net).parameters())
    total = sum(flops.values())
    print(
        f"the 2B configuration, one chunk at batch 1: {total / 1e12:.0f} TFLOP ("
        + ", ".join(f"{name} {value / 1e12:.1f}" for name, value in flops.items())
        + f"), {4 * weights / 1e9:.0f} GB of weights read"
    )
    for name, (speed, bandwidth) in CHIPS.items():
        print(
            f"  {name}: at least {total / speed:.2f} s of arithmetic in dense bf16,"
            f" {4 * weights / bandwidth * 1e3:.0f} ms of reading weights;"
            f" {100 * total / speed / GOAL:.0f}% of its peak would meet {GOAL} s"
        )
    print(goal_line(spec, chip))


def goal_line(spec: WorldSpec, chip: str) -> str:
    """The goal, whether a bench on this chip measured it, and by which command it is."""
    size = f"{spec.chunk} frames x {spec.views} views at {spec.size[0]} x {spec.size[1]}"
    found = "measured above" if _GOAL_CHIP in chip else f"unmeasured, for this is {chip}"
    return f"goal, {size} in {GOAL} s on one {_GOAL_CHIP}: {found}; {COMMAND}"
