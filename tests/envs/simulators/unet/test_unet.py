"""The U-Net at either detail of its finest level."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.targets import ConfigError, build
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of
from tests.envs.simulators.test_engines import section_of


def unet(size: tuple[int, int], **options: Any) -> Simulator:
    """The engine of configs/simulator/unet.yaml."""
    section = {key: value for key, value in section_of("unet").items() if key not in WORLD_OPTIONS}
    torch.manual_seed(0)
    made: Simulator = build({**section, **options}, "simulator", spec=world_spec(BIMANUAL_POSES, size))
    return made


@pytest.mark.long
def test_a_picture_twice_as_large_folded_twice_as_far_meets_the_same_blocks() -> None:
    """All views learn, to the last weight, and what lies between embedding and heads has the same places."""
    plain, fine = unet((32, 32)), unet((64, 64), fold=4)
    inner = ("fine_in", "mid_in", "deep", "mid_out", "fine_out", "down", "up", "fuse", "where", "flows")
    shapes = [
        {name: p.shape for name, p in model.named_parameters() if name.startswith(inner)}
        for model in (plain, fine)
    ]
    assert shapes[0] == shapes[1]
    clips = clip(fine.spec, 2, fine.memory_frames, chunks=2)
    clips["stride"] = torch.tensor([1, 3])
    optimiser = torch.optim.AdamW(fine.parameters(), lr=2e-3)
    losses = []
    for _ in range(12):
        loss, _ = fine.loss(clips, torch.Generator().manual_seed(0))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.9 * losses[0], losses
    assert all(p.grad is not None and p.grad.any() for p in fine.parameters())
    fine.eval()
    state = fine.reset(first_of(fine.spec, clips), torch.arange(2))
    frames, features, _ = fine.step(state, future_of(fine.spec, clips))
    assert frames.shape == (2, fine.spec.chunk, fine.spec.views, 3, 64, 64)
    assert features.shape == (2, *fine.feature_shape)


@pytest.mark.parametrize(
    ("options", "size", "said"),
    [
        ({"fold": 3}, (48, 48), r"simulator\.fold=3 must be 2 or 4"),
        ({"newest_frames": 4}, (32, 32), r"newest_frames=4 is more than simulator\.memory_frames=3"),
        ({"fold": 4}, (48, 64), r"task\.size=\[48, 64\] must be multiples of 32"),
        ({"fold": 2}, (40, 32), r"task\.size=\[40, 32\] must be multiples of 16"),
    ],
)
def test_sizes_that_squares_do_not_fill_are_refused(
    options: dict[str, int], size: tuple[int, int], said: str
) -> None:
    with pytest.raises((ValueError, ConfigError), match=said):
        unet(size, **options)


def test_one_episode_is_enough_to_say_how_cameras_see() -> None:
    world = unet((32, 32))
    world.fit_camera_statistics(torch.full((1, world.spec.views, 3, 32, 32), 51, dtype=torch.uint8))
    assert not bool(world.spread.any()) and float(world.mean.mean()) == pytest.approx(0.2)
