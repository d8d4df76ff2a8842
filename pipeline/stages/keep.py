"""Stage that lets physics decide: of two policies, the one that succeeded more often when it was deployed.

RL believes its simulator. A policy that has learned to exploit it looks ever better in imagination and gets
worse in truth, as its own deployment shows; the next round then goes on from the policy before, in a
simulator that has seen the exploit.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from envs.files import atomic
from envs.manifest import read_manifest
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.given import Cfg

_WEIGHTS = "weights.safetensors"


@stage(reads=())
def keep(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The better of the policies `candidate` and `incumbent`, by their deployments `tried` and `known`; the
    candidate if both succeeded as often.

    Returns:
        Whether the candidate was kept, and as "success" how often the kept one succeeded.
    """
    tried, known = (_success(inputs.folder(role)) for role in ("tried", "known"))
    kept = tried >= known
    with atomic(folder / _WEIGHTS) as part:
        shutil.copyfile(inputs.folder("candidate" if kept else "incumbent") / _WEIGHTS, part)
    return {"kept": kept, "success": max(tried, known), "candidate": tried}


def _success(folder: Path) -> float:
    """Success of a deployed policy, or of one that was kept before."""
    manifest = read_manifest(folder)
    assert manifest is not None, f"{folder} is not finished"
    return float(manifest["result"]["success"])
