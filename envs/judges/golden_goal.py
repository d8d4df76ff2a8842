"""The golden-goal reward of RoboScape-R: a text world imagines how the task ends, and frames are measured by
how near they come to that.

At reset the text world goes on from the first frame as the instruction says until it says that the task is
done; that frame is the goal. Progress is dense, by a perceptual distance to the goal; success is sparse, by
the text world's own word on each frame. What they are worth is judge.rewards; the paper pays likeness itself
in every step, ours pays what was gained of it, so that nobody earns by waiting near the goal.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, Literal

import torch
from torch import Tensor

from envs.judges.goal import GoalJudge, Goals
from envs.ranges import Count, Share
from envs.specs import Status, WorldSpec
from envs.targets import build

_AT_ONCE = 64  # goals imagined, or frames asked about, in one pass


class Fallback(str, Enum):
    """What becomes of an episode whose text world never says done.

    DROP: no judgement; the episode is dropped and counted. LAST_FRAME: the last imagined frame is the goal.
    PROGRESS_ONLY: so it is, and no frame counts as success.
    """

    DROP = "drop"
    LAST_FRAME = "last_frame"
    PROGRESS_ONLY = "progress_only"


class GoldenGoalJudge(GoalJudge):
    """See the module's docstring. The text world is the judge's own, and is trained apart.

    A goal hangs on the first frame and the instruction alone, its noise included: it is imagined once and
    remembered.

    Args:
        spec, hold, threshold, metric, cameras: see GoalJudge.
        text_world: `_target_` and options of a text world (simulators/tokens/text_world.py).
        fallback: see Fallback.
        cache: goals remembered.
    """

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        threshold: Share,
        metric: Mapping[str, Any],
        cameras: str | Sequence[str],
        text_world: Mapping[str, Any],
        fallback: Literal["drop", "last_frame", "progress_only"],
        cache: Count,
    ):
        super().__init__(spec, hold, threshold, metric, cameras)
        self.text_world = build(text_world, "judge.text_world", spec=spec)
        self.text_world.requires_grad_(False)
        self.fallback, self.room = Fallback(fallback), cache
        self.imagined = self.unfinished = 0
        self._known: OrderedDict[bytes, tuple[Tensor, bool]] = OrderedDict()
        self.text_world.register_load_state_dict_post_hook(self._forget)

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See Judge.check: what metric and words need is there."""
        super().check(options)
        if words := options["text_world"].get("words"):
            build(words, "judge.text_world.words")

    @classmethod
    def remedy(cls, options: Mapping[str, Any]) -> str:
        """See Judge.remedy."""
        ending, fallback = options["text_world"].get("ending", {}), options["fallback"]
        told = {key: "null" if value is None else value for key, value in ending.items()}
        settings = ", ".join(f"judge.text_world.ending.{key}={value}" for key, value in told.items())
        others = f"judge.fallback={Fallback.LAST_FRAME.value} or {Fallback.PROGRESS_ONLY.value}"
        more = f", change these, or set {others}" if fallback == Fallback.DROP.value else " or change these"
        return (
            f"its text world does not say in the goals it imagines that the task is done ({settings}), and"
            f" judge.fallback={fallback}: train it longer (text_world_fit){more}"
        )

    def goals(self, first: Tensor, instruction: list[str]) -> Goals:
        """See GoalJudge.goals; imagines those that are not remembered."""
        keys = [_digest(*pair) for pair in zip(first, instruction, strict=True)]
        found = {key: self._known[key] for key in dict.fromkeys(keys) if key in self._known}
        rows = list({key: row for row, key in enumerate(keys) if key not in found}.values())
        for begin in range(0, len(rows), _AT_ONCE):
            some = rows[begin : begin + _AT_ONCE]
            # From the content alone: whoever asks about the same episode gets the same goal.
            seeds = torch.tensor([int.from_bytes(keys[row][:5], "big") for row in some])
            texts = [instruction[row] for row in some]
            ends, finished = self.text_world.imagine_goals(first[some], texts, seeds)
            for row, end, ended in zip(some, ends, finished.tolist(), strict=True):
                found[keys[row]] = (end.clone(), ended)
                self.imagined += 1
                self.unfinished += not ended
        for key, goal in found.items():
            self._known[key] = goal
            self._known.move_to_end(key)
        while len(self._known) > self.room:
            self._known.popitem(last=False)
        frames = torch.stack([found[key][0] for key in keys])
        return Goals(
            frames.to(first.device), torch.tensor([found[key][1] for key in keys], device=first.device)
        )

    def as_goals(self, frames: Tensor) -> Tensor:
        """See GoalJudge.as_goals: through the text world's tokenizer, out of which goals come. As they are,
        even the goal's own frame would be as far away as the tokenizer errs.
        """
        return self.text_world.redraw(frames) if hasattr(self.text_world, "redraw") else frames

    def done(
        self, frames: Tensor, instruction: list[str], progress: Tensor, features: Tensor | None = None
    ) -> Tensor:
        """See GoalJudge.done: what the text world says of each frame by itself, so that it hangs on no cut of
        the video; progress, if it says nothing.
        """
        if not hasattr(self.text_world, "done"):
            return progress
        count = frames.shape[1]
        texts = [text for text in instruction for _ in range(count)]
        rows, done = frames.flatten(0, 1)[:, None], []
        for begin in range(0, len(rows), _AT_ONCE):
            some = slice(begin, begin + _AT_ONCE)
            done.append(self.text_world.done(rows[some], texts[some])[:, 0])
        return torch.cat(done).unflatten(0, (-1, count))

    def unknown(self, success: Tensor, status: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """See GoalJudge.unknown; as `fallback` says."""
        if self.fallback is Fallback.PROGRESS_ONLY:
            return torch.where(known[:, None] | ~torch.isfinite(success), success, 0.0), status
        if self.fallback is Fallback.DROP:
            return success, torch.where(known | (status != Status.OK.value), status, Status.ABSTAIN.value)
        return success, status

    def facts(self) -> dict[str, Any]:
        """See Judge.facts: also by what success is told, how many goals were imagined here, in how many of
        them the text world never said done, and above what they end.
        """
        source = "done" if hasattr(self.text_world, "done") else "likeness"
        ending = getattr(self.text_world, "threshold", None)
        ending = None if ending is None else float(ending)
        counted = {"goals": self.imagined, "goals_unfinished": self.unfinished, "ending_threshold": ending}
        return {**super().facts(), "success_by": source, "fallback": self.fallback.value, **counted}

    def train(self, mode: bool = True) -> GoldenGoalJudge:
        """As of any module, but the text world stays as it is used."""
        super().train(mode)
        self.text_world.eval()
        return self

    def _forget(self, *_: Any) -> None:
        """Other weights imagine other goals."""
        self._known.clear()


def _digest(first: Tensor, instruction: str) -> bytes:
    """Of a first frame uint8 [V, 3, H, W] and an instruction."""
    digest = hashlib.blake2b(instruction.encode(), digest_size=16)
    digest.update(first.cpu().contiguous().numpy().tobytes())
    return digest.digest()
