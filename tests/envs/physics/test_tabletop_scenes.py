"""The bench of scenes: its lists, words that decide, real grasps, experts and their noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from envs.physics.suite import build_suite, scene_of
from envs.physics.tabletop.scenes.behaviour import MANNERS
from envs.physics.tabletop.scenes.catalogue import CONTAINERS, TABLES, THINGS
from envs.physics.tabletop.scenes.scene import SCENES
from envs.physics.tabletop.scenes.suite import TabletopScenes
from envs.physics.tabletop.scenes.tasks import DISTANCE, TASKS
from envs.physics.tabletop.scenes.words import PHRASINGS, STYLES
from envs.targets import ConfigError
from tests.envs.physics.sections import task_section

HORIZON = 32


def built(**changes: Any) -> TabletopScenes:
    suite = build_suite(task_section("tabletop", **changes)["suite"])
    assert isinstance(suite, TabletopScenes)
    return suite


@pytest.fixture(scope="module")
def suite() -> TabletopScenes:
    return built()


def play(suite: TabletopScenes, task: str, seed: int, noise_level: float = 0.0) -> list[np.ndarray[Any, Any]]:
    """The commands of a scripted episode."""
    suite.reset(task, seed)
    act, commands = suite.expert(noise_level, np.random.default_rng([seed, 1])), []
    for _ in range(HORIZON):
        if suite.observe().success:
            break
        suite.step(act())
        commands.append(suite.observe().command)
    return commands


# -- scenes and words ----------------------------------------------------------------------------------------
def test_eighty_scenes_are_parted_into_fixed_lists() -> None:
    section = task_section("tabletop")["suite"]["domains"]
    known, kept = section["in_domain"], section["out_of_domain"]
    assert (len(THINGS), len(CONTAINERS), len(TABLES)) == (20, 2, 2)
    assert (len(known), len(kept)) == (64, 16) and set(known) | set(kept) == set(SCENES)
    seen = {SCENES[name].thing for name in known}
    unseen = [name for name in kept if SCENES[name].thing not in seen]
    combined = [name for name in kept if SCENES[name].thing in seen]
    assert len(unseen) == 8 and len(combined) == 8  # unseen objects, unseen combinations of seen ones
    pairs = {(SCENES[name].thing, SCENES[name].container) for name in known}
    assert not {(SCENES[name].thing, SCENES[name].container) for name in kept} & pairs


def test_what_is_out_of_domain_is_nowhere_to_be_seen_in_domain(suite: TabletopScenes) -> None:
    known = task_section("tabletop")["suite"]["domains"]["in_domain"]
    for seed in range(200):
        suite.reset("push", seed)
        layout = suite.request.layout
        for thing in (layout.scene.thing, layout.companion):
            assert f"{thing}-{layout.scene.container}-{layout.scene.table}" in known
        assert suite.privileged()["scene"] == list(SCENES).index(scene_of(suite.scenes, seed))
    kept = built(scenes="out_of_domain")
    for seed in range(20):
        kept.reset("push", seed)
        assert kept.request.layout.scene.name not in known


def test_things_lie_apart_and_at_rest(suite: TabletopScenes) -> None:
    for seed in range(30):
        suite.reset("carry", seed)
        before = suite.privileged()["object_poses"]
        for _ in range(3):
            suite.step(suite.observe().command)
        assert np.abs(suite.privileged()["object_poses"] - before)[:, :3].max() < 0.002, seed


def test_each_task_has_several_phrasings_and_some_are_held_out(suite: TabletopScenes) -> None:
    held_out = set(STYLES) - set(suite.phrasings)
    assert len(suite.phrasings) >= 3 and held_out == {"colloquial", "inverted"}
    for task, words in PHRASINGS.items():
        assert tuple(words) == STYLES and len(set(words.values())) == len(STYLES)
        assert all("{thing}" in text for text in words.values())
        assert all(("{goal}" in text) == bool(TASKS[task].goals) for text in words.values())
    said = set()
    for seed in range(40):
        suite.reset("push", seed)
        thing = THINGS[suite.request.layout.scene.thing].words
        said.add(suite.instruction.replace(thing, "{thing}"))
    assert said == {PHRASINGS["push"][style] for style in suite.phrasings}


@pytest.mark.parametrize("task", sorted(TASKS))
def test_other_words_at_the_same_first_frame_make_the_expert_do_the_other_thing(task: str) -> None:
    plain, other = built(phrasings=["plain"]), built(phrasings=["plain"], swapped=True)
    for seed in (3, 4):
        plain.reset(task, seed)
        other.reset(task, seed)
        assert np.array_equal(plain.render(), other.render()) and plain.instruction != other.instruction
        first, second = plain.request, other.request
        assert first.thing != second.thing and (not first.goal or first.goal != second.goal)
        start = plain.privileged()["object_poses"]
        assert np.array_equal(start, other.privileged()["object_poses"][::-1])
        for suite in (plain, other):
            commands = play(suite, task, seed)
            assert suite.observe().success, (task, seed, suite.instruction)
            # What happened is not what the other words ask for.
            asked = TASKS[task](second if suite is plain else first, suite._bench.model)
            assert not asked.satisfied(suite._bench.data) and len(commands) > 5


def test_out_of_domain_the_words_may_ask_for_the_familiar_thing() -> None:
    task = task_section("tabletop")
    own, other = (built(**task["variants"][name]) for name in ("out_of_domain", "out_of_domain_swapped"))
    seen = {SCENES[name].thing for name in task["suite"]["domains"]["in_domain"]}
    asked = set()
    for seed in range(20):
        own.reset("pull", seed)
        other.reset("pull", seed)
        layout = other.request.layout
        assert np.array_equal(own.request.layout.objects, layout.objects)
        assert THINGS[layout.scene.thing].words in own.instruction
        assert THINGS[layout.companion].words in other.instruction and layout.companion in seen
        asked.add(layout.scene.thing in seen)
    assert asked == {True, False}


def test_other_tasks_share_the_first_frame(suite: TabletopScenes) -> None:
    frames, words = [], set()
    for task in suite.tasks:
        suite.reset(task, 17)
        frames.append(suite.render())
        words.add(suite.instruction)
    assert all(np.array_equal(frames[0], frame) for frame in frames) and len(words) == len(frames) == 5


# -- physics -------------------------------------------------------------------------------------------------
def test_only_friction_holds_things(suite: TabletopScenes) -> None:
    suite.reset("carry", 1)
    model = suite._bench.model
    assert model.neq == 0 and model.ntendon == 0 and model.opt.disableflags == 0


def test_things_have_the_mass_and_height_that_stand_in_the_catalogue(suite: TabletopScenes) -> None:
    for seed in range(5):
        suite.reset("push", seed)
        model, layout = suite._bench.model, suite.request.layout
        for body, name in (("thing", layout.scene.thing), ("companion", layout.companion)):
            assert model.body(body).mass[0] == pytest.approx(THINGS[name].mass)
            assert 0.02 < THINGS[name].top < 0.09


def test_every_number_of_both_hands_moves(suite: TabletopScenes) -> None:
    commands = []
    for task in ("pick_place", "push", "carry"):
        for seed in range(4):
            commands += play(suite, task, seed)
    spread = np.stack(commands).std(0).reshape(2, 7)
    assert (spread[:, :3] > 0.02).all() and (spread[:, 3:6] > 0.02).all() and (spread[:, 6] > 0.1).all(), (
        spread
    )


def test_moving_both_objects_is_no_success(suite: TabletopScenes) -> None:
    suite.reset("push", 5)
    bench, goal = suite._bench, suite._goal
    joints = goal._joints
    bench.data.qpos[joints[0]] += DISTANCE + 0.01
    assert goal.satisfied(bench.data) and goal.progress(bench.data) == 1.0
    bench.data.qpos[joints[1]] += DISTANCE
    assert not goal.satisfied(bench.data)


def test_a_thing_in_one_hand_is_not_carried_by_both(suite: TabletopScenes) -> None:
    play(suite, "carry", 2)
    bench, goal = suite._bench, suite._goal
    assert goal.satisfied(bench.data) and goal._hands(bench.data) == {0, 1}
    away = suite.observe().command.copy()
    away[9] += 0.05  # the right hand lets go
    away[8] -= 0.05
    for _ in range(4):
        suite.step(away)
    assert not goal.satisfied(bench.data)


# -- behaviour -----------------------------------------------------------------------------------------------
def test_optimal_behaviour_is_the_shortest_and_each_manner_is_recorded(suite: TabletopScenes) -> None:
    optimal, taken = len(play(suite, "pick_place", 8)), {}
    told = suite.privileged()
    assert (told["noise_level"], told["manner"]) == (0.0, -1)
    for draw in range(30):
        suite.reset("pick_place", 8)
        assert suite.privileged()["noise_level"] == -1  # nobody acts yet
        act = suite.expert(0.3, np.random.default_rng(draw))
        told = suite.privileged()
        assert told["noise_level"] == 0.3
        if int(told["manner"]) in taken:
            continue
        steps = 0
        while steps < HORIZON and not suite.observe().success:
            suite.step(act())
            steps += 1
        taken[int(told["manner"])] = steps
    assert sorted(taken) == list(range(len(MANNERS))) == [0, 1, 2]
    assert all(steps >= optimal for steps in taken.values()) and taken[0] > optimal


def test_more_noise_means_less_success() -> None:
    suite, won = built(), {}
    for level in (0.1, 0.9):
        won[level] = 0
        for seed in range(10):
            play(suite, "carry", seed, level)
            won[level] += suite.observe().success
    assert won[0.1] > won[0.9]


# -- bad input -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"scenes": "in_domian"}, r"task\.suite\.scenes holds 'in_domian'.*in_domain"),
        ({"scenes": ["red_cube-bowl-oka"]}, r"task\.suite\.scenes holds .*red_cube-bowl-oak"),
        ({"scenes": []}, r"task\.suite\.scenes is empty"),
        ({"phrasings": ["plane"]}, r"task\.suite\.phrasings holds 'plane'.*plain"),
        ({"domains": {"in_domain": ["red_cube-bowl-oak"]}}, r"domains\.in_domain holds no other scene"),
        (
            {"domains": {"a": ["red_cube-bowl-oak"], "b": ["red_cube-bowl-oak"]}},
            r"domains\.b holds .*red_cube-bowl-oak.* stand in a, too",
        ),
    ],
)
def test_unknown_scenes_and_phrasings_are_named_with_the_nearest(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        built(**changes)


def test_unknown_tasks_are_named_with_the_nearest(suite: TabletopScenes) -> None:
    with pytest.raises(ConfigError, match=r"task\.name='pick_plaice' is unknown.*pick_place"):
        suite.reset("pick_plaice", 0)
