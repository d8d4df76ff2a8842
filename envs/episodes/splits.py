"""Which episodes are for training, which are held out, and on which judges are calibrated.

A data set says it in LeRobot's own field, info.json's `splits`: a name and a range of episodes, such as
{"train": "0:40,56:60", "held_out": "40:48", "calibration": "48:56"}; more than one range where episodes were
appended later. A set that knows only "train", as LeRobot writes it, is divided by episode number, as far as
that names episodes: of every eight one is held out and two calibrate. Where others stand beside it, such as
"val" and "test", all of these are held out, and of every eight episodes of "train" two calibrate.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from zlib import crc32

from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot.files import read_info
from envs.files import write_atomically

TRAIN, HELD_OUT, CALIBRATION = "train", "held_out", "calibration"
NAMES = (TRAIN, HELD_OUT, CALIBRATION)


def range_of(splits: Mapping[str, str], name: str, count: int, folder: Path) -> list[int]:
    """Episodes of a data set of `count` in a split.

    Raises:
        EpisodeError: if its splits lack the name, or say no range.
    """
    others = set(splits) - {TRAIN}
    if name not in NAMES or others & set(NAMES):
        return _named(splits, name, count, folder)
    own = range(count) if not splits else _named(splits, TRAIN, count, folder)
    if not others:
        return [number for number in own if _by_number(number) == name]
    apart = sorted({number for other in others for number in _named(splits, other, count, folder)})
    if name == HELD_OUT:
        return apart
    left = [number for number in own if number not in set(apart)]
    return [number for number in left if (_by_number(number) == CALIBRATION) == (name == CALIBRATION)]


def _named(splits: Mapping[str, str], name: str, count: int, folder: Path) -> list[int]:
    """Episodes of a data set of `count` that its splits give a name."""
    try:
        ranges = [tuple(int(end) for end in part.split(":")) for part in splits[name].split(",")]
        return sorted({number for begin, end in ranges for number in range(begin, min(end, count))})
    except (KeyError, ValueError, AttributeError) as error:
        raise EpisodeError(
            f"{folder / 'meta/info.json'}: splits are {dict(splits)}; {name!r} must be among them, as"
            ' "first:end" or "first:end,first:end"'
        ) from error


def write_splits(root: Path, sizes: Mapping[str, int]) -> None:
    """Say in a finished data set how many of its episodes, in their order, each split takes.

    Episodes that are appended afterwards are added to one split; see LeRobotWriter.write.

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


def read_splits(root: Path) -> dict[str, list[int]]:
    """The episodes of each of NAMES in a data set, by number."""
    info = read_info(root)
    return {name: range_of(info.get("splits") or {}, name, info["total_episodes"], root) for name in NAMES}


def keep_in_splits(root: Path, kept: Mapping[str, Iterable[int]]) -> None:
    """Say in a data set which episodes each split has; an episode that none has is not used.

    Args:
        kept: numbers of episodes by split.
    """
    path, info = Path(root) / "meta/info.json", read_info(root)
    splits = {
        name: ",".join(f"{begin}:{end}" for begin, end in _runs(set(some))) or "0:0"
        for name, some in kept.items()
    }
    text = json.dumps({**info, "splits": splits}, indent=4)
    write_atomically(path, lambda target: target.write_text(text))


def _runs(numbers: Set[int]) -> list[tuple[int, int]]:
    """First and last + 1 of each run of consecutive numbers."""
    starts = sorted(n for n in numbers if n - 1 not in numbers)
    ends = sorted(n + 1 for n in numbers if n + 1 not in numbers)
    return list(zip(starts, ends, strict=True))


def extend_splits(splits: Mapping[str, str], name: str, before: int, count: int) -> dict[str, str]:
    """The splits of a data set that grew from `before` episodes to `count`: the new ones are in split `name`,
    the old ones where they were.
    """
    if count <= before:
        return dict(splits)
    old = splits.get(name, "")
    head, _, end = old.rpartition(":")
    joined = f"{head}:{count}" if end == f"{before}" else ",".join(filter(None, (old, f"{before}:{count}")))
    return {**splits, name: joined}


def _by_number(number: int) -> str:
    block, place = divmod(number, 8)
    # Turned from one eight to the next: tasks that were recorded by turns would each be in one split alone.
    turned = (place - crc32(str(block).encode()) * (block > 0)) % 8
    if turned == 7:
        return HELD_OUT
    return CALIBRATION if turned % 4 == 2 else TRAIN
