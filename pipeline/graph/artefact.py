"""An artefact is a folder: config.yaml, manifest.json, weights.safetensors, metrics.jsonl, media/.

The manifest is written last, so a folder without one is unfinished work. It holds a hash of every file beside
it: one that has changed since is told before anything is built on it.
"""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from safetensors.torch import save_file
from torch import nn

from envs.files import atomic, write_text
from envs.manifest import write_manifest
from learners.training.parallel import leads
from pipeline.graph.code_version import digest

_PACKAGES = ("worldloop", "torch", "torchrl", "tensordict", "numpy", "mujoco")


def save_weights(module: nn.Module, folder: Path, name: str = "weights") -> Path:
    """Write a module's state as safetensors; of several workers that hold it, the leading one writes."""
    if not leads():
        return folder / f"{name}.safetensors"
    path = folder / f"{name}.safetensors"
    tensors = {key: value.detach().cpu().contiguous().clone() for key, value in module.state_dict().items()}
    with atomic(path) as part:
        save_file(tensors, part)
    return path


def versions() -> dict[str, str]:
    """Versions of the packages that results depend on, and of this code."""
    out = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = "not installed"
    root = Path(__file__).resolve().parents[2]
    commit = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    out["commit"] = commit.stdout.strip() or "unknown"
    return out


@dataclass(frozen=True)
class Identity:
    """All that an artefact's key is made of.

    Left out on purpose: `launch`, which decides who computes and not what comes out; the kind of machine and
    the versions of libraries, which move last bits only and stand in the manifest (an upgrade must not throw
    a day's training away); the run's name and its tracking.

    Args:
        stage: the node's name.
        config: hash of every config section that it reads, by dotted path, and of the files that its options
            name (outside.option_files).
        settings: plain values that tell it from other nodes of the same stage.
        parents: keys of the nodes that it builds on, by name.
        roles: names of those nodes, by the role they play.
        code: hash of every source file behind it, by path.
    """

    stage: str
    config: Mapping[str, str]
    settings: Mapping[str, Any]
    parents: Mapping[str, str]
    roles: Mapping[str, list[str]]
    code: Mapping[str, str]

    @cached_property
    def key(self) -> str:
        """Twelve hexadecimal digits; equal for equal identities."""
        return digest(json.dumps(asdict(self), sort_keys=True))

    def changed(self, older: Mapping[str, Any]) -> str:
        """In words, what differs from an older artefact's identity of the same node."""
        reasons = []
        for kind, mine in (
            ("config", self.config),
            ("settings", self.settings),
            ("stages", self.parents),
            ("code", self.code),
        ):
            theirs = older.get({"stages": "parents"}.get(kind, kind), {})
            names = [name for name in sorted({*mine, *theirs}) if mine.get(name) != theirs.get(name)]
            if names:
                more = f" and {len(names) - 3} more" if len(names) > 3 else ""
                reasons.append(f"{kind} {', '.join(names[:3])}{more}")
        if not reasons and dict(self.roles) != older.get("roles"):
            reasons.append("the roles of its inputs")
        return f"changed since it last ran: {'; '.join(reasons)}" if reasons else ""


def finish(
    folder: Path, identity: Identity, config: Mapping[str, Any], seconds: float, result: Mapping[str, Any]
) -> dict[str, Any]:
    """Write config.yaml and, last, manifest.json; returns the manifest.

    Args:
        config: the sections that the stage read, by dotted path.
    """
    nested = OmegaConf.create({})
    for path, value in config.items():
        OmegaConf.update(nested, path, value, force_add=True)
    write_text(folder / "config.yaml", OmegaConf.to_yaml(nested))
    manifest = {
        "stage": identity.stage,
        "key": identity.key,
        "parents": dict(identity.parents),
        "seconds": round(seconds, 2),
        "versions": versions(),
        "result": dict(result),
        "identity": asdict(identity),
    }
    return write_manifest(folder, manifest)
