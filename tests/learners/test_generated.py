"""Generated frames beside true ones: which are kept, and that policies learn to see both alike."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict

from actors.policies.chunk_gaussian import ChunkGaussianHead
from actors.policies.vla import ChunkPolicy
from envs.episodes.clips import ClipStore
from envs.simulators.unet.engine import UNetSimulator
from learners.stages.generated import generated_frames
from learners.stages.imitation import train_imitation
from learners.training.fit import FitConfig


def test_frames_gone_astray_are_left_out(simulator: UNetSimulator, store: ClipStore) -> None:
    every = torch.arange(3)
    count = int((store.length[every] - 1).sum())
    # nothing is known of places, nothing astray
    assert len(generated_frames(simulator, store, every, bf16=False)) == count
    simulator.places.taught.fill_(True)  # now it believes its untrained guesses, which are far off
    kept = generated_frames(simulator, store, every, bf16=False)
    assert len(kept) < count
    assert kept["frames"].shape[1:] == (3, 3, 64, 64)


def test_cloning_brings_generated_and_true_pictures_together(
    simulator: UNetSimulator, store: ClipStore, tmp_path: Path
) -> None:
    demos = torch.tensor([0, 4])
    made = generated_frames(simulator, store, torch.arange(8), bf16=False)

    def apart(generated: TensorDict | None) -> float:
        """How differently a cloned policy acts on generated and on true pictures."""
        torch.manual_seed(0)
        policy = ChunkPolicy(3, partial(ChunkGaussianHead, chunk=4), width=32, points=4)
        train_imitation(
            policy,
            store,
            demos,
            FitConfig(steps=60, batch=16, lr=3e-3, bf16=False),
            tmp_path / str(generated is None),
            generated=generated,
        )
        with torch.no_grad():
            states = store.arrays["states"][made["row"]]
            said = [
                policy.head(policy.fusion(policy.perception(frames, made["tokens"]), states))[0]
                for frames in (made["frames"], store.frames(made["row"]))
            ]
        return float((said[0] - said[1]).abs()[..., policy.head.gain > 0].mean())

    assert apart(made) < 0.8 * apart(None)
