"""Live experiment tracking: what stages append to metrics.jsonl and media/ goes to one wandb run as it comes,
and so does what they learn in parts, by the part's folder (imitation-perception).

metrics.jsonl is always written, by the stages themselves, in whatever process they run. A tracker only reads
along, so it works for every placement, and a run without it costs nothing: wandb is not even imported.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import uuid
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from envs.files import write_json

_PERIOD = 2.0  # seconds between looks at a stage's files
_STATE = "wandb.json"  # in the run's folder: the run's id, and the last row and the videos already sent


class Tracker(Protocol):
    """What the graph tells of the stages that it runs."""

    def follow(self, name: str, folder: Path) -> AbstractContextManager[None]:
        """Within, whatever the stage writes to metrics.jsonl and media/ is tracked as it comes."""
        ...

    def catch_up(self, name: str, folder: Path) -> None:
        """Track what a finished stage wrote and nobody has tracked yet."""
        ...

    def summarise(self, result: Mapping[str, Any]) -> None:
        """Track the figures of the whole run."""
        ...


class NullTracker:
    """Tracks nothing."""

    def follow(self, name: str, folder: Path) -> AbstractContextManager[None]:
        """Do nothing."""
        return contextlib.nullcontext()

    def catch_up(self, name: str, folder: Path) -> None:
        """Do nothing."""

    def summarise(self, result: Mapping[str, Any]) -> None:
        """Do nothing."""


@contextlib.contextmanager
def tracking(cfg: Mapping[str, Any], root: Path) -> Iterator[Tracker]:
    """The tracker that track.wandb asks for: offline, online or disabled.

    One wandb run per worldloop run: its id is kept in `root`, so an interrupted run goes on in it. Offline
    runs are seen with `wandb leet` and sent with `wandb sync`.

    Args:
        cfg: the resolved config.
        root: the run's folder, where wandb keeps its files.
    """
    if cfg["track"]["wandb"] == "disabled":
        yield NullTracker()
        return
    tracker = WandbTracker(cfg, root)
    try:
        yield tracker
    finally:
        tracker.close()


class WandbTracker:
    """One wandb run, fed by reading along in the folders of stages.

    Args:
        cfg: the resolved config.
        root: the run's folder.
    """

    def __init__(self, cfg: Mapping[str, Any], root: Path):
        os.environ.setdefault("WANDB_SILENT", "true")
        import wandb

        root.mkdir(parents=True, exist_ok=True)
        self._file = root / _STATE
        state = json.loads(self._file.read_text()) if self._file.exists() else {}
        self._rows: dict[str, int] = state.get("rows", {})  # per stage: the last step sent
        self._videos: set[str] = set(state.get("videos", []))
        self._video = wandb.Video
        self._run = wandb.init(
            project=cfg["track"]["project"],
            name=f"{cfg['name']}-seed{cfg['seed']}",
            id=state.get("id") or uuid.uuid4().hex[:8],
            resume="allow" if cfg["track"]["wandb"] == "online" else None,
            dir=str(root),
            config=dict(cfg),
            mode=cfg["track"]["wandb"],
            settings=wandb.Settings(console="off", x_disable_stats=True),
        )
        self._remember()

    @property
    def folder(self) -> Path:
        """Where wandb writes this run."""
        return Path(self._run.dir).parent

    @contextlib.contextmanager
    def follow(self, name: str, folder: Path) -> Iterator[None]:
        """Read along while a stage runs."""
        over = threading.Event()

        def tail() -> None:
            while not over.wait(_PERIOD):
                self.catch_up(name, folder)

        thread = threading.Thread(target=tail, name=f"track-{name}", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            self.catch_up(name, folder)

    def catch_up(self, name: str, folder: Path) -> None:
        """Send the rows and videos of a stage that were not sent yet; trouble with wandb stops no stage."""
        try:
            sent = self._send_rows(name, folder / "metrics.jsonl") + self._send_videos(name, folder / "media")
            for path in sorted(folder.glob("*/metrics.jsonl")):  # of what a stage learns in parts
                sent += self._send_rows(f"{name}-{path.parent.name}", path)
            if sent:
                self._remember()
        except Exception as error:  # tracking must never cost a run
            tqdm.write(f"track: {name}: {error}")

    def summarise(self, result: Mapping[str, Any]) -> None:
        """Put the figures of the whole run into the run's summary."""
        self._run.summary.update(
            {key: value for key, value in result.items() if isinstance(value, (str, int, float, dict))}
        )

    def close(self) -> None:
        """End the wandb run."""
        self._run.finish()

    def _send_rows(self, name: str, path: Path) -> int:
        last, sent = self._rows.get(name, -1), 0
        for row in read_metrics(path):
            step = int(row["step"])
            if step <= last:
                continue
            if last < 0 and not sent:
                self._run.define_metric(f"{name}/*", step_metric=f"{name}/step")
            self._run.log({f"{name}/{key.split('/')[-1]}": value for key, value in row.items()})
            self._rows[name], sent = step, sent + 1
        return sent

    def _send_videos(self, name: str, folder: Path) -> int:
        new = [path for path in sorted(folder.glob("*.mp4")) if f"{name}/{path.name}" not in self._videos]
        for path in new:
            what, _, step = path.stem.partition("-step")  # of one thing, again and again while it learns
            row = {f"videos/{name}/{what}": self._video(str(path), format="mp4")}
            self._run.log(row | ({f"{name}/step": int(step)} if step else {}))
            self._videos.add(f"{name}/{path.name}")
        return len(new)

    def _remember(self) -> None:
        write_json(self._file, {"id": self._run.id, "rows": self._rows, "videos": sorted(self._videos)})


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.jsonl, [] if there is none; a last row that is still being written is left out."""
    if not path.exists():
        return []
    text = path.read_text()
    complete = text[: text.rfind("\n") + 1]
    return [json.loads(line) for line in complete.splitlines()]
