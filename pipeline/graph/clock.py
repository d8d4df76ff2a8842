"""How long a stage has been worked on, over all attempts, killed ones included."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from envs.files import write_json


class WorkClock:
    """Counts the seconds of this attempt and of earlier ones; a context manager.

    An attempt that was killed could not say how long it was; the last change of a file in its folder does.

    Args:
        folder: of the stage; `seconds.json` in it is removed once an attempt succeeds.
    """

    def __init__(self, folder: Path):
        self.folder, self.path = folder, folder / "seconds.json"
        self.earlier, self._began = 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Of all attempts so far."""
        return self.earlier + time.time() - self._began

    def __enter__(self) -> WorkClock:
        known: dict[str, Any] = {"spent": 0.0, "since": None}
        if self.path.exists():
            known = json.loads(self.path.read_text())
        self.earlier = known["spent"]
        if known["since"] is not None:
            touched = [path.stat().st_mtime for path in self.folder.rglob("*") if path.is_file()]
            self.earlier += max(0.0, max(touched, default=0.0) - known["since"])
        self._began = time.time()
        write_json(self.path, {"spent": self.earlier, "since": self._began})
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self.path.unlink()
            return
        with contextlib.suppress(OSError):  # a full disk must not hide what went wrong
            write_json(self.path, {"spent": self.seconds, "since": None})
