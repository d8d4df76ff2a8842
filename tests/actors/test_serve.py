"""A served simulator: strangers' clients work, and sessions share passes and nothing else."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import requests
import torch

from actors.serving.batching import Company
from actors.serving.page import joint_table
from actors.serving.session import Session, first_frame, next_chunk
from envs.conditioning.joint_commands import JointCommands
from envs.embodiment import EmbodimentError
from envs.episodes.formats.agibot import AGIBOT
from envs.simulators.dit.engine import DiTSimulator
from tests.actors.serving import POSES, Running, Stranger, make, tiny_world
from tests.embodiments import ARM_DELTAS, BIMANUAL_JOINTS, world_spec

JOINTS = np.zeros((4, 16), np.float32)


def test_a_strangers_client_works_unchanged(server: Running) -> None:
    assert requests.get(f"{server.url}/healthz", timeout=5).json()["status"] == "ok"
    client = Stranger(server.url)
    assert client.post("/set_task", task="push it").json() == {"success": True}
    client.prepare(frames=12)
    frames, state = client.step(POSES)
    assert frames.shape == (4, 3, 3, 32, 32) and state is not None and state.shape == (4, 14)
    frames, state = client.step(POSES[:3])  # fewer actions than a chunk: fewer frames, and no more happened
    assert frames.shape[0] == 3 and state is not None and len(state) == 3
    (session,) = server.host.sessions.values()
    assert session.frames == 7 and int(session.state["length"]) == 8
    said = requests.get(f"{server.url}/api/status", timeout=5).json()
    assert (
        said["step_count"] == 2
        and said["frames_generated"] == 7
        and said["has_preview"]
        and len(said["state"]) == 14
        and said["task"] == "push it"
    )
    assert client.id not in json.dumps(said)
    preview = requests.get(f"{server.url}/api/preview.jpg", timeout=5)
    assert preview.headers["Content-Type"] == "image/jpeg" and preview.content[:2] == b"\xff\xd8"
    assert "world model" in requests.get(server.url, timeout=5).text
    assert client.post("/reset").status_code == 200
    refused = client.send("/step", client.actions(POSES))
    assert refused.status_code == 400 and "/set_episode_data" in refused.json()["error"]
    assert client.post("/close").status_code == 200 and client.post("/reset").status_code == 403


def test_pictures_of_another_size_are_resized_and_their_intrinsics_with_them(server: Running) -> None:
    client = Stranger(server.url)
    client.prepare(size=(64, 96))
    assert client.step(POSES)[0].shape[-2:] == (32, 32)
    (session,) = server.host.sessions.values()
    assert session.state is not None
    expected = torch.tensor([[20.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    assert torch.allclose(session.state["intrinsic"][0, :2], expected.expand(2, 3, 3))
    assert not session.state["intrinsic"][0, 2].any()  # that camera is not calibrated


def test_joints_go_through_the_kinematics(server: Running, joints: JointCommands) -> None:
    client = Stranger(server.url)
    client.prepare()
    assert client.step(JOINTS)[0].shape[0] == 4
    (session,) = server.host.sessions.values()
    assert session.state is not None
    command = session.state["history", "commands"][0, 1]
    assert torch.allclose(command, joints(torch.zeros(16)), atol=1e-6)
    assert float(command[2]) == pytest.approx(0.7, abs=1e-4)  # seven links of 0.1 m
    assert joints.grippers == (7, 15)
    with pytest.raises(EmbodimentError, match="absolute end-effector"):
        JointCommands(ARM_DELTAS, joints.kinematics)


@pytest.mark.parametrize("robot", ["one_arm_deltas", "one_arm_joints"])
def test_worlds_without_calibration_ask_for_neither_cameras_nor_pose_maps(robot: str) -> None:
    world = tiny_world(robot)
    server = make(world)
    try:
        client, spec = Stranger(server.url), world.spec
        refused = client.send("/step", client.actions(np.zeros((4, spec.action_dim))))
        assert refused.status_code == 400 and "['/set_episode_data']" in refused.json()["error"]
        frame = np.zeros((3, spec.views, *spec.size), np.float32)
        assert client.send("/set_episode_data", client.first_frame(frame)).status_code == 200
        frames, state = client.step(np.zeros((4, spec.action_dim), np.float32))
        assert frames.shape == (4, 3, spec.views, *spec.size)
        assert state is not None and state.shape == (4, spec.state_dim)
    finally:
        server.stop()


def test_what_a_client_does_not_say_of_the_state_is_its_first_command_by_names() -> None:
    names = BIMANUAL_JOINTS.action_names
    bare = replace(BIMANUAL_JOINTS, cameras=ARM_DELTAS.cameras, main_camera="")
    last = replace(bare, state_names=(*names[8:], *names[:8]))
    other = replace(bare, state_names=tuple(f"torque{k}" for k in range(16)))
    for robot, wanted in ((last, [*range(8, 16), *range(8)]), (other, [0.0] * 16)):
        spec = world_spec(robot)
        session = Session("", 0, "", 0, 0.0, first=np.zeros((spec.views, 3, *spec.size), np.uint8))
        future = next_chunk(session, torch.arange(16.0)[None], spec)
        assert first_frame(session, future, spec)["state"][0].tolist() == wanted


def test_the_same_client_run_twice(world: DiTSimulator) -> None:
    for fixed in (True, False):
        server = make(world, fixed_seed=fixed)
        try:
            made = []
            for _ in range(2):
                client = Stranger(server.url)
                client.prepare()
                made.append(client.step(POSES)[0])
            assert np.array_equal(*made) == fixed
        finally:
            server.stop()


def test_the_page_names_joints_and_keeps_watching_whom_it_watched(server: Running) -> None:
    first, second = Stranger(server.url, "first"), Stranger(server.url, "second")
    second.prepare()
    second.step(POSES)
    number = list(server.host.sessions.values())[1].number
    first.post("/close")

    def status(query: str) -> requests.Response:
        return requests.get(f"{server.url}/api/status?session={query}", timeout=5)

    said = status(str(number)).json()
    assert said["session"] == number and said["sessions"] == [
        {"number": number, "user": "second", "task": "", "steps": 1, "frames": 4}
    ]
    row = next(row for row in said["joints"] if row["name"] == "right_gripper")
    assert row["action"] == 0.5 and row["difference"] == pytest.approx(row["state"] - 0.5)
    assert status("0").json()["session"] is None  # closed: nobody else is shown in its stead
    for query in ("\u00b2", "9" * 5000, "-1", "x"):
        assert status(query).status_code == 400 and "session" in status(query).json()["error"]
    robot = replace(ARM_DELTAS, action_names=("a", "b"), state_names=("b", "c"), arms=())
    assert joint_table(robot, [1.0, 2.0], [2.5, 3.0]) == [
        {"name": "b", "action": 2.0, "state": 2.5, "difference": 0.5},
        {"name": "c", "action": None, "state": 3.0, "difference": None},
        {"name": "a", "action": 1.0, "state": None, "difference": None},
    ]
    table = joint_table(AGIBOT, [1.0] * 16, [2.0] * 7 + [120.0] * 9)
    assert [row["difference"] for row in table[6:9]] == [1.0, 0.0, 119.0]  # a closed gripper is read as 120


def test_free_running_clients_share_passes(world: DiTSimulator) -> None:
    server = make(world)
    try:
        clients = [Stranger(server.url, seed=n) for n in range(3)]
        for client in clients:
            client.prepare()
        steps = 6

        def run(client: Stranger) -> None:
            for _ in range(steps):
                client.step(POSES)

        threads = [threading.Thread(target=run, args=[client]) for client in clients]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        assert server.host.steps == 3 * steps and server.host.passes <= steps + 4
    finally:
        server.stop()


def test_nobody_waits_for_those_who_do_not_come() -> None:
    company = Company(10.0)
    assert company.wait_until(5.0) == 5.0
    company.answered(["slow", "quick"], 100.0, pass_s=1.0)
    assert company.wait_until(100.1) == 101.0  # for as long as a pass takes, while pauses are unknown
    company.arrived("quick", 100.2)
    company.arrived("slow", 130.0)
    company.answered(["slow", "quick"], 131.0, pass_s=1.0)
    assert company.wait_until(131.0) == pytest.approx(131.3)  # for the quick one, half again its usual pause
    assert company.wait_until(132.0) == 132.0
    company.left("quick")
    assert company.wait_until(131.0) == 131.0


def test_sessions_share_forward_passes_and_nothing_else(world: DiTSimulator) -> None:
    server = make(world, batch=4)
    try:
        clients = [Stranger(server.url, seed=n) for n in range(4)]
        for n, client in enumerate(clients):
            client.prepare(seed=n)
        made: dict[int, list[np.ndarray]] = {n: [] for n in range(4)}
        for _ in range(2):
            threads = [
                threading.Thread(target=lambda n=n: made[n].append(clients[n].step(POSES)[0]))
                for n in range(4)
            ]
            [thread.start() for thread in threads]
            [thread.join() for thread in threads]
        assert server.host.steps == 8 and server.host.passes <= 5
        alone = Stranger(server.url, seed=2)
        alone.prepare(seed=2)
        for step in range(2):
            assert np.abs(alone.step(POSES)[0].astype(int) - made[2][step].astype(int)).mean() < 0.5
        assert np.abs(made[1][1].astype(int) - made[2][1].astype(int)).mean() > 2
    finally:
        server.stop()


def test_a_repeated_step_is_answered_again_and_not_made_again(server: Running) -> None:
    client = Stranger(server.url, seed=1)
    client.prepare()
    body = client.actions(POSES, chunk=0)
    first, again = client.send("/step", body), client.send("/step", body)
    assert first.content == again.content and server.host.sessions[client.id].chunk == 1
    assert client.send("/step", client.actions(POSES, chunk=7)).status_code == 400
    assert client.send("/step", client.actions(POSES, chunk=1)).status_code == 200


def test_full_servers_say_so_and_idle_sessions_make_room(world: DiTSimulator) -> None:
    server = make(world, sessions=2, idle_s=0.5)
    try:
        clients = [Stranger(server.url) for _ in range(2)]
        full = requests.post(f"{server.url}/init", json={}, timeout=5)
        assert full.status_code == 503 and "serve.sessions=2" in full.json()["error"]
        for _ in range(6):
            time.sleep(0.2)
            assert clients[1].post("/set_task", task="still here").status_code == 200
        assert len(server.host.sessions) == 1  # the other one ended by itself
        assert Stranger(server.url).id
        assert clients[0].post("/reset").status_code == 403 and clients[1].post("/reset").status_code == 200
    finally:
        server.stop()


def test_what_a_client_says_of_a_camera_that_is_not_calibrated_changes_nothing(server: Running) -> None:
    plain, other = Stranger(server.url, seed=4), Stranger(server.url, seed=4)
    made = []
    for client in (plain, other):
        client.prepare()
        if client is other:  # the third camera; the first two as `prepare` says them
            k = [[[60.0, 0, 16], [0, 60, 16], [0, 0, 1]]] * 2 + [np.zeros((3, 3)).tolist()]
            assert client.post("/set_camera_params", intrinsic=k).status_code == 200
            c2w = np.tile(np.eye(4, dtype=np.float32), (3, 4, 1, 1))
            c2w[2, :, :3, 3] = 0.7
            bare = np.full((3, 3, 4, 32, 32), 50 / 255, np.float32)
            assert client.send("/set_episode_traj", client.trajectory(bare, c2w)).status_code == 200
        made.append(client.step(POSES)[0])
    assert np.array_equal(*made)
