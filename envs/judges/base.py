"""The contract of a judge (reward model), and how judgements on frames become an episode's success."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.files import named_files
from envs.specs import Status
from envs.targets import ConfigError

if TYPE_CHECKING:
    from envs.simulators.base import Simulator


class JudgeError(RuntimeError):
    """A judge cannot go on, and asking it again would not help: its budget is spent, or nobody is there.

    The run stops; the message names the config key and the fix.
    """


class Judgement(NamedTuple):
    """What a judge says of clips.

    success float32 [B, T] in 0..1, the probability that the task is done in a frame; progress float32 [B, T]
    in 0..1; status int64 [B] (specs.Status). Where the status is not OK the numbers mean nothing.
    """

    success: Tensor
    progress: Tensor
    status: Tensor


_SLACK = 1e-4  # by which rounding may carry a probability beyond 0..1
_STATUS = tuple(status.value for status in Status)


class MissingFeatures(ValueError):
    """A judge that reads a simulator's features was shown video that has none."""


def features_of_all(features: Tensor | None, frames: int, chunk: int, judge: str, otherwise: str) -> Tensor:
    """Features [B, C, D], if they are those of so many frames in chunks of `chunk`.

    Args:
        judge, otherwise: who reads them, and who does not, for the message.

    Raises:
        MissingFeatures: if some are missing.
    """
    if features is None or features.shape[1] * chunk < frames:
        raise MissingFeatures(
            f"judge={judge} reads the simulator's features of every chunk, and of these {frames} frames it"
            f" was given {'none' if features is None else f'{features.shape[1]} chunks'}; recordings have"
            f" them where a simulator can be run on their actions. Choose another judge, such as"
            f" judge={otherwise}, for video without"
        )
    return features


