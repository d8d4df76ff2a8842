"""Charts of the report as SVG: they take fonts and colours from the page, so they follow light and dark."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

_WIDTH, _HEIGHT = 520.0, 250.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 14.0, 34.0, 36.0
_CURVE = (600.0, 96.0)  # width and height of a progress chart


@dataclass(frozen=True)
class Curve:
    """One line of a chart."""

    label: str
    x: Sequence[float]
    y: Sequence[float]


def line_chart(curves: Sequence[Curve], title: str, xlabel: str, ylabel: str) -> Markup:
    """Lines over common axes, with a legend if there are several; "" where nothing is finite."""
    points = [(x, y) for curve in curves for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(y)]
    if not points:
        return Markup("")
    (left, right), (low, high) = ((min(values), max(values)) for values in zip(*points, strict=True))
    ticks = _ticks(low, high)
    low, high = min(low, ticks[0]), max(high, ticks[-1])

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - left) / ((right - left) or 1.0)
        up = (y - low) / ((high - low) or 1.0)
        return (
            _LEFT + across * (_WIDTH - _LEFT - _RIGHT),
            _HEIGHT - _BOTTOM - up * (_HEIGHT - _TOP - _BOTTOM),
        )

    parts = [_text(_LEFT, 14, title, "title")]
    for tick in ticks:
        _, y = place(left, tick)
        parts.append(f'<path class=grid d="M{_LEFT:.0f} {y:.1f}H{_WIDTH - _RIGHT:.0f}"/>')
        parts.append(_text(_LEFT - 7, y + 4, f"{tick:g}", "tick end"))
    for x in sorted({left, right}):
        parts.append(_text(place(x, low)[0], _HEIGHT - 20, f"{x:g}", "tick middle"))
    parts.append(_text(_WIDTH / 2, _HEIGHT - 5, xlabel, "tick middle"))
    parts.append(_text(_LEFT, 28, ylabel, "tick"))
    beside = _WIDTH - _RIGHT
    for number, curve in reversed(list(enumerate(curves))):  # the legend is laid out from the right
        known = [place(x, y) for x, y in zip(curve.x, curve.y, strict=True) if math.isfinite(y)]
        parts.append(f'<path class="line c{number % 6}" d="{_path(known)}"/>')
        if len(curves) > 1:
            beside -= 22 + 6.6 * len(curve.label)
            parts.append(f'<rect class="c{number % 6}" x="{beside:.0f}" y="20" width="8" height="8" rx="2"/>')
            parts.append(_text(beside + 11, 28, curve.label, "tick"))
    box = f"0 0 {_WIDTH:.0f} {_HEIGHT:.0f}"
    return Markup(f'<svg class=chart viewBox="{box}" role=img>{"".join(parts)}</svg>')


@dataclass(frozen=True)
class Point:
    """One mark of a scatter chart, coordinates in 0..1.

    Args:
        label: what it says when it is pointed at.
        x, y: where it is.
        error: half the length of the bar through it, along y.
        series: number of its colour.
    """

    label: str
    x: float
    y: float
    error: float = 0.0
    series: int = 0


def agreement_chart(points: Sequence[Point], series: Sequence[str], title: str) -> Markup:
    """Estimated shares (up) over true ones (across) with the diagonal on which they are equal.

    Args:
        series: names of the points' colours.
    """
    across, up = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        return _LEFT + x * across, _HEIGHT - _BOTTOM - min(1.0, max(0.0, y)) * up

    parts = [_text(_LEFT, 14, title, "title"), _text(_LEFT, 28, "estimated", "tick")]
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(f'<path class=grid d="M{_LEFT:.0f} {place(0, tick)[1]:.1f}H{_WIDTH - _RIGHT:.0f}"/>')
        parts.append(_text(_LEFT - 7, place(0, tick)[1] + 4, f"{tick:g}", "tick end"))
        parts.append(_text(place(tick, 0)[0], _HEIGHT - 20, f"{tick:g}", "tick middle"))
    parts.append(_text(_WIDTH / 2, _HEIGHT - 5, "true", "tick middle"))
    parts.append(f'<path class="line recorded" d="{_path([place(0, 0), place(1, 1)])}"/>')
    for point in points:
        x, y = place(point.x, point.y)
        kind = f"c{point.series % 6}"
        ends = [place(point.x, point.y + sign * point.error) for sign in (-1, 1)]
        parts.append(f'<path class="line {kind}" d="{_path(ends)}"/>')
        parts.append(
            f'<rect class="{kind}" x="{x - 4:.1f}" y="{y - 4:.1f}" width="8" height="8" rx="4">'
            f"<title>{escape(point.label)}</title></rect>"
        )
    beside = _WIDTH - _RIGHT
    for number, name in reversed(list(enumerate(series))):
        beside -= 22 + 6.6 * len(name)
        parts.append(f'<rect class="c{number % 6}" x="{beside:.0f}" y="20" width="8" height="8" rx="2"/>')
        parts.append(_text(beside + 11, 28, name, "tick"))
    box = f"0 0 {_WIDTH:.0f} {_HEIGHT:.0f}"
    return Markup(f'<svg class=chart viewBox="{box}" role=img>{"".join(parts)}</svg>')


def progress_chart(video: Mapping[str, Any]) -> Markup:
    """The judge's progress over the frames of a paired video, generated and recorded, and from when on the
    recording is a success; a bar that the page moves along with the video.

    Args:
        video: an entry of videos.json, see pipeline/stages/show.py.
    """
    width, height = _CURVE
    count = len(video["curves"]["generated"])

    def place(frame: float, value: float) -> tuple[float, float]:
        return width * frame / max(1, count), height - 4 - value * (height - 8)

    parts = []
    if video["done"] is not None:
        x = place(video["done"] + 1, 0)[0]
        parts.append(f'<rect class=done x="{x:.1f}" y="0" width="{width - x:.1f}" height="{height:.0f}"/>')
    for value in (0.0, 0.5, 1.0):
        parts.append(f'<path class=grid d="M0 {place(0, value)[1]:.1f}H{width:.0f}"/>')
    for name in ("recorded", "generated"):  # what is imagined is drawn last, over the other
        known = [place(frame + 1, value) for frame, value in enumerate(video["curves"][name])]
        parts.append(f'<path class="line {name}" d="{_path(known)}"/>')
    parts.append(f'<path class=head d="M0 0V{height:.0f}"/>')
    return Markup(
        f'<svg class=progress viewBox="0 0 {width:.0f} {height:.0f}" preserveAspectRatio=none'
        f' data-frames="{count}" data-fps="{video["fps"]:g}">{"".join(parts)}</svg>'
    )


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "".join(f"{'L' if n else 'M'}{x:.1f} {y:.1f}" for n, (x, y) in enumerate(points))


def _text(x: float, y: float, text: str, kind: str) -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}">{escape(text)}</text>'


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers around a range."""
    span = (high - low) or abs(high) or 1.0
    step = 10 ** math.floor(math.log10(span / 3))
    step *= next((factor for factor in (1, 2, 5) if span / (factor * step) <= 5), 10)
    first, last = math.floor(low / step), math.ceil(high / step)
    return [round(n * step, 10) for n in range(first, last + 1)]
