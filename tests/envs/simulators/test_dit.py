"""The DiT for every robot: determinism in any batch slot, partial resets, no unused weights, learning."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from envs.simulators import memory
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.dit.layers import Attention
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.shape import DiTShape
from envs.simulators.inputs import build_inputs
from envs.simulators.state_experts.flow import StateExpert, StateTokens
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_JOINTS, BIMANUAL_POSES, EMBODIMENTS, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of
from tests.envs.simulators.loss_weights import loss_weights

NET = {"layers": 3, "heads": 2, "head_dim": 24, "adaln_rank": 8, "patch": 2, "stem": 8}
DENOISING: dict[str, Any] = {
    "prediction": "clean",
    "sampler": "euler",
    "steps": 2,
    "shift": 2.0,
    "foreground": 4.0,
    "augment": 0.8,
}


def make(robot: str, **denoising: Any) -> DiTSimulator:
    torch.manual_seed(0)
    spec = world_spec(EMBODIMENTS[robot])
    world = DiTSimulator(spec, 3, NET, {"channels": 8, "width": 16}, DENOISING | denoising)
    with torch.no_grad():
        world.net.proj_out.weight.mul_(20)  # output that is not trivial
    return world.eval()


def expert_of(world: DiTSimulator) -> StateExpert:
    torch.manual_seed(1)
    return StateExpert(world, layers=2, heads=2, head_dim=16, steps=2).eval()


@pytest.fixture
def dit() -> DiTSimulator:
    return make("two_arms_poses")


@pytest.mark.parametrize("robot", EMBODIMENTS)
def test_rows_depend_on_seed_and_commands_and_on_no_other_row(robot: str) -> None:
    world = make(robot)
    expert, spec = expert_of(world), world.spec
    clips, seeds = clip(spec, 3, 3, chunks=2), torch.tensor([7, 8, 7])
    clips[2] = clips[0]
    first = first_of(spec, clips)
    together, alone = world.reset(first, seeds), world.reset(first[1:2], seeds[1:2])
    for step in range(2):
        future = future_of(spec, clips, step)
        frames, features, together = world.step(together, future)
        states = expert.follow(together, spec.chunk, features)
        assert frames.shape == (3, spec.chunk, spec.views, 3, *spec.size) and frames.dtype == torch.uint8
        assert states.shape == (3, spec.chunk, spec.state_dim) and torch.isfinite(states).all()
        one, own, alone = world.step(alone, future[1:2])
        # Matrices' last rows may be rounded otherwise, so another slot may differ by a grey level.
        assert (frames[0].int() - frames[2].int()).abs().max() <= 1
        assert (frames[0].int() - frames[1].int()).abs().max() > 1
        assert (frames[1].int() - one[0].int()).abs().max() <= 1
        assert torch.allclose(states[1], expert.follow(alone, spec.chunk, own)[0], atol=1e-3)
    # Another command, other frames: the action vector tells, whether or not there is a pose map.
    again = world.reset(first[:1], seeds[:1])
    other = future_of(spec, clips[:1])
    frames = world.step(again.clone(), other)[0]
    other["commands"] = other["commands"] + 1.0
    assert not torch.equal(world.step(again, other)[0], frames)


def test_a_partial_reset_is_a_masked_write(dit: DiTSimulator) -> None:
    spec = dit.spec
    clips = clip(spec, 2, 3, chunks=2)
    state = dit.reset(first_of(spec, clips), torch.tensor([1, 2]))
    _, _, state = dit.step(state, future_of(spec, clips))
    fresh = first_of(spec, clip(spec, 1, 3, seed=9))
    state = memory.replace(state, torch.tensor([True, False]), dit.reset(fresh, torch.tensor([5])))
    assert state["length"].tolist() == [1, 1 + spec.chunk] and state["chunk_index"].tolist() == [0, 1]
    future = future_of(spec, clips, 1)
    mixed = dit.step(state, future)[0]
    again = dit.step(dit.reset(fresh, torch.tensor([5])), future[:1])[0]
    assert (mixed[0].int() - again[0].int()).abs().max() <= 1


@pytest.mark.parametrize("robot", EMBODIMENTS)
def test_every_weight_learns_and_nothing_of_the_autoencoder(robot: str) -> None:
    world = make(robot)
    clips = clip(world.spec, 2, 3, chunks=2)
    loss, _ = world.loss(clips, torch.Generator().manual_seed(1))
    loss.backward()
    assert [n for n, p in world.named_parameters() if p.requires_grad and p.grad is None] == []
    dead = [n for n, p in world.named_parameters() if p.grad is not None and not p.grad.abs().sum() > 0]
    assert dead == []
    assert all(p.grad is None for p in world.codec.parameters())
    expert = expert_of(world)
    clips = clip(world.spec, 2, 3)
    inputs = build_inputs(world.spec, clips, 0, generator=torch.Generator().manual_seed(0))
    features = expert.read(expert.look(world, inputs))
    expert.loss(features, clips["history"], clips["future"], torch.Generator().manual_seed(0)).backward()
    dead = [n for n, p in expert.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    # of one key's bias the softmax over all keys takes no notice
    assert all(name.endswith("to_k.bias") for name in dead), dead


def test_what_is_to_be_said_does_not_decide_what_it_weighs(dit: DiTSimulator) -> None:
    clips = clip(dit.spec, 2, 3)
    clips["future", "valid"][1, 3:] = False
    other = clips.clone()
    other["future", "frames"] = clips["future", "frames"].flip(-1)

    mine, others = (loss_weights(dit, dit.net.proj_out, data) for data in (clips, other))
    for one, same in zip(mine, others, strict=True):
        assert torch.equal(one, same) and len(one[one > 0].unique()) > 1
    chunk = dit.chunk_of(clips, torch.Generator().manual_seed(0))[1]
    assert (chunk[1, :, :, 3:] == 0).all() and (chunk[1, :, :, :3] >= 1).all()


def test_where_nothing_changes_the_newest_frame_stays_as_it_was(dit: DiTSimulator) -> None:
    torch.nn.init.zeros_(dit.net.proj_out.weight)  # its network says no change
    clips = clip(dit.spec, 2, 3, chunks=2)
    state = dit.reset(first_of(dit.spec, clips), torch.tensor([1, 2]))
    for step in range(2):
        frames, _, state = dit.step(state, future_of(dit.spec, clips, step))
        # The autoencoder has learned nothing: decoded, the frame would be noise.
        assert torch.equal(frames, clips["memory", "frames"][:, 0, :1].expand_as(frames))


@pytest.mark.parametrize("prediction", ["velocity", "clean"])
def test_loss_falls_and_frames_come_nearer(prediction: str) -> None:
    world = make("one_arm_deltas", prediction=prediction, augment=0.0)
    clips = clip(world.spec, 4, 3)
    world.normalise(clips["future", "commands"].flatten(0, 1), torch.zeros(1, 4), clips["now", "state"])
    optimiser = torch.optim.Adam([p for p in world.parameters() if p.requires_grad], 3e-3)
    generator, losses = torch.Generator().manual_seed(0), []
    for _ in range(60):
        optimiser.zero_grad()
        loss = world.loss(clips, generator)[0]
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])


def test_predictions_follow_the_flow_to_the_data(dit: DiTSimulator) -> None:
    from envs.simulators.dit.prediction import PREDICTIONS

    clean, noise, base = torch.randn(3, 2, 4)
    z = 0.3 * clean + 0.7 * noise
    for said, name in ((noise - clean, "velocity"), (clean - base, "clean")):
        prediction = PREDICTIONS[name]
        assert torch.allclose(prediction.velocity(said, z, 0.7, base), noise - clean, atol=1e-5)
        assert prediction.error(said, clean, noise, base).abs().max() < 1e-5
    with pytest.raises(ValueError, match=r"denoising\.prediction='x0'"):
        make("one_arm_deltas", prediction="x0")
    with pytest.raises(ValueError, match=r"task\.size"):
        DiTSimulator(world_spec(ARM_DELTAS, (24, 32)), 3, NET, {"channels": 8, "width": 16}, DENOISING)


def test_the_expert_learns_its_mix_and_the_simulator_takes_it_over(dit: DiTSimulator) -> None:
    expert = expert_of(dit)
    inputs = build_inputs(dit.spec, clip(dit.spec, 2, 3), 0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expert.net.video_buffer_weights.copy_(torch.tensor([0.5, 2.0, -1.0]))
    expert.attach(dit)
    mine = expert.read(expert.look(dit, inputs)).detach()
    assert torch.allclose(dit.features(inputs)[:, :, expert.read_tokens].detach(), mine, atol=1e-5)
    assert dit.features(inputs).shape[1:] == dit.feature_shape


def test_state_tokens_mean_what_the_robot_says() -> None:
    g = torch.Generator().manual_seed(0)
    for robot, absolute in (
        (BIMANUAL_JOINTS, True),
        (ARM_JOINTS, True),
        (BIMANUAL_POSES, False),
        (ARM_DELTAS, False),
    ):
        tokens = StateTokens(robot)
        commands, past = (torch.randn(1, n, robot.action_dim, generator=g) for n in (4, 2))
        states = torch.randn(1, 2, robot.state_dim, generator=g)
        clean, origin = tokens.clean(commands, past, states)
        assert clean.shape == (1, 8, max(robot.action_dim, robot.state_dim))
        assert (origin == 0).all() == absolute
        moved, _ = tokens.clean(commands + 1, past + 1, states)
        # only absolute joints and deltas are told as they are
        unmoved = torch.allclose(moved, clean, atol=1e-5)
        assert unmoved == (not absolute and not robot.delta)


def test_a_disturbed_past_lies_between_orientations_however_these_are_told(dit: DiTSimulator) -> None:
    expert = expert_of(dit)
    clips, yaw = clip(dit.spec, 64, 3), torch.tensor([3.1, -3.12, 3.13])
    clips["history", "states"][..., 5] = yaw  # it turns to and fro where yaw jumps from pi to -pi
    past = clips["history", "states"]
    expert.normalise(torch.randn(50, 14), torch.randn(50, 14), past.flatten(0, 1))
    seen: list[Tensor] = []
    clean = expert.tokens.clean

    def watch(commands: Tensor, past_commands: Tensor, past_states: Tensor) -> tuple[Tensor, Tensor]:
        seen.append(past_states)
        return clean(commands, past_commands, past_states)

    expert.tokens.clean = watch  # type: ignore[method-assign]
    inputs = build_inputs(dit.spec, clips, 0, generator=torch.Generator().manual_seed(0))
    features = expert.read(expert.look(dit, inputs))
    expert.loss(features, clips["history"], clips["future"], torch.Generator().manual_seed(0))
    assert (seen[0][..., 5].cos() < -0.99).all()
    assert not torch.equal(seen[0], past) and (seen[0] - past)[..., :5].abs().max() > 0.5  # disturbed


def test_cross_view_attention_in_every_third_block_only() -> None:
    net = tiny_net()
    calls = []
    for block in net.transformer_blocks:
        block.register_forward_pre_hook(lambda module, args: calls.append(args[-1]))
    net(torch.randn(3, 4, 2, 4, 4), torch.rand(3, 2), torch.zeros(1, 1, 8), 10.0)
    assert calls == [3, 1, 1]


def tiny_net() -> MultiViewDiT:
    torch.manual_seed(0)
    sizes = {"num_attention_heads": 2, "attention_head_dim": 24, "num_layers": 3, "adaln_lora_dim": 8}
    return MultiViewDiT(DiTShape(in_channels=4, out_channels=4, text_embed_dim=8, **sizes)).eval()


def test_known_text_keys_change_nothing() -> None:
    net = tiny_net()
    for p in net.parameters():
        torch.nn.init.normal_(p, std=0.1)
    latents, times, text = torch.randn(6, 4, 2, 4, 4), torch.rand(6, 2), torch.randn(1, 5, 8)
    anew = net(latents, times, text.repeat(6, 1, 1), 10.0)[0].detach()
    with torch.no_grad():
        for known in (text, net.text_keys(text)):
            assert torch.allclose(net(latents, times, known, 10.0)[0], anew, atol=1e-5)


def test_checkpointed_blocks_give_the_same_gradients(dit: DiTSimulator) -> None:
    grads = []
    for checkpointing in (False, True):
        dit.net.checkpointing = checkpointing
        dit.zero_grad()
        dit.loss(clip(dit.spec, 1, 3), torch.Generator().manual_seed(0))[0].backward()
        grads.append(dit.net.transformer_blocks[1].attn1.to_q.weight.grad.clone())
    assert torch.allclose(*grads, atol=1e-7)


def test_one_token_tells_everybody_the_same() -> None:
    torch.manual_seed(0)
    attention = Attention(24, 2, 8, context=12)
    asking, context = torch.randn(3, 5, 24), torch.randn(3, 1, 12)
    said = attention.of_one_token(attention.keys_of(context)[1])
    assert said.shape == (3, 1, 24) and torch.allclose(
        attention(asking, context), said.expand(-1, 5, -1), atol=1e-6
    )


def test_of_remembered_changes_none_is_summed_up_with_others() -> None:
    world = make("one_arm_deltas")
    clips = clip(world.spec, 2, 3)
    world.normalise(*(torch.randn(50, n) for n in (4, 4, 5)))
    clips["future", "commands"][1] = clips["future", "commands"][0]
    told = world.actions(build_inputs(world.spec, clips, 0))
    assert not torch.equal(clips["memory", "commands"][0], clips["memory", "commands"][1])
    assert torch.equal(told[0, 3:], told[1, 3:])
