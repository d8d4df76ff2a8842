"""The choice between sources: sharp where they disagree, shared where they agree, and taught through time."""

from __future__ import annotations

import torch

from envs.simulators.unet.compose import DRAWN, Sources, choose, compose, enlarge, move, surprise


def scene(logits: list[float], drawn: float) -> Sources:
    """Sources of an 8 x 8 picture that is black in both remembered frames."""
    memory = torch.zeros(1, 2, 3, 8, 8)
    maps = torch.zeros(1, 1, 3 + DRAWN, 8, 8)
    maps[0, 0, :4] = torch.tensor(logits)[:, None, None]
    maps[0, 0, 4:] = 2 * drawn - 1
    return compose(maps, torch.zeros(1, 1, 2, 8, 8), memory)


def test_a_pixel_is_one_of_its_sources_and_never_a_mean() -> None:
    frames, _ = choose(scene([0.0, 0.0, 0.0, 0.5], drawn=1.0))
    assert set(frames.unique().tolist()) <= {0.0, 1.0}


def test_sources_that_agree_outvote_the_likeliest() -> None:
    colours, logs, flow = scene([0.0, 0.0, 0.0, 0.25], drawn=1.0)
    assert int(logs[0, 0, :, 0, 0].argmax()) == 3  # drawn, but three others say black
    assert choose(Sources(colours, logs, flow))[0].max() == 0.0
    colours, logs, flow = scene([0.0, 0.0, 0.0, 1.0], drawn=1.0)
    assert choose(Sources(colours, logs, flow))[0].min() == 1.0


def test_moved_pixels_come_from_where_the_flow_points() -> None:
    memory = torch.zeros(1, 2, 3, 8, 8)
    memory[0, 1, :, 4, 2] = 1.0
    maps = torch.zeros(1, 1, 3 + DRAWN, 8, 8)
    maps[:, :, 2] = 9.0  # moved
    flow = torch.zeros(1, 1, 2, 8, 8)
    flow[:, :, 0] = -3 / 8  # units of 8 pixels, from a frame to the last remembered one
    frames, _ = choose(compose(maps, flow, memory))
    assert frames[0, 0, 0].nonzero().tolist() == [[4, 5]]


def test_a_view_at_half_the_detail_fades_in_no_number_of_chunks() -> None:
    """What is remembered comes back as it is, and of what has moved a world sees what it chose."""
    memory = torch.randint(0, 256, (1, 2, 3, 8, 8), dtype=torch.uint8)
    known = memory.float() / 255
    half = torch.nn.functional.avg_pool2d(known[0], 2)
    frames = torch.stack([half[1], torch.rand(3, 4, 4), torch.rand(3, 4, 4)])[None].requires_grad_()
    chosen = torch.tensor([1, 2, 3])[None, :, None, None].expand(1, 3, 4, 4)  # the second one; moved; drawn
    flow = torch.zeros(1, 3, 2, 4, 4)
    full = enlarge(frames, chosen, flow, memory)
    assert torch.equal(full[0, 0], known[0, 1])
    again = torch.nn.functional.avg_pool2d(full.flatten(0, 1), 2)
    assert torch.allclose(again[:2], frames[0, :2], atol=1e-6)
    full.sum().backward()
    assert frames.grad is not None and torch.allclose(frames.grad, torch.full_like(frames, 4.0))
    flow[:, 1, 0] = 1 / 8  # a pixel of half the detail, two of the whole, to the right of where it comes to
    frames = torch.nn.functional.avg_pool2d(move(known[:, -1], flow, 2).flatten(0, 1), 2)[None]
    moved = enlarge(frames, chosen, flow, memory)[0, 1]
    assert torch.allclose(moved[:, :, :6], known[0, 1, :, :, 2:], atol=1e-5)


def test_of_sources_that_say_the_same_the_first_is_chosen() -> None:
    colours, logs, flow = scene([0.0, 0.3, 0.1, -9.0], drawn=1.0)
    jitter = 1e-6 * torch.rand_like(logs)  # as other kernels round
    assert int(choose(Sources(colours, logs + jitter, flow))[1].max()) == 0


def test_surprise_is_least_at_what_is_likely_and_grows_with_doubt() -> None:
    sure, unsure = scene([0.0, 0.0, 0.0, -3.0], drawn=1.0), scene([0.0, 0.0, 0.0, 0.0], drawn=1.0)
    black, white = torch.zeros(1, 1, 3, 8, 8), torch.ones(1, 1, 3, 8, 8)
    assert surprise(sure, black).mean() < surprise(unsure, black).mean()
    assert surprise(sure, white).mean() > surprise(unsure, white).mean() > surprise(unsure, black).mean()


def test_gradients_pass_the_choice() -> None:
    colours, logs, flow = scene([0.0, 0.0, 0.0, 0.5], drawn=1.0)
    logs = logs.detach().requires_grad_()
    choose(Sources(colours, logs, flow))[0].sum().backward()
    assert logs.grad is not None and float(logs.grad[:, :, 3].min()) > 0
