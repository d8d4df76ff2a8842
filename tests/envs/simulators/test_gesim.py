"""GE-Sim's released form: checkpoints load strictly, sessions are independent, quirks only on request."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs.conditioning import render_ray_map
from envs.embodiment import ActionKind, Embodiment
from envs.geometry.kinematics import Kinematics
from envs.initial_states import InitialStates
from envs.judges.learned import LearnedJudge
from envs.simulators import memory
from envs.simulators.gesim.checkpoint import CheckpointError, load_released, load_state_network
from envs.simulators.gesim.engine import GESimulator, Sampling
from envs.simulators.gesim.state_expert import GESimStateExpert
from envs.simulators.inputs import build_inputs
from envs.simulators.samplers import DISTILLED, EDM, Distilled
from envs.simulators.state_experts.flow import StateExpert
from envs.specs import CHUNK, STATE, ActionMode, Rewards, WorldSpec
from envs.transforms import world_transforms
from envs.world import WorldEnv
from tests.arms import two_arms
from tests.embodiments import BIMANUAL_JOINTS, BIMANUAL_POSES
from tests.envs.simulators.clips import clip, first_of, future_of
from tests.envs.simulators.gesim_tiny import NET, SPEC, VAE, build, write_checkpoint


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("released") / "v2")


@pytest.fixture(scope="module")
def world(folder: Path) -> GESimulator:
    return build(folder)


def begin(world: GESimulator, seeds: list[int]) -> TensorDict:
    first = torch.cat([first_of(SPEC, clip(SPEC, 1, 4))] * len(seeds))
    return world.reset(first, torch.tensor(seeds))


def chunk(seed: int, count: int = 1) -> TensorDict:
    return torch.cat([future_of(SPEC, clip(SPEC, 1, 4, seed=seed))] * count)


def test_the_released_folder_loads_with_one_path(world: GESimulator, folder: Path) -> None:
    assert world.diffusion.sampler == Distilled() and world.ahead == 2
    assert world.net.shape.num_layers == NET["num_layers"] and not hasattr(world.net, "pose_blocks")
    expert = GESimStateExpert(world, str(folder)).eval()
    assert expert.normalised and expert.tokens.states.std[15] == pytest.approx(2.5)
    tensors = load_file(folder / "model.safetensors")
    for part in (world.net, expert.net):
        assert all(torch.equal(value, tensors[name]) for name, value in part.state_dict().items())
    frames, features, state = world.step(begin(world, [1]), chunk(0))
    assert frames.shape == (1, 5, 3, 3, *SPEC.size) and frames.float().std() > 1
    states = expert.follow(state, SPEC.chunk, features)
    assert states.shape == (1, 5, 16) and torch.isfinite(states).all()
    assert torch.equal(memory.recent(state, 5)["states"], states)


def test_gesim_1_is_one_file_with_fifteen_undistilled_steps(tmp_path: Path) -> None:
    path = write_checkpoint(tmp_path / "v1", expert=False)
    world = build(path)
    assert world.diffusion.sampler == EDM(15) and not GESimStateExpert(world, str(path)).normalised
    frames, features, _ = world.step(begin(world, [1]), chunk(0))
    assert frames.shape[1] == 5 and features.std() > 0


def test_rows_are_sessions_of_their_own(world: GESimulator) -> None:
    together, alone = begin(world, [1, 2]), begin(world, [2])
    for step in range(2):
        both, _, together = world.step(together, chunk(step, 2))
        one, _, alone = world.step(alone, chunk(step))
        assert (both[1].int() - one[0].int()).abs().max() <= 1 and not torch.equal(both[0], both[1])
    together = memory.replace(together, torch.tensor([True, False]), begin(world, [7]))
    assert together["length"].tolist() == [1, 11]
    mixed, _, _ = world.step(together, chunk(3, 2))
    again, _, _ = world.step(begin(world, [7]), chunk(3))
    assert (mixed[0].int() - again[0].int()).abs().max() <= 1


def test_conditioning_is_resized_as_released(world: GESimulator) -> None:
    state, future = begin(world, [1]), chunk(0)
    inputs = memory.build_inputs(state, world.recall(state, future), future)
    made = world.conditioning(inputs, (4, 6))
    assert made.shape == (1, 3, 10, 4 + 2, 4, 6)
    # Without antialiasing, halfway between the fourth and the fifth pixel of every eight.
    block = future["pose_map"][0, :, 0, 0, 3:5, 3:5].float().mean((-1, -2)) / 127.5 - 1
    # (0 + 0.5) * 5 / 2 - 0.5 = 0.75
    assert made[0, 0, 0, 4, 0, 0] == pytest.approx(float(0.25 * block[0] + 0.75 * block[1]), abs=1e-5)
    c2w = future["c2w"].transpose(1, 2)[:, :, :1]
    rays = render_ray_map(state["intrinsic"], c2w, SPEC.size)[0, 0, 0, 5, 3:5, 3:5].mean()
    assert made[0, 0, 8, 0, 0, 0] == pytest.approx(float(rays), abs=1e-5)
    assert (made[:, :, 9, :4] == 1).all() and (made[:, :, 9, 4:] == 0).all()


def test_parity_repeats_the_released_quirks(folder: Path) -> None:
    right, released, replayed = (
        build(folder, parity=name) for name in ("right", "released", "released_replay")
    )
    state = begin(right, [1])
    for step in range(2):  # history: the first frame and ten more
        _, _, state = right.step(state, chunk(step))
    future, history = chunk(2), state["history"]["frames"][0]
    assert torch.equal(right.recall(state, future)["frames"][0], history[[0, 3, 7, 10]])
    assert torch.equal(released.recall(state, future)["frames"][0], history[[1, 4, 7, 10]])
    shown = released.recall(state, future)["pose_map"][0]
    assert torch.equal(shown, future["pose_map"][0, :1].expand_as(shown))
    kept = state["history"]["pose_map"][0][[1, 4, 7, 10]]
    assert torch.equal(replayed.recall(state, future)["pose_map"][0], kept)
    assert torch.equal(released.recall(begin(right, [1]), future)["frames"][0], history[[0, 0, 0, 0]])
    expert = GESimStateExpert(released, str(folder))
    past = torch.arange(20.0)[None, :, None].expand(1, -1, 16)
    first = torch.full((1, 5, 16), -1.0)
    thinned = expert._thinned(past, first, torch.tensor([3]))[0, :, 0]
    assert expert.memory_frames == 20 and thinned.tolist() == [-1, -1, 14, 19]


def test_one_step_of_the_undistilled_sampler_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"simulator\.sampling\.steps=1 of the undistilled"):
        Sampling("edm", 1)
    path = write_checkpoint(tmp_path / "v1", expert=False)
    with pytest.raises(ValueError, match=r"simulator\.sampling\.steps=2 or more"):
        build(path, sampling={"kind": "", "steps": 1})
    assert Sampling("", 1).sampler(EDM(), True).evaluations == 1
    assert Sampling("edm", 2).sampler(EDM(), True) == EDM(2)


def test_a_student_has_levels_of_its_own_and_a_released_one_its_first() -> None:
    levels = {2: (1.0, 5 / 6), 3: (1.0, 10 / 11, 5 / 7), 4: (1.0, 15 / 16, 5 / 6, 5 / 8)}
    for steps, own in levels.items():
        section = GESimulator.student_section({"sampling": {"kind": "edm", "steps": 15}}, steps)
        world = build(None, sampling=section["sampling"])
        assert world.sampler.jumps and world.sampler.sigmas == pytest.approx(own, abs=1e-6)  # type: ignore[attr-defined]
        released = build(None, sampling={"kind": "distilled", "steps": steps})
        assert released.sampler == Distilled(DISTILLED[:steps])


def test_a_thinned_state_expert_trains_on_the_history_that_it_decodes_from() -> None:
    world = build(None, parity="released")
    expert = GESimStateExpert(world, None)
    clips = clip(SPEC, 1, 4)
    past = torch.arange(20.0)[None, :, None].expand(1, -1, 16)
    history = TensorDict({"commands": past, "states": past}, [1])
    seen: list[tuple[torch.Tensor, torch.Tensor]] = []
    clean = expert.tokens.clean

    def watch(
        commands: torch.Tensor, past_commands: torch.Tensor, past_states: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        seen.append((past_commands, past_states))
        return clean(commands, past_commands, past_states)

    expert.tokens.clean = watch  # type: ignore[method-assign]
    features = expert.read(expert.look(world, build_inputs(SPEC, clips, 0)))
    loss = expert.loss(features, history, clips["future"], torch.Generator().manual_seed(0))
    commands, states = seen[0]
    assert torch.isfinite(loss) and commands[0, :, 0].tolist() == [4, 9, 14, 19]
    # shifted by at most three frames, as it would be unthinned
    assert states.shape == (1, 4, 16) and (states - commands).abs().max() < 4


def test_it_trains_whole_and_for_other_robots() -> None:
    """The state expert of GE-Sim's form takes any robot whose pose maps can be drawn."""
    for spec in (SPEC, WorldSpec(BIMANUAL_POSES, (32, 48), 5, pose_map=True, ray_map=True)):
        torch.manual_seed(0)
        world = build(None, spec).train()
        clips = clip(spec, 1, 4)
        world.loss(clips, torch.Generator().manual_seed(0))[0].backward()
        trained = {name: p for name, p in world.named_parameters() if p.requires_grad}
        # An untrained prompt is zero, so nobody asks it anything.
        unused = [
            n for n, p in trained.items() if p.grad is None and ".attn2." not in n and ".norm2." not in n
        ]
        assert trained and unused == []
        inputs = build_inputs(spec, clips, 0)
        for expert in (GESimStateExpert(world, None), StateExpert(world, 1, 2, 16, 2)):
            features = expert.read(expert.look(world, inputs))
            loss = expert.loss(features, clips["history"], clips["future"], torch.Generator().manual_seed(0))
            loss.backward()
            assert torch.isfinite(loss) and all(p.grad is not None for p in expert.parameters())


