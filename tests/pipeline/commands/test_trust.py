"""worldloop trust asks for a run that has come so far, and goes on where it was interrupted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from envs.targets import ConfigError
from pipeline.commands.worlds import trust as command
from pipeline.commands.worlds.trust import trust
from pipeline.config import load_config
from pipeline.evaluation.trust import branches
from pipeline.graph.stage import Inputs
from pipeline.stages.given import DATASETS
from tests.worlds import scripted_set, untrained_world

ROLES = ("simulator", "state", "judge", "policy")
# nothing succeeds for so long, so progress is what an untrained judge makes of each picture
WORDS = ["experiment=soak", "track=disabled", "launch.workers=1", "cameras=main", "judge.hold=99"]


def test_a_run_that_has_not_come_so_far_is_told_so(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    with pytest.raises(ConfigError, match=r"not come to round 2 .*deploy-2.*first `worldloop run`"):
        trust(cfg, tmp_path, 2, 10, 4, 1)
    with pytest.raises(ConfigError, match=r"round=3: the rounds of this run are 1 to 2"):
        trust(cfg, tmp_path, 3, 10, 4, 1)


@pytest.mark.long
def test_an_interrupted_command_goes_on_and_tries_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cfg, data = load_config(WORDS), tmp_path / "deployed"
    untrained_world(cfg, tmp_path)
    data.mkdir()
    (data / DATASETS).write_text(json.dumps([str(scripted_set(cfg, data / "set", 3, source="policy-1"))]))
    inputs = Inputs({**{role: tmp_path / role for role in ROLES}, "data": (data,)})
    monkeypatch.setattr(command, "round_inputs", lambda *_: inputs)
    carry_out, tried = branches.carry_out, list[int]()

    def counted(*given: Any) -> Any:
        tried.append(len(given[3]))
        if len(tried) == interrupted:
            raise KeyboardInterrupt
        return carry_out(*given)

    def asked(root: Path, moments: int = 5, depth: int = 2) -> str:
        tried.clear()
        return trust(cfg, root, 1, moments, 2, depth)

    def left(root: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in [root / "trust-1.json", *(root / "trust").iterdir()]}

    monkeypatch.setattr(command, "_SIDE_BY_SIDE", 4)
    monkeypatch.setattr(branches, "carry_out", counted)
    interrupted, whole, cut = 0, tmp_path / "whole", tmp_path / "cut"
    said = asked(whole)
    assert tried == [4, 4, 2] and said.endswith("\n0 parts were reused")
    interrupted = 2
    with pytest.raises(KeyboardInterrupt):
        asked(cut)
    assert not (cut / "trust-1.json").exists()
    interrupted = 0
    resumed = asked(cut)
    assert tried == [4, 2] and resumed == said.replace("0 parts", "1 parts")
    assert left(cut) == left(whole) and len(left(whole)) == 4
    assert asked(cut) == said.replace("0 parts", "3 parts") and not tried
    asked(cut, moments=6)
    assert tried == [4]  # whole batches of the same moments are those of before
    asked(cut, depth=1)
    assert tried == [4, 4, 2]
    cfg = {**cfg, "policy": {**cfg["policy"], "head": {**cfg["policy"]["head"], "std": 0.5}}}
    asked(cut)
    assert tried == [4, 4, 2]
