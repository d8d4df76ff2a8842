"""Experiment tracking: metrics.jsonl is always there; wandb, offline by default, shows it with videos."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.evaluation.report import read_metrics


def publish(
    cfg: Mapping[str, Any], stages: Mapping[str, Path], result: Mapping[str, Any], root: Path
) -> Path | None:
    """Write a finished run to wandb: every stage's metric rows, the result, the videos.

    Args:
        cfg: resolved config; track.wandb says offline, online or disabled.
        stages: folder of every stage.
        root: the run's folder, where wandb keeps its files.

    Returns:
        Folder of the wandb run, or None if disabled. Offline ones are seen with `wandb leet` or sent with
        `wandb sync`.
    """
    mode = cfg["track"]["wandb"]
    if mode == "disabled":
        return None
    os.environ.setdefault("WANDB_SILENT", "true")
    import wandb

    run = wandb.init(
        project=cfg["track"]["project"],
        name=f"{cfg['name']}-seed{cfg['seed']}",
        dir=str(root),
        config=dict(cfg),
        mode=mode,
        settings=wandb.Settings(console="off", x_disable_stats=True),
    )
    for stage, folder in stages.items():
        step_key = f"{stage}/step"
        run.define_metric(f"{stage}/*", step_metric=step_key)
        rows = read_metrics(folder)
        for row in rows[:: max(1, len(rows) // 500)]:
            run.log({f"{stage}/{key.split('/')[-1]}": value for key, value in row.items()})
    for path in sorted((stages["videos"] / "media").glob("*.mp4")):
        run.log({f"videos/{path.stem}": wandb.Video(str(path), format="mp4")})
    run.summary.update(
        {key: value for key, value in result.items() if isinstance(value, (str, int, float, dict))}
    )
    folder = Path(run.dir).parent
    run.finish()
    return folder
