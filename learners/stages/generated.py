"""Generated frames that show what true ones show: what judges and policies learn from to see both alike."""

from __future__ import annotations

from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.simulators.base import Simulator
from envs.simulators.replay import replay


def generated_frames(
    simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool, within: float = 0.015
) -> TensorDict:
    """Frames the simulator generates under the true actions of some episodes, beside the true ones.

    Frames on which the simulator's object has gone another way than the true one show something else, and
    are left out.

    Args:
        within: metres off its true place at which an object's picture is no longer what physics labels.

    Returns:
        TensorDict [N] with frames uint8 [V, 3, H, W], row (that of the true frame), begin (that of the
        episode's first),
        places [S, 4] where the simulator has its objects, tokens and progress.
    """
    made = replay(simulator, store, episodes, bf16=bf16)
    truth = simulator.places.of(store.arrays["objects"][made.rows])
    # false for NaN, where nobody knows
    astray = ((made.places - truth)[..., :2].norm(dim=-1) > within).any(-1)
    keep = (made.valid & ~astray).reshape(-1)
    rows, count = made.rows.reshape(-1)[keep], made.valid.shape[1]
    return TensorDict(
        {
            "frames": made.frames.flatten(0, 1)[keep],
            "row": rows,
            "places": made.places.flatten(0, 1)[keep],
            "begin": store.start[episodes].repeat_interleave(count, 0)[keep],
            "tokens": store.tokens[episodes].repeat_interleave(count, 0)[keep],
            "progress": store.arrays["progress"][rows].float(),
        },
        [int(keep.sum())],
    )
