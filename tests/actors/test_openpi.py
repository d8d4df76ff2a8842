"""policy=openpi against a real websocket server that speaks openpi's own messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
import websockets.sync.server
from openpi_client import msgpack_numpy

from actors.policies.openpi import OpenPIPolicy, PolicyServerError
from actors.rollouts.evaluate import evaluate
from envs.geometry.kinematics import Kinematics
from envs.layouts import CommandLayout, JointLayout, Joints
from envs.physics.env import PhysicsEnv
from envs.physics.tabletop.bench import BenchConfig
from envs.specs import ActionMode


class PolicyServer:
    """Answers every observation by a function; keeps what it was shown."""

    def __init__(self, act: Callable[[dict[str, Any]], Any]):
        self.seen: list[dict[str, Any]] = []

        def talk(socket: Any) -> None:
            pack = msgpack_numpy.Packer()
            socket.send(pack.pack({"name": "test"}))
            for message in socket:
                self.seen.append(msgpack_numpy.unpackb(message))
                answer = act(self.seen[-1])
                socket.send(answer if isinstance(answer, str) else pack.pack(answer))

        self.server = websockets.sync.server.serve(talk, "127.0.0.1", 0, max_size=None, compression=None)
        self.url = f"ws://127.0.0.1:{self.server.socket.getsockname()[1]}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def still() -> Iterator[PolicyServer]:
    """A policy that holds the arms where they are, fifty rows at a time."""

    def act(seen: dict[str, Any]) -> dict[str, Any]:
        state = seen["observation.state"]
        row = np.concatenate([state[:7], state[14:15], state[7:14], state[15:]])
        return {"actions": np.tile(row, (50, 1)).astype(np.float32)}

    server = PolicyServer(act)
    yield server
    server.server.shutdown()


@pytest.mark.parametrize("mode", [ActionMode.RELATIVE, ActionMode.ABSOLUTE])
def test_it_drives_physics_through_kinematics(still: PolicyServer, mode: ActionMode) -> None:
    env = PhysicsEnv(BenchConfig(), 2, 4, 8, mode=mode, workers=1)
    try:
        policy = OpenPIPolicy(still.url, BenchConfig().views, 4, CommandLayout.EEF, mode, Kinematics())
        env.schedule([3, 4])
        before = env.reset()
        outcome = evaluate(env, policy, [3, 4])
        after = env.rollout(1, policy=policy, auto_reset=True)
    finally:
        env.close()
    assert len(outcome.seeds) == 2
    shown = still.seen[0]
    assert (
        shown["observation.images.head"].shape == (64, 64, 3)
        and shown["observation.images.head"].dtype == np.uint8
        and "block" in shown["prompt"]
    )
    mine = Joints(before["observation", "state"][0], JointLayout.PER_ARM).to(JointLayout.GRIPPERS_LAST)
    assert np.allclose(shown["observation.state"], mine.numpy(), atol=1e-5)
    meant = Kinematics().flanges(Joints(after["observation", "state"][:, 0], JointLayout.PER_ARM))
    assert torch.allclose(after["next", "observation", "command"][:, 0, :3], meant[:, :3], atol=1e-4)


def test_joint_worlds_get_joints(still: PolicyServer) -> None:
    from tensordict import TensorDict

    policy = OpenPIPolicy(
        still.url, ("head", "hand_left", "hand_right"), 25, CommandLayout.JOINTS, ActionMode.ABSOLUTE
    )
    state = torch.arange(16.0)[None]
    said = policy(
        TensorDict(
            {
                "observation": TensorDict(
                    {
                        "image": torch.zeros(1, 3, 3, 8, 8, dtype=torch.uint8),
                        "state": state,
                        "command": state,
                    },
                    [1],
                )
            },
            [1],
        )
    )
    assert torch.equal(said["vla_action", "chunk"], state[:, None].expand(-1, 25, -1))


def test_what_a_policy_server_may_get_wrong() -> None:
    from tensordict import TensorDict

    state = torch.zeros(1, 16)
    seen = TensorDict(
        {
            "observation": TensorDict(
                {"image": torch.zeros(1, 1, 3, 8, 8, dtype=torch.uint8), "state": state, "command": state},
                [1],
            )
        },
        [1],
    )
    for answer, message in (
        ({"actions": np.zeros((50, 7), np.float32)}, r"\(50, 7\)"),
        ({"actions": np.full((50, 16), np.nan, np.float32)}, "finite"),
        ("Traceback", "Error in inference server"),
        ({}, "wanted at least"),
    ):
        server = PolicyServer(lambda _, answer=answer: answer)
        policy = OpenPIPolicy(server.url, ("head",), 25, CommandLayout.JOINTS, ActionMode.ABSOLUTE)
        with pytest.raises(PolicyServerError, match=message):
            policy(seen)
        server.server.shutdown()
    with pytest.raises(PolicyServerError, match="no openpi server listens"):
        OpenPIPolicy("ws://127.0.0.1:9", ("head",), 25, CommandLayout.JOINTS, ActionMode.ABSOLUTE)
    with pytest.raises(PolicyServerError, match="kinematics"):
        OpenPIPolicy("ws://127.0.0.1:9", ("head",), 25, CommandLayout.EEF, ActionMode.ABSOLUTE)
    with pytest.raises(PolicyServerError, match="address of an openpi server"):
        OpenPIPolicy("", ("head",), 25, CommandLayout.JOINTS, ActionMode.ABSOLUTE)
