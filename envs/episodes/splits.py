"""Which episodes are for training, which are held out, and on which judges are calibrated.

A data set says it in LeRobot's own field, info.json's `splits`: a name and a contiguous range of episodes,
such as {"train": "0:40", "held_out": "40:48", "calibration": "48:56"}. One that knows only "train", as
LeRobot writes it, is divided by episode number: every eighth is held out, every fourth calibrates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot_files import read_info
from envs.files import write_atomically

NAMES = ("train", "held_out", "calibration")


def range_of(splits: Mapping[str, str], name: str, count: int, folder: Path) -> list[int]:
    """Episodes of a data set of `count` in a split.

    Raises:
        EpisodeError: if its splits lack the name, or say no range.
    """
    if name in NAMES and not set(splits) - {"train"}:
        return [number for number in range(count) if _by_number(number) == name]
    try:
        begin, end = (int(part) for part in splits[name].split(":"))
    except (KeyError, ValueError) as error:
        raise EpisodeError(
            f"{folder / 'meta/info.json'}: splits are {dict(splits)}; {name!r} must be among them, as"
            ' "first:end"'
        ) from error
    return list(range(begin, min(end, count)))


def write_splits(root: Path, sizes: Mapping[str, int]) -> None:
    """Say in a finished data set how many of its episodes, in their order, each split takes.

    Appending to the data set afterwards makes it forget them.

    Raises:
        EpisodeError: if the sizes do not add up to the episodes that are there.
    """
    path, info = Path(root) / "meta/info.json", read_info(root)
    if sum(sizes.values()) != info["total_episodes"]:
        raise EpisodeError(
            f"{path}: splits of {dict(sizes)} episodes do not add up to {info['total_episodes']}"
        )
    begin, splits = 0, {}
    for name, size in sizes.items():
        splits[name] = f"{begin}:{begin + size}"
        begin += size
    text = json.dumps({**info, "splits": splits}, indent=4)
    write_atomically(path, lambda target: target.write_text(text))


def _by_number(number: int) -> str:
    if number % 8 == 7:
        return "held_out"
    return "calibration" if number % 4 == 2 else "train"
