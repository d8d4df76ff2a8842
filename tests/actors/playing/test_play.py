"""A person plays: keys of any robot, drivers that take over, both sides under the same actions, who may."""

from __future__ import annotations

import asyncio
import base64
import io
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from aiohttp.test_utils import TestClient, TestServer
from PIL import Image
from torchrl.envs import TransformedEnv

from actors.playing.app import PlayServer
from actors.playing.controls import Controls
from actors.playing.game import Game, Recorded, Unplayable
from actors.playing.imagination import ImaginedSide, start_of
from envs.conditioning import PoseMapStyle
from envs.embodiment import Embodiment
from envs.initial_states import InitialStates
from envs.judges.base import Judge, Judgement
from envs.physics.suite import Observation
from envs.specs import ActionMode, Rewards, WorldSpec
from envs.transforms import world_transforms
from envs.world import WorldEnv
from examples.task_suite import DotToSquare
from tests.embodiments import (
    ARM_DELTAS,
    BIMANUAL_JOINTS,
    BIMANUAL_POSES,
    recorded_cameras,
    world_spec,
)
from tests.envs.simulators.test_engines import build_engine
from tests.envs.test_world import Fixed
from tests.suites.counting import Scriptless

ACTIONS = np.array([[0.5, 0.0], [0.5, 0.0], [0.0, -1.0]])


def beginning(robot: Embodiment, spec: WorldSpec) -> InitialStates:
    """A start of imagination as a suite of the robot would show it."""
    seen = Observation(
        np.zeros(robot.state_dim),
        np.full(robot.action_dim, 0.1) * (not robot.delta),
        "do it",
        False,
        0.0,
        *(recorded_cameras(spec) if robot.calibrated else ()),
    )
    pictures = np.full((spec.views, 3, *spec.size), 90, np.uint8)
    return start_of(spec, seen, pictures, PoseMapStyle(), None)


def imagination(robot: Embodiment, judge: Judge | None = None) -> ImaginedSide:
    spec = world_spec(robot)
    simulator, decoder = build_engine("unet_small", spec)
    mode = ActionMode.ABSOLUTE if robot.delta else ActionMode.RELATIVE
    base = WorldEnv(simulator, beginning(robot, spec), 1, 8, mode, shared_noise=False, bf16=False)
    chain = world_transforms(spec, decoder, judge or Fixed(0.25), Rewards(1.0, 1.0))
    return ImaginedSide(TransformedEnv(base, chain))


def game(imagined: bool = False) -> Game:
    suite = DotToSquare()
    spec = world_spec(suite.embodiment)

    def starts(seen: Observation, pictures: np.ndarray) -> InitialStates:
        return start_of(spec, seen, pictures, PoseMapStyle(), None)

    side = imagination(suite.embodiment) if imagined else None
    recorded = [Recorded("0: seed 7", "reach", 7, ACTIONS)]
    return Game(suite.embodiment, suite.tasks, suite, side, starts if imagined else None, recorded)


class NumpyBacked(Scriptless):
    """Counts, and answers with NumPy's own truths and numbers."""

    def observe(self) -> Observation:
        return replace(super().observe(), success=np.bool_(True), progress=np.float32(0.5))  # type: ignore


def test_keys_move_what_their_names_say() -> None:
    poses = Controls(BIMANUAL_POSES)
    assert poses.arms == ["left", "right"] and len(poses.channels) == 14
    at = {channel.name: channel for channel in poses.channels}
    command = np.zeros(14)
    moved = poses.action(command, {at["right_y"].number: 1.0, at["left_gripper"].number: 1.0})
    assert moved[8] == pytest.approx(0.25 / 10) and moved[6] == pytest.approx(0.2) and moved.sum() < 0.3
    assert poses.action(moved, {at["left_gripper"].number: -1.0}, 9.0)[6] == 0.0  # no further than open
    joints = Controls(BIMANUAL_JOINTS)
    assert joints.action(np.zeros(16), {15: 1.0})[15] == pytest.approx(120 / 0.5 / 30)
    assert joints.action(np.zeros(16), {6: -1.0}, 2.0)[6] == pytest.approx(-2 / 30)
    deltas = Controls(ARM_DELTAS)
    start = deltas.start(np.full(4, 0.3))
    assert start.tolist() == [0, 0, 0, -1]
    pushed = deltas.action(start, {0: 1.0, 3: 1.0})
    assert pushed.tolist() == pytest.approx([1, 0, 0, -1 + 4 / 12.5])
    assert deltas.action(pushed, {}).tolist() == pytest.approx([0, 0, 0, -1 + 4 / 12.5])
    base = Controls(replace(BIMANUAL_JOINTS, action_names=("x.vel", *BIMANUAL_JOINTS.action_names[1:])))
    assert base.start(np.full(16, 0.3)).tolist() == [0.0, *[0.3] * 15]
    driven = base.action(np.full(16, 0.3), {0: 1.0})
    assert driven[0] == 1.0 and base.action(driven, {}).tolist() == [0.0, *[0.3] * 15]


