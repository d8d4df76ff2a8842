"""Videos and pictures for people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envs.episodes.filming import BAR, side_by_side, tiled, titled, write_film, write_gif
from envs.episodes.video import read_video


def shades(*values: int, size: tuple[int, int] = (4, 6)) -> list[np.ndarray]:
    return [np.full((*size, 3), value, np.uint8) for value in values]


def test_views_stand_side_by_side_and_sides_are_even(tmp_path: Path) -> None:
    frames = np.zeros((5, 2, 3, 33, 31), np.uint8)
    frames[:, 1] = 200
    pictures = side_by_side(frames)
    assert [picture.shape for picture in pictures] == [(6 * 33, 6 * 62, 3)] * 5
    write_film(tmp_path / "media" / "one.mp4", side_by_side(frames, height=33), 10.0)
    seen = read_video(tmp_path / "media" / "one.mp4")
    assert seen.shape == (5, 3, 32, 62)
    assert seen[0, :, :, :27].mean() < 30 < 170 < seen[0, :, :, 35:].mean()


def test_a_film_rests_at_its_end(tmp_path: Path) -> None:
    write_film(tmp_path / "one.mp4", shades(0, 240, size=(32, 32)), 10.0, rest=3)
    seen = read_video(tmp_path / "one.mp4")
    assert len(seen) == 5 and seen[0].mean() < 30 and all(frame.mean() > 200 for frame in seen[1:])


def test_titles_stand_above(tmp_path: Path) -> None:
    plain = shades(0, 0, size=(8, 90))
    same = titled(plain, "now")
    assert [picture.shape for picture in same] == [(8 + BAR, 90, 3)] * 2
    assert np.array_equal(same[0], same[1]) and same[0][:BAR].max() > 150
    other = titled(plain, ["now", "then"])
    assert np.array_equal(other[0], same[0]) and not np.array_equal(other[1], same[1])
    with pytest.raises(ValueError):
        titled(plain, ["now"])


def test_tiles_fill_rows_and_short_videos_wait() -> None:
    pictures = tiled([shades(1, 2, 3), shades(4), shades(5, 6)], columns=2)
    assert [picture.shape for picture in pictures] == [(8, 12, 3)] * 3
    seen = [[int(p[y, x, 0]) for y, x in ((0, 0), (0, 6), (4, 0), (4, 6))] for p in pictures]
    assert seen == [[1, 4, 5, 0], [2, 4, 6, 0], [3, 4, 6, 0]]


def test_gifs_are_whole_or_not_there(tmp_path: Path) -> None:
    from PIL import Image

    write_gif(tmp_path / "media" / "one.gif", shades(0, 120, 240), 10.0)
    with Image.open(tmp_path / "media" / "one.gif") as image:
        assert image.n_frames == 3 and image.info["duration"] == 100  # type: ignore[attr-defined]
    with pytest.raises(AttributeError):
        write_gif(tmp_path / "media" / "two.gif", [*shades(0), None], 10.0)  # type: ignore[list-item]
    assert [path.name for path in (tmp_path / "media").iterdir()] == ["one.gif"]
