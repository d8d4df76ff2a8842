"""What imagined returns are worth is the part of what actions did in imagination that is true."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from learners.rl.recorded.worth import Returns, correlation, worth_by_task
from learners.rl.starts import Starts, weighed
from pipeline.stages.rl import by_worth


def returns(true: float, moment: float, seed: int, episodes: int = 40, each: int = 5) -> Returns:
    """Of a world that knows `true` of what an action changes, where moments differ so much."""
    generator = torch.Generator().manual_seed(seed)
    episode = torch.arange(episodes * each) // each

    def draw(count: int = episodes * each) -> torch.Tensor:
        return torch.randn(count, generator=generator)

    state, action = moment * (draw() + draw(episodes)[episode]), draw()
    imagined = state + true * action + (1 - true**2) ** 0.5 * draw()
    return Returns(state + action, imagined, state + draw(), draw(), episode)


def together(*parts: Returns) -> Returns:
    return Returns(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Returns)))


@pytest.mark.parametrize("moment", [0.0, 3.0])
def test_what_moments_say_of_themselves_is_worth_nothing(moment: float) -> None:
    found = [correlation(returns(0.0, moment, seed)) for seed in range(20)]
    values, errors = (torch.tensor(some) for some in zip(*(one for one in found if one), strict=True))
    assert abs(float(values.mean())) < 0.05
    assert float(errors.mean()) == pytest.approx(float(values.std()), rel=0.4)


@pytest.mark.long
def test_what_actions_do_is_worth_what_is_true_of_it() -> None:
    for true in (0.3, 0.8):
        found = [correlation(returns(true, 0.0, seed)) for seed in range(20)]
        assert sum(one[0] for one in found if one) / 20 == pytest.approx(true, abs=0.05)
    far = correlation(returns(0.8, 3.0, 0))  # what the world cannot know of a moment is noise beside it
    assert far is not None and 0.4 < far[0] < 0.8


def test_tasks_are_drawn_towards_their_mean_by_what_they_tell() -> None:
    true = {"a": 0.0, "b": 0.1, "c": 0.8}
    parts = [returns(value, 1.0, seed) for seed, value in enumerate(true.values())]
    parts.append(returns(0.9, 1.0, 9, episodes=2))  # too few to tell
    tasks = [name for name in (*true, "few") for _ in range(10 if name == "few" else 200)]
    found = worth_by_task(together(*parts), tasks)
    assert found["a"].value < found["b"].value < found["few"].value < found["c"].value
    assert found["few"].measured is None and found["few"].moments == 10
    for name in true:
        told = found[name].measured
        assert told is not None and 0.0 <= found[name].value <= 1.0
        assert abs(found[name].value - told[0]) < told[1]


def test_where_nothing_is_told_imagination_is_taken_at_its_word() -> None:
    silent = returns(0.5, 1.0, 0)
    alike = Returns(
        *(0 * part for part in (silent.true, *[silent.imagined] * 2, silent.begun)), silent.episode
    )
    assert correlation(alike) is None
    assert worth_by_task(alike, ["a"] * 200)["a"].value == 1.0


def test_what_was_known_of_earlier_worlds_counts_half() -> None:
    now = returns(0.3, 1.0, 0)
    alone = worth_by_task(now, ["a"] * 200)["a"]
    assert alone.measured is not None and alone.known == alone.measured
    value, error = alone.measured
    told = worth_by_task(now, ["a"] * 200, {"a": (0.9, error / 2**0.5), "b": (0.1, 0.1)})["a"]
    assert told.measured == alone.measured and told.known is not None
    assert told.known == pytest.approx(((value + 0.9) / 2, error / 2**0.5))
    silent = worth_by_task(now[torch.arange(4)], ["a"] * 4, {"a": (0.9, 0.1)})["a"]
    assert silent.measured is None and silent.known == pytest.approx((0.9, 0.1 * 2**0.5))


def test_two_lucky_episodes_do_not_decide() -> None:
    lucky = returns(0.0, 1.0, 3)
    for values in (lucky.true, lucky.imagined):
        values[[0, 100]] += 100.0
    found = correlation(lucky)
    assert found is not None and abs(found[0]) < 2 * found[1] < 0.5


def test_each_task_weighs_what_it_is_worth() -> None:
    tasks = ["a", "a", "a", "b", "c", "c"]
    starts, mean = by_worth(Starts(list(range(6)), 6), tasks, {"a": 0.4, "b": 0.1, "c": 0.0})
    assert starts.count == 6 and mean == pytest.approx((3 * 0.4 + 0.1) / 6)
    share = {task: sum(tasks[n] == task for n in starts.pool) / len(starts.pool) for task in "abc"}
    assert share == pytest.approx({"a": 12 / 13, "b": 1 / 13, "c": 0.0}, abs=0.001)
    assert share["a"] * mean * 6 == pytest.approx(3 * 0.4, abs=0.01)
    assert by_worth(Starts([0, 3], 4), tasks, {"a": 0.2})[1] == pytest.approx(0.2)  # b is not measured
    assert weighed([5, 6], [0.0, 0.0]) == weighed([5, 6], [0.3, 0.3]) == [5, 6]
