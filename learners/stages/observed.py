"""Recorded frames as a policy would have observed them."""

from __future__ import annotations

from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.specs import C2W, COMMAND, IMAGE, INSTRUCTION_UTF8, INTRINSIC, STATE
from learners.stages.simulator import owners


def observe(store: ClipStore, rows: Tensor, pictures: bool = True) -> TensorDict:
    """What a policy would have observed at frames `rows` [N], under the keys of envs/specs.py."""
    owner = owners(store, rows)
    out = TensorDict({STATE: store.arrays["states"][rows]}, [len(rows)])
    if pictures:
        out[IMAGE] = store.frames(rows)
    out[COMMAND] = store.arrays["commands"][rows]
    out[INSTRUCTION_UTF8] = store.text[owner]
    if store.spec.embodiment.calibrated:
        out[INTRINSIC], out[C2W] = store.intrinsic[owner], store.arrays["c2w"][rows]
    return out
