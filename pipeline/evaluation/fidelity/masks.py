"""Which pixels truly show the robot and which a thing that can move: from physics, or from a file."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from actors.factory import build_pool
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.physics.render import PARTS
from envs.targets import ConfigError
from pipeline.evaluation.objects.error import POSES

_POSES = 1e-4  # metres and radians between things as recorded at the start and as they are laid out again
_CLEARLY = 40  # grey levels; encoding changes hardly a pixel by so much
# Shares of a view's pixels that may be clearly changed in the first and in the last frame: a thing that lies
# a pixel or two elsewhere changes more than the first, a contact that comes out otherwise less than the last.
_START, _END = 0.002, 0.02


def part_labels(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> Tensor:
    """Labels uint8 [N, T, V, H, W] (envs.physics.render.PARTS) of all frames but the first of N episodes
    int64, as ClipStore.whole counts them; 255 where nothing is known.

    Physics repeats episodes from their recorded seeds by their recorded commands. One that begins with things
    elsewhere (or, where nobody recorded where they were, looks otherwise) or looks otherwise in the end is
    not measured.

    Raises:
        ConfigError: if pictures are of another size than physics renders.
    """
    size = tuple(world_spec(cfg).embodiment.cameras[0].size)
    if size != tuple(store.spec.size):
        raise ConfigError(
            f"task.size={store.spec.size} must be task.suite.size={size} for masks from physics"
        )
    out = _unknown(store, episodes)
    places = store.seeded(episodes).nonzero().flatten().tolist()
    if not places:
        return out
    jobs = []
    for number in episodes[places].tolist():
        rows = store.rows(torch.tensor([number]))
        commands = store.arrays["commands"][rows].double().numpy()
        jobs.append((int(store.episodes[number]["seed"]), commands))
    pool = build_pool(cfg)
    try:
        made = pool.segment(jobs)
    finally:
        pool.close()
    poses = read_privileged(store, POSES)
    for n, (labels, pictures, start) in zip(places, made, strict=True):
        first = store.start[episodes[n]]
        ends = torch.stack((first, first + store.length[episodes[n]] - 1))
        begun, ended = _changed(store.frames(ends), torch.from_numpy(pictures)).tolist()
        if poses is None or POSES not in start:
            same = begun <= _START
        else:
            same = _alike(poses[first].numpy(), start[POSES])
        if labels is not None and same and ended <= _END:
            out[n, : len(labels) - 1] = torch.from_numpy(labels[1:])
    return out


def read_labels(path: Path, store: ClipStore, episodes: Tensor) -> Tensor:
    """The same from a file, for recordings of a real robot.

    Args:
        path: an .npz file with an array for each episode, named by its number in the data sets: uint8
            [length, V, h, w] of 0 background, 1 arm, 2 object; brought to the size of the world's pictures.

    Raises:
        ConfigError: if the file is damaged, or an episode missing, or of another length or number of views.
    """
    with _reading(path):
        held = np.load(path, allow_pickle=False)
        names = set(held.files)
    out = _unknown(store, episodes)
    for n, number in enumerate(episodes.tolist()):
        if str(number) not in names:
            raise ConfigError(f"fidelity.masks={path} holds no array '{number}', of episode {number}")
        with _reading(path):
            found = torch.from_numpy(held[str(number)])
        due = (int(store.length[number]), store.spec.views)
        whole = not found.is_floating_point() and not found.is_complex()
        known = whole and found.numel() and int(found.min()) >= 0 and int(found.max()) <= max(PARTS.values())
        if found.ndim != 4 or tuple(found.shape[:2]) != due or not known:
            raise ConfigError(
                f"fidelity.masks={path}: array '{number}' is {found.dtype} {tuple(found.shape)}, from"
                f" {found.min().item() if found.numel() else 'nothing'} to"
                f" {found.max().item() if found.numel() else 'nothing'}; the episode takes whole numbers"
                f" [{due[0]}, {due[1]}, h, w] of {PARTS}"
            )
        small = functional.interpolate(found.float(), store.spec.size, mode="nearest").to(torch.uint8)
        out[n, : len(small) - 1] = small[1:]
    return out


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """What reading a file of another kind, or a damaged one, raises, as a ConfigError."""
    try:
        yield
    except (OSError, EOFError, ValueError, TypeError, AttributeError, BadZipFile, zlib.error) as error:
        raise ConfigError(f"fidelity.masks={path} is no .npz file, or damaged: {error}") from error


def _unknown(store: ClipStore, episodes: Tensor) -> Tensor:
    """Labels of episodes of which nothing is known."""
    rows, _ = store.whole(episodes)
    return torch.full((*rows.shape, store.spec.views, *store.spec.size), 255, dtype=torch.uint8)


def _changed(recorded: Tensor, again: Tensor) -> Tensor:
    """Share of clearly changed pixels, in the view that has most of them, [B] of pictures uint8
    [B, V, 3, H, W].
    """
    off = (recorded.float() - again.float()).abs().amax(2)
    return (off > _CLEARLY).float().mean((2, 3)).amax(1)


def _alike(recorded: NDArray[Any], again: NDArray[Any]) -> bool:
    return recorded.shape == again.shape and bool(np.abs(recorded - again).max() <= _POSES)
