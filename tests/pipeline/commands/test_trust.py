"""worldloop trust asks for a run that has come so far."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.targets import ConfigError
from pipeline.commands.worlds.trust import trust
from pipeline.config import load_config


def test_a_run_that_has_not_come_so_far_is_told_so(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    with pytest.raises(ConfigError, match=r"not come to round 2 .*deploy-2.*first `worldloop run`"):
        trust(cfg, tmp_path, 2, 10, 4, 1)
    with pytest.raises(ConfigError, match=r"round=3: the rounds of this run are 1 to 2"):
        trust(cfg, tmp_path, 3, 10, 4, 1)
