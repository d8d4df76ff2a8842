"""Stage that lets physics decide: of two policies, the newer one, unless its deployment says it got worse.

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
from pipeline.stages.given import Cfg, deployed_in

_WEIGHTS = "weights.safetensors"
# By how many standard errors the newer policy must have succeeded less often. Deployments are short and RL
# mostly gains: whoever takes the better count goes back to the older policy by chance too often.
_DOUBT = 1.0


@stage(reads=())
def keep(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The policy `candidate`, unless it succeeded less often than the `incumbent` by more than one standard
    error of the difference, by their deployments `tried` and `known`.

    Returns:
        Whether the candidate was kept, how often it succeeded (candidate) and the kept one (success), in how
        many episodes the kept one was tried, and in which round.
    """
    tried, known = (_deployment(inputs.folder(role)) for role in ("tried", "known"))
    kept = not got_worse(tried, known)
    with atomic(folder / _WEIGHTS) as part:
        shutil.copyfile(inputs.folder("candidate" if kept else "incumbent") / _WEIGHTS, part)
    success, episodes = tried if kept else known
    found = {"kept": kept, "success": success, "episodes": episodes, "candidate": tried[0]}
    return {**found, "round": deployed_in(inputs, "tried" if kept else "known")}


def got_worse(tried: tuple[float, int], known: tuple[float, int]) -> bool:
    """Whether the first (success rate, episodes) lies more than one standard error below the second."""
    (new, some), (old, others) = tried, known
    if not some or not others:
        return not some
    pooled = (new * some + old * others) / (some + others)
    return old - new > _DOUBT * (pooled * (1 - pooled) * (1 / some + 1 / others)) ** 0.5


def _deployment(folder: Path) -> tuple[float, int]:
    """Success rate and episodes of a deployed policy, or of one that was kept before."""
    manifest = read_manifest(folder)
    assert manifest is not None, f"{folder} is not finished"
    return float(manifest["result"]["success"]), int(manifest["result"]["episodes"])
