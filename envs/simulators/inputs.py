"""Training inputs: the inputs of Simulator.predict for a chunk of a recorded clip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.specs import WorldSpec

if TYPE_CHECKING:
    from envs.simulators.base import Simulator


def build_inputs(
    spec: WorldSpec,
    clip: TensorDict,
    number: int,
    drawn: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """The inputs of `predict` for chunk `number` of a training clip [B] (see episodes/clips.py).

    Args:
        drawn: uint8 [B, number * K, V, 3, H, W], the model's own frames of the chunks before; memory then
            shows these instead of true ones. Later ones may follow, and are not looked at.
        generator: draws the noise seeds; without one they are zero.
    """
    size = clip.shape
    part = slice(number * spec.chunk, (number + 1) * spec.chunk)
    maps = [name for name in ("pose_map", "c2w") if name in clip["future"].keys()]
    memory = TensorDict(
        {name: clip["memory", name][:, number] for name in ("frames", "commands", *maps)}, size
    )
    if drawn is not None:
        rows = torch.arange(len(clip), device=clip.device)[:, None]
        ahead = clip["memory", "index"][:, number] - clip["begin"][:, None] - 1
        own = drawn[rows, ahead.clamp(min=0)]
        memory["frames"] = torch.where((ahead >= 0)[..., None, None, None, None], own, memory["frames"])
    if number == 0:
        now = {"command": clip["now", "command"], "state": clip["now", "state"]}
    else:
        before = clip["future"][:, part.start - 1]
        now = {"command": before["commands"], "state": before["states"]}
    zero = torch.zeros(size, dtype=torch.int64)
    seed = zero if generator is None else torch.randint(2**40, size, generator=generator)
    inputs = TensorDict(
        {
            "memory": memory,
            "future": TensorDict({name: clip["future", name][:, part] for name in ("commands", *maps)}, size),
            "now": TensorDict(now, size),
            "seed": seed.to(clip.device),
            "chunk_index": zero.to(clip.device),
            "stride": clip["stride"],
        },
        size,
    )
    if "intrinsic" in clip.keys():
        inputs["intrinsic"] = clip["intrinsic"]
    return inputs


def own_frames(simulator: Simulator, clip: TensorDict, generator: torch.Generator) -> tuple[int, TensorDict]:
    """A chunk of a clip, and its inputs, whose memory shows the simulator's own frames of the chunks before.

    Of the chunks that are not wholly past the end of every episode it is the one at clip["depth"]. As many
    are predicted as lie before that depth in a clip without an end, used or not: all microbatches of a step
    share the depth, and run the network as often, whatever episodes they hold.
    """
    chunk = simulator.spec.chunk
    whole = clip["future", "valid"].bool().any(0).unflatten(0, (-1, chunk)).any(1)
    depth = float(clip["depth"][0]) if len(whole) > 1 else 0.0
    chosen, before = int(depth * int(whole.sum())), int(depth * len(whole))
    own: Tensor | None = None
    for number in range(before):
        with torch.no_grad():
            frames = simulator.predict(build_inputs(simulator.spec, clip, number, own, generator))[0]
        own = frames if own is None else torch.cat([own, frames], 1)
    return chosen, build_inputs(simulator.spec, clip, chosen, own, generator)


def taught_memory(clip: TensorDict, number: int) -> Tensor:
    """Which frames of the memory of chunk `number` of a training clip [B] are true ones that a command led
    to, bool [B, M]: no repeats of the first frame, none of the model's own, none without a picture. For
    engines whose memory is the newest frames.
    """
    memory = clip["memory"][:, number]
    index = memory["index"]
    led = index.diff(dim=1, prepend=index[:, :1]) > 0
    return led & (index <= clip["begin"][:, None]) & memory["present"].bool()
