"""Bridge clips as WPE hands them out: a video and ten numbers a frame."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from envs.embodiment import ActionKind, Camera, Embodiment
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.recordings import Cut, Format, assemble
from envs.episodes.video import read_video

# One arm whose motions are normalised by numbers that nobody published, and one camera that nobody
# calibrated. The clips hold no robot state; the numbers stand for it.
BRIDGE = Embodiment(
    robot="widowx",
    action_names=tuple(f"motion{k}" for k in range(10)),
    action_kind=ActionKind.OTHER,
    delta=True,
    arms=(),
    state_names=tuple(f"motion{k}" for k in range(10)),
    cameras=(Camera("front", (0, 0)),),
    fps=20.0,
)


def _find(source: Path) -> list[Path]:
    return sorted(path for path in source.glob("*.mp4") if path.with_suffix(".npz").exists())


def _read(place: Path, number: int, cut: Cut) -> Episode:
    video, numbers = read_video(place), place.with_suffix(".npz")
    try:
        with np.load(numbers, allow_pickle=False) as file:
            actions = file["arr_0"].astype(np.float32)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise EpisodeError(f"{numbers}: {error!r}") from error
    if actions.ndim != 2 or actions.shape[1] != BRIDGE.action_dim:
        raise EpisodeError(f"{numbers}: arr_0 has shape {actions.shape}, expected (T, {BRIDGE.action_dim})")
    length = min(len(video), len(actions), cut.frames or len(video))
    return assemble(
        BRIDGE,
        {row: [video[row]] for row in range(length)},
        length,
        place,
        commands=actions[:length],
        states=actions[:length],
        instruction="",
        seed=int(place.stem) if place.stem.isdigit() else number,
        source="bridge",
    )


BRIDGE_CLIPS = Format("Bridge clips", _find, _read)
