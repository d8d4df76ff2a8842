"""Task sections of configs/ for tests, small, and table tops that somebody tampers with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from envs.physics.suite import Array, task_names
from envs.physics.tabletop.suite import Tabletop
from envs.targets import ConfigError
from tests.sections import CONFIGS, offered


def task_section(choice: str, **changes: Any) -> dict[str, Any]:
    """A task of configs/task, with small pictures and with options of its suite changed."""
    cfg = _load(choice)
    cfg.size = [24, 32]
    cfg.starts = "all"  # what configs/config.yaml says
    cfg.suite = {**cfg.suite, **changes}
    section = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(section, dict)
    del section["starts"]
    return section  # type: ignore[return-value]


def physical_tasks() -> dict[str, dict[str, Any]]:
    """Every task that choices of configs/task with a suite play, and push commanded by joints, by name."""
    known = [name for name in offered("task") if _load(name).suite is not None]
    out = {"push-joints": task_section("push", actions="joints")}
    for choice in known:
        section = task_section(choice)
        names = task_names(section["name"])
        for name in names:
            key = choice if len(names) == 1 else f"{choice}-{name}"
            out[key] = {**section, "name": name}
    return out


def _load(choice: str) -> DictConfig:
    cfg = OmegaConf.load(CONFIGS / "task" / f"{choice}.yaml")
    assert isinstance(cfg, DictConfig)
    return cfg


class Solved(Tabletop):
    """The table top, whose block is put where it belongs before the first action."""

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.put = False

    def step(self, action: Array) -> None:
        goal, data = self._bench.goal, self._bench.data
        if not self.put:
            data.qpos[goal.joint : goal.joint + 2], self.put = goal.target, True
        super().step(action)


class Stopped(Solved):
    """The same, with the seeds that it lays out in a file, a line each; it refuses another while there is a
    file `stop` beside that, which holds their number.
    """

    def __init__(self, laid_out: str, **options: Any):
        super().__init__(**options)
        self.laid_out = Path(laid_out)

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        stop, lines = self.laid_out.with_name("stop"), self.laid_out.read_text().split()
        if stop.exists() and len(lines) == int(stop.read_text()):
            raise ConfigError("stopped, as asked")
        self.laid_out.write_text("\n".join([*lines, str(seed)]))
