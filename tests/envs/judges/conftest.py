"""A chat server, and judges that ask it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envs.judges.vlm import VLMJudge
from envs.targets import build
from tests.envs.judges.chat_server import MODEL, ChatServer, serving
from tests.envs.judges.vlm_clips import SPEC, Make
from tests.sections import merged, section


@pytest.fixture
def server() -> Iterator[ChatServer]:
    """A server whose model sees the square."""
    with serving() as chat:
        yield chat


@pytest.fixture
def options(server: ChatServer, tmp_path: Path) -> dict[str, Any]:
    """The section judge for that server, in a hurry."""
    quick = {"cache": str(tmp_path / "cache"), "deadline_s": 20.0, "retries": 2, "pause_s": 0.01}
    found = section("judge/vlm", chat={"url": server.url, "model": MODEL}, asking=quick, pictures={"side": 0})
    found.pop("rewards")
    return found


@pytest.fixture
def make(options: dict[str, Any]) -> Make:
    """Makes a judge with other options."""

    def judge(**changes: Any) -> VLMJudge:
        return build(merged(options, changes), "judge", spec=SPEC)  # type: ignore[no-any-return]

    return judge
