"""Answers by the content of their questions, one small file each: nothing is paid for twice."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from envs.files import new_neighbour, remove, write_json
from envs.judges.vlm.chat import Question, Reply


class AnswerCache:
    """A folder of answers; any number of processes may share it.

    Args:
        folder: of judge.asking.cache.
    """

    def __init__(self, folder: Path):
        self.folder = folder / "answers"

    def key(self, question: Question, model: str, vote: int) -> str:
        """A hash of the words, every pixel, the model's name (Chat.name) and which vote it is. Where it is
        served is no part of it.
        """
        found = hashlib.sha256()
        for part in (question.text, model, str(vote)):
            found.update(f"{len(part)}:{part}".encode())
        for picture in question.pictures:
            found.update(str(picture.shape).encode())
            found.update(picture.tobytes())
        return found.hexdigest()

    def get(self, key: str) -> Reply | None:
        """The answer of a key, None if there is none."""
        try:
            kept = json.loads(self._path(key).read_text())
            return Reply(str(kept["text"]), int(kept["prompt_tokens"]), int(kept["completion_tokens"]))
        except (OSError, ValueError, KeyError, TypeError):  # a damaged one is asked for again, and replaced
            return None

    def put(self, key: str, reply: Reply) -> None:
        """Keep an answer, also where other processes put the same one meanwhile."""
        path = self._path(key)
        own = new_neighbour(path)
        try:
            write_json(own / path.name, vars(reply))
            (own / path.name).replace(path)
        finally:
            remove(own)

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.json"
