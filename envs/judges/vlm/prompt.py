"""Questions in words: a text file with a few fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template

from envs.targets import ConfigError, nearest

_FOLDER = Path(__file__).parent / "prompts"
_FIELDS = ("instruction", "count", "cameras")


def text_file(folder: Path, name: str, key: str) -> Path:
    """The text file that a config key names: `name`.txt of a folder of ours, or a path.

    Raises:
        ConfigError: if there is none.
    """
    own = folder / f"{name}.txt"
    path = own if own.is_file() else Path(name)
    if not path.is_file():
        known = [file.stem for file in folder.glob("*.txt")]
        raise ConfigError(f"{key}={name} is no text file, and no prompt of that name{nearest(name, known)}")
    return path


def prompt_file(name: str) -> Path:
    """The file that judge.prompt names: one of the folder prompts/ beside this file, or a path.

    Raises:
        ConfigError: if there is none.
    """
    return text_file(_FOLDER, name, "judge.prompt")


class Prompt:
    """A prompt with the fields $instruction, $count (pictures after the first) and $cameras (a sentence on
    what stands where in each picture, or nothing).

    Args:
        name: see prompt_file.
        cameras: their names as they stand in each picture, from left to right.

    Raises:
        ConfigError: if there is no such file, it does not say $instruction, or has other fields.
    """

    def __init__(self, name: str, cameras: Sequence[str]):
        path = prompt_file(name)
        self._template = Template(path.read_text())
        marks = list(Template.pattern.finditer(self._template.template))
        found = {mark["named"] or mark["braced"] or "" for mark in marks if mark["escaped"] is None}
        if "instruction" not in found or found - set(_FIELDS):
            raise ConfigError(
                f"judge.prompt={name}: {path} must say $instruction, and may say $count and $cameras; found"
                f" {sorted(f'${field}' for field in found)} (a plain $ is written $$)"
            )
        several = f" Each picture shows {len(cameras)} cameras side by side, from left to right: "
        self._cameras = f"{several}{', '.join(cameras)}." if len(cameras) > 1 else ""

    def __call__(self, instruction: str, count: int) -> str:
        """The words of a question with `count` pictures after the first."""
        return self._template.substitute(instruction=instruction, count=count, cameras=self._cameras)
