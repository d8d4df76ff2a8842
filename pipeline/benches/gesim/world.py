"""GE-Sim worlds with random weights, and what they are shown: what its benches share."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from envs.embodiment import ActionKind, Arm, Camera, Embodiment, Robot
from envs.rng import constant_generator
from envs.simulators.gesim.engine import GESimulator
from envs.specs import WorldSpec
from pipeline.benches.gesim.floor import PROMPT

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
MEMORY = 4
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
_TRAINING = {"shift": 1.0, "foreground": 0.0, "augment": 0.0}


def build(
    spec: WorldSpec, net: dict[str, Any], vae: dict[str, Any], kind: str = "distilled", learns: bool = False
) -> GESimulator:
    """GE-Sim with random weights, a released sampler and a prompt as long as the floor's.

    Args:
        kind: of sampler, as in simulator.sampling.kind.
        learns: compute blocks anew in the backward pass, for memory.
    """
    training = {**_TRAINING, "checkpointing": learns}
    sampling = {"kind": kind, "steps": 0}
    world = GESimulator(spec, MEMORY, None, "right", sampling, training, {"net": net, "vae": vae})
    world.prompt = torch.zeros(1, PROMPT, world.net.shape.text_embed_dim)
    return world


def sessions(world: GESimulator, batch: int, device: torch.device) -> tuple[TensorDict, TensorDict]:
    """Sessions that have begun, and the next chunk's future."""
    spec, generator = world.spec, constant_generator(0)
    first = TensorDict(
        {
            "frames": _pictures(spec, generator, batch),
            "command": torch.zeros(batch, spec.action_dim),
            "state": torch.zeros(batch, spec.state_dim),
            "intrinsic": _intrinsic(spec, batch),
            "c2w": torch.eye(4).expand(batch, spec.views, 4, 4).contiguous(),
            "pose_map": _pictures(spec, generator, batch),
        },
        [batch],
    )
    future = TensorDict(
        {
            "commands": torch.zeros(batch, spec.chunk, spec.action_dim),
            "pose_map": _pictures(spec, generator, batch, spec.chunk),
            "c2w": torch.eye(4).expand(batch, spec.chunk, spec.views, 4, 4).contiguous(),
        },
        [batch],
    )
    return world.reset(first.to(device), torch.arange(batch, device=device)), future.to(device)


def clips(spec: WorldSpec, batch: int) -> TensorDict:
    """Training clips of one chunk, as ClipStore makes them."""
    generator = constant_generator(0)

    def frames(count: int) -> dict[str, torch.Tensor]:
        return {
            "frames": _pictures(spec, generator, batch, count),
            "commands": torch.zeros(batch, count, spec.action_dim),
            "pose_map": _pictures(spec, generator, batch, count),
            "c2w": torch.eye(4).expand(batch, count, spec.views, 4, 4).contiguous(),
        }

    memory = TensorDict(frames(MEMORY), [batch]).unsqueeze(1)
    memory.batch_size = [batch]
    memory["index"] = torch.zeros(batch, 1, MEMORY, dtype=torch.int64)
    future = TensorDict(frames(spec.chunk), [batch])
    future["valid"] = torch.ones(batch, spec.chunk, dtype=torch.bool)
    now = TensorDict(
        {"command": torch.zeros(batch, spec.action_dim), "state": torch.zeros(batch, spec.state_dim)}, [batch]
    )
    rest = {"begin": torch.zeros(batch, dtype=torch.int64), "stride": torch.ones(batch, dtype=torch.int64)}
    whole = {"memory": memory, "future": future, "now": now, "intrinsic": _intrinsic(spec, batch), **rest}
    return TensorDict(whole, [batch])


def _pictures(spec: WorldSpec, generator: torch.Generator, *lead: int) -> torch.Tensor:
    shape = (*lead, spec.views, 3, *spec.size)
    return torch.randint(0, 255, shape, dtype=torch.uint8, generator=generator)


def _intrinsic(spec: WorldSpec, batch: int) -> torch.Tensor:
    height, width = spec.size
    camera = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    return camera.expand(batch, spec.views, 3, 3).contiguous()
