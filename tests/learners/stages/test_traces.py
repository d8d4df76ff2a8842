"""Where hands go, as pixels: what is projected, and that key-points learn it from recordings alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from actors.policies.vla import ChunkPolicy
from envs.conditioning import end_effector_poses
from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.geometry.cameras import project
from envs.geometry.rotations import pose_transforms
from envs.specs import ActionMode
from envs.targets import build
from learners.stages.observed import observe
from learners.stages.perception import train_perception
from learners.stages.traces import CHUNKS, Hands, trace_loss
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES
from tests.sections import section

Stores = Callable[[Embodiment], ClipStore]
HANDS = Hands(tool_offset=0.1, kinematics=None)


def test_hands_are_seen_where_the_commands_to_come_put_them(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    robot, last = store.spec.embodiment, int(store.length[0]) - 1
    views = list(range(store.spec.views))
    seen = HANDS.ahead(store, torch.tensor([0, last]), views)
    assert seen is not None and seen.shape == (2, len(views), len(CHUNKS) * len(robot.arms), 2)
    height, width = store.spec.size
    for number, chunks in enumerate(CHUNKS):
        pose = end_effector_poses(robot, store.arrays["commands"][min(chunks * store.spec.chunk, last)])[1]
        frame = pose_transforms(pose)
        tip = frame[:3, 3] + 0.1 * frame[:3, 2]
        for view in views:
            pixel, depth = project(tip[None], store.intrinsic[0, view], store.arrays["c2w"][0, view])
            got = seen[0, view, number * len(robot.arms) + 1]
            if depth > 0:
                assert torch.allclose(got * torch.tensor([width, height]), pixel[0], rtol=1e-4, atol=1e-3)
            else:
                assert got.isnan().all()
    ends = seen[1].unflatten(1, (len(CHUNKS), -1))  # at the end of an episode nothing is to come
    assert torch.equal(ends.nan_to_num(), ends[:, :1].expand_as(ends).nan_to_num())


def test_robots_without_calibration_or_poses_have_no_traces(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    assert HANDS.ahead(store, torch.tensor([0]), [0]) is None


def test_the_loss_is_least_where_the_hand_is_and_leaves_out_what_nobody_sees() -> None:
    hands = torch.tensor([[[[0.325, 0.75], [float("nan"), 0.5], [1.2, 0.5]]]])
    found = torch.zeros(1, 1, 3, 10, 20)
    flat = float(trace_loss(found, hands))
    found[0, 0, 0, 7, 6] = 5.0  # row 7 of 10, column 6 of 20
    assert float(trace_loss(found, hands)) < flat - 1
    found[0, 0, 1:] = torch.randn(2, 10, 20)
    once = float(trace_loss(found, hands))
    found[0, 0, 1:] = torch.randn(2, 10, 20)
    assert float(trace_loss(found, hands)) == pytest.approx(once)
    assert float(trace_loss(found[:, :, 1:], hands[:, :, 1:])) == 0.0


def test_key_points_that_are_told_what_to_look_for_learn_where_hands_will_be(
    tiny_store: Stores, tmp_path: Path
) -> None:
    store = tiny_store(BIMANUAL_POSES)
    torch.manual_seed(0)
    small = {"width": 32, "channels": 8, "points": 4, "instruction_keypoints": len(CHUNKS) * 2}
    policy = build(section("policy/chunk_gaussian", "relative", **small), "policy", spec=store.spec)
    assert isinstance(policy, ChunkPolicy)
    rows = torch.arange(int(store.length[0]))
    hands = HANDS.ahead(store, rows, policy.views)
    assert hands is not None

    def loss() -> float:
        with torch.no_grad():
            found = policy.gaze(observe(store, rows))[1]
        return float(trace_loss(found[:, :, -policy.instruction_keypoints :], hands))

    before = loss()
    options = FitConfig(steps=60, batch=16, lr=3e-3, warmup=5, bf16=False)
    learn = torch.arange(len(store))
    train_perception(policy, store, learn, ActionMode.RELATIVE, options, tmp_path, 0.9, HANDS)
    assert loss() < before - 1
