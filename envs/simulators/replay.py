"""Roll a simulator out over recorded episodes under their true actions, to compare or to learn from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.features import pooled
from envs.simulators.state_experts.base import StateDecoder
from envs.targets import ConfigError

SIDE_BY_SIDE = 32  # episodes at most
_ROOM = 2**32  # bytes of pictures that they may hold, all of it on the simulator's device


class Replay(NamedTuple):
    """Generated episodes beside the rows of the true ones.

    frames uint8 [N, T, V, 3, H, W] generated, rows int64 [N, T] of the true frames, valid bool [N, T], states
    float32 [N, T, S] decoded or recorded, features float32 [N, C, D] of the generated chunks, pooled.
    """

    frames: Tensor
    rows: Tensor
    valid: Tensor
    states: Tensor
    features: Tensor

    def pictured(self, store: ClipStore) -> Replay:
        """The same, with those frames alone valid of which a picture was recorded, as the store of the true
        episodes says; nothing else can be compared.
        """
        return self._replace(valid=self.valid & store.arrays["present"][self.rows])


def side_by_side(store: ClipStore, frames: int, most: int = SIDE_BY_SIDE) -> int:
    """How many episodes of so many frames of a store's pictures, with pose maps if it has them, are generated
    or held at once: `most`, or fewer where they would take more than 4 GiB, and one at least.
    """
    spec = store.spec
    picture = spec.views * 3 * spec.size[0] * spec.size[1] * (2 if spec.pose_map else 1)
    return max(1, min(most, _ROOM // (frames * picture)))


@torch.no_grad()
def replay(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    decoder: StateDecoder | None = None,
    bf16: bool = True,
    alone: int | None = None,
    stride: int = 1,
    draw: int = 0,
    most: int | None = None,
) -> Replay:
    """Generate the given episodes from their first frames on, to the end of the longest. So many at once as
    the simulator has places for; their sessions have ended when it returns.

    Args:
        alone: chunks after which it goes on from true frames again; None for never.
        decoder: decodes the robot's states along the way, as in imagination, at stride 1; without one they
            are the recorded ones, so that the simulator alone is to blame for what differs.
        stride: recorded frames from one generated frame to the next; T is then so many times smaller.
        draw: number of the sample; each draws noise of its own.
        most: chunks to generate at most; None for whole episodes.

    Raises:
        ConfigError: if a state expert is to decode at another stride than it has learned.
        EpisodeError: if an episode has no picture at its first frame.
    """
    if decoder is not None and stride != 1:
        raise ConfigError(
            f"simulator.state_expert: {type(decoder).__name__} has learned states of every frame (state_fit"
            f" and finetune.state know no strides), and stride={stride} is asked for; replay at stride 1, or"
            " without a decoder, so that states are the recorded ones, as fidelity.strides does"
        )
    device, chunk = simulator.device, simulator.spec.chunk
    steps = -(-(int(store.length[episodes].max()) - 1) // (chunk * stride))
    steps = steps if most is None else min(steps, most)
    simulator.eval()
    free, parts = simulator.free_places, []
    together = SIDE_BY_SIDE if free is None else min(SIDE_BY_SIDE, free)
    for ids in episodes.split(side_by_side(store, 1 + steps * chunk, together)):
        start, last = store.start[ids], store.length[ids][:, None] - 1
        first, every = store.first(ids), torch.ones(len(ids), dtype=torch.bool)
        # Whoever asks the same simulator twice for the same draw gets the same noise.
        seeds = (ids + draw * len(store)).to(device)
        state = simulator.reset(first.to(device), seeds, capacity=1 + steps * chunk, stride=stride)
        made: list[tuple[Tensor, ...]] = []
        for step in range(steps):
            if alone and step and step % alone == 0:
                known = stride * torch.arange(1 + step * chunk)
                past = store.at(ids[:, None].expand(-1, len(known)), known)
                before = start[:, None] + torch.minimum(known, last)
                past["command"] = store.commands(before, start, stride)
                simulator.release(state, every)
                length, room = torch.full_like(ids, len(known)), len(known) + chunk * alone
                state = simulator.resume(past.to(device), length.to(device), seeds, room, stride)
            ahead = stride * (step * chunk + torch.arange(1, chunk + 1)[None])
            rows = start[:, None] + torch.minimum(ahead.expand(len(ids), -1), last)
            shown = future_of(simulator, store, rows)
            shown["commands"] = store.commands(rows, start, stride)
            with mixed_precision(device, bf16):
                frames, features, state = simulator.step(state, shown.to(device))
            if decoder is None:
                states = store.arrays["states"][rows].to(device)
                memory.write_states(state, states)
            else:
                states = decoder.follow(state, chunk, features)
            shown = pooled(features)[:, None].cpu()
            made.append((frames.cpu(), rows, (ahead <= last), states.cpu(), shown))
        simulator.release(state, every)
        parts.append(Replay(*(torch.cat(values, 1) for values in zip(*made, strict=True))))
    return Replay(*(torch.cat(values) for values in zip(*parts, strict=True)))


def future_of(simulator: Simulator, store: ClipStore, rows: Tensor) -> TensorDict:
    """What Simulator.step takes for the recorded frames `rows` [B, K]: commands, and conditioning as the spec
    asks.
    """
    future = TensorDict({"commands": store.arrays["commands"][rows]}, rows.shape[:1])
    if simulator.spec.pose_map:
        future["pose_map"] = store.pose_maps(rows)
    if simulator.spec.embodiment.calibrated:
        future["c2w"] = store.arrays["c2w"][rows]
    return future