def test_what_is_wrong_with_a_checkpoint_is_listed(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"model\.safetensors.*missing"):
        load_released(tmp_path)
    broken = write_checkpoint(tmp_path / "broken")
    tensors = load_file(broken / "model.safetensors")
    gone, kept = "transformer_blocks.1.attn1.to_q.weight", dict(tensors)
    del kept[gone]
    save_file(kept | {"surprise": torch.zeros(1)}, broken / "model.safetensors")
    with pytest.raises(CheckpointError, match=rf"Missing: {gone}\. Unexpected: surprise\."):
        load_released(broken)
    save_file(tensors, broken / "model.safetensors")
    (broken / "norm_stats.json").write_text(json.dumps({"action": {"mean": [0] * 16, "std": [1] * 16}}))
    with pytest.raises(CheckpointError, match="norm_stats"):
        load_state_network(broken)
    torch.save({"a": torch.nn.Linear(1, 1)}, broken / "prompt_embeds.pt")
    (broken / "norm_stats.json").write_text((folder / "norm_stats.json").read_text())
    with pytest.raises(CheckpointError, match=r"prompt_embeds\.pt cannot be read as tensors alone"):
        load_released(broken)
    (broken / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_released(broken)
    with pytest.raises(CheckpointError, match="3 views"):
        build(folder, replace(SPEC, embodiment=replace(SPEC.embodiment, cameras=SPEC.embodiment.cameras[:2])))
    with pytest.raises(CheckpointError, match=r"knows 16 joints.*actions of 14"):
        spec = WorldSpec(BIMANUAL_POSES, (32, 48), 5, pose_map=True, ray_map=True)
        GESimStateExpert(build(folder, spec), str(folder))


def test_released_statistics_know_one_order_of_joints(folder: Path) -> None:
    def refuse(robot: Embodiment, said: str) -> None:
        with pytest.raises(CheckpointError, match=rf"in one order.*{said}.*state_expert\.checkpoint=null"):
            GESimStateExpert.check({"checkpoint": str(folder)}, robot)
        GESimStateExpert.check({"checkpoint": None}, robot)

    names, (left, right) = BIMANUAL_JOINTS.action_names, BIMANUAL_JOINTS.arms
    last = (*names[:7], *names[8:15], names[7], names[15])
    GESimStateExpert.check({"checkpoint": str(folder)}, BIMANUAL_JOINTS)
    refuse(replace(BIMANUAL_JOINTS, state_names=last), "'left_gripper', 'right_gripper'")
    arms = (replace(left, gripper=14), replace(right, numbers=tuple(range(7, 14))))
    refuse(replace(BIMANUAL_JOINTS, action_names=last, state_names=last, arms=arms), "'right_gripper'")
    turned = (replace(left, name="right"), replace(right, name="left"))
    refuse(replace(BIMANUAL_JOINTS, arms=turned), "right_gripper")
    refuse(replace(BIMANUAL_JOINTS, action_kind=ActionKind.OTHER), "(other, delta=False)")
    refuse(replace(BIMANUAL_JOINTS, state_names=tuple(f"torque{k}" for k in range(16))), "torque0")


@pytest.mark.parametrize(("opened", "closed"), [(35.0, 120.0), (100.0, 0.0)])
def test_released_statistics_know_grippers_as_closed_shares(
    opened: float, closed: float, folder: Path
) -> None:
    def told(ends: tuple[float, float], commands: torch.Tensor) -> torch.Tensor:
        arms = tuple(replace(arm, gripper_range=ends) for arm in BIMANUAL_JOINTS.arms)
        spec = replace(SPEC, embodiment=replace(SPEC.embodiment, arms=arms))
        return GESimStateExpert(build(folder, spec), str(folder)).tokens.actions(commands)

    shares = torch.linspace(0, 1, 32).reshape(2, 16)
    commands = shares.clone()
    commands[:, [7, 15]] = opened + (closed - opened) * shares[:, [7, 15]]
    assert torch.allclose(told((opened, closed), commands), told((0.0, 1.0), shares), atol=1e-5)


def test_from_nothing_at_any_size_and_chunks_that_fit_the_autoencoder() -> None:
    assert build(None).feature_shape == (3, 6 * 2 * 3, 48)
    with pytest.raises(ValueError, match="1 \\+ a multiple of 4"):
        build(None, replace(SPEC, chunk=6))
    with pytest.raises(ValueError, match="steps=9"):
        build(None, sampling={"kind": "", "steps": 9})
    with pytest.raises(ValueError, match="parity"):
        build(None, parity="almost")
    with pytest.raises(ValueError, match=r"scratch\.net.*layrs"):
        build(None, scratch={"net": {"layrs": 3}, "vae": VAE})
    with pytest.raises(ValueError, match=r"simulator\.pose_map=true"):
        build(None, replace(SPEC, pose_map=False))


def test_rl_runs_inside_a_joint_world(tmp_path: Path) -> None:
    """GE-Sim of 16 joints is an ordinary environment: chunks go in, states and rewards come out."""
    robot = replace(BIMANUAL_JOINTS, kinematics=two_arms(tmp_path))
    spec = WorldSpec(robot, (32, 48), 5, pose_map=True, ray_map=True)
    world = build(None, spec)
    judge = LearnedJudge(
        spec,
        hold=99,
        margin=0.0,
        discount=0.9,
        width=8,
        points=8,
        hidden=16,
        cameras="all",
        instruction_keypoints=0,
    )
    starts = InitialStates(first_of(spec, clip(spec, 3, 4)), ["pour"] * 3)
    base = WorldEnv(world, starts, 2, 10, ActionMode.RELATIVE, shared_noise=False, bf16=False)
    expert = GESimStateExpert(world, None).eval()
    transforms = world_transforms(
        spec, expert, judge, Rewards(1.0, 1.0), kinematics=Kinematics(two_arms(tmp_path))
    )
    env = TransformedEnv(base, transforms)
    check_env_specs(env)
    policy = ChunkMean(spec)
    rollout = env.rollout(2, policy)
    assert rollout[CHUNK].shape == (2, 2, 5, 16) and rollout["next", STATE].shape == (2, 2, 16)
    assert torch.isfinite(rollout["next", "reward"]).all()
    wrists = rollout["next", "camera", "c2w"]
    assert not torch.allclose(wrists[:, 0, 1], wrists[:, 1, 1])  # went with their flange
    assert torch.allclose(wrists[:, 0, 0], wrists[:, 1, 0])  # stands still


class ChunkMean(TensorDictModuleBase):
    """A policy that moves every joint on."""

    in_keys: ClassVar = [STATE]
    out_keys: ClassVar = [CHUNK]

    def __init__(self, spec: WorldSpec):
        super().__init__()
        self.rows = 0.1 * torch.arange(1, spec.chunk + 1)[:, None].expand(-1, spec.action_dim)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(CHUNK, self.rows.expand(*tensordict.shape, -1, -1).clone())
