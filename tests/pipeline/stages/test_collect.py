"""What is said of scripted experts that fail while data are collected."""

from __future__ import annotations

from pathlib import Path

from pipeline.config import load_config
from pipeline.loop import build_loop


def test_an_expert_that_fails_is_an_alarm_with_videos(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "track=disabled", "task.horizon=4"])  # too short for anybody
    graph = build_loop(cfg, tmp_path)
    made = graph.run("collect")["collect"]["result"]
    assert made["expert_failures"] and f"push {len(made['expert_failures'])} of " in made["alarm"]
    films = list((graph.folder("collect") / "media").glob("expert-push-*.mp4"))
    assert 1 <= len(films) <= 3 and all(film.stat().st_size for film in films)
