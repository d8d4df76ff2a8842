"""Cloning: the chunks that are imitated, any policy, and acting alike on recorded and generated pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
import torch

from envs.embodiment import Arm, Embodiment
from envs.episodes.clips import ClipStore
from envs.specs import C2W, IMAGE, INSTRUCTION_UTF8, ActionMode, bytes_to_text
from learners.stages.imitation import Cloning, chunks_ahead, train_imitation
from learners.stages.observed import observe
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES, EMBODIMENTS
from tests.learners.models import POLICIES, policy_of
from tests.moving_square import INSTRUCTION
from tests.sampling import every

Stores = Callable[[Embodiment], ClipStore]
QUICK = FitConfig(steps=40, batch=16, lr=3e-3, warmup=5, bf16=False)


def losses(folder: Path) -> list[float]:
    return [json.loads(line)["imitation/loss"] for line in (folder / "metrics.jsonl").open()]


def modes(robot: Embodiment) -> ActionMode:
    return ActionMode.ABSOLUTE if robot.delta else ActionMode.RELATIVE


@pytest.mark.parametrize(
    ("name", "robot"),
    every(5, product(POLICIES, EMBODIMENTS.values())),
    ids=lambda value: getattr(value, "robot", value),
)
def test_every_policy_learns_to_imitate(
    name: str, robot: Embodiment, tiny_store: Stores, tmp_path: Path
) -> None:
    store = tiny_store(robot)
    policy = policy_of(name, store.spec, modes(robot))
    demos = store.select(["expert"], succeeded=True)
    train_imitation(Cloning(policy, store, demos, modes(robot)), QUICK, tmp_path)
    rows = losses(tmp_path)
    assert sum(rows[-5:]) < 0.8 * sum(rows[:5])


def test_chunks_are_the_next_commands_and_hold_at_the_end(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    start, length, chunk = int(store.start[1]), int(store.length[1]), store.spec.chunk
    rows = torch.tensor([start, start + length - 2])
    commands = store.arrays["commands"]
    absolute = chunks_ahead(store, rows, ActionMode.ABSOLUTE)
    assert torch.equal(absolute[0], commands[start + 1 : start + 1 + chunk])
    assert torch.equal(absolute[1], commands[start + length - 1].expand(chunk, -1))
    relative = chunks_ahead(store, rows, ActionMode.RELATIVE)
    assert torch.allclose(relative + commands[rows][:, None], absolute)


def test_past_the_end_of_a_robot_that_takes_changes_only_grippers_go_on(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    store.arrays["commands"] = torch.ones_like(store.arrays["commands"])
    row = torch.tensor([int(store.length[0]) - 2])
    chunk = chunks_ahead(store, row, ActionMode.ABSOLUTE)[0]
    assert chunk[0].tolist() == [1.0] * 4 and chunk[1:].tolist() == [[0.0, 0.0, 0.0, 1.0]] * (len(chunk) - 1)


def test_a_base_does_not_drive_on_past_the_end(tiny_store: Stores) -> None:
    names = (*ARM_JOINTS.action_names[:4], "x.vel", "theta.vel", "gripper.pos")
    robot = replace(ARM_JOINTS, action_names=names, arms=(Arm("arm", (0, 1, 2, 3), 6, (100.0, 0.0)),))
    robot = replace(robot, cameras=tuple(replace(camera, wrist=None) for camera in robot.cameras))
    store = tiny_store(robot)
    store.arrays["commands"] = torch.ones_like(store.arrays["commands"])
    row = torch.tensor([int(store.length[0]) - 2])
    chunk = chunks_ahead(store, row, ActionMode.ABSOLUTE)[0]
    assert chunk[0].tolist() == [1.0] * 7
    assert chunk[1:].tolist() == [[1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0]] * (len(chunk) - 1)
    assert robot.changes == (4, 5) and not ARM_JOINTS.changes and ARM_DELTAS.changes == (0, 1, 2)


def test_what_is_observed(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    cloning = Cloning(policy_of("chunk_gaussian", store.spec), store, torch.arange(4), ActionMode.RELATIVE)
    seen = observe(store, store.start[:2] + 3)
    assert torch.equal(seen[IMAGE], store.frames(store.start[:2] + 3))
    assert bytes_to_text(seen[INSTRUCTION_UTF8]) == [INSTRUCTION] * 2 and seen[C2W].shape == (2, 3, 4, 4)
    draw = cloning.sample(4, torch.Generator().manual_seed(1))
    same = cloning.sample(4, torch.Generator().manual_seed(1))
    assert torch.equal(draw["target"], same["target"])
    assert torch.equal(draw["observed", IMAGE], same["observed", IMAGE])


def test_a_frozen_perception_encodes_each_frame_once(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    policy = policy_of("chunk_gaussian", store.spec)
    policy.freeze_perception()
    cloning = Cloning(policy, store, torch.arange(4), ActionMode.RELATIVE)
    cloning.state_noise.zero_()
    plain = cloning.sample(8, torch.Generator().manual_seed(0))
    wanted = policy.imitation_loss(plain["observed"], plain["target"])
    cloning.encode()
    data = cloning.sample(8, torch.Generator().manual_seed(0))
    assert IMAGE not in data["observed"].keys(True)
    loss = cloning.loss(data, torch.Generator().manual_seed(0))
    assert float(loss.detach()) == pytest.approx(float(wanted.detach()), rel=1e-4)


def test_a_policy_without_features_cannot_keep_them(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    cloning = Cloning(policy_of("tiny_vla", store.spec), store, torch.arange(4), ActionMode.ABSOLUTE)
    with pytest.raises(ValueError, match=r"rl\.freeze_perception=false"):
        cloning.encode()
