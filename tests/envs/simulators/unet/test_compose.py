"""The choice between sources: sharp where they disagree, shared where they agree, and taught through time."""

from __future__ import annotations

import torch

from envs.simulators.unet.compose import DRAWN, Sources, choose, compose, surprise


def scene(logits: list[float], drawn: float) -> Sources:
    """Sources of an 8 x 8 picture that is black in both remembered frames."""
    memory = torch.zeros(1, 2, 3, 8, 8)
    maps = torch.zeros(1, 1, 3 + DRAWN, 8, 8)
    maps[0, 0, :4] = torch.tensor(logits)[:, None, None]
    maps[0, 0, 4:] = 2 * drawn - 1
    return compose(maps, torch.zeros(1, 1, 2, 8, 8), memory)


def test_a_pixel_is_one_of_its_sources_and_never_a_mean() -> None:
    frames = choose(scene([0.0, 0.0, 0.0, 0.5], drawn=1.0))
    assert set(frames.unique().tolist()) <= {0.0, 1.0}


def test_sources_that_agree_outvote_the_likeliest() -> None:
    colours, logs = scene([0.0, 0.0, 0.0, 0.25], drawn=1.0)
    assert int(logs[0, 0, :, 0, 0].argmax()) == 3  # drawn, but three others say black
    assert choose(Sources(colours, logs)).max() == 0.0
    colours, logs = scene([0.0, 0.0, 0.0, 1.0], drawn=1.0)
    assert choose(Sources(colours, logs)).min() == 1.0


def test_moved_pixels_come_from_where_the_flow_points() -> None:
    memory = torch.zeros(1, 2, 3, 8, 8)
    memory[0, 1, :, 4, 2] = 1.0
    maps = torch.zeros(1, 1, 3 + DRAWN, 8, 8)
    maps[:, :, 2] = 9.0  # moved
    flow = torch.zeros(1, 1, 2, 8, 8)
    flow[:, :, 0] = -3 / 8  # units of 8 pixels, from a frame to the last remembered one
    frames = choose(compose(maps, flow, memory))
    assert frames[0, 0, 0].nonzero().tolist() == [[4, 5]]


def test_surprise_is_least_at_what_is_likely_and_grows_with_doubt() -> None:
    sure, unsure = scene([0.0, 0.0, 0.0, -3.0], drawn=1.0), scene([0.0, 0.0, 0.0, 0.0], drawn=1.0)
    black, white = torch.zeros(1, 1, 3, 8, 8), torch.ones(1, 1, 3, 8, 8)
    assert surprise(sure, black).mean() < surprise(unsure, black).mean()
    assert surprise(sure, white).mean() > surprise(unsure, white).mean() > surprise(unsure, black).mean()


def test_gradients_pass_the_choice() -> None:
    colours, logs = scene([0.0, 0.0, 0.0, 0.5], drawn=1.0)
    logs = logs.detach().requires_grad_()
    choose(Sources(colours, logs)).sum().backward()
    assert logs.grad is not None and float(logs.grad[:, :, 3].min()) > 0
