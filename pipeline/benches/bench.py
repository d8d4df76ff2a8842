"""worldloop bench: performance as ratios within one run, on the machine at hand."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch

from actors.factory import ConfigError, bench_config, build_simulator, prepare_process
from envs.conditioning import PoseMapStyle, render_pose_map, render_ray_map
from envs.conditioning.pose_map import AXIS_RGB, arm_shades, layout
from envs.geometry.cameras import follow_hands, hands_of
from envs.physics.pool import BenchPool
from envs.physics.tabletop.bench import Bench
from envs.precision import mixed_precision
from pipeline.benches.actors import actors
from pipeline.benches.gesim import gesim
from pipeline.benches.learning import learning
from pipeline.benches.training import overfit, pretrained
from pipeline.config import load_config


def best(work: Callable[[], Any], repeats: int = 7) -> float:
    """Least seconds of several runs after one warm-up; the least is what the machine can do."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def conditioning(cfg: dict[str, Any]) -> None:
    """Pose and ray maps at 384 x 512 on one core, beside a plain OpenCV loop over the same frames."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    bench = Bench(bench_config(cfg))
    bench.reset(0)
    size, steps = (384, 512), 10
    commands = torch.from_numpy(np.tile(bench.command, (steps, 1))).float()
    commands[:, 0] += torch.linspace(0, 0.2, steps)
    intrinsic, c2w = (torch.from_numpy(a).float() for a in bench.cameras())
    scale = torch.tensor([size[1] / cfg["task"]["size"][1], size[0] / cfg["task"]["size"][0], 1.0])
    intrinsic = intrinsic * scale[:, None]
    cameras = follow_hands(c2w, commands[0], commands, hands_of(tuple(cfg["task"]["views"]))).transpose(0, 1)
    count = steps * len(intrinsic)

    def plain() -> list[np.ndarray]:
        out = []
        pixels, radii, shades, visible = layout(commands, cameras, intrinsic, size, 0.15, PoseMapStyle())
        for v in range(len(intrinsic)):
            for t in range(steps):
                canvas = np.full((*size, 3), 50, np.uint8)
                for arm in np.flatnonzero(visible[v, t]):
                    centre = tuple(int(x) for x in pixels[v, t, arm, 0])
                    cv2.circle(
                        canvas,
                        centre,
                        int(radii[v, t, arm]),
                        arm_shades()[arm][shades[v, t, arm]].tolist(),
                        -1,
                    )
                for arm in np.flatnonzero(visible[v, t]):
                    centre = tuple(int(x) for x in pixels[v, t, arm, 0])
                    for axis in range(3):
                        cv2.line(
                            canvas,
                            centre,
                            tuple(int(x) for x in pixels[v, t, arm, axis + 1]),
                            AXIS_RGB[arm][axis],
                            8,
                        )
                out.append(np.ascontiguousarray(canvas.transpose(2, 0, 1)))
        return out

    ours = best(lambda: render_pose_map(commands, cameras, intrinsic, size)) / count * 1e3
    theirs = best(plain) / count * 1e3
    rays = best(lambda: render_ray_map(intrinsic, cameras, size)) / count * 1e3
    same = np.array_equal(
        np.stack(plain()), render_pose_map(commands, cameras, intrinsic, size).flatten(0, 1).numpy()
    )
    print(
        f"pose map  {ours:.3f} ms per view-frame at 384x512 (goal 0.12), OpenCV loop {theirs:.3f} ms: {theirs / ours:.1f}x; pictures equal: {same}"
    )
    print(f"ray map   {rays:.3f} ms per view-frame")


def physics(cfg: dict[str, Any]) -> None:
    """View-frames rendered and control steps simulated per second, with one worker and with one per core."""
    config = bench_config(cfg)
    views = len(config.views)
    rates = {}
    for workers in (1, torch.get_num_threads()):
        pool = BenchPool(config, 2 * workers, cfg["task"]["horizon"], workers)
        jobs = [(seed, 0.5) for seed in range(16 * workers)]
        pool.script(jobs[:workers])
        began = time.perf_counter()
        frames = sum(len(track.rows["frames"]) for track in pool.script(jobs))
        rates[workers] = frames / (time.perf_counter() - began)
        pool.close()
        print(
            f"{workers} worker(s): {rates[workers]:.0f} control steps/s with all views, {views * rates[workers]:.0f} view-frames/s at {config.size} (goal 400 on 2 cores)"
        )
    few, many = min(rates), max(rates)
    print(f"{many} workers are {rates[many] / rates[few]:.2f}x one")


def world(cfg: dict[str, Any]) -> None:
    """Generated frames per second, and the forward pass's share of a simulator step."""
    prepare_process(0)
    simulator = build_simulator(cfg).eval()
    shape = simulator.shape
    device = next(simulator.parameters()).device
    for batch in (1, 32):
        commands = torch.zeros(batch, shape.chunk, 14)
        intrinsic = torch.eye(3).expand(batch, shape.views, 3, 3).contiguous()
        c2w = torch.eye(4).expand(batch, shape.chunk, shape.views, 4, 4).contiguous()
        maps = render_pose_map(commands, c2w.transpose(1, 2), intrinsic, shape.size).transpose(1, 2)
        frames = torch.zeros(batch, shape.views, 3, *shape.size, dtype=torch.uint8)
        first = [
            frames,
            intrinsic,
            c2w[:, 0],
            commands[:, 0],
            torch.zeros(batch, 16),
            maps[:, 0],
            torch.arange(batch),
        ]
        state = simulator.reset(*(t.to(device) for t in first))
        spent = [0.0]
        forward = simulator.predict

        def timed(inputs: Any, forward: Any = forward, spent: list[float] = spent) -> Any:
            began = time.perf_counter()
            out = forward(inputs)
            spent[0] += time.perf_counter() - began
            return out

        simulator.predict = timed  # type: ignore[method-assign]
        began = time.perf_counter()
        for _ in range(8):
            with mixed_precision(device, cfg["simulator"]["bf16"]):
                _, _, state = simulator.step(state, commands.to(device), maps.to(device), c2w.to(device))
        total = time.perf_counter() - began
        simulator.predict = forward  # type: ignore[method-assign]
        print(
            f"batch {batch}: {8 * batch * shape.chunk / total:.0f} frames/s, forward pass {100 * spent[0] / total:.1f}% of the step"
        )


BENCHES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "conditioning": conditioning,
    "physics": physics,
    "world": world,
    "actors": actors,
    "learning": learning,
    "gesim": gesim,
    "overfit": overfit,
    "pretrained": pretrained,
}
# What a benchmark takes for granted unless the command line says otherwise.
BASES = {
    "actors": ["launch=ray"],
    "overfit": ["simulator=gesim"],
    "pretrained": ["experiment=smoke", "simulator=dit_small"],
}


def run_bench(words: list[str]) -> None:
    """`worldloop bench NAME [overrides]`."""
    if not words or words[0] not in BENCHES:
        raise ConfigError(f"say which: worldloop bench {'|'.join(BENCHES)}")
    extra = [
        word
        for word in BASES.get(words[0], [])
        if not any(own.startswith(word.split("=")[0] + "=") for own in words)
    ]
    BENCHES[words[0]](load_config([*extra, *words[1:]]))
