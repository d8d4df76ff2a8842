"""Pictures of tasks, also of those that nobody has scripted."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from pipeline.commands.task_pictures import draw


def test_of_a_task_without_an_expert_the_start_is_drawn(tmp_path: Path) -> None:
    suite = {"_target_": "tests.suites.counting.Scriptless", "fault": ""}
    (path,) = draw("mine", {"suite": suite, "name": "count", "horizon": 8}, tmp_path)
    with Image.open(path) as drawn:
        assert path.name == "mine-count.gif" and getattr(drawn, "n_frames", 1) < 8
