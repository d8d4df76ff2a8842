"""worldloop bench gesim: seconds a chunk of a GE-Sim world and its state expert with random weights, where
they go, and what the silicon would allow.

On a GPU (launch.device) it is the 2B configuration at 3 x 384 x 512 and 25 frames; elsewhere the same code at
a small size, and for the 2B one its floor: floating-point operations and bytes, counted on the network itself
without computing it.
"""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict

from actors.process import device_of
from envs.precision import mixed_precision
from envs.rng import seed_process
from envs.simulators.compiling import Compile, compile_parts
from envs.simulators.gesim.engine import GESimulator
from envs.simulators.gesim.state_expert import GESimStateExpert
from pipeline.benches.gesim.floor import GOAL, floor
from pipeline.benches.gesim.updates import updates
from pipeline.benches.gesim.world import FULL, MEMORY, SMALL, SMALL_NET, SMALL_VAE, build, sessions
from pipeline.benches.timing import best, now

_COMPILED: tuple[Compile, ...] = ("blocks", "graphs")


class Watch:
    """Seconds spent in named methods, by wrapping them; waits for the GPU at either end."""

    def __init__(self, device: torch.device):
        self.device, self.spent = device, dict[str, float]()

    def wrap(self, owner: Any, method: str, name: str) -> Callable[[], None]:
        """Time a method from now on; returns what undoes it."""
        call = getattr(owner, method)

        def timed(*args: Any, **more: Any) -> Any:
            began = now(self.device)
            out = call(*args, **more)
            self.spent[name] = self.spent.get(name, 0.0) + now(self.device) - began
            return out

        setattr(owner, method, timed)
        return lambda: setattr(owner, method, call)


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
        state, future = sessions(self.world, batch, self.watch.device)
        with mixed_precision(self.watch.device, True):
            return best(partial(self.step, state, future), repeats, self.watch.device)


def gesim(cfg: Mapping[str, Any]) -> None:
    """Seconds a chunk and frames per second at several batches, memory, parts, and variants, each as a ratio
    to the plain run; then what an update of distilling takes; on launch.device.

    Raises:
        ConfigError: if launch.device asks for a GPU that is not there.
    """
    device = device_of(cfg)
    big = device.type == "cuda"
    seed_process(0)
    spec, sizes = (FULL, ({}, {})) if big else (SMALL, (SMALL_NET, SMALL_VAE))
    with device:
        world = build(spec, *sizes)
        expert = GESimStateExpert(world, None)
    for part in (world, expert):
        part.to(device, torch.bfloat16 if big else torch.float32).eval()
    served = Served(world, expert, Watch(device))
    count = sum(p.numel() for part in (world.net, expert) for p in part.parameters())
    chip = torch.cuda.get_device_name(device) if big else "CPU"
    size = f"{spec.views} x {spec.size[0]} x {spec.size[1]}"
    print(f"{count / 1e6:.0f}M parameters, {size}, {spec.chunk} frames, {chip}")
    repeats = 3 if big else 2
    plain = 0.0
    for batch in (1, 2) if big else (1, 2, 4, 8):
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
    del served, world, expert, part
    print("an update of distilling (DMD2), one clip:")
    updates(spec, sizes, device, "blocks" if big else None)
    floor(FULL, MEMORY, chip)


def _parts(served: Served) -> None:
    """Where the seconds of one chunk go at batch 1."""
    world, watch = served.world, served.watch
    state, future = sessions(world, 1, watch.device)
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
        began = now(watch.device)
        served.step(state, future)
        total = now(watch.device) - began
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
    if not shutil.which("g++"):
        print("  torch.compile was not tried: this machine has no C++ compiler")
        return
    for how in _COMPILED:
        for part in (world, served.expert):
            compile_parts(part, how)
        ratio(f"launch.compile={how}")
        _parts(served)
