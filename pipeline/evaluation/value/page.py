"""Values of policies as a table of text and as one page with plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pipeline.evaluation.charts import Point, agreement_chart
from pipeline.evaluation.judging import cost_text, facts_text
from pipeline.evaluation.report import templates
from pipeline.evaluation.statistics import percent_line
from pipeline.evaluation.value.agreement import ALL
from pipeline.evaluation.value.chance import RESAMPLES
from pipeline.markdown import markdown_table

_SERIES = ("in distribution", "out of distribution")
# Figures of an agreement: key, heading and form.
FIGURES = (
    ("pearson", "Pearson", "{:.2f}"),
    ("spearman", "Spearman", "{:.2f}"),
    ("mmrv", "MMRV", "{:.3f}"),
    ("difference", "mean |dSR|, points", "{:.1f}"),
)


def build_page(result: Mapping[str, Any]) -> str:
    """One self-contained HTML page of policy-value.json."""
    tasks = list(result["starts"])
    found = result["agreement"]
    rows = found.get("tasks", {}) if found else {}
    return (
        templates()
        .get_template("value.html.j2")
        .render(
            result=result,
            verdict=verdict(result),
            notes=[ranking(result), *chance_lines(found), *result["notes"], *judge_lines(result)],
            cells=[*result["cells"], *(result["overall"] if len(tasks) > 1 else [])],
            charts=_charts(result["cells"], tasks),
            figures=_titles(),
            order_text=order_text,
            agreements=[
                (ALL, _figures(found), _sides(found), found),
                *((t, _figures(row), _sides(row), row) for t, row in rows.items()),
            ]
            if found
            else [],
        )
    )


def table_text(result: Mapping[str, Any]) -> str:
    """Markdown: a row for each policy, true and estimated values by task, and over all of several; then what
    they come to.
    """
    tasks = list(result["starts"])
    overall = {row["policy"]: row for row in result["overall"]}
    found = {(cell["policy"], cell["task"]): cell for cell in result["cells"]}
    columns = [*tasks, ALL] if len(tasks) > 1 else tasks
    title = (
        f"Values of policies in {result['simulator']} by {result['judge']}, in percent: true -> estimated,"
        f" +- standard error over {result['repeats']} repeats"
    )
    rows = []
    for policy, whole in overall.items():
        cells = [found[policy, task] for task in tasks] + ([whole] if len(tasks) > 1 else [])
        rows.append([policy, *map(_cell_text, cells)])
    said = [verdict(result), ranking(result), *chance_lines(result["agreement"])]
    shown = markdown_table(["policy", *columns], rows)
    return "\n".join([title, "", shown, "", *said, *result["notes"], *judge_lines(result)])


def ranking(result: Mapping[str, Any]) -> str:
    """Policies by their estimated values over all starts, the best first; last who could not be judged."""
    rows = sorted(
        result["overall"],
        key=lambda row: -1.0 if row["estimated"] is None else row["estimated"],
        reverse=True,
    )
    texts = (f"{row['policy']}: {_cell_text(row)}" for row in rows)
    return f"The best first, by estimated values over all starts, in percent: {'; '.join(texts)}."


def judge_lines(result: Mapping[str, Any]) -> list[str]:
    """What the judge measures by, and what it was asked for and paid."""
    facts, cost = facts_text(result["judged_by"]), result["judge_cost"]
    lines = [f"Judged by {facts}."] if facts else []
    return [*lines, f"Asking the judge: {cost_text(cost)}."] if cost else lines


def verdict(result: Mapping[str, Any]) -> str:
    """What agreement there is, in one sentence."""
    found = result["agreement"]
    if not found:
        return "Estimated values alone: without true ones nobody knows how far they can be trusted."
    agreement = ", ".join(f"{title} {value}" for title, value in zip(_titles(), _figures(found), strict=True))
    sides = [f"{text} points {_SERIES[name == 'out']}" for name, text in _sides(found).items()]
    if found["kept"] is None:
        order = f"no ranking to keep ({order_text(found['order'])})"
    else:
        order = f"ranking {'' if found['kept'] else 'not '}kept ({order_text(found['order'])})"
    return f"{order}; {agreement}; estimated less true {', '.join(sides)}"


def order_text(order: Mapping[str, int]) -> str:
    """Of how many pairs of policies the order is kept; older results count all pairs that differ at all."""
    if "all" not in order:
        return f"{order['kept']:.0f} of {order['pairs']:.0f} pairs"
    if not order["all"]:
        return "no task has two policies to compare"
    if not order["pairs"]:
        return f"true values differ beyond chance in none of {order['all']:.0f} pairs"
    return f"{order['kept']:.0f} of {order['pairs']:.0f} pairs told apart in truth, of {order['all']:.0f}"


def chance_lines(found: Mapping[str, Any]) -> list[str]:
    """How intervals and what chance shows were found; [] of an agreement without."""
    if "intervals" not in found:
        return []
    if found["intervals"]:
        brackets = (
            f"In brackets 95% by resampling starts ({RESAMPLES} times, the same for all policies), less what"
            " noise adds; figures without do not change with the starts, or cannot be told."
        )
    else:
        brackets = "No figure changes with the starts, so nothing is known of how sure they are."
    return [
        f"{brackets} By chance: what a perfect world shows in the mean with as many episodes, if each"
        " succeeds at its policy's true rate, in truth and in imagination; less where equal starts end alike."
        " Pairs are told apart by McNemar's test, p < .05."
    ]


def _titles() -> list[str]:
    return [title for _, title, _ in FIGURES]


def _figures(found: Mapping[str, Any]) -> list[str]:
    """The texts of FIGURES; "-" for what cannot be said."""
    return [figure_text(found, key, form) or "-" for key, _, form in FIGURES]


def figure_text(found: Mapping[str, Any], key: str, form: str) -> str:
    """A figure of FIGURES with its interval, and what chance shows, as far as known; "" if it is not."""
    value, scale = found.get(key), 100 if key == "difference" else 1
    if value is None:
        return ""
    chance = found.get("chance", {}).get(key)
    more = "" if chance is None else f" (by chance {form.format(scale * chance)})"
    return form.format(scale * value) + _interval(found, key, form, scale) + more


def _interval(found: Mapping[str, Any], key: str, form: str, scale: int) -> str:
    ends = found.get("intervals", {}).get(key)
    return f" [{', '.join(form.format(scale * end) for end in ends)}]" if ends else ""


def _sides(found: Mapping[str, Any]) -> dict[str, str]:
    """Biases in points by "in" and "out" of distribution, with their intervals."""
    return {
        name: f"{100 * side['mean']:+.1f}{_interval(found, f'bias_{name}', '{:+.1f}', 100)}"
        for name, side in found["bias"].items()
    }


def _cell_text(cell: Mapping[str, Any]) -> str:
    value, error = cell["estimated"], cell["standard_error"]
    estimated = "nothing judged" if value is None else f"{100 * value:.0f}"
    spread = "" if error is None or value is None else f" +- {100 * error:.1f}"
    return f"{_true_text(cell)}{estimated}{spread}"


def _true_text(cell: Mapping[str, Any]) -> str:
    """The true value on the judged starts, which the estimated one is of, and, where it is another, that on
    all of them; "" if nobody knows it.
    """
    if "true" not in cell:
        return ""
    whole, matched = percent_line(cell["true"], 0).rstrip("%"), cell["matched_value"]
    own = whole if matched is None else f"{100 * matched:.0f}"
    return f"{own} -> " if own == whole else f"{own} (all starts {whole}) -> "


def _charts(cells: Sequence[Mapping[str, Any]], tasks: Sequence[str]) -> list[Markup]:
    """Estimated over true values, both of the judged starts: of all tasks, and of each of several; [] where
    no true value is known.
    """
    known = [cell for cell in cells if "true" in cell and cell["estimated"] is not None]
    if not known:
        return []
    shown = [("All cells", known)] if len(tasks) == 1 else [("All tasks", known)]
    if len(tasks) > 1:
        shown += [(task, [cell for cell in known if cell["task"] == task]) for task in tasks]
    return [agreement_chart([_point(cell) for cell in some], _SERIES, title) for title, some in shown]


def _point(cell: Mapping[str, Any]) -> Point:
    label = f"{cell['policy']}, {cell['task']}: {_cell_text(cell)} percent"
    series = 0 if cell["inside"] else 1
    return Point(label, cell["matched_value"], cell["estimated"], cell["standard_error"] or 0.0, series)
