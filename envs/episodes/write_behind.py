"""Writing shards of episodes while the next ones are being made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.writer import LeRobotWriter


class WriteBehind:
    """A LeRobotWriter in a thread of its own, one shard at a time; what fails there is raised by the next
    call, or at the end.

    Args:
        writer: writes the shards, in the order of the calls.
        after: called when one is there, in that thread.

    Examples:
        >>> with WriteBehind(writer) as behind:
        ...     for batch in batches:
        ...         behind.write(episodes(batch))
    """

    def __init__(self, writer: LeRobotWriter, after: Callable[[], object] = lambda: None):
        self.writer, self.after = writer, after
        self._thread = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None

    def write(self, episodes: Sequence[Episode]) -> None:
        """Begin to write a shard; waits for the one before."""
        self._wait()
        self._pending = self._thread.submit(self._write, episodes)

    def _write(self, episodes: Sequence[Episode]) -> None:
        self.writer.write(episodes)
        self.after()

    def _wait(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def __enter__(self) -> WriteBehind:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish what was begun, whatever happened meanwhile."""
        try:
            self._wait()
        finally:
            self._thread.shutdown()