def test_keys_go_as_far_as_recordings_do_whatever_the_units() -> None:
    degrees = Controls(BIMANUAL_JOINTS, np.full(16, 40.0))
    assert degrees.action(np.zeros(16), {6: -1.0}, 2.0)[6] == pytest.approx(-80 / 30)
    assert degrees.action(np.zeros(16), {15: 1.0})[15] == pytest.approx(120 / 0.5 / 30)  # a gripper's range
    metres = Controls(ARM_DELTAS, np.array([0.01, 0.02, 0.0, 0.5]))
    pushed = metres.action(metres.start(np.zeros(4)), {0: 1.0, 1: -1.0, 2: 1.0})
    assert pushed[:3].tolist() == pytest.approx([0.01, -0.02, 1.0])  # the last never moved in recordings


def test_a_person_the_expert_and_a_recording_drive_physics() -> None:
    played = game()
    first = played.reset(7)
    assert len(first.true) == 1 and not first.imagined and played.chunk == 1
    place = played.suite.observe().state.copy()  # type: ignore[union-attr]
    played.press({0: 1.0}, 0.5, 1)
    assert played.seen is not None and played.seen.state[0] > place[0] and played.steps == 1
    played.hand_over("expert")
    while not played.seen.success and played.steps < 20:
        played.go_on(1)
    assert played.seen.success
    played.hand_over("recorded", 0)
    assert played.seed == 7 and played.steps == 0
    for action in ACTIONS:
        played.go_on(1)
        assert played.command.tolist() == pytest.approx(action.tolist())
    assert not played.go_on(1).true and played.driven_by == "nobody" and played.steps == 3
    with pytest.raises(Unplayable, match="recording 1"):
        played.hand_over("recorded", 1)
    with pytest.raises(Unplayable, match=r"actions=2 must lie in 1\.\.1"):
        played.press({}, 1.0, 2)


def test_a_task_without_an_expert_is_played_by_hand() -> None:
    suite = Scriptless("")
    played = Game(suite.embodiment, suite.tasks, suite, None)
    played.reset(7)
    with pytest.raises(Unplayable, match=r"Scriptless\.expert has no behaviour of noise level 0 for task"):
        played.hand_over("expert")
    assert played.driven_by == "keys" and len(played.press({}, 1.0, 1).true) == 1


def test_both_sides_take_the_same_actions() -> None:
    played = game(imagined=True)
    first = played.reset(3)
    assert np.array_equal(first.true[0], first.imagined[0])  # imagination begins where the episode does
    shown = played.press({0: 1.0, 1: -1.0}, 1.0, 3)
    assert len(shown.true) == len(shown.imagined) == 3 and played.steps == 3
    assert played.imagination is not None
    told = played.imagination.world.session["history", "commands"][0, :4]
    assert torch.equal(told[1:], torch.tensor([1.0, -1.0]).expand(3, -1))
    assert int(played.imagination.world.session["length"]) == 4
    assert played.dreamt is not None and played.dreamt.progress == pytest.approx(0.25)
    again = played.reset(3)
    assert np.array_equal(again.true[0], first.true[0])
    more = played.press({0: 1.0, 1: -1.0}, 1.0, 3)
    assert all(np.array_equal(a, b) for a, b in zip(more.imagined, shown.imagined, strict=True))


@pytest.mark.parametrize("robot", [BIMANUAL_POSES, ARM_DELTAS], ids=lambda robot: robot.robot)
def test_imagination_alone_is_played(robot: Embodiment) -> None:
    played = Game(robot, ("task",), None, imagination(robot, Fixed(1.0)))
    assert len(played.reset(5).imagined) == 1 and played.instruction == "do it"
    before = played.command.copy()
    assert len(played.press({0: 1.0}, 1.0, 4).imagined) == 4
    moved = 1.0 if robot.delta else 4 * 0.25 / robot.fps
    assert played.command[0] - before[0] == pytest.approx(moved)
    assert played.dreamt is not None and played.dreamt.success
    with pytest.raises(Unplayable, match="needs physics"):
        played.hand_over("expert")


