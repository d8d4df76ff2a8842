"""Fidelity of a simulator as text and as one page that a paper could print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pipeline.evaluation.charts import Curve, line_chart
from pipeline.evaluation.fidelity.end_effector import end_effector_text
from pipeline.evaluation.fidelity.strides import HEADINGS, VERDICTS, common_stride, stride_cells
from pipeline.evaluation.report import templates
from pipeline.markdown import markdown_table

# Figures of a row: key, heading and form.
FIGURES = (
    ("mse", "MSE", "{:.4f}"),
    ("psnr", "PSNR dB", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("perceptual", "NLPD", "{:.3f}"),
    ("arm_mse", "arm MSE", "{:.4f}"),
    ("object_mse", "object MSE", "{:.4f}"),
)
_CURVES = ("psnr", "ssim", "perceptual", "arm_mse", "object_mse")


def build_page(result: Mapping[str, Any]) -> str:
    """One self-contained HTML page of fidelity.json."""
    rows = {
        "all": result["overall"],
        **result["groups"],
        **{f"view {k}": v for k, v in result["views"].items()},
        **result["held"],
    }
    return (
        templates()
        .get_template("fidelity.html.j2")
        .render(
            result=result,
            headings=[title for _, title, _ in FIGURES],
            rows={name: texts(row) for name, row in rows.items()},
            curves=_curves(result),
            long=_long(result["long"]) if result["long"] else [],
            strides=_strides(result["strides"]) if result["strides"] else None,
            grid=_grid(result["grid"]) if result["grid"] else None,
            collapse=collapse_text(result["long"]),
            left_out=pictures_text(result),
            object_error=object_text(result),
            end_effector=end_effector_text(result["end_effector"]),
        )
    )


def summary_text(result: Mapping[str, Any]) -> str:
    """Markdown: overall figures, by source, Frechet distances, long rollouts, strides, and the grid."""
    known = {"all": result["overall"], **result["groups"], **result["held"]}
    lines = [
        f"{result['simulator']} under the true actions of {result['episodes']} held-out episodes; perceptual"
        f" distance: {result['perceptual']}",
        "",
        markdown_table(
            ["", *(title for _, title, _ in FIGURES)], [[name, *texts(row)] for name, row in known.items()]
        ),
        "",
    ]
    for one in result["frechet"]:
        lines.append(frechet_text(one))
    if result["without_picture"]:
        lines.append(pictures_text(result))
    lines.append(object_text(result))
    lines.append(end_effector_text(result["end_effector"]))
    lines.append(collapse_text(result["long"]))
    for table in (
        _strides(result["strides"]) if result["strides"] else None,
        _grid(result["grid"]) if result["grid"] else None,
    ):
        if table:
            lines += ["", markdown_table(table["headings"], table["rows"]), "", table["note"]]
    return "\n".join(lines)


def frechet_text(one: Mapping[str, Any]) -> str:
    """A Frechet distance in a sentence, or why there is none."""
    if one["value"] is None:
        return f"No Frechet distance by {one['extractor']}: {one['unknown']}"
    return f"Frechet distance {one['value']:.4g} of {one['samples']} samples by {one['extractor']}"


def texts(row: Mapping[str, Any]) -> list[str]:
    """The texts of FIGURES; "-" for what is unknown."""
    return ["-" if row.get(key) is None else form.format(row[key]) for key, _, form in FIGURES]


def object_text(result: Mapping[str, Any]) -> str:
    """Where the first object was found, in a sentence."""
    cm, lost = result["object_cm"], result["object_lost"]
    if result["object_unknown"] is not None:
        return f"How far off the first object lies is unknown: {result['object_unknown']}."
    if lost is None:
        return (
            "The first object is not measured: nobody recorded where it is, or no still camera is calibrated."
        )
    floor = result["locator_cm"]
    own = f"in recorded video the same locator errs {result['locator_px']:.1f} pixels"
    own += "" if floor is None else f" or {floor:.2f} cm"
    if cm is None:
        return f"The first object is lost: it is found in no generated frame; {own}."
    return (
        f"The first object lies {cm:.2f} cm off (median over the frames in which it is found) and is lost in"
        f" {100 * lost:.1f}% of those that truly show it; {own}."
    )


def pictures_text(result: Mapping[str, Any]) -> str:
    """How many frames are left out, in a sentence; "" if none is."""
    dark = result["without_picture"]
    return f"{dark} frames are left out, for no picture was recorded of them." if dark else ""


def collapse_text(long: Mapping[str, Any] | None) -> str:
    """What came of long rollouts, in a sentence."""
    if long is None:
        return "No long rollouts were made (fidelity.long.frames=0)"
    end = long["end"]
    if end["sharpness"] is None:
        return "Of long rollouts nothing is known: no picture was recorded but the first"
    outcome = {
        True: "the video has collapsed",
        False: "no collapse",
        None: "collapse unknown (there is no other episode, as whose pictures it could err)",
    }[long["collapsed"]]
    short = (
        f" ({long['wanted']} were wanted; recordings are no longer)"
        if long["frames"] < long["wanted"]
        else ""
    )
    return (
        f"After {long['frames']} frames{short} {outcome}: PSNR {end['psnr']:.1f} dB, sharpness"
        f" {end['sharpness']:.2f} of the truth's over the last tenth of {long['episodes']} rollouts"
    )


def _curves(result: Mapping[str, Any]) -> list[Markup]:
    titles = {key: title for key, title, _ in FIGURES}
    charts = []
    for key in _CURVES:
        lines = [Curve("generated", *_points(result["by_frame"].get(key, [])))]
        if key in result["still"]:
            lines.append(Curve("first frame held", *_points(result["still"][key])))
        if key in (result["still_coded"] or {}):
            lines.append(Curve("through the autoencoder", *_points(result["still_coded"][key])))
        charts.append(line_chart(lines, f"{titles[key]} against frame number", "frame", titles[key]))
    return [chart for chart in charts if chart]


def _long(long: Mapping[str, Any]) -> list[Markup]:
    lines = [Curve("generated", *_points(long["by_frame"]["psnr"]))]
    lines.append(Curve("first frame held", *_points(long["still"])))
    if long["unrelated"]:
        lines.append(Curve("another episode", *_points(long["unrelated"])))
    sharp = [Curve("generated / true", *_points(long["sharpness"]))]
    return [
        line_chart(lines, "PSNR of long rollouts", "frame", "PSNR dB"),
        line_chart(sharp, "Sharpness of long rollouts, 1 is the truth's", "frame", "mean gradient"),
    ]


def _points(values: Sequence[float | None]) -> tuple[list[float], list[float]]:
    known = [(n + 1.0, value) for n, value in enumerate(values) if value is not None]
    return [x for x, _ in known], [y for _, y in known]


def _strides(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Headings, rows of texts, and what must be known to compare them."""
    common = common_stride([row["stride"] for row in rows])
    judged = any(row["verdicts"] for row in rows)
    return {
        "headings": [*HEADINGS, *(title for _, title, _ in FIGURES), *VERDICTS],
        "rows": [stride_cells(row, texts(row)) for row in rows],
        "note": f"Errors are those of frames {common}, {2 * common}, ..., which all strides show. "
        + (
            "Verdicts are the judge's, against recorded success; it sees the frames that are shown"
            if judged
            else "No verdicts: the judge has learned nothing yet; train it, or name imagined.judge"
        ),
    }


def _grid(grid: Mapping[str, Any]) -> dict[str, Any]:
    """The same, with the optimum in words."""
    headings = [*grid["keys"], *(title for _, title, _ in FIGURES), "frames/s"]
    rows = [
        [
            *(str(row["settings"][key]) for key in grid["keys"]),
            *texts(row),
            f"{row['frames_per_second']:.0f}",
        ]
        for row in grid["rows"]
    ]
    best = grid["rows"][grid["best"]]["settings"]
    settings = ", ".join(f"{key}={value}" for key, value in best.items())
    name = grid["figure"].replace("_mse", " MSE").replace("mse", "MSE")
    return {"headings": headings, "rows": rows, "note": f"Least {name}: {settings}"}
