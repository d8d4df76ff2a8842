"""Roll a simulator out over recorded episodes under their true actions, to compare or to learn from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.simulators.base import Simulator
from envs.simulators.state_experts.base import StateDecoder


class Replay(NamedTuple):
    """frames uint8 [N, T, V, 3, H, W] generated, rows int64 [N, T] of the true frames, valid bool [N, T],
    states float32 [N, T, 16] decoded,
    places float32 [N, T, S, 4] where the simulator has its objects (schema.OBJECT_DIM), NaN where it does not
    know."""

    frames: Tensor
    rows: Tensor
    valid: Tensor
    states: Tensor
    places: Tensor


@torch.no_grad()
def replay(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    decoder: StateDecoder | None = None,
    batch: int = 32,
    bf16: bool = True,
) -> Replay:
    """Generate the given episodes from their first frames on, to the end of the longest.

    Args:
        decoder: decodes joint states along the way; without one `states` repeats the first.
        batch: episodes generated side by side.
    """
    device = next(simulator.parameters()).device
    chunk, steps = simulator.shape.chunk, -(-(int(store.length[episodes].max()) - 1) // simulator.shape.chunk)
    simulator.eval()
    parts = []
    for ids in episodes.split(batch):
        start, last = store.start[ids], store.length[ids][:, None] - 1
        first = [
            store.frames(start),
            store.intrinsic[ids],
            store.arrays["c2w"][start],
            store.arrays["commands"][start],
            store.arrays["states"][start],
            store.pose_maps(start),
            ids,
        ]
        state = simulator.reset(
            *(value.to(device) for value in first), likeliest=True, capacity=1 + steps * chunk
        )
        frames, rows, valid, states, places = [], [], [], [], []
        for step in range(steps):
            ahead = step * chunk + torch.arange(1, chunk + 1)[None]
            at = start[:, None] + torch.minimum(ahead.expand(len(ids), -1), last)
            commands = store.arrays["commands"][at].to(device)
            with mixed_precision(device, bf16):
                made, features, state = simulator.step(
                    state, commands, store.pose_maps(at).to(device), store.arrays["c2w"][at].to(device)
                )
            decoded = (
                decoder.follow(simulator, state, features)
                if decoder is not None
                else store.arrays["states"][start][:, None].expand(-1, chunk, -1)
            )
            frames.append(made.cpu())
            rows.append(at)
            valid.append(ahead <= last)
            states.append(decoded.cpu())
            places.append(
                state["history", "places"][
                    torch.arange(len(ids))[:, None],
                    state["length"].cpu()[:, None] - chunk + torch.arange(chunk),
                ].cpu()
            )
        parts.append(Replay(*(torch.cat(values, 1) for values in (frames, rows, valid, states, places))))
    return Replay(*(torch.cat(values) for values in zip(*parts, strict=True)))
