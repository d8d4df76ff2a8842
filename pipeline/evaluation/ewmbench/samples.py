"""Generates the samples of each episode, measures them beside the recording, and keeps what was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.simulators.base import Simulator
from envs.simulators.replay import replay, side_by_side
from pipeline.evaluation.ewmbench.drawing import film_tracks
from pipeline.evaluation.ewmbench.measure import Instruments
from pipeline.evaluation.ewmbench.records import Record, Records

_SIDE_BY_SIDE = 16  # episodes at most, whose frames are held at once
_MEASURED = 4  # videos that a vision-language model is asked about at once


def without_picture(store: ClipStore, episodes: Tensor) -> list[str]:
    """A note of how many frames of episodes int64 [N] are left out, for there is no picture of them; [] if
    there is one of each.
    """
    dark = int((store.length[episodes] - store.pictures(episodes)).sum())
    return [f"{dark} frames are left out, for no picture was recorded of them."] if dark else []


@dataclass
class Samples:
    """A simulator on a set of episodes.

    Args:
        simulator: whose video is measured.
        store: of the episodes.
        instruments: what it is measured with.
        made, true: records of generated and of recorded videos.
        films: folder of videos for people, by episode and sample.
        bf16: generate in bfloat16 where the device computes in it.
        filmed: numbers of the episodes of which videos are kept.
    """

    simulator: Simulator
    store: ClipStore
    instruments: Instruments
    made: Records
    true: Records
    films: Path
    bf16: bool
    filmed: set[int] = field(default_factory=set)

    def recorded(self, episodes: Tensor, done: Callable[[int], Any]) -> dict[int, Record]:
        """Records of the recordings of episodes int64 [N], by number.

        Args:
            done: called with the number of videos that were finished.
        """
        out: dict[int, Record] = {}
        for number in episodes.tolist():
            about = self._about(number)
            record = self.true.get(f"{number}", about)
            if record is None:
                record = self.instruments.measure([self._video(number)])[0]
                self.true.put(f"{number}", about, record)
            out[number] = record
            done(1)
        return out

    def generated(
        self, episodes: Tensor, draw: int, true: Mapping[int, Record], done: Callable[[int], Any]
    ) -> dict[int, Record]:
        """Records of sample number `draw` of each of the episodes int64 [N], by number.

        Args:
            true: records of their recordings, whose tracks are drawn beside.
        """
        out: dict[int, Record] = {}
        for number in episodes.tolist():
            if number in self.filmed and not self.film(number, draw).is_file():
                continue  # measured without a film
            record = self.made.get(f"{number}-{draw}", self._about(number, draw))
            if record is not None:
                out[number] = record
        done(len(out))
        missing = torch.tensor([n for n in episodes.tolist() if n not in out], dtype=torch.int64)
        for some in missing.split(self._at_once(missing)) if len(missing) else ():
            played = replay(self.simulator, self.store, some, bf16=self.bf16, draw=draw).pictured(self.store)
            for places in torch.arange(len(some)).split(_MEASURED):
                numbers = some[places].tolist()
                recorded = [self._video(number) for number in numbers]
                videos = [
                    torch.cat((truth[:1], played.frames[n][played.valid[n]]))
                    for n, truth in zip(places.tolist(), recorded, strict=True)
                ]
                records = self.instruments.measure(videos)
                for number, video, truth, record in zip(numbers, videos, recorded, records, strict=True):
                    if number in self.filmed:
                        views = list(self.instruments.detected or self.instruments.views)
                        tracks = record.tracks, true[number].tracks
                        path = self.film(number, draw)
                        film_tracks(path, (video[:, views], truth[:, views]), tracks, self.store.fps)
                    self.made.put(f"{number}-{draw}", self._about(number, draw), record)
                    out[number] = record
                done(len(numbers))
        return out

    def film(self, number: int, draw: int) -> Path:
        """The file of the video for people of a sample."""
        path = self.made.path(f"{number}-{draw}", self._about(number, draw))
        return self.films / path.with_suffix(".mp4").name

    def _about(self, number: int, draw: int | None = None) -> dict[str, Any]:
        row = self.store.episodes[number]
        return {"episode": number, "draw": draw, "length": row["length"], "instruction": row["instruction"]}

    def _at_once(self, episodes: Tensor) -> int:
        return side_by_side(self.store, int(self.store.length[episodes].max()), _SIDE_BY_SIDE)

    def _video(self, number: int) -> Tensor:
        """The recorded frames uint8 [T, V, 3, H, W] of an episode, of which there is a picture."""
        rows = self.store.rows(torch.tensor([number]))
        return self.store.frames(rows[self.store.arrays["present"][rows]])
