"""Videos of the imagined episodes that a policy learns from, while it learns: where it exploits its world,
one sees it here first.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from actors.rollouts.footage import Footage
from envs.episodes.filming import Picture, side_by_side, tiled, titled, write_film

_REST = 5  # frames for which a video shows its last one, with the verdicts


def film_rollouts(folder: Path, version: int, shown: Sequence[Footage]) -> Path:
    """Write media/imagined-step<version>.mp4, what the policy did after so many iterations; returns its path.

    Args:
        folder: of the stage.
        shown: imagined episodes.
    """
    videos = [_captioned(episode) for episode in shown]
    height, width = videos[0][0].shape[:2]
    columns = max(1, round((len(videos) * height / width) ** 0.5))  # about a square
    path = folder / f"media/imagined-step{version:06d}.mp4"
    write_film(path, tiled(videos, columns), shown[0].fps, rest=_REST)
    return path


def _captioned(episode: Footage) -> list[Picture]:
    recorded = len(episode.frames) - episode.imagined
    words = ["recorded"] * recorded + ["imagined"] * episode.imagined
    words[-1] = f"{words[-1]}: {'success' if episode.success else 'none yet'}"
    return titled(side_by_side(episode.frames), words)
