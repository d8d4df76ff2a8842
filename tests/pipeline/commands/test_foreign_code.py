"""Nothing that Worldloop opens can run code: every loader meets a pickle that would leave a mark."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from actors.weights import load
from envs.episodes.episode import EpisodeError
from envs.episodes.formats.bridge import BRIDGE_CLIPS
from envs.episodes.formats.recordings import Cut, read_numbers
from envs.episodes.video import write_video
from envs.simulators.gesim.checkpoint import CheckpointError, load_released
from envs.simulators.gesim.fixture import verify
from envs.targets import ConfigError
from learners.training import checkpoint
from learners.training.checkpoint import Checkpoints
from tests.envs.simulators.gesim_tiny import write_checkpoint


class Mark:
    """A pickle of it creates a file when it is opened."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def plant(place: Path, mark: Path) -> None:
    """Every way to write the mark where a loader looks."""
    if place.suffix == ".npy":
        np.save(place, np.array([Mark(mark)], dtype=object), allow_pickle=True)
    elif place.suffix == ".npz":
        np.savez(place, arr_0=np.array([Mark(mark)], dtype=object))
    elif place.suffix in (".pt", ".bin"):
        torch.save(Mark(mark), place)
    else:
        place.write_bytes(pickle.dumps(Mark(mark)))


def weights(folder: Path, mark: Path) -> None:
    plant(folder / "weights.safetensors", mark)
    with pytest.raises(ConfigError, match="cannot be read"):
        load(nn.Linear(1, 1), folder / "weights.safetensors")


def resumed(folder: Path, mark: Path) -> None:
    held = {"module": {"w": torch.ones(2)}}
    Checkpoints(folder).save(1, held, {})
    newest = Checkpoints(folder).newest
    assert newest is not None
    plant(newest / ".metadata", mark)  # what torch.distributed.checkpoint would unpickle
    Checkpoints(folder).load(held)
    for name in ("module.safetensors", "facts.json", "sha256.json"):
        plant(newest / name, mark)
        with pytest.raises(checkpoint.CheckpointError, match="damaged"):
            Checkpoints(folder).load(held)


def released(folder: Path, mark: Path) -> None:
    place = write_checkpoint(folder / "gesim")
    kept = folder / "kept"
    for name in ("model.safetensors", "prompt_embeds.pt", "vae/diffusion_pytorch_model.safetensors"):
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(place, kept)
        plant(kept / name, mark)
        with pytest.raises(CheckpointError):
            load_released(kept)
    (kept / name).unlink()
    plant((kept / name).with_suffix(".bin"), mark)
    with pytest.raises(CheckpointError, match="safetensors"):
        load_released(kept)


def fixture(folder: Path, mark: Path) -> None:
    plant(folder / "fixture.safetensors", mark)
    with pytest.raises(Exception, match="fixture"):
        verify(folder / "fixture.safetensors")


def recordings(folder: Path, mark: Path) -> None:
    plant(folder / "numbers.npy", mark)
    with pytest.raises(EpisodeError, match=r"numbers\.npy"):
        read_numbers(folder / "numbers.npy", (None,))
    write_video(folder / "0.mp4", iter(np.zeros((3, 32, 32, 3), np.uint8)), 5)
    plant(folder / "0.npz", mark)
    with pytest.raises(EpisodeError, match=r"0\.npz"):
        BRIDGE_CLIPS.read(folder / "0.mp4", 0, Cut())


@pytest.mark.parametrize("loader", [weights, resumed, released, fixture, recordings])
def test_no_loader_runs_what_it_opens(loader: Callable[[Path, Path], None], tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    loader(tmp_path, mark)
    assert not mark.exists()
    pickle.loads(pickle.dumps(Mark(mark)))  # the trap itself works
    assert mark.exists()