class Judge(nn.Module):
    """Scores video against an instruction; subclasses implement `score`, and `loss` if they learn.

    Args:
        hold: frames in a row that must count as success before the episode does.
        threshold: probability from which a frame counts as success; calibration sets it later.

    Attributes:
        needs_labels: whether it is taught by recorded success, and cannot do without.
        reads_features: whether `score` must be given the simulator's features of the frames.
        asks_world: whether what the simulator says of a task's end decides (Simulator.says_done).
        reads_instruction: whether its scores depend on the words; one that is blind to them cannot tell tasks
            apart.
        discount: per frame, of the progress that `loss` is given: discount ** (frames until success).
        calibrates: whether the threshold is to be set on recorded video (learners/stages/judge.py).
        charges: whether each clip costs, and is judged apart from the others; those of episodes that have
            succeeded are then spared.
        rehearsed: whether one may be built before any work, to see that it can; not where that is dear.

    Raises:
        ValueError: if hold is less than one frame.
    """

    threshold: Tensor
    rehearsed = True
    needs_labels = False
    reads_features = False
    asks_world = False
    reads_instruction = True
    discount = 1.0
    calibrates = True
    charges = False

    def __init__(self, hold: int, threshold: float = 0.5):
        super().__init__()
        if hold < 1:
            raise ValueError(f"judge.hold={hold} must be at least 1 frame")
        self.hold = hold
        self.register_buffer("threshold", torch.tensor(threshold))

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """Judge clips.

        Args:
            frames: uint8 [B, T, V, 3, H, W].
            first: uint8 [B, V, 3, H, W], the first frame of each episode.
            instruction: B texts.
            features: float32 [B, C, D], the pooled features (simulators/features.py) of the C chunks that the
                frames make up, the last of which may be cut; only given to a judge that `reads_features`.
        """
        raise NotImplementedError

    def loss(self, data: TensorDict) -> tuple[Tensor, dict[str, Any]]:
        """Training loss and figures to log; a judge without weights of its own has none.

        Args:
            data: TensorDict [N] of frames, with label float32 in {0, 1} and progress float32 in 0..1, both
                NaN where nobody labelled the episode (such frames teach nothing), and text uint8
                [N, TEXT_BYTES]; frames and first uint8 [N, V, 3, H, W], or, for a judge that
                `reads_features`, features float32 [N, D] of the frame's chunk and offset int64 [N], its
                place in that chunk.
        """
        raise NotImplementedError

    def attach(self, simulator: Simulator) -> None:
        """Take over from the simulator whose video it shall judge what it needs of it; here nothing. Asked
        before it is calibrated, and again whenever the simulator has learned.
        """

    def facts(self) -> dict[str, Any]:
        """Numbers and texts that results say of the judge, such as what it measures by and how often it
        could not.
        """
        return {}

    def submit(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Any:
        """Hand clips over (see `score`) and get a ticket for `fetch`.

        A judge in another process works meanwhile; one in this process puts it off until then.
        """
        return (frames, first, instruction, *([] if features is None else [features]))

    def fetch(self, ticket: Any) -> Judgement:
        """The judgement on what `submit` was given."""
        return ask(self, *ticket)

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See that a judge of these options (section judge) can work here, before hours are spent on others.

        Raises:
            ConfigError: naming the key and the fix.
        """

    @classmethod
    def remedy(cls, options: Mapping[str, Any]) -> str:
        """What to change, and why, where a judge of these options gives no judgement on episode after
        episode; names keys.
        """
        return "choose another judge (judge=...)"

    @classmethod
    def files(cls, options: Mapping[str, Any]) -> tuple[Path, ...]:
        """Files whose contents decide judgements, by options, however deep, that name one or a folder, whose
        own files count: when they change, what was made with the judge is out of date.
        """
        return tuple(path for value in _texts(options) for path in named_files(value))

    @classmethod
    def decisive(cls, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """The part of the options (section judge) that decides judgements; when any of the others changes,
        what was made with the judge stays as it is.
        """
        return options

    @classmethod
    def spent(cls, options: Mapping[str, Any]) -> dict[str, float]:
        """What judges of these options have asked for and paid so far, over all processes; {} if they are
        free.
        """
        return {}

    def streak(self, success: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Whether `hold` frames in a row were successes by the end of each frame.

        Args:
            success: [B, T] probabilities.
            before: int64 [B], length of the run of successes that precedes them.

        Returns:
            done bool [B, T], and the run at the end, int64 [B].
        """
        run, done = before, []
        for frame in (success >= self.threshold.to(success.device)).unbind(1):
            run = torch.where(frame, run + 1, 0)
            done.append(run >= self.hold)
        return torch.stack(done, 1), run

    def confidence(self, success: Tensor) -> Tensor:
        """The highest threshold [B] at which episodes of frame probabilities [B, T], 0 where they are over,
        count as successes: the least probability of the best run of `hold` frames.
        """
        short = self.hold - success.shape[1]
        padded = nn.functional.pad(success, (0, max(0, short)))
        return padded.unfold(1, self.hold, 1).amin(-1).amax(1)

    def episode(self, success: Tensor, valid: Tensor) -> Tensor:
        """Episode success bool [B] from frame probabilities [B, T]; frames exist where valid [B, T]."""
        masked = torch.where(valid, success, 0.0)
        done, _ = self.streak(masked, torch.zeros(len(success), dtype=torch.int64, device=success.device))
        return done.any(1)


def _texts(options: Any) -> Iterator[str]:
    """The texts among options, however deep."""
    if isinstance(options, str):
        yield options
    elif isinstance(options, (Mapping, list, tuple)):
        for value in options.values() if isinstance(options, Mapping) else options:
            yield from _texts(value)


def counted(judge: Judge) -> dict[str, int]:
    """What a judge has counted so far, such as goals, of its facts."""
    return {name: value for name, value in judge.facts().items() if type(value) is int}


def judgement_status(success: Tensor) -> Tensor:
    """Status int64 [B] of probabilities [B, T]: ERROR where one is not finite, OK elsewhere."""
    bad = ~torch.isfinite(success).all(1)
    return torch.where(bad, Status.ERROR.value, Status.OK.value)


def ask(judge: Judge, frames: Tensor, first: Tensor, instruction: list[str], *features: Tensor) -> Judgement:
    """A judge's judgement on clips (see Judge.score), held to its contract.

    Raises:
        JudgeError: if it raises an error of its own, or answers something else than a judgement on them.
    """
    try:
        judgement = judge.score(frames, first, instruction, *features)
    except (JudgeError, MissingFeatures, ConfigError):
        raise
    except Exception as error:
        step = traceback.extract_tb(error.__traceback__)[-1]
        raise JudgeError(
            f"judge: {type(judge).__name__}.score raised {type(error).__name__}: {error}"
            f" ({step.filename}, line {step.lineno})"
        ) from error
    return checked(judge, judgement, frames)


def checked(judge: Judge, judgement: Any, frames: Tensor) -> Judgement:
    """What a judge answered on frames [B, T, ...], if it is a Judgement as that class says; its numbers as
    float32 and int64.

    Raises:
        JudgeError: naming the judge's class and what is wrong.
    """
    says = f"judge: {type(judge).__name__}.score gives"
    if not isinstance(judgement, Judgement):
        raise JudgeError(f"{says} a {type(judgement).__name__}; give an envs.judges.base.Judgement")
    batch, count = frames.shape[:2]
    for name, value in judgement._asdict().items():
        due, kind = ((batch,), "int64") if name == "status" else ((batch, count), "float32")
        right = isinstance(value, Tensor) and tuple(value.shape) == due and value.dtype != torch.bool
        if not right or value.is_floating_point() != (kind == "float32"):
            found = (
                f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            )
            raise JudgeError(
                f"{says} {name} {found.removeprefix('torch.')} on {batch} clips of {count} frames; give"
                f" {kind} {list(due)}"
            )
    success, progress, status = judgement.success.float(), judgement.progress.float(), judgement.status.long()
    if not torch.isin(status, torch.tensor(_STATUS, device=status.device)).all():
        raise JudgeError(f"{says} status {status.tolist()[:8]}; each is one of envs.specs.Status, {_STATUS}")
    known = (status == Status.OK.value).unsqueeze(-1)
    for name, numbers in (("success", success), ("progress", progress)):
        odd = numbers[known.to(numbers.device) & ~((numbers >= -_SLACK) & (numbers <= 1 + _SLACK))]
        if len(odd):
            raise JudgeError(
                f"{says} {name} {float(odd[0]):.4g} where its status is OK; give 0..1 (of a logit"
                " its sigmoid, of percents a hundredth), or another status"
            )
    return Judgement(success, progress, status)
