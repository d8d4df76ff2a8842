"""The forward path's second half, where a reward is decided: the judge watches the chunk and writes reward and done."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from envs.judges import Judge
from envs.schema import FEATURES, FRAMES, IMAGE, JUDGE_STATUS, PROGRESS, SUCCESS, TOKENS, Rewards, Status


class JudgeReward(Transform):
    """Success, progress and reward of imagined video; the frames themselves stay behind.

    A verdict that is not OK ends the episode and is written to `judge_status`, by which learners drop and count it.

    Args:
        judge: scores frames.
        rewards: turns progress and success into a number.
    """

    def __init__(self, judge: Judge, rewards: Rewards):
        super().__init__(in_keys=[FRAMES], out_keys=["reward", SUCCESS, PROGRESS, JUDGE_STATUS])
        self.judge, self.rewards = judge, rewards
        self._run = torch.zeros(0, dtype=torch.int64)
        self._progress = torch.zeros(0, 1)
        self._first = torch.zeros(0, dtype=torch.uint8)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        verdict = self.judge.score(next_tensordict[FRAMES], self._first, tensordict[TOKENS])
        done, self._run = self.judge.streak(verdict.success, self._run)
        failed = (verdict.status != Status.OK.value).unsqueeze(-1)
        success = done.any(1, keepdim=True) & ~failed
        progress = torch.where(failed, self._progress, verdict.progress[:, -1:])
        next_tensordict["reward"] = self.rewards(self._progress, progress, success)
        self._progress = progress
        next_tensordict[SUCCESS], next_tensordict[PROGRESS] = success, progress
        next_tensordict[JUDGE_STATUS] = verdict.status.unsqueeze(-1)
        next_tensordict["terminated"] = success | failed
        next_tensordict["truncated"] = next_tensordict["truncated"] & ~next_tensordict["terminated"]
        next_tensordict["done"] = next_tensordict["terminated"] | next_tensordict["truncated"]
        return next_tensordict.exclude(FRAMES, FEATURES, "world")

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        image = tensordict_reset[IMAGE]
        progress = self.judge.score(image.unsqueeze(1), image, tensordict_reset[TOKENS]).progress
        if mask is None or self._run.shape[0] != progress.shape[0]:
            self._run = torch.zeros(progress.shape[0], dtype=torch.int64, device=progress.device)
            self._progress, self._first = progress, image.clone()
        else:
            mask = mask.reshape(-1, 1)
            self._run = torch.where(mask.squeeze(-1), 0, self._run)
            self._progress = torch.where(mask, progress, self._progress)
            self._first = torch.where(mask[..., None, None, None], image, self._first)
        tensordict_reset[PROGRESS] = self._progress
        tensordict_reset[JUDGE_STATUS] = torch.full_like(self._run, Status.OK.value).unsqueeze(-1)
        return tensordict_reset.exclude(FRAMES, FEATURES, "world")

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Frames and features leave the specs, the judge's status enters."""
        spec: Composite = observation_spec
        del spec["world"]
        spec[JUDGE_STATUS] = Unbounded((*spec.shape, 1), dtype=torch.int64, device=spec.device)
        return spec
