"""policy=openpi against a real websocket server that speaks openpi's own messages."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import websockets.sync.server
from openpi_client import msgpack_numpy
from tensordict import TensorDict

from actors.policies.openpi import OpenPIPolicy, PolicyServerError, compress
from envs.conditioning.joint_commands import JointCommands
from envs.embodiment import Embodiment
from envs.geometry.kinematics import Kinematics
from envs.specs import CHUNK, COMMAND, IMAGE, STATE, WorldSpec
from tests.arms import two_arms
from tests.embodiments import (
    ARM_DELTAS,
    ARM_JOINTS,
    BIMANUAL_JOINTS,
    BIMANUAL_POSES,
    INSTRUCTIONS,
    observations,
    world_spec,
)


class PolicyServer:
    """Answers every observation by a function; keeps what it was shown."""

    def __init__(self, act: Callable[[dict[str, Any]], Any]):
        self.seen: list[dict[str, Any]] = []
        self.paths: list[str] = []

        def talk(socket: Any) -> None:
            self.paths.append(socket.request.path)
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
    """A policy that holds the joints where they are, fifty rows at a time; it sees grippers last."""

    def act(seen: dict[str, Any]) -> dict[str, Any]:
        state = seen["observation.state"]
        if len(state) == 16:
            state = np.concatenate([state[:7], state[14:15], state[7:14], state[15:]])
        return {"actions": np.tile(state, (50, 1)).astype(np.float32)}

    server = PolicyServer(act)
    yield server
    server.server.shutdown()


def ask(
    spec: WorldSpec, url: str, mode: str, joints: bool = False, **options: Any
) -> tuple[TensorDict, OpenPIPolicy]:
    given = {"grippers_last": True, "longer": "first"} | options
    policy = OpenPIPolicy(spec, url, mode, joints, **given)
    return policy(observations(spec, 2)), policy


@pytest.mark.parametrize("robot", [BIMANUAL_JOINTS, ARM_JOINTS])
def test_joint_worlds_get_joints_and_servers_see_grippers_at_the_end(
    still: PolicyServer, robot: Embodiment
) -> None:
    spec = world_spec(robot)
    said, _ = ask(spec, still.url, "absolute")
    held = said[STATE][:, None].expand(-1, spec.chunk, -1)
    assert torch.allclose(said[CHUNK], held, atol=1e-5)
    shown, state = still.seen[0], said[STATE][0].tolist()
    last = [state[k] for k in robot.grippers]
    first = [value for k, value in enumerate(state) if k not in robot.grippers]
    assert shown["observation.state"].tolist() == pytest.approx([*first, *last])
    assert shown["prompt"] == INSTRUCTIONS[0] and still.seen[1]["prompt"] == INSTRUCTIONS[1]
    picture = shown[f"observation.images.{robot.views[1]}"]
    assert picture.shape == (*spec.size, 3) and picture.dtype == np.uint8
    assert np.array_equal(picture, said[IMAGE][0, 1].permute(1, 2, 0).numpy())
    said, _ = ask(spec, still.url, "relative")
    assert torch.allclose(
        said[CHUNK] + said[COMMAND][:, None], said[STATE][:, None].expand(-1, spec.chunk, -1)
    )


def test_pose_worlds_get_poses_through_the_kinematics(still: PolicyServer, tmp_path: Path) -> None:
    robot = two_arms(tmp_path)
    # This robot takes poses, and its state is its joints, as the bench's is.
    body = replace(BIMANUAL_POSES, kinematics=robot, state_names=BIMANUAL_JOINTS.state_names)
    said, policy = ask(world_spec(body), still.url, "absolute", joints=True)
    assert policy.width == 16 and policy.grippers == (7, 15)
    meant = JointCommands(body, Kinematics(robot))(said[STATE])
    assert torch.allclose(said[CHUNK][:, 0], meant, atol=1e-5) and said[CHUNK].shape == (2, 4, 14)
    with pytest.raises(PolicyServerError, match=r"simulator\.kinematics"):
        ask(world_spec(BIMANUAL_POSES), still.url, "absolute", joints=True)


def test_grippers_are_found_in_the_state_by_name(still: PolicyServer) -> None:
    names = BIMANUAL_JOINTS.state_names
    turned = replace(BIMANUAL_JOINTS, state_names=(*names[8:], *names[:8]))  # the right arm first
    said, _ = ask(world_spec(turned), still.url, "absolute")
    state = said[STATE][0].tolist()
    shown = still.seen[0]["observation.state"].tolist()
    assert shown == pytest.approx([*state[:7], *state[8:15], state[15], state[7]])
    nameless = replace(ARM_JOINTS, state_names=(*ARM_JOINTS.state_names[:6], "opening"))
    with pytest.raises(PolicyServerError, match=r"gripper\.pos.*policy\.grippers_last=false"):
        ask(world_spec(nameless), still.url, "absolute")
    said, _ = ask(world_spec(nameless), still.url, "absolute", grippers_last=False)
    assert still.seen[-2]["observation.state"].tolist() == pytest.approx(said[STATE][0].tolist())


def test_of_longer_answers_the_first_rows_are_taken_unless_asked_otherwise() -> None:
    rows = np.repeat(np.arange(10, dtype=np.float32)[:, None], 16, 1)
    server = PolicyServer(lambda _: {"actions": rows})
    spec = world_spec(BIMANUAL_JOINTS)
    said, _ = ask(spec, server.url, "absolute")
    assert said[CHUNK][0, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    said, _ = ask(spec, server.url, "absolute", longer="compress")
    assert torch.equal(said[CHUNK][0], compress(torch.from_numpy(rows), 4, (7, 15)))
    with pytest.raises(PolicyServerError, match=r"set policy\.longer=first"):
        ask(world_spec(ARM_DELTAS), server.url, "absolute", grippers_last=False, longer="compress")
    with pytest.raises(PolicyServerError, match=r"policy\.longer='last'"):
        ask(spec, server.url, "absolute", longer="last")
    server.server.shutdown()


def test_the_whole_url_reaches_the_server(still: PolicyServer, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = world_spec(BIMANUAL_JOINTS)
    ask(spec, f"{still.url}/policies/pi?robot=2", "absolute")
    assert still.paths == ["/policies/pi?robot=2"]
    tried: list[tuple[str, int]] = []

    def refuse(address: tuple[str, int], timeout: float) -> None:
        tried.append(address)
        raise ConnectionRefusedError("nobody")

    monkeypatch.setattr("socket.create_connection", refuse)
    for url in ("wss://policy.test/pi", "ws://policy.test", "wss://policy.test:8443"):
        with pytest.raises(PolicyServerError, match="no openpi server listens"):
            ask(spec, url, "absolute")
    assert tried == [("policy.test", 443), ("policy.test", 80), ("policy.test", 8443)]


def test_long_chunks_are_compressed_as_gesim_does() -> None:
    rows = torch.stack([torch.arange(10.0), torch.arange(10.0)], 1)
    made = compress(rows, 4, (1,))
    assert made[:, 0].tolist() == [0.0, 2.5, 6.5, 9.0] and made[:, 1].tolist() == [0.0, 3.0, 6.0, 9.0]
    assert torch.equal(compress(rows, 10, (1,)), rows) and compress(rows, 1, ()).tolist() == [[0.0, 0.0]]
    assert compress(rows, 2, ()).tolist() == [[0.0, 0.0], [9.0, 9.0]]


def test_a_missing_client_is_named_with_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openpi_client.websocket_client_policy", None)
    with pytest.raises(PolicyServerError, match=r"pip install --no-deps openpi-client==0\.1\.2"):
        ask(world_spec(BIMANUAL_JOINTS), "ws://127.0.0.1:9", "absolute")


def test_what_a_policy_server_may_get_wrong() -> None:
    spec = world_spec(BIMANUAL_JOINTS)
    for answer, message in (
        ({"actions": np.zeros((50, 7), np.float32)}, r"\(50, 7\)"),
        ({"actions": np.full((50, 16), np.nan, np.float32)}, "finite"),
        ({"actions": np.zeros((3, 16), np.float32)}, "at least 4 finite rows of 16"),
        ("Traceback", "Error in inference server"),
        ({}, "wanted at least"),
    ):
        server = PolicyServer(lambda _, answer=answer: answer)
        with pytest.raises(PolicyServerError, match=message):
            ask(spec, server.url, "absolute")
        server.server.shutdown()
    with pytest.raises(PolicyServerError, match="no openpi server listens"):
        ask(spec, "ws://127.0.0.1:9", "absolute")
    for url in ("", "ws://127.0.0.1:99999"):
        with pytest.raises(PolicyServerError, match="address of an openpi server"):
            ask(spec, url, "absolute")
