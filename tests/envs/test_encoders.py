"""Encoders take any number of views of any size, and see each of them."""

from __future__ import annotations

import pytest
import torch

from envs.conditioning import ActionVector
from envs.embodiment import Embodiment
from envs.encoders.images import MultiViewEncoder, QueriedKeypoints, centres, to_signed
from envs.specs import IMAGE
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, EMBODIMENTS, observations, world_spec


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
@pytest.mark.parametrize("size", [(32, 32), (48, 80)])
def test_every_view_counts(robot: Embodiment, size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    spec = world_spec(robot, size)
    encoder = MultiViewEncoder(spec, points=4, width=8)
    image = observations(spec, 2)[IMAGE]
    with torch.no_grad():
        out = encoder(image)
        assert out.shape == (2, encoder.out_features) and out.dtype == torch.float32
        for view in range(spec.views):
            other = image.clone()
            other[:, view] = 255 - other[:, view]
            assert not torch.allclose(encoder(other), out)
        assert torch.allclose(encoder(to_signed(image)), out)  # bytes and signed floats are the same


def test_two_pictures_of_a_view_are_seen_as_one() -> None:
    spec = world_spec(ARM_DELTAS)
    encoder = MultiViewEncoder(spec, points=4, width=8, pictures=2)
    assert encoder(torch.randn(3, spec.views, 6, 32, 32)).shape == (3, encoder.out_features)


@pytest.mark.parametrize("side", [32, 64, 128])
def test_key_points_lie_as_finely_in_large_pictures(side: int) -> None:
    spec = world_spec(ARM_DELTAS, (side, side))
    encoder = MultiViewEncoder(spec, points=4, width=8)
    dot = torch.zeros(1, spec.views, 3, side, side, dtype=torch.uint8)
    found = encoder.gaze(dot)[1]
    dot[..., side // 2 :, side // 2 :] = 255
    assert found.shape[-2:] == (side // 2, side // 2)
    moved = (encoder.gaze(dot)[1] - found).abs().amax((0, 1, 2))
    assert moved[-2, -2] > 0
    torch.manual_seed(0)
    blocks = encoder.gaze(torch.randn(1, spec.views, 3, side, side))[1].unfold(-2, 2, 2).unfold(-2, 2, 2)
    assert float(blocks.std((-2, -1)).min()) > 1e-4  # more than coarse maps that are shown larger


def test_some_key_points_are_queried_by_the_conditioning() -> None:
    torch.manual_seed(0)
    spec = world_spec(ARM_DELTAS)
    encoder = MultiViewEncoder(spec, points=4, width=8, instruction_keypoints=2, cond_dim=6)
    pictures, cond = torch.randn(2, spec.views, 3, 32, 32), torch.randn(2, 6)
    out, other = encoder(pictures, cond), encoder(pictures, torch.stack((cond[0], cond[0])))
    assert out.shape == (2, encoder.out_features)
    assert torch.allclose(out[0], other[0]) and not torch.allclose(out[1], other[1])
    places = spec.views * 6 * 2  # of key-points stand first; those of the last two of each view hang on it
    moved = (out - other)[1, :places].reshape(spec.views, 6, 2).abs().sum(-1) > 1e-6
    assert moved[:, 4:].all() and not moved[:, :4].any()


def test_features_depend_on_the_conditioning_once_the_encoder_has_learned_to() -> None:
    torch.manual_seed(0)
    spec = world_spec(ARM_DELTAS)
    encoder = MultiViewEncoder(spec, points=4, width=8, instruction_keypoints=2, cond_dim=6)
    pictures, cond = torch.randn(2, spec.views, 3, 32, 32), torch.randn(2, 6)
    encoder(pictures, cond).square().sum().backward()
    film = encoder.blocks[0].film
    assert film is not None and film.weight.grad.abs().sum() > 0
    torch.nn.init.normal_(film.weight)
    out, other = encoder(pictures, cond), encoder(pictures, cond.flip(0))
    grid = out.shape[1] - spec.views * 8 * 4 * 4  # stands last
    assert not torch.allclose(out[:, grid:], other[:, grid:])


def test_asked_for_places_are_found_whatever_they_look_like() -> None:
    torch.manual_seed(0)
    queried, cond = QueriedKeypoints(views=1, points=1, width=8, cond_dim=3), torch.eye(3)
    aims = torch.tensor([[0, 0], [5, 12], [14, 3]])  # rows and columns
    optimiser = torch.optim.Adam(queried.parameters(), 0.02)
    for _ in range(200):
        found = queried(torch.rand(3, 1, 8, 16 * 16), cond, (16, 16))[:, 0, 0]
        loss = torch.nn.functional.cross_entropy(found, aims[:, 0] * 16 + aims[:, 1])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    best = queried(torch.rand(3, 1, 8, 16 * 16), cond, (16, 16))[:, 0, 0].argmax(-1)
    assert ((torch.stack((best // 16, best % 16), -1) - aims).abs() <= 1).all()


def test_centres_are_in_half_pictures_from_the_middle() -> None:
    share = torch.zeros(2, 4, 8)
    share[0, 0, 0] = share[1, 3, 7] = 1.0
    assert torch.allclose(centres(share), torch.tensor([[-0.875, -0.75], [0.875, 0.75]]))


def test_cameras_that_are_not_looked_through_change_nothing() -> None:
    robot = BIMANUAL_POSES
    spec = world_spec(robot, (32, 32))
    encoder = MultiViewEncoder(spec, points=4, width=8, cameras="main")
    pictures = torch.randint(0, 256, (2, spec.views, 3, 32, 32), dtype=torch.uint8)
    seen = encoder(pictures)
    assert seen.shape[1] == encoder.out_features
    others = [view for view in range(spec.views) if view != robot.main_view]
    pictures[:, others] = 0
    assert torch.equal(encoder(pictures), seen)


@pytest.mark.parametrize("cameras", ["both", [], ["nose"]])
def test_unknown_cameras_are_named_with_those_there_are(cameras: object) -> None:
    with pytest.raises(ValueError, match=r"cameras=.* must be .* of .*\['"):
        BIMANUAL_POSES.views_of(cameras)  # type: ignore[arg-type]


def test_small_changes_are_told_and_numbers_that_never_change_are_not() -> None:
    vector, units = ActionVector(ARM_DELTAS), torch.tensor([6e-4, 1, 1e-6, 1])
    commands = torch.randn(200, 4, generator=torch.Generator().manual_seed(0)) * units
    vector.normalise(commands, torch.zeros(200, 4))
    spread = vector(commands[None], commands[:1])[0, :, :4].std(0, unbiased=False)
    assert spread.tolist() == pytest.approx([1, 1, 0, 1], abs=1e-3)
