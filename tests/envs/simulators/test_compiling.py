"""Compiled parts compute what they computed before, under the same names."""

from __future__ import annotations

import shutil
from copy import deepcopy

import pytest
import torch

from envs.rng import constant_generator
from envs.simulators.compiling import compile_parts, replays
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.inputs import build_inputs
from envs.simulators.stepwise import Stepwise
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.simulators.clips import clip

NET = {"layers": 1, "heads": 2, "head_dim": 24, "adaln_rank": 8, "patch": 2, "stem": 8}
DENOISING = {
    **{"prediction": "clean", "sampler": "euler", "steps": 2, "shift": 2.0, "foreground": 4.0},
    "augment": 0.0,
}


@pytest.fixture
def world() -> DiTSimulator:
    torch.manual_seed(0)
    made = DiTSimulator(world_spec(ARM_DELTAS), 3, NET, {"channels": 8, "width": 16}, DENOISING)
    with torch.no_grad():
        made.net.proj_out.weight.mul_(20)  # output that is not trivial
    return made


@pytest.mark.skipif(not shutil.which("g++"), reason="needs a C++ compiler")
def test_what_is_compiled_generates_and_learns_as_before(world: DiTSimulator) -> None:
    clips, plain = clip(world.spec, 2, 3), deepcopy(world)
    # a graph cannot be captured without a GPU; all else of this way is the same
    assert compile_parts(world, "graphs") is world and replays(world) and not replays(plain)
    assert list(world.state_dict()) == list(plain.state_dict())
    inputs = build_inputs(world.spec, clips, 0)
    with torch.no_grad():
        frames, features = world.eval().predict(inputs)
        wanted, reference = plain.eval().predict(inputs)
    assert (frames.int() - wanted.int()).abs().max() <= 1
    assert torch.allclose(features, reference, atol=1e-4)
    for one in (world, plain):
        one.train().loss(clips, constant_generator(0))[0].backward()
    for (name, ours), (_, theirs) in zip(world.named_parameters(), plain.named_parameters(), strict=True):
        if theirs.grad is not None:
            assert ours.grad is not None and torch.allclose(ours.grad, theirs.grad, atol=1e-5), name


def test_a_copy_is_compiled_by_its_own_order(world: DiTSimulator) -> None:
    compile_parts(world, "blocks")
    (block, *_) = world.net.transformer_blocks
    assert block._compiled_call_impl is not None and isinstance(world, Stepwise)
    assert deepcopy(world).net.transformer_blocks[0]._compiled_call_impl is None


def test_without_a_compiler_the_key_is_named(world: DiTSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ValueError, match=r"launch\.compile=blocks needs a C\+\+ compiler"):
        compile_parts(world, "blocks")
    assert compile_parts(world, None) is world