class Late(Judge):
    """Success from the third frame of a clip on; progress counts frames in hundredths."""

    def score(self, frames: torch.Tensor, first: torch.Tensor, instruction: list[str]) -> Judgement:
        at = torch.arange(frames.shape[1]).expand(len(frames), -1)
        return Judgement((at >= 2).float(), (at + 1) / 100, torch.zeros(len(frames), dtype=torch.int64))


def test_frames_that_did_not_happen_are_not_judged() -> None:
    side = imagination(BIMANUAL_POSES, Late(2))
    side.reset(None, 3)
    action = side.command[None]
    for count, success in ((2, False), (3, False), (1, False), (4, True)):
        shown = side.step(action.repeat(count, 0))
        assert len(shown.frames) == count and shown.success is success
        assert shown.progress == pytest.approx(1.0 if success else count / 100)


def in_browser(talk: Callable[[TestClient[Any, Any]], Awaitable[None]], imagined: bool = False) -> None:
    async def session() -> None:
        async with TestClient(TestServer(PlayServer(lambda: game(imagined)).app())) as client:
            await talk(client)

    asyncio.run(session())


def test_the_page_and_its_game() -> None:
    async def talk(client: TestClient[Any, Any]) -> None:
        page = await (await client.get("/")).text()
        assert "api/step" in page and "http" not in page.replace("http-equiv", "")
        about = await (await client.get("/api/game")).json()
        assert about["robot"] == "dot" and about["views"] == ["above"] and about["chunk"] == 4
        assert about["tasks"] == ["reach"] and about["expert"] and about["recorded"] == ["0: seed 7"]
        assert [one["raises"] for one in about["channels"]] == ["w", "a"]
        start = await (await client.post("/api/reset", json={"seed": 11})).json()
        assert start["seed"] == 11 and start["instruction"].startswith("move the dot")
        kept = {"held": {"0": 1}, "actions": 2, "speed": 0.5}
        stepped = await (await client.post("/api/step", json=kept)).json()
        assert stepped["steps"] == 2 and stepped["command"] == [0.5, 0.0]
        assert {side: len(frames) for side, frames in stepped["frames"].items()} == {"true": 2, "imagined": 2}
        picture = stepped["frames"]["true"][0].removeprefix("data:image/png;base64,")
        assert Image.open(io.BytesIO(base64.b64decode(picture))).size == (32, 32)
        watched = await (await client.post("/api/hand_over", json={"to": "expert"})).json()
        assert watched["driver"] == "expert" and watched["seed"] == 11

    in_browser(talk, imagined=True)


def test_bad_input_is_refused_by_name() -> None:
    async def talk(client: TestClient[Any, Any]) -> None:
        for path, body, said in (
            ("reset", {"seed": -1}, "seed=-1"),
            ("reset", {"seed": 1, "task": "reech"}, "the nearest of 1 names are ['reach']"),
            ("step", {"held": {"2": 1}}, "0..1"),
            ("step", {"held": {"0": 3}}, "0=3"),
            ("step", {"held": [1]}, "held must be"),
            ("step", {"held": {}, "actions": 9}, "actions=9"),
            ("step", {"held": {}, "speed": True}, "speed=True"),
            ("step", {"actions": 1}, "hand the game over"),
            ("hand_over", {"to": "nobody"}, "expert or recorded"),
        ):
            answer = await client.post(f"/api/{path}", json=body)
            assert answer.status == 400 and said in (await answer.json())["error"], (path, body)
        broken = await client.post("/api/step", data=b"{")
        assert broken.status == 400
        large = await client.post("/api/step", data=b" " * 2**17)
        assert large.status == 413

    in_browser(talk)


def test_a_page_of_another_origin_cannot_play() -> None:
    async def talk(client: TestClient[Any, Any]) -> None:
        own = str(client.make_url("")).rstrip("/")
        for origin, status in (("http://evil.example", 403), ("null", 403), (own, 200)):
            answer = await client.post("/api/reset", json={"seed": 1}, headers={"Origin": origin})
            assert answer.status == status, origin

    in_browser(talk)


def test_truths_and_numbers_of_numpy_reach_the_page() -> None:
    async def asked() -> dict[str, Any]:
        suite = NumpyBacked("")
        server = PlayServer(lambda: Game(suite.embodiment, suite.tasks, suite, None))
        async with TestClient(TestServer(server.app())) as client:
            answer = await client.post("/api/step", json={"actions": 1, "held": {}})
            assert answer.status == 200, await answer.text()
            found: dict[str, Any] = await answer.json()
            return found

    assert asyncio.run(asked())["true"] == {"success": True, "progress": 0.5}
