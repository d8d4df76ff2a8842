"""One table of a simulator, as a paper prints it: video, scenes and hands, and what it thinks of policies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.evaluation.ewmbench.page import COLUMNS, chosen_text
from pipeline.evaluation.fidelity.end_effector import end_effector_text
from pipeline.evaluation.fidelity.page import FIGURES as FIDELITY
from pipeline.evaluation.fidelity.page import collapse_text
from pipeline.evaluation.report import templates
from pipeline.evaluation.statistics import verdicts_line
from pipeline.evaluation.value.page import FIGURES as VALUES
from pipeline.evaluation.value.page import figure_text, order_text
from pipeline.markdown import markdown_table

Found = Mapping[str, Any]
MISSING = "unmeasured"
_BETTER = {"mse": "↓", "psnr": "↑", "ssim": "↑", "perceptual": "↓", "arm_mse": "↓", "object_mse": "↓"}
_AGREE = {"pearson": "↑", "spearman": "↑", "mmrv": "↓", "difference": "↓"}


@dataclass(frozen=True)
class Row:
    """A figure: its name with an arrow to what is better, its text, and what bounds it, if anything is known:
    that of recorded video, and that of a picture that stands still.
    """

    name: str
    value: str
    recorded: str = ""
    still: str = ""


@dataclass(frozen=True)
class Part:
    """What one command measured.

    Args:
        title: of the part.
        command: that measures it.
        rows: () if it has not been measured.
        notes: what must be known to read them, or why there are none.
    """

    title: str
    command: str
    rows: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()


def parts_of(results: Mapping[str, Found], left_out: Mapping[str, str]) -> list[Part]:
    """The parts of the page.

    Args:
        results: of `worldloop fidelity`, `ewmbench` and `policy-value`, as far as there are any, by name.
        left_out: why others were left out.
    """
    out = [
        Part(title, command, notes=(left_out[name],) if (name := command.split()[-1]) in left_out else ())
        for title, command in _PARTS
    ]
    if fidelity := results.get("fidelity"):
        out[0] = Part(*_PARTS[0], tuple(_video(fidelity)), tuple(_video_notes(fidelity)))
    if ewmbench := results.get("ewmbench"):
        out[1] = Part(*_PARTS[1], tuple(_scenes(ewmbench)), tuple(_scene_notes(ewmbench)))
    if value := results.get("policy-value"):
        out[2] = Part(*_PARTS[2], tuple(_values(value)), tuple(value["notes"]))
    return out


_PARTS = (
    ("Video under true actions", "worldloop fidelity"),
    ("Scenes, hands and words (EWMBench)", "worldloop ewmbench"),
    ("Policies", "worldloop policy-value"),
)


def _video(found: Found) -> Iterator[Row]:
    sides = (found["overall"], found["held"]["first frame held"])
    for key, title, form in FIDELITY:
        made, still = ("" if one.get(key) is None else form.format(one[key]) for one in sides)
        yield Row(f"{title} {_BETTER[key]}", made or MISSING, still=still)
    for one in found["frechet"]:
        text = MISSING if one["value"] is None else f"{one['value']:.4g}"
        yield Row(f"Frechet distance, {one['extractor']}, {one['samples']} samples ↓", text)
    cm, lost, hands = found["object_cm"], found["object_lost"], found["end_effector"]
    floor = found.get("locator_cm")  # results of former versions hold none
    yield Row(
        "object off where it is found, cm ↓",
        *(MISSING if cm is None else f"{cm:.2f}", "" if floor is None else f"{floor:.2f}"),
    )
    yield Row("object lost ↓", MISSING if lost is None else f"{lost:.1%}")
    made, own = (hands.get(f"{name}_cm") for name in ("generated", "recorded"))
    yield Row("end effector off, cm ↓", *(f"{one['median']:.2f}" if one else MISSING for one in (made, own)))
    for batch, speed in found["frames_per_second"].items():
        yield Row(f"frames/s at {batch} ↑", f"{speed:.0f}")


def _video_notes(found: Found) -> Iterator[str]:
    yield f"{found['episodes']} held-out episodes, {' x '.join(map(str, found['size']))} pixels; NLPD is"
    yield f"{found['perceptual']}. {collapse_text(found['long'])}. {end_effector_text(found['end_effector'])}"
    if why := found.get("object_unknown"):
        yield f"How far off the first object lies is unknown: {why}."


def _scenes(found: Found) -> Iterator[Row]:
    whole = found["overall"]
    for key, title, form in COLUMNS:
        texts = [
            MISSING if whole[side].get(key) is None else form.format(whole[side][key])
            for side in ("generated", "recorded", "still")
        ]
        yield Row(title, texts[0], *("" if text == MISSING else text for text in texts[1:]))


def _scene_notes(found: Found) -> Iterator[str]:
    kind = "strict parity with the public code; " if found["strict_parity"] else ""
    samples = f"{chosen_text(found)} samples" if found["samples"] > 1 else "one sample of each"
    yield f"{len(found['rows'])} held-out episodes, {samples}; {kind}features by"
    yield f"{'; '.join(found['extractors'].values())}."
    yield from found["notes"]


def _values(found: Found) -> Iterator[Row]:
    known = found["agreement"]
    for key, title, form in VALUES:
        yield Row(f"{title} {_AGREE[key]}", figure_text(known, key, form) or MISSING)
    if known:
        yield Row("pairs of policies in order ↑", order_text(known["order"]))
        yield Row("verdicts that are right ↑", verdicts_line(known["micro"]))
        for side, bias in known["bias"].items():
            yield Row(f"estimated less true, {side} of distribution, points", f"{100 * bias['mean']:+.1f}")


def build_page(name: str, simulator: str, weights: str, parts: list[Part]) -> str:
    """One self-contained HTML page."""
    page = templates().get_template("summary.html.j2")
    return page.render(name=name, simulator=simulator, weights=weights, parts=parts, missing=MISSING)


def summary_text(simulator: str, parts: list[Part]) -> str:
    """The same as Markdown."""
    lines = []
    for part in parts:
        told = "" if part.rows else "; ".join((MISSING, part.command, *part.notes))
        lines.append([f"**{part.title}**", told, "", ""])
        lines += [[row.name, row.value, row.recorded, row.still] for row in part.rows]
    return markdown_table([simulator, "generated", "recorded", "first frame held"], lines)
