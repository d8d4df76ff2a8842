"""Which pixels truly show the robot and which a thing that can move: from physics, or from a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from actors.factory import build_pool
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.physics.render import PARTS
from envs.targets import ConfigError

# mean grey levels between a recorded picture and the same one rendered anew; encoding costs some
ALIKE = 12.0


def part_labels(
    cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor, path: str | None
) -> Tensor | None:
    """Labels uint8 [N, T, V, H, W] (envs.physics.render.PARTS) of all frames but the first of some episodes,
    as ClipStore.whole counts them; 255 where nothing is known.

    With physics, episodes are repeated from their seeds by their recorded commands; one whose pictures then
    look otherwise than they were recorded is not measured.

    Args:
        path: an .npz file, see `read_labels`; None asks physics.

    Returns:
        None if nobody knows.
    """
    if path is not None:
        return read_labels(Path(path), store, episodes)
    if not cfg["task"].get("suite"):
        return None
    return _repeated(cfg, store, episodes)


def read_labels(path: Path, store: ClipStore, episodes: Tensor) -> Tensor:
    """Labels from a file for recordings of a real robot.

    Args:
        path: an .npz file with an array for each episode, named by its number in the data sets: uint8
            [length, V, h, w] of 0 background, 1 arm, 2 object; brought to the size of the world's pictures.

    Raises:
        ConfigError: if an episode is missing, or of another length or number of views.
    """
    try:
        held = np.load(path, allow_pickle=False)
        names = set(held.files)
    except (OSError, ValueError, AttributeError) as error:
        raise ConfigError(f"fidelity.masks={path} is no .npz file: {error}") from error
    rows, _ = store.whole(episodes)
    out = torch.full((*rows.shape, store.spec.views, *store.spec.size), 255, dtype=torch.uint8)
    for n, number in enumerate(episodes.tolist()):
        if str(number) not in names:
            raise ConfigError(f"fidelity.masks={path} holds no array '{number}', of episode {number}")
        found = torch.from_numpy(held[str(number)])
        due = (int(store.length[number]), store.spec.views)
        if found.ndim != 4 or tuple(found.shape[:2]) != due or int(found.max()) > max(PARTS.values()):
            raise ConfigError(
                f"fidelity.masks={path}: array '{number}' is {tuple(found.shape)} up to {int(found.max())};"
                f" the episode takes [{due[0]}, {due[1]}, h, w] of {PARTS}"
            )
        small = functional.interpolate(found.float(), store.spec.size, mode="nearest").to(torch.uint8)
        out[n, : len(small) - 1] = small[1:]
    return out


def _repeated(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> Tensor | None:
    size = tuple(world_spec(cfg).embodiment.cameras[0].size)
    if size != tuple(store.spec.size):
        raise ConfigError(
            f"task.size={store.spec.size} must be task.suite.size={size} for masks from physics"
        )
    jobs = []
    for number in episodes.tolist():
        rows = store.rows(torch.tensor([number]))
        commands = store.arrays["commands"][rows].double().numpy()
        jobs.append((int(store.episodes[number]["seed"]), commands))
    pool = build_pool(cfg)
    try:
        made = pool.segment(jobs)
    finally:
        pool.close()
    if any(labels is None for labels, _ in made):
        return None
    rows, _ = store.whole(episodes)
    out = torch.full((*rows.shape, store.spec.views, *store.spec.size), 255, dtype=torch.uint8)
    for n, (labels, pictures) in enumerate(made):
        number = episodes[n]
        ends = torch.stack((store.start[number], store.start[number] + store.length[number] - 1))
        off = (store.frames(ends).float() - torch.from_numpy(pictures).float()).abs().mean()
        if labels is not None and off <= ALIKE:
            out[n, : len(labels) - 1] = torch.from_numpy(labels[1:])
    return out
