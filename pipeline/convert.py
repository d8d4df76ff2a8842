"""Recordings from elsewhere to LeRobot v3.0 and back, and pictures that show whether their calibration holds."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from envs.conditioning import CANVAS, PoseMapStyle
from envs.episodes import Episode, EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.clips import pose_maps_of
from envs.episodes.formats.foreign import Cut, read_foreign, write_gesim2


def read_any(source: Path, cut: Cut | None = None) -> chain[Episode]:
    """Episodes of a LeRobot data set or of any known foreign format, so far as they are wanted."""
    if (source / "meta/info.json").exists():
        cut = cut or Cut()
        return chain(cut.of(episode) for episode in LeRobotDataset(source))
    return chain(read_foreign(source, cut))


def convert(source: Path, target: Path, cut: Cut) -> int:
    """Write `source` as a LeRobot data set, or a LeRobot data set as GE-Sim 2.0 bundles, a folder each;
    returns how many episodes.

    Raises:
        EpisodeError: if the source is damaged or unknown, or the target is not empty.
    """
    if target.exists() and any(target.iterdir()):
        raise EpisodeError(f"{target} is not empty; choose a new folder")
    back = (source / "meta/info.json").exists()
    count = 0
    writer: LeRobotWriter | None = None
    for episode in tqdm(read_any(source, cut), desc="convert", unit="ep"):
        if back:
            write_gesim2(target / f"episode_{count:06d}", episode)
        else:
            size = (episode.frames.shape[-2], episode.frames.shape[-1])
            writer = writer or LeRobotWriter(target, episode.views, size, episode.fps)
            if (writer.views, writer.size) != (episode.views, size):
                raise EpisodeError(
                    f"episode {count} has views {episode.views} of {size}, those before {writer.views} of {writer.size}; convert them apart, or give size=[height,width]"
                )
            writer.write([episode])
        count += 1
    return count


def overlay(
    frame: NDArray[np.uint8], pose_map: NDArray[np.uint8], strength: float = 0.6
) -> NDArray[np.uint8]:
    """A pose map laid over a frame, both uint8 [3, H, W] -> RGB uint8 [H, W, 3]."""
    drawn = (pose_map != CANVAS).any(0)[..., None]
    mixed = (1 - strength) * frame.transpose(1, 2, 0) + strength * pose_map.transpose(1, 2, 0)
    return np.where(drawn, mixed, frame.transpose(1, 2, 0)).round().astype(np.uint8)


def inspect(
    source: Path, target: Path, cut: Cut, style: PoseMapStyle, rows: int = 4, episodes: int = 8
) -> list[Path]:
    """A picture per episode: some of its frames, a row each with all views side by side, the commanded
    grippers drawn over them.
    """
    target.mkdir(parents=True, exist_ok=True)
    made = []
    for number, episode in enumerate(read_any(source, cut)):
        if number == episodes:
            break
        shown = np.flatnonzero(episode.seen)
        shown = shown[np.linspace(0, len(shown) - 1, min(rows, len(shown))).round().astype(int)]
        part = Cut().of(episode)
        for name in (
            "frames",
            "commands",
            "achieved",
            "states",
            "c2w",
            "success",
            "progress",
            "objects",
            "seen",
        ):
            setattr(part, name, getattr(episode, name)[shown])
        maps = pose_maps_of(part, torch.from_numpy(part.c2w), style).transpose(0, 1).numpy()
        sheet = np.concatenate(
            [
                np.concatenate(
                    [overlay(frame, drawn) for frame, drawn in zip(views, drawings, strict=True)], 1
                )
                for views, drawings in zip(part.frames, maps, strict=True)
            ]
        )
        path = target / f"{source.name}-{number:03d}.png"
        cv2.imwrite(str(path), sheet[..., ::-1])
        made.append(path)
    return made
