"""Rewards side by side as a table of text and as one page with their curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from pipeline.evaluation.charts import Curve, line_chart
from pipeline.evaluation.report import templates
from pipeline.evaluation.rewards.figures import cell
from pipeline.markdown import markdown_table

# Figures of a reward: key, and heading.
FIGURES = (
    ("within", "Spearman within episodes"),
    ("pooled", "Spearman over all frames"),
    ("auc", "AUC of success"),
    ("dropped", "not judged"),
)


def build_page(result: Mapping[str, Any]) -> str:
    """One self-contained HTML page of rewards.json."""
    domains = [
        {"name": name, "about": about_of(domain), "lines": list(lines_of(domain)), "charts": _charts(domain)}
        for name, domain in result["domains"].items()
    ]
    return (
        templates()
        .get_template("rewards.html.j2")
        .render(result=result, headings=[heading for _, heading in FIGURES], domains=domains)
    )


def table_text(result: Mapping[str, Any]) -> str:
    """Markdown: a table for each domain."""
    out = []
    for name, domain in result["domains"].items():
        headings = ["reward", "video", *(heading for _, heading in FIGURES)]
        out.append(f"{name}: {about_of(domain)}\n\n{markdown_table(headings, lines_of(domain))}")
    return "\n\n".join(out)


def about_of(domain: Mapping[str, Any]) -> str:
    """What a domain's figures are of, in a sentence."""
    return (
        f"{domain['episodes']} episodes, {domain['successes']} of them successes, against {domain['truth']}"
        " and true success [95% by resampling episodes]"
    )


def lines_of(domain: Mapping[str, Any]) -> Iterator[list[str]]:
    """Name, video and figures of every reward, recorded video before generated."""
    for name, row in domain["rewards"].items():
        facts = "".join(f"; {key} {value}" for key, value in row["facts"].items())
        for video, found in row["figures"].items():
            yield [name + facts, video, *(cell(found, key) for key, _ in FIGURES)]


def _charts(domain: Mapping[str, Any]) -> list[Markup]:
    """The rewards' progress, and their belief in success, along each drawn episode, as it was recorded."""
    out = []
    for drawn in domain["drawn"]:
        title = f"{drawn['outcome']}: {drawn['instruction']}, seed {drawn['seed']}"
        for part, rewards in drawn["curves"].items():
            curves = [Curve(name, list(range(1, len(y) + 1)), y) for name, y in rewards.items()]
            out.append(line_chart(curves, title, "frame", part))
    return out
