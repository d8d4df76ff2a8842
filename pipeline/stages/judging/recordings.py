"""The judge of imagined episodes, as it is asked about recorded ones."""

from __future__ import annotations

import torch
from torch import Tensor

from actors.factory import build_judge, build_simulator, build_state_decoder
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.simulators.features import features_of_chunks, features_of_episodes
from pipeline.graph.stage import Inputs
from pipeline.stages.given import Cfg


def judge_of_recordings(
    cfg: Cfg, inputs: Inputs, store: ClipStore, episodes: Tensor
) -> tuple[Judge, Tensor | None]:
    """The judge that rewards imagined episodes, of the roles simulator, state and judge, and the features
    that it reads of recorded ones, if any; see learners.rl.recorded.rollout.
    """
    judge = build_judge(cfg, inputs.weights("judge")).eval()
    if not judge.reads_features:
        return judge, None
    simulator, bf16 = build_simulator(cfg, inputs.weights("simulator")), cfg["simulator"]["bf16"]
    build_state_decoder(cfg, simulator, inputs.weights("state"))  # it may mix the simulator's features
    begin = torch.zeros_like(episodes)
    still = features_of_chunks(simulator, store, episodes, begin, bf16, still=True)
    return judge, torch.cat((still[:, None], features_of_episodes(simulator, store, episodes, bf16)), 1)
