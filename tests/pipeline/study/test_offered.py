"""Every study that configs offer, planned by the command in its file: no row can be refused after hours."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from actors.world_config import world_spec
from envs.simulators.base import WORLD_OPTIONS
from envs.targets import build
from pipeline.acting import acting
from pipeline.config import CONFIGS, choices
from pipeline.study.plan import plan_study
from tests.sampling import every, those

COMMAND = re.compile(r"worldloop study((?: [\w.]+=[\w\[\],]+)*)")


def command(group: str, name: str) -> tuple[str, ...] | None:
    """The words of `worldloop study ...` in the head of a file of configs/; None if it does not say so."""
    head = (CONFIGS / group / f"{name}.yaml").read_text().partition("\ndefaults:")[0]
    found = COMMAND.search(head)
    return None if found is None else tuple(found[1].split())


COMMANDS = sorted(
    {words for group in ("study", "experiment") for name in choices(group) if (words := command(group, name))}
)
ELSEWHERE = [
    ("experiment=bench4", "study=data_size", "study.places=[]"),
    ("experiment=metaworld5", "study=judges"),
]

PLANNED = [(words,) for words in [(), *COMMANDS, *ELSEWHERE]]
SAMPLED = [(("experiment=bench4",),)]


def test_every_file_says_how_its_study_is_run() -> None:
    assert all(command("study", name) is not None for name in choices("study"))
    for name in choices("experiment"):
        section = yaml.safe_load((CONFIGS / "experiment" / f"{name}.yaml").read_text())
        chosen = [key for base in section.get("defaults", []) for key in base if key == "override /study"]
        own = "study" in section or "study" in section.get("if_chosen", {})
        assert bool(chosen or own) == (command("experiment", name) is not None), name


@pytest.mark.parametrize("words", those(SAMPLED, PLANNED), ids=" ".join)
def test_every_row_can_be_built(words: tuple[str, ...], tmp_path: Path) -> None:
    study = plan_study([*words, f"runs={tmp_path}", "study.seeds=[0]"])
    assert {row.name for row in study.rows} == set(study.cfg["study"]["rows"])
    for row in study.rows:
        for cfg in (row.cfg, acting(row.cfg)):
            own = {key: value for key, value in cfg["simulator"].items() if key not in WORLD_OPTIONS}
            world = build(own, "simulator", spec=world_spec(cfg))
            assert world.spec.chunk == cfg["task"]["chunk"], row.title


@pytest.mark.parametrize("name", every(2, ["worlds", "reward_curves"]))
def test_no_engine_learns_views_that_nobody_looks_through(name: str, tmp_path: Path) -> None:
    study = plan_study([f"experiment={name}", f"runs={tmp_path}", "study.seeds=[0]"])
    assert {(row.cfg["cameras"], world_spec(row.cfg).views) for row in study.rows} == {("main", 1)}
