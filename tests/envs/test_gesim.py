"""GE-Sim's released form: checkpoints load strictly, sessions are independent rows, quirks only on request."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from envs.conditioning import render_ray_map
from envs.geometry.kinematics import Kinematics, KinematicsError
from envs.judges import LearnedJudge
from envs.layouts import CommandLayout
from envs.simulators.base import WorldShape
from envs.simulators.gesim.checkpoint import CheckpointError, load_released
from envs.simulators.gesim.engine import GESimConfig, GESimulator
from envs.simulators.samplers import EDM, Distilled
from envs.specs import CHUNK, STATE, ActionMode, Rewards
from envs.transforms import world_transforms
from envs.world import InitialStates, WorldEnv
from tests.envs.gesim_tiny import NET, VAE, write_checkpoint

SHAPE = WorldShape(views=3, size=(32, 48), chunk=5, memory=4, fps=30.0, sides=(), layout=CommandLayout.JOINTS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("released") / "v2")


@pytest.fixture(scope="module")
def world(folder: Path) -> GESimulator:
    return GESimulator.build(SHAPE, GESimConfig(), str(folder)).eval()


def begin(world: GESimulator, seeds: list[int]) -> TensorDict:
    g = torch.Generator().manual_seed(5)
    first = torch.randint(0, 255, (1, 3, 3, *SHAPE.size), dtype=torch.uint8, generator=g)
    count = len(seeds)
    eye = torch.eye(4).repeat(count, 3, 1, 1)
    k = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).repeat(count, 3, 1, 1)
    return world.reset(
        first.repeat(count, 1, 1, 1, 1),
        k,
        eye,
        torch.zeros(count, 16),
        torch.zeros(count, 16),
        first.repeat(count, 1, 1, 1, 1),
        torch.tensor(seeds),
    )


def chunk(seed: int, count: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    maps = torch.randint(0, 255, (1, 5, 3, 3, *SHAPE.size), dtype=torch.uint8, generator=g)
    return (
        torch.randn(1, 5, 16, generator=g).repeat(count, 1, 1),
        maps.repeat(count, 1, 1, 1, 1, 1),
        torch.eye(4).repeat(count, 5, 3, 1, 1),
    )


def test_the_released_folder_loads_with_one_path(world: GESimulator) -> None:
    assert (
        world.sampler == Distilled() and world.ahead == 2 and world.net.shape.num_layers == NET["num_layers"]
    )
    expert = world.state_expert()
    assert expert.normalised and expert.state_std[15] == pytest.approx(2.5)
    state = begin(world, [1])
    frames, features, state = world.step(state, *chunk(0))
    assert frames.shape == (1, 5, 3, 3, *SHAPE.size) and frames.float().std() > 1
    recent = world.recent(state, 9)
    states = expert.decode(
        features,
        recent["commands"][:, -5:],
        recent["commands"][:, :4],
        recent["states"][:, :4],
        state["seed"],
        state["chunk_index"],
    )
    assert states.shape == (1, 5, 16) and torch.isfinite(states).all()


def test_gesim_1_is_one_file_with_fifteen_undistilled_steps(tmp_path: Path) -> None:
    world = GESimulator.build(
        SHAPE, GESimConfig(), str(write_checkpoint(tmp_path / "v1", expert=False))
    ).eval()
    assert world.sampler == EDM(15) and world.net.shape.pose_expert and not world.state_expert().normalised
    frames, _, _ = world.step(begin(world, [1]), *chunk(0))
    assert frames.shape[1] == 5


def test_rows_are_sessions_of_their_own(world: GESimulator) -> None:
    together, alone = begin(world, [1, 2]), begin(world, [2])
    for step in range(2):
        both, _, together = world.step(together, *chunk(step, 2))
        one, _, alone = world.step(alone, *chunk(step))
        assert (both[1].int() - one[0].int()).abs().max() <= 1 and not torch.equal(both[0], both[1])
    fresh = begin(world, [7])
    group_size = world.replace(together, torch.tensor([True, False]), fresh)
    assert together["length"].tolist() == [1, 11]
    mixed, _, _ = world.step(together, *chunk(3, 2))
    again, _, _ = world.step(begin(world, [7]), *chunk(3))
    assert (mixed[0].int() - again[0].int()).abs().max() <= 1


def test_conditioning_is_resized_as_released(world: GESimulator) -> None:
    state = begin(world, [1])
    _, maps, c2w = chunk(0)
    inputs = TensorDict(
        {
            "memory": world.recall(state, maps, c2w),
            "future": TensorDict({"pose_map": maps, "c2w": c2w}, [1]),
            "intrinsic": state["intrinsic"],
        },
        [1],
    )
    made = world.conditioning(inputs, (4, 6))
    assert made.shape == (1, 3, 10, 4 + 2, 4, 6)
    # Without antialiasing, halfway between the fourth and the fifth pixel of every eight.
    block = maps[0, :, 0, 0, 3:5, 3:5].float().mean((-1, -2)) / 127.5 - 1
    # (0 + 0.5) * 5 / 2 - 0.5 = 0.75
    assert made[0, 0, 0, 4, 0, 0] == pytest.approx(float(0.25 * block[0] + 0.75 * block[1]), abs=1e-5)
    rays = render_ray_map(state["intrinsic"], c2w.transpose(1, 2)[:, :, :1], SHAPE.size)[
        0, 0, 0, 5, 3:5, 3:5
    ].mean()
    assert made[0, 0, 8, 0, 0, 0] == pytest.approx(float(rays), abs=1e-5)
    assert (made[:, :, 9, :4] == 1).all() and (made[:, :, 9, 4:] == 0).all()


def test_parity_repeats_the_released_quirks(folder: Path) -> None:
    right, released, replayed = (
        GESimulator.build(SHAPE, GESimConfig(parity=name), str(folder)).eval()
        for name in ("right", "released", "released_replay")
    )
    state = begin(right, [1])
    _, _, state = right.step(state, *chunk(0))
    _, _, state = right.step(state, *chunk(1))  # history: the first frame and ten more
    _, maps, c2w = chunk(2)
    history = state["history"]["frames"][0]
    assert torch.equal(right.recall(state, maps, c2w)["frames"][0], history[[0, 3, 7, 10]])
    assert torch.equal(released.recall(state, maps, c2w)["frames"][0], history[[1, 4, 7, 10]])
    assert torch.equal(
        released.recall(state, maps, c2w)["pose_map"][0], maps[0, :1].expand(4, -1, -1, -1, -1)
    )
    assert torch.equal(
        replayed.recall(state, maps, c2w)["pose_map"][0], state["history"]["pose_map"][0][[1, 4, 7, 10]]
    )
    assert torch.equal(released.recall(begin(right, [1]), maps, c2w)["frames"][0], history[[0, 0, 0, 0]])
    expert = released.state_expert()
    past = torch.arange(20.0)[None, :, None].expand(1, -1, 16)
    first = torch.full((1, 5, 16), -1.0)
    assert expert.memory == 20 and expert._thinned(past, first, torch.tensor([3]))[0, :, 0].tolist() == [
        -1,
        -1,
        14,
        19,
    ]


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
        load_released(broken)
    torch.save({"a": torch.nn.Linear(1, 1)}, broken / "prompt_embeds.pt")
    (broken / "norm_stats.json").write_text((folder / "norm_stats.json").read_text())
    with pytest.raises(CheckpointError, match=r"prompt_embeds\.pt cannot be read as tensors alone"):
        load_released(broken)
    (broken / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_released(broken)
    with pytest.raises(CheckpointError, match="3 views"):
        GESimulator.build(
            WorldShape(views=2, size=(32, 48), chunk=5, sides=(), layout=CommandLayout.JOINTS),
            GESimConfig(),
            str(folder),
        )


def test_from_nothing_at_any_size_and_chunks_that_fit_the_autoencoder() -> None:
    world = GESimulator.build(SHAPE, GESimConfig(net=NET, vae=VAE), None)
    assert world.feature_shape == (3, 6 * 2 * 3, 48)
    with pytest.raises(ValueError, match="1 \\+ a multiple of 4"):
        GESimulator.build(
            WorldShape(views=3, size=(32, 48), chunk=6, sides=()), GESimConfig(net=NET, vae=VAE), None
        )
    with pytest.raises(ValueError, match="steps=9"):
        GESimConfig(steps=9)
    with pytest.raises(ValueError, match="parity"):
        GESimConfig(parity="almost")


def test_a_joint_world_is_an_ordinary_environment(world: GESimulator) -> None:
    rest = torch.tensor([0, -0.35, 0, 2.1, 0, 1.39, 0, 0.2] * 2)
    count, views = 3, ("head", "hand_left", "hand_right")
    k = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).repeat(count, 3, 1, 1)
    c2w = torch.eye(4).repeat(count, 3, 1, 1)
    c2w[..., 2, 3] = -2.0
    pictures = torch.randint(
        0, 255, (count, 3, 3, *SHAPE.size), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )
    starts = InitialStates(
        pictures,
        torch.full_like(pictures, 50),
        rest.repeat(count, 1),
        rest.repeat(count, 1),
        k,
        c2w,
        ["pour"] * count,
        views,
    )

    def env(kinematics: Kinematics | None) -> TransformedEnv:
        base = WorldEnv(world, starts, 2, 10, ActionMode.ABSOLUTE, bf16=False)
        return TransformedEnv(
            base,
            world_transforms(
                world.state_expert().eval(), LearnedJudge(3, 4), Rewards(), views, kinematics=kinematics
            ),
        )

    check_env_specs(env(Kinematics()))
    acting = env(Kinematics())
    now = acting.reset()
    now[CHUNK] = rest.repeat(2, 5, 1)
    after = acting.step(now)["next"]
    assert after[STATE].shape == (2, 16) and after["observation", "command"].shape == (2, 16)
    # Wrist cameras went with the hands, which the joints say stayed where they were.
    assert torch.allclose(after["camera", "c2w"], now["camera", "c2w"], atol=1e-5)
    lost = env(None)
    now = lost.reset()
    now[CHUNK] = rest.repeat(2, 5, 1)
    with pytest.raises(KinematicsError, match=r"simulator\.kinematics"):
        lost.step(now)
    now[CHUNK] = torch.zeros(2, 5, 14)
    with pytest.raises(ValueError, match="L7,Lg,R7,Rg"):
        lost.step(now)
