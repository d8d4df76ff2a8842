"""An artefact is a folder: config.yaml, manifest.json, weights.safetensors, metrics.jsonl, media/.

The manifest is written last, so a folder without one is unfinished work.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from safetensors.torch import save_file
from torch import nn

from learners.training.parallel import leads

_PACKAGES = ("worldloop", "torch", "torchrl", "tensordict", "numpy", "mujoco")


def write_text(path: Path, text: str) -> None:
    """Write a file through a neighbour and a rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_text(text)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(
            f"cannot write {path}: {error.strerror}; free disk space and start again, finished stages are kept"
        ) from error
    os.replace(temporary, path)


def save_weights(module: nn.Module, folder: Path, name: str = "weights") -> Path:
    """Write a module's state as safetensors; of several workers that hold it, the leading one writes."""
    if not leads():
        return folder / f"{name}.safetensors"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.safetensors"
    temporary = folder / f".{name}.part"
    try:
        save_file(
            {key: value.detach().cpu().contiguous().clone() for key, value in module.state_dict().items()},
            temporary,
        )
    except Exception as error:
        temporary.unlink(missing_ok=True)
        raise OSError(
            f"cannot write {path}: {error}; free disk space and start again, finished stages are kept"
        ) from error
    os.replace(temporary, path)
    return path


def versions() -> dict[str, str]:
    """Versions of the packages that results depend on, and of this code."""
    out = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = "not installed"
    root = Path(__file__).resolve().parent.parent
    commit = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    out["commit"] = commit.stdout.strip() or "unknown"
    return out


def finish(
    folder: Path,
    stage: str,
    key: str,
    config: Mapping[str, Any],
    parents: Mapping[str, str],
    seconds: float,
    result: Mapping[str, Any],
) -> None:
    """Write config.yaml and, last, manifest.json."""
    write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(dict(config))))
    manifest = {
        "stage": stage,
        "key": key,
        "parents": dict(parents),
        "seconds": round(seconds, 2),
        "versions": versions(),
        "result": dict(result),
    }
    write_text(folder / "manifest.json", json.dumps(manifest, indent=1, default=float))


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a finished artefact, or None."""
    path = folder / "manifest.json"
    if not path.exists():
        return None
    return dict(json.loads(path.read_text()))
