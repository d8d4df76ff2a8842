"""Cloning: perception learns where objects are from frames without actions."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from actors.policies.chunk_gaussian import ChunkGaussianHead
from actors.policies.vla import ChunkPolicy
from envs.encoders import Gaze
from envs.episodes.clips import ClipStore
from envs.specs import TOKENS
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.pictures import sights
from learners.training.fit import FitConfig


def test_policies_learn_where_objects_are_from_frames_without_actions(
    store: ClipStore, tmp_path: Path
) -> None:
    rows = store.rows(torch.arange(1, 8))

    def missed(watched: torch.Tensor | None) -> float:
        torch.manual_seed(0)
        policy = ChunkPolicy(3, partial(ChunkGaussianHead, chunk=4), width=32, points=4, channels=8, aims=2)
        train_imitation(
            policy,
            store,
            torch.tensor([0]),
            FitConfig(steps=60, batch=16, lr=5e-3, bf16=False),
            tmp_path / str(watched is None),
            watched=watched,
        )
        with torch.no_grad():
            _, aimed = policy.perception.look(store.frames(rows), store.tokens[:1].expand(len(rows), -1))
        return float(Gaze.missed(aimed, sights(store, store.arrays["objects"][rows], rows, 2))[1])

    assert missed(torch.arange(1, 8)) < 0.7 * missed(None)


def test_a_policy_without_aims_watches_nothing(store: ClipStore) -> None:
    policy = ChunkPolicy(3, partial(ChunkGaussianHead, chunk=4), width=32, points=4, channels=8)
    cloning = Cloning(policy, store, torch.tensor([0]), watched=torch.arange(8))
    drawn = cloning.sample(4, torch.Generator().manual_seed(0))
    assert "shown" not in drawn.keys() and drawn[TOKENS].shape[0] == 4
