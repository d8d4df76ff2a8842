"""Diffusion forcing: its schedule, a level per frame, blocks of any context and horizon, DDIM."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.forcing.engine import ForcingSimulator
from envs.simulators.forcing.prediction import Clean, Prediction, V
from envs.simulators.forcing.schedule import DDIM, Sigmoid, unit_parts
from envs.specs import memory_indices
from envs.targets import ConfigError
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of
from tests.envs.simulators.loss_weights import loss_weights
from tests.envs.simulators.test_engines import build_engine, section_of

SIGMOID = Sigmoid(-3.0, 3.0, 1.0)


@pytest.mark.parametrize("ends", [(-3.0, 3.0, 0.0), (-3.0, 3.0, -1.0), (3.0, 3.0, 1.0), (3.0, -3.0, 1.0)])
def test_no_schedule(ends: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="end must be above start, and temperature above 0"):
        Sigmoid(*ends)


def make(chunk: int = 4, **options: Any) -> ForcingSimulator:
    """A tiny world of an arm moved by deltas, whose output is not trivial."""
    world = build_engine("forcing_small", world_spec(ARM_DELTAS, chunk=chunk))[0]
    assert isinstance(world, ForcingSimulator)
    for name, value in options.items():
        setattr(world, name, value)
    return world


def test_the_schedule_falls_from_noise_to_data() -> None:
    levels = SIGMOID.levels(10)
    assert levels[0] == 1.0 and levels[-1] == 0.0 and levels == sorted(levels, reverse=True)
    times = torch.linspace(0, 1, 11)
    signal, noise = unit_parts(SIGMOID.level(times))
    assert torch.allclose(signal.square() + noise.square(), torch.ones(11))
    share = signal.square()  # falls along the sigmoid, alike on both sides of its middle
    assert torch.allclose(share + share.flip(0), torch.ones(11), atol=1e-5)
    wanted = (torch.sigmoid(torch.tensor(3.0)) - torch.sigmoid(torch.tensor(-1.2))) / 0.9051482
    assert torch.allclose(share[3], wanted, atol=1e-4)


def test_a_step_is_that_of_ddim() -> None:
    data, noise = torch.randn(2, 5)
    z = 0.6 * noise + 0.4 * data
    (now, later), guess = (0.6, 0.25), torch.randn(5)
    stepped = DDIM((now, later))(lambda z, level: (z - guess) / level, z)
    # with signal and noise at unit variance: x' = a' x + b' e, where e is what is left of z without x
    (a, b), (a2, b2) = (unit_parts(torch.tensor(level)) for level in (now, later))
    e = (z / ((1 - now) ** 2 + now**2) ** 0.5 - a * guess) / b
    wanted = (a2 * guess + b2 * e) * ((1 - later) ** 2 + later**2) ** 0.5
    assert torch.allclose(stepped, wanted, atol=1e-5)


@pytest.mark.parametrize("prediction", [V(), Clean()], ids=["v", "clean"])
def test_predictions_say_the_clean_frames(prediction: Prediction) -> None:
    clean, noise = torch.randn(2, 3, 4, 1, 2, 2, 2)
    level = torch.rand(3, 4, 1, 1, 1, 1)
    z = (1 - level) * clean + level * noise
    base = prediction.base(z, level)
    signal, rest = unit_parts(level)
    output = signal * noise - rest * clean if base is None else clean - base
    assert torch.allclose(prediction.clean(output, z, level, base), clean, atol=1e-5)
    assert prediction.error(output, (clean, noise), level, base).abs().max() < 1e-5
    assert prediction.error(output + 1, (clean, noise), level, base).abs().min() > 0.9


def test_the_filter_repeats_what_is_known_best() -> None:
    clean = torch.randn(1, 3, 1, 2, 2, 2)
    level = torch.tensor([0.01, 1.0, 0.01])[None, :, None, None, None, None]
    base = Clean().base((1 - level) * clean + level * torch.randn_like(clean), level)
    assert base is not None
    assert torch.allclose(base[:, 0], clean[:, 0], atol=0.1)
    assert torch.allclose(base[:, 1], clean[:, 0], atol=0.1)  # pure noise: the frame before
    assert torch.allclose(base[:, 2], clean[:, 2], atol=0.1)  # nearly clean: itself


def passed(world: ForcingSimulator, level: Tensor, actions: Tensor, z: Tensor) -> Tensor:
    beside = torch.zeros(*z.shape[:3], 0, *z.shape[-2:])
    with torch.no_grad():
        return world._run(z, level, (beside, actions))[0]


def test_every_frame_has_its_own_level_and_knows_none_that_is_newer() -> None:
    world = make()
    z, level = torch.randn(2, 5, 2, 16, 4, 4), torch.rand(2, 5)
    actions = torch.randn(2, 5, world.actions.size)
    before = passed(world, level, actions, z)
    for what in range(3):
        inputs = [level.clone(), actions.clone(), z.clone()]
        inputs[what][:, 3] = inputs[what][:, 3] * 0.5
        after = passed(world, *inputs)
        assert torch.equal(after[:, :3], before[:, :3])
        assert not torch.allclose(after[:, 3], before[:, 3]) and not torch.allclose(after[:, 4], before[:, 4])


def test_frames_of_the_past_are_read_once_and_tell_the_same() -> None:
    world = make()
    z, level = torch.randn(2, 6, 2, 16, 4, 4), torch.rand(2, 6)
    actions, beside = torch.randn(2, 6, world.actions.size), torch.zeros(2, 6, 2, 0, 4, 4)
    base = world._base(z, level)
    assert base is not None
    with torch.no_grad():
        whole = world._run(z, level, (beside, actions))
        known = world._run(z[:, :4], level[:, :4], (beside[:, :4], actions[:, :4]))[2]
        ahead = world._run(z[:, 4:], level[:, 4:], (beside[:, 4:], actions[:, 4:]), base[:, 4:], known)
    assert torch.allclose(ahead[0], whole[0][:, 4:], atol=1e-5)
    assert torch.allclose(ahead[1], whole[1][:, 4:], atol=1e-5)


@pytest.mark.parametrize(("context", "horizon"), [(1, 1), (4, 2), (6, 3), (3, 4)])
def test_a_chunk_takes_blocks_of_any_context_and_horizon(context: int, horizon: int) -> None:
    world = make(chunk=4, context=context, horizon=horizon)
    spec = world.spec
    clips = clip(spec, 2, world.memory_frames, chunks=2)
    seen: list[tuple[int, int]] = []
    world.net.register_forward_hook(
        lambda net, args, out: seen.append((args[0].shape[1], out[2][0][0].shape[2]))
    )
    state, out = world.reset(first_of(spec, clips), torch.tensor([1, 2])), []
    for number in range(2):
        frames, features, state = world.step(state, future_of(spec, clips, number))
        out.append(frames)
    blocks, steps = ceil(4 / horizon), world.denoising.steps
    assert len(seen) == 2 * blocks * (1 + steps)
    sizes = [min(horizon, 4 - begin) for begin in range(0, 4, horizon)]
    wanted = [row for n in sizes for row in [(context, context), *[(n, context + n)] * steps]]
    assert seen == 2 * wanted
    assert features.shape == (2, *world.feature_shape)
    assert torch.cat(out, 1).float().std() > 1


def test_frames_are_those_of_the_same_seed_commands_and_steps() -> None:
    world = make()
    spec, clips = world.spec, clip(make().spec, 1, 4)
    future = future_of(spec, clips)

    def frames(seed: int, steps: int = 2, changed: int | None = None) -> Tensor:
        world.denoising = replace(world.denoising, steps=steps)
        given = future.clone()
        if changed is not None:
            given["commands"][:, changed] += 1.0
        return world.step(world.reset(first_of(spec, clips), torch.tensor([seed])), given)[0]

    first = frames(3)
    assert torch.equal(first, frames(3)) and not torch.equal(first, frames(4))
    assert not torch.equal(first, frames(3, steps=5))
    later = frames(3, changed=2)
    assert torch.equal(later[:, :2], first[:, :2]) and not torch.equal(later[:, 2:], first[:, 2:])


def test_before_there_are_enough_frames_the_first_repeats() -> None:
    assert memory_indices(torch.tensor([1, 3, 9]), 4, 4).tolist() == [[0] * 4, [0, 0, 1, 2], [5, 6, 7, 8]]
    world = make()
    clips = clip(world.spec, 2, 4)
    state = world.reset(first_of(world.spec, clips), torch.tensor([1, 2]))
    remembered = world.recall(state, future_of(world.spec, clips))
    assert remembered["frames"].shape[1] == world.context
    assert (remembered["frames"] == clips["memory", "frames"][:, 0, :1]).all()


def taught(world: ForcingSimulator, clips: TensorDict) -> list[bool]:
    """Which frames the loss of the first clip depends on, as far as latents that are to be said go."""
    said: list[Tensor] = []
    hook = world.net.out.register_forward_hook(lambda layer, args, out: said.append(out) or out)
    loss = world.loss(clips, torch.Generator().manual_seed(0))[0]
    hook.remove()
    (gradient,) = torch.autograd.grad(loss, said[-1:])
    return (gradient[0] != 0).flatten(1).any(1).tolist()


def test_repeats_and_invalid_frames_teach_nothing() -> None:
    world = make()
    clips = clip(world.spec, 2, 4)
    clips["memory", "index"] = torch.tensor([0, 0, 1, 2]).expand(2, 1, 4).contiguous()
    assert taught(world, clips) == [False, False, *[True] * 6]
    clips["memory", "present"][..., 2] = False  # nobody photographed it
    assert taught(world, clips) == [False, False, False, *[True] * 5]
    clips["memory", "present"][..., 2] = True
    clips["future", "valid"][:, -1] = False
    assert taught(world, clips) == [False, False, *[True] * 5, False]
    clips["future", "valid"][:] = False
    clips["memory", "index"][:] = 0
    assert not any(taught(world, clips))


def test_later_chunks_are_learned_from_own_frames_which_teach_nothing_themselves() -> None:
    world = make()
    clips = clip(world.spec, 2, 4, chunks=2)
    clips["memory", "index"] = torch.tensor([[0, 0, 1, 2], [1, 2, 4, 6]]).expand(2, 2, 4).contiguous()
    first, second = [False, False, *[True] * 6], [False, True, False, False, *[True] * 4]
    for depth, which in ((0.0, first), (0.49, first), (0.5, second), (0.99, second)):
        clips["depth"][:] = depth
        assert taught(world, clips) == which
    other = clips.clone()
    other["future", "frames"][:, :4] = 0  # of the first chunk, which a second one does not see
    one, same = (world.loss(data, torch.Generator().manual_seed(0))[0] for data in (clips, other))
    assert torch.equal(one, same)


def test_what_is_to_be_said_does_not_decide_what_it_weighs() -> None:
    world = make()
    clips = clip(world.spec, 2, 4)
    other = clips.clone()
    other["future", "frames"] = clips["future", "frames"].flip(-1)

    mine, others = (loss_weights(world, world.net.out, data) for data in (clips, other))
    for one, same in zip(mine, others, strict=True):
        assert torch.equal(one, same) and len(one[one > 0].unique()) > 1


@pytest.mark.parametrize(("steps", "apart"), [(1, 0.01), (2, 0.5)])
def test_a_network_that_repeats_shows_the_newest_frame_again(steps: int, apart: float) -> None:
    world = make(context=2)
    world.denoising = replace(world.denoising, steps=steps)  # of several the first leaves noise behind
    with torch.no_grad():
        for layer in (world.net.out.weight, world.net.out.bias):
            layer.zero_()
    context = torch.randn(1, 1, 2, 16, 4, 4).expand(-1, 2, -1, -1, -1, -1)
    beside = torch.zeros(1, 5, 2, 0, 4, 4), torch.zeros(1, 5, world.actions.size)
    with torch.no_grad():
        made, _ = world._block(context, torch.randn(1, 3, 2, 16, 4, 4), beside)
    # Taken as it is for noisy latents of its level, context would grow by 7% with every block.
    gap = (made - context[:, -1:]).square().mean().sqrt()
    assert gap < apart * context.std(), "an untrained network should stand still"


def test_pose_maps_stand_beside_latents_with_their_detail() -> None:
    world = build_engine("forcing_small", replace(world_spec(BIMANUAL_POSES, chunk=4), ray_map=False))[0]
    assert isinstance(world, ForcingSimulator)
    clips = clip(world.spec, 1, 4)
    maps = clips["future", "pose_map"]
    frames = {"commands": clips["future", "commands"], "pose_map": maps}
    beside = world._beside(frames, slice(0, 4), clips)[0]
    half = maps.float().flatten(0, 2).unfold(2, 2, 2).unfold(3, 2, 2).mean((-1, -2)) / 127.5 - 1
    assert beside.shape[3] == half[0].numel() // (4 * 4)
    assert torch.allclose(beside.std(), half.std())  # nothing is averaged away but pairs of pixels


def test_what_stands_still_is_as_sharp_as_the_last_frame() -> None:
    world = make(context=4)
    world.denoising = replace(world.denoising, steps=1)
    with torch.no_grad():
        for layer in (world.net.out.weight, world.net.out.bias):
            layer.zero_()
    clips = clip(world.spec, 2, 4)
    first = first_of(world.spec, clips)
    frames = world.step(world.reset(first, torch.tensor([1, 2])), future_of(world.spec, clips))[0]
    # The autoencoder has learned nothing: decoded, the frame would be grey.
    assert (frames.int() - first["frames"][:, None].int()).abs().max() <= 1


@pytest.mark.parametrize(("chunk", "horizon"), [(1, 1), (2, 2), (4, 4), (8, 4), (30, 4)])
def test_window_and_horizon_follow_from_the_chunk(chunk: int, horizon: int) -> None:
    world = make(chunk)
    assert (world.context, world.horizon, world.memory_frames) == (4, horizon, 4)
    clips = clip(world.spec, 1, world.memory_frames)
    state = world.reset(first_of(world.spec, clips), torch.tensor([1]))
    assert world.step(state, future_of(world.spec, clips))[0].shape[1] == chunk
    assert bool(world.loss(clips, torch.Generator().manual_seed(0))[0].isfinite())


def test_what_does_not_fit_is_named() -> None:
    section = {key: value for key, value in section_of("forcing_small").items() if key != "_target_"}
    own = {name: section[name] for name in ("context", "horizon", "net", "codec", "denoising")}
    own |= {"prediction": section["prediction"], "actions": section["actions"]}
    with pytest.raises(ValueError, match=r"simulator\.window=4 must be more than task\.chunk=4"):
        ForcingSimulator(world_spec(BIMANUAL_POSES), window=4, **own)
    with pytest.raises(ValueError, match=r"task\.size=\[24, 32\] must be multiples of 16"):
        ForcingSimulator(world_spec(BIMANUAL_POSES, (24, 32)), window=8, **own)
    with pytest.raises(ValueError, match=r"simulator\.horizon=5 must be at most task\.chunk=4"):
        ForcingSimulator(world_spec(BIMANUAL_POSES), window=8, **{**own, "horizon": 5})
    with pytest.raises(ConfigError, match=r"simulator\.net: net\.head_dim=6 must be a multiple of 4"):
        ForcingSimulator(
            world_spec(BIMANUAL_POSES), window=8, **{**own, "net": {**own["net"], "head_dim": 6}}
        )
    wrong = {**own, "prediction": {"_target_": "envs.simulators.forcing.prediction.X"}}
    with pytest.raises(ConfigError, match=r"simulator\.prediction\._target_"):
        ForcingSimulator(world_spec(BIMANUAL_POSES), window=8, **wrong)
