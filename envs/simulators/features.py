"""A simulator's features as others than its state expert read them: pooled, and of recorded episodes.

The features of a chunk come from what was remembered when it began and from its actions, so recorded video
has them too: of the true past and the true actions.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.inputs import build_inputs
from envs.specs import WorldSpec, at_rest

_AT_ONCE = 50  # chunks per forward pass


def pooled(features: Tensor) -> Tensor:
    """One vector float32 [B, D] of a chunk's features [B, *feature_shape]: what is one already, as it is; of
    tokens [..., width] their mean and their maximum.
    """
    tokens = features.float().flatten(1, -2) if features.ndim > 2 else features.float()
    return tokens if tokens.ndim == 2 else torch.cat((tokens.mean(1), tokens.amax(1)), -1)


def pooled_size(feature_shape: Sequence[int]) -> int:
    """D of `pooled`."""
    return feature_shape[-1] * (1 if len(feature_shape) == 1 else 2)


def held(spec: WorldSpec, now: TensorDict) -> TensorDict:
    """A chunk of commands that changes nothing, TensorDict [B] as Simulator.step takes it.

    Args:
        now: TensorDict [B] with the command in force [A] as `command`, and pose_map, c2w of the last frame
            where the spec asks for them. Grippers of robots that act by changes are told where to be.
    """
    names = {name: now[name] for name in ("pose_map", "c2w") if name in now.keys()}
    names["commands"] = at_rest(now["command"], spec.embodiment)
    still = {name: value[:, None].expand(-1, spec.chunk, *value.shape[1:]) for name, value in names.items()}
    return TensorDict(still, now.shape)


@torch.no_grad()
def features_of_sessions(simulator: Simulator, state: TensorDict) -> Tensor:
    """Pooled features float32 [B, D] of where sessions are: of a chunk that would change nothing. The
    sessions stay as they are.
    """
    newest = memory.newest(state).rename_key_("commands", "command")
    future = held(simulator.spec, newest)
    return pooled(simulator.features(memory.build_inputs(state, simulator.recall(state, future), future)))


@torch.no_grad()
def features_of_chunks(
    simulator: Simulator, store: ClipStore, episode: Tensor, begin: Tensor, bf16: bool, still: bool = False
) -> Tensor:
    """Pooled features float32 [N, D], on the CPU, of recorded chunks that begin at frame `begin` [N] of
    `episode` [N].

    Args:
        bf16: whether the simulator computes in bfloat16 where the device does.
        still: of a chunk that would change nothing, instead of the one that was recorded.
    """
    device, spec = simulator.device, simulator.clip_spec()
    simulator.eval()
    parts = []
    for some in torch.arange(len(episode)).split(_AT_ONCE):
        clip = store.clips(episode[some], begin[some], spec).to(device)
        inputs = build_inputs(simulator.spec, clip, 0)
        if still:
            last = inputs["memory"][:, -1].exclude("frames", "commands")
            inputs["future"] = held(simulator.spec, last.set("command", inputs["now", "command"]))
        with mixed_precision(device, bf16):
            parts.append(pooled(simulator.features(inputs)).cpu())
    return torch.cat(parts)


def features_of_episodes(simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool) -> Tensor:
    """Pooled features float32 [N, C, D] of all chunks of recorded episodes [N], as many as the longest has;
    those past an episode's end are of its last frame, held.
    """
    chunk = simulator.spec.chunk
    count = -(-(int(store.length[episodes].max()) - 1) // chunk)
    begin = torch.minimum(chunk * torch.arange(count), store.length[episodes][:, None] - 1)
    owner = episodes[:, None].expand(-1, count)
    return features_of_chunks(simulator, store, owner.flatten(), begin.flatten(), bf16).unflatten(
        0, (len(episodes), count)
    )
