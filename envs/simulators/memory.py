"""A session's memory: the history of a batch of imagined episodes, and what of it the next chunk is made
from.

The state of B sessions is a TensorDict [B]: history (rows of frames, commands, states, and pose_map, c2w
where there are any), length int64, intrinsic if cameras are calibrated, seed, chunk_index and stride int64.
Rows of the history past a session's length hold anything and are never read.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.specs import memory_indices

# What a first frame or a chunk brings, by its name there, and the history's name for it.
_FIRST = {"frames": "frames", "command": "commands", "state": "states", "pose_map": "pose_map", "c2w": "c2w"}
_MEMORY = ("frames", "commands", "pose_map", "c2w")


def new_sessions(
    past: TensorDict, length: Tensor, seed: Tensor, capacity: int = 1, stride: int = 1
) -> TensorDict:
    """The state of sessions that go on from `past` [B, P]; see Simulator.resume."""
    size, device = past.shape[:1], past["frames"].device
    rows = {_FIRST[name]: value for name, value in past.items() if name in _FIRST}
    state = TensorDict(
        {
            "history": _with_capacity(TensorDict(rows, past.shape), capacity),
            "length": length.to(device, copy=True),
            "seed": seed.reshape(size).to(device),
            "chunk_index": torch.zeros(size, dtype=torch.int64, device=device),
            "stride": torch.full(size, stride, device=device),
        },
        size,
    )
    if "intrinsic" in past.keys():
        state["intrinsic"] = past["intrinsic"][:, 0].float()
    return state


def recall(state: TensorDict, count: int, newest: int = 1) -> TensorDict:
    """`count` remembered frames and what belongs to them, [B, M, ...]: see memory_indices."""
    history = state["history"]
    known = history.select(*(name for name in _MEMORY if name in history.keys()))
    return _pick(known, memory_indices(state["length"], count, newest))


def build_inputs(state: TensorDict, remembered: TensorDict, future: TensorDict) -> TensorDict:
    """The inputs of Simulator.predict for the next chunk of every session."""
    now = _pick(state["history"].select("commands", "states"), state["length"] - 1)
    inputs = TensorDict(
        {
            "memory": remembered,
            "future": future,
            "now": TensorDict({"command": now["commands"], "state": now["states"]}, state.shape),
            "seed": state["seed"],
            "chunk_index": state["chunk_index"],
            "stride": state["stride"],
        },
        state.shape,
    )
    if "intrinsic" in state.keys():
        inputs["intrinsic"] = state["intrinsic"]
    return inputs


def append(state: TensorDict, frames: Tensor, future: TensorDict) -> TensorDict:
    """The state after a chunk of frames [B, K, V, 3, H, W]; joint states repeat the last until
    `write_states`.
    """
    history, length, count = state["history"], state["length"], frames.shape[1]
    need = int(length.max()) + count
    if need > history.shape[1]:  # for twice as many frames, so that long rollouts copy seldom
        history = _with_capacity(history, max(need, 2 * history.shape[1]))
    last = history["states"][_rows(state).squeeze(1), length - 1]
    new = {**dict(future.items()), "frames": frames, "states": last[:, None].expand(-1, count, -1)}
    # Slot by slot each is one piece of memory; indexed all at once, it is written byte by byte.
    for slot, begin in enumerate(length.tolist()):
        for name in history.keys():
            history[name][slot, begin : begin + count] = new[name][slot]
    state = state.copy()  # of the names only
    state["history"], state["length"], state["chunk_index"] = (
        history,
        length + count,
        state["chunk_index"] + 1,
    )
    return state


def write_states(state: TensorDict, decoded: Tensor) -> None:
    """Write the decoded robot states [B, K, S] of the last chunk into the sessions' history."""
    count = decoded.shape[1]
    at = state["length"][:, None] - count + torch.arange(count, device=decoded.device)
    state["history", "states"][_rows(state), at] = decoded


def recent(state: TensorDict, count: int) -> TensorDict:
    """The last `count` commands and states [B, count, ...] of each session, the first repeated where there
    are fewer.
    """
    length = state["length"]
    at = (length[:, None] - count + torch.arange(count, device=length.device)).clamp(min=0)
    return _pick(state["history"].select("commands", "states"), at)


def newest(state: TensorDict) -> TensorDict:
    """The last row of each session's history, [B]."""
    return _pick(state["history"], state["length"] - 1)


def stack(states: Sequence[TensorDict]) -> TensorDict:
    """Sessions [B1], [B2], ... of equal or different length as one state."""
    most = max(state["history"].shape[1] for state in states)
    parts = []
    for state in states:
        part = state.copy()
        part["history"] = _with_capacity(state["history"], most)
        parts.append(part)
    return torch.cat(parts)


def replace(state: TensorDict, mask: Tensor, begun: TensorDict) -> TensorDict:
    """The state with the sessions of `mask` [B] replaced by those of `begun` (one row per True, in order)."""
    for name in state.keys():
        if name != "history":
            state[name][mask] = begun[name].to(state[name].dtype)
    slots, known = mask.nonzero().flatten()[:, None], torch.arange(int(begun["length"].max()))
    for name in state["history"].keys():
        state["history", name][slots, known] = begun["history", name][:, : len(known)]
    return state


def _pick(history: TensorDict, at: Tensor) -> TensorDict:
    """Rows `at` [B] or [B, M] of a history [B, N]; a row is copied as one piece, where indexing by two
    tensors copies pictures byte by byte.
    """
    begin = history.shape[1] * torch.arange(len(at), device=at.device)
    rows = (begin.reshape(-1, *[1] * (at.ndim - 1)) + at).flatten()
    return TensorDict(
        {
            name: value.flatten(0, 1).index_select(0, rows).unflatten(0, at.shape)
            for name, value in history.items()
        },
        at.shape,
    )


def _rows(state: TensorDict) -> Tensor:
    return torch.arange(len(state), device=state["length"].device)[:, None]


def _with_capacity(history: TensorDict, capacity: int) -> TensorDict:
    """A history [B, N] as one of at least `capacity` frames."""
    rows = history.shape[1]
    if capacity <= rows:
        return history
    out = history.new_empty(len(history), capacity)
    for name, value in history.items():
        out[name][:, :rows] = value
    return out
