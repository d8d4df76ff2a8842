"""Other people's recordings as Episodes; which format a folder holds is told by what lies in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.agibot import AGIBOT_BETA
from envs.episodes.formats.bridge import BRIDGE_CLIPS
from envs.episodes.formats.gesim import GESIM1, GESIM2
from envs.episodes.formats.recordings import Cut, Format

FORMATS: tuple[Format, ...] = (GESIM2, GESIM1, AGIBOT_BETA, BRIDGE_CLIPS)


def read_foreign(source: Path, cut: Cut | None = None) -> Iterator[Episode]:
    """Every episode under a folder of one of the known formats.

    Raises:
        EpisodeError: if there is none, or one is damaged.
    """
    source, cut = Path(source), cut or Cut()
    for known in FORMATS:
        places = known.find(source)
        if places:
            return (cut.of(known.read(place, number, cut)) for number, place in enumerate(places))
    raise EpisodeError(
        f"{source} holds no recording in a known format: {', '.join(known.name for known in FORMATS)}, or"
        " LeRobot (meta/info.json)"
    )
