"""The forward path's second half, where a reward is decided: the judge watches the chunk and writes reward
and done.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from envs.judges.base import Judge, Judgement, ask
from envs.simulators.features import pooled
from envs.specs import FEATURES, FRAMES, IMAGE, JUDGE_STATUS, PROGRESS, SUCCESS, Rewards, Status


class JudgeReward(Transform):
    """Success, progress and reward of imagined video; the frames themselves stay behind.

    A judgement that is not OK ends the episode and is written to `judge_status`, by which learners drop and
    count it. At resets the judge is asked how far the task is, unless progress is worth nothing: to some
    judges every question costs.

    Args:
        judge: scores frames.
        rewards: turns progress and success into a number.
        later: do not wait for judgements. Episodes then run to their horizon, and `settle` writes rewards and
            ends into the finished rollout; what a slot did after its success belongs to no episode.

    Attributes:
        counted: frames of the next steps that are judged, the first ones; None means all. What comes after
            them did not happen.
    """

    def __init__(self, judge: Judge, rewards: Rewards, later: bool = False):
        super().__init__(in_keys=[FRAMES], out_keys=["reward", SUCCESS, PROGRESS, JUDGE_STATUS])
        self.judge, self.rewards, self.later = judge, rewards, later
        self.counted: int | None = None
        self._tickets: list[Any] = []
        self._opening = (torch.zeros(0, 1), torch.zeros(0, dtype=torch.int64))
        self._run = torch.zeros(0, dtype=torch.int64)
        self._won = torch.zeros(0, dtype=torch.bool)
        self._progress = torch.zeros(0, 1)
        self._begun = torch.zeros(0, dtype=torch.int64)  # status of the judgement at the episode's beginning
        self._first = torch.zeros(0, dtype=torch.uint8)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        frames = next_tensordict[FRAMES][:, : self.counted]
        clips = [frames, self._first, self.parent.base_env.instructions]
        if self.judge.reads_features:
            clips.append(pooled(next_tensordict[FEATURES])[:, None])
        if self.later:
            if not self._tickets:
                self._opening = (self._progress, self._begun)
            self._tickets.append(self.judge.submit(*clips))
            nothing = torch.zeros_like(self._progress)
            next_tensordict["reward"], next_tensordict[SUCCESS], next_tensordict[PROGRESS] = (
                nothing,
                nothing.bool(),
                self._progress,
            )
            next_tensordict[JUDGE_STATUS] = torch.full_like(self._run, Status.OK.value).unsqueeze(-1)
            return next_tensordict.exclude(FRAMES, FEATURES, "world")
        self._decide(self._judgement(*clips), next_tensordict)
        return next_tensordict.exclude(FRAMES, FEATURES, "world")

    def _judgement(self, frames: Tensor, first: Tensor, texts: list[str], *features: Tensor) -> Judgement:
        """The judge's judgement on clips of all episodes, see Judge.score. One that charges is asked only
        about those that have not succeeded, and the others stay successes. One that does not is asked about
        all, as smaller batches may round otherwise.
        """
        if not self.judge.charges or not self._won.any():
            return ask(self.judge, frames, first, texts, *features)
        rows = (~self._won).nonzero().flatten()
        success = torch.ones(frames.shape[:2], device=frames.device)
        out = Judgement(success, success.clone(), torch.full_like(self._run, Status.OK.value))
        if len(rows):
            shown = (frames[rows], first[rows], [texts[row] for row in rows.tolist()])
            found = ask(self.judge, *shown, *(part[rows] for part in features))
            for whole, some in zip(out, found, strict=True):
                whole[rows] = some.to(whole)
        return out

    def forget(self) -> None:
        """Drop what waits for a judgement, of a rollout that came to nothing."""
        self._tickets = []

    def settle(self, batch: TensorDictBase) -> None:
        """Write the judgements of a finished rollout [B, T] of whole episodes into it."""
        tickets, self._tickets = self._tickets, []
        if len(tickets) != batch.shape[1]:
            raise RuntimeError(
                f"{len(tickets)} chunks were handed to the judge, the rollout holds {batch.shape[1]};"
                " settle each rollout before the next begins"
            )
        # By now the collector has begun the next episodes; these begin where theirs did.
        self._run, (self._progress, self._begun) = torch.zeros_like(self._run), self._opening
        self._won = torch.zeros_like(self._won)
        for number, ticket in enumerate(tickets):
            after = batch["next"][:, number]
            self._decide(self.judge.fetch(ticket), after)
            batch["next"][:, number] = after

    def _decide(self, judgement: Judgement, next_tensordict: TensorDictBase) -> None:
        """Reward, success, progress, status and ends of one step; remembers progress and the run of
        successes.
        """
        done, self._run = self.judge.streak(judgement.success, self._run)
        # progress from an unknown beginning is as worthless as to an unknown end
        status = torch.where(self._begun != Status.OK.value, self._begun, judgement.status)
        failed = (status != Status.OK.value).unsqueeze(-1)
        success = done.any(1, keepdim=True) & ~failed
        progress = torch.where(failed, self._progress, judgement.progress[:, -1:])
        progress = torch.where(success, 1.0, progress)  # what is done is done, as where physics says it
        self._won = self._won | success.squeeze(-1)
        next_tensordict["reward"] = self.rewards(self._progress, progress, success)
        self._progress = progress
        next_tensordict[SUCCESS], next_tensordict[PROGRESS] = success, progress
        next_tensordict[JUDGE_STATUS] = status.unsqueeze(-1)
        next_tensordict["terminated"] = success | failed
        next_tensordict["truncated"] = next_tensordict["truncated"] & ~next_tensordict["terminated"]
        next_tensordict["done"] = next_tensordict["terminated"] | next_tensordict["truncated"]

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        image, world = tensordict_reset[IMAGE], self.parent.base_env
        progress, status = self._beginning(image, world)
        if mask is None or self._run.shape[0] != progress.shape[0]:
            self._run = torch.zeros(progress.shape[0], dtype=torch.int64, device=progress.device)
            self._won = torch.zeros_like(self._run, dtype=torch.bool)
            self._progress, self._begun, self._first = progress, status, world.opening.clone()
        else:
            mask = mask.reshape(-1, 1)
            self._run = torch.where(mask.squeeze(-1), 0, self._run)
            self._won = self._won & ~mask.squeeze(-1)
            self._progress = torch.where(mask, progress, self._progress)
            self._begun = torch.where(mask.squeeze(-1), status, self._begun)
            self._first = torch.where(mask[..., None, None, None], world.opening, self._first)
        tensordict_reset[PROGRESS] = self._progress
        tensordict_reset[JUDGE_STATUS] = torch.full_like(self._run, Status.OK.value).unsqueeze(-1)
        return tensordict_reset.exclude(FRAMES, FEATURES, "world")

    def _beginning(self, image: Tensor, world: Any) -> tuple[Tensor, Tensor]:
        """Progress [B, 1] of episodes that begin with `image` uint8 [B, V, 3, H, W], and its status [B]."""
        if not self.rewards.progress:
            nothing = torch.zeros(len(image), 1, device=image.device)
            return nothing, nothing.squeeze(-1).long()
        shown = [image.unsqueeze(1), world.opening, world.instructions]
        if self.judge.reads_features:
            shown.append(world.features_now()[:, None])
        judgement = ask(self.judge, *shown)
        known = judgement.status == Status.OK.value
        return torch.where(known.unsqueeze(-1), judgement.progress, 0.0), judgement.status

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Frames and features leave the specs, the judge's status enters."""
        spec: Composite = observation_spec
        del spec["world"]
        spec[JUDGE_STATUS] = Unbounded((*spec.shape, 1), dtype=torch.int64, device=spec.device)
        return spec
