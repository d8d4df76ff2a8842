"""Runs what a study lacks, in its order, and keeps its table up to date."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup
from tqdm import tqdm

from envs.files import write_json, write_text
from pipeline.study.deadline import deadline
from pipeline.study.plan import Row, Study
from pipeline.study.show import markdown, page
from pipeline.study.table import measured, pooled, study_table
from pipeline.track import tracking

NAMES = ("study.json", "study.md", "study.html")


def run_study(study: Study) -> str:
    """Run the missing cells until study.minutes are over; writes the table after each of them.

    Returns:
        The table as Markdown.
    """
    waiting = study.missing()
    text = write_table(study)
    with deadline(study.cfg["study"]["minutes"]) as time:
        with tqdm(total=len(waiting), desc="study", unit="cell", dynamic_ncols=True) as bar:
            for row, column in waiting:
                if time.over:
                    break
                seconds, unknown = study.seconds_left()
                more = f" and {unknown} stages never timed" if unknown else ""
                bar.set_postfix_str(f"about {seconds / 60:.0f} min left{more}")
                tqdm.write(f"=== {row.title}, seed {row.seed}: {study.columns[column].title}")
                _run_cell(study, row, column)
                text = write_table(study)
                bar.update()
    if time.over:
        left = len(study.missing())
        tqdm.write(f"study.minutes={study.cfg['study']['minutes']} are over, {left} cells were not run")
        text = write_table(study)
    return text


def write_table(study: Study) -> str:
    """Write the table as it stands into the study's folder, as JSON, Markdown and a page; returns the
    Markdown.
    """
    table = study_table(study)
    text = markdown(table, study.columns)
    shown = page(table, study.columns, charts(study))
    write_json(study.root / NAMES[0], table)
    for name, content in zip(NAMES[1:], (text, shown), strict=True):
        write_text(study.root / name, content)
    return text


def charts(study: Study) -> list[Markup]:
    """What columns draw of the rows that were run, place by place."""
    found = measured(study)
    out = []
    for name, column in study.columns.items():
        for place in dict.fromkeys(row.place for row in study.rows):
            rows = {row.key: row.title for row in study.rows if row.place == place}
            known = {title: pooled(study, found, key, name) for key, title in rows.items()}
            out.append(column.chart({title: one for title, one in known.items() if one is not None}))
    return [drawn for drawn in out if drawn]


def _run_cell(study: Study, row: Row, column: str) -> None:
    """Run a column's stages and all that they need, tracked as a run of its own for each row and seed."""
    name = "-".join(filter(None, (study.cfg["name"], row.name, row.place)))
    named: Mapping[str, Any] = {**row.cfg, "name": name}
    with tracking(named, study.root / "tracks" / f"{name}-{row.seed}") as tracker:
        row.made.graph.run(row.nodes[column], tracker)
