"""What only physics knows of recorded episodes, such as true object poses; for pipeline/evaluation alone."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.formats.lerobot.columns import PRIVILEGED
from envs.episodes.formats.lerobot.dataset import LeRobotDataset


def read_privileged(store: ClipStore, name: str) -> Tensor | None:
    """The column privileged.<name> [N, ...] of all rows of a store, read from the data anew.

    None where a data set has no such column, as recordings of real robots have none.
    """
    sets = [LeRobotDataset(part.folder, store.spec.size, privileged=True) for part in store.parts]
    if any(PRIVILEGED + name not in data.features for data in sets):
        return None
    return torch.from_numpy(np.concatenate([data.column(PRIVILEGED + name) for data in sets]))
