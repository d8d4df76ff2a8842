"""worldloop doctor: what this machine has, what is missing, and the line to type for it."""

from __future__ import annotations

import os
import platform
import shutil
from importlib.metadata import PackageNotFoundError, version

import torch

_NEEDED = (
    "torch",
    "torchrl",
    "tensordict",
    "mujoco",
    "av",
    "pyarrow",
    "hydra-core",
    "ray",
    "wandb",
    "opencv-python-headless",
    "matplotlib",
    "scipy",
    "jinja2",
)


def examine() -> int:
    """Print the findings; returns 0 if quickstart would run."""
    fine = True

    def report(good: bool, what: str, fix: str = "") -> None:
        nonlocal fine
        fine &= good
        print(f"[{'ok' if good else 'NO'}] {what}" + (f"\n     {fix}" if fix and not good else ""))

    report(
        True,
        f"{platform.system()} {platform.release()}, Python {platform.python_version()},"
        f" {os.cpu_count()} cores",
    )
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    report(memory >= 6, f"{memory:.0f} GiB of memory", "quickstart needs about 6 GiB")
    free = shutil.disk_usage(".").free / 2**30
    report(free >= 4, f"{free:.0f} GiB of disk free here", "quickstart needs about 4 GiB")
    for package in _NEEDED:
        try:
            report(True, f"{package} {version(package)}")
        except PackageNotFoundError:
            report(False, f"{package} is missing", "make setup")
    if torch.cuda.is_available():
        report(True, f"GPU: {torch.cuda.get_device_name()}")
    else:
        print("[--] no GPU; everything runs on the CPU")
    try:
        from envs.physics.suite import build_suite
        from pipeline.config import load_config

        task = load_config([])["task"]
        suite = build_suite(task["suite"])
        suite.reset(task["name"], 0)
        report(
            int(suite.render().max()) > 0,
            f"OpenGL renders (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'egl')})",
            "the picture is black: try MUJOCO_GL=osmesa",
        )
    except Exception as error:  # whatever is wrong with the driver, the doctor's work is to say so
        report(False, "OpenGL", str(error))
    print("\nready: make quickstart" if fine else "\nnot ready: see the lines marked NO")
    return 0 if fine else 1
