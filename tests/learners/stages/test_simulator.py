"""The stages that teach a simulator and its video autoencoder: units, which clips, and that they learn."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from envs.conditioning import ActionVector
from envs.embodiment import Embodiment
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.rng import step_generator
from envs.targets import options
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator, units
from learners.stages.tokenizer import train_tokenizer
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES
from tests.learners.models import simulator_of

Stores = Callable[[Embodiment], ClipStore]


def test_units_are_changes_within_a_chunk_of_absolute_commands_only(tiny_store: Stores) -> None:
    store = tiny_store(BIMANUAL_POSES)
    commands, moves, states = units(store, torch.tensor([4, 2]), store.spec.chunk)
    rows = store.rows(torch.tensor([4, 2]))
    assert torch.equal(commands, store.arrays["commands"][rows])
    assert torch.equal(states, store.arrays["states"][rows])
    assert torch.equal(moves[0], commands[1] - commands[0]) and torch.equal(
        moves[1], commands[3] - commands[1]
    )
    last = int(store.length[4]) - 1  # what follows belongs to another episode
    assert not bool(moves[last].any())
    assert not bool(units(tiny_store(ARM_DELTAS), torch.arange(4), 4)[1].any())


@pytest.mark.parametrize(
    ("name", "most"), [("tokens_small", 1), ("forcing_small", 1), ("dit_small", 4), ("unet_small", 4)]
)
def test_moves_are_told_in_units_of_what_is_told(
    tiny_store: Stores, tmp_path: Path, name: str, most: int
) -> None:
    store = tiny_store(BIMANUAL_POSES)
    simulator = simulator_of(name, store.spec)
    episodes = torch.arange(6)
    config, fit = SimulatorFitConfig(1.0, 1, (1,), 0.0, 0), FitConfig(1, 2, 1e-4, bf16=False)
    train_simulator(simulator, store, episodes, config, fit, tmp_path)
    (vector,) = [part for part in simulator.modules() if isinstance(part, ActionVector)]
    spread = units(store, episodes, most)[1].square().mean(0).sqrt()
    told = (vector.move_scale * spread)[spread > 1e-3]
    assert len(told) and torch.allclose(told, torch.ones_like(told), atol=1e-4)


def test_the_microbatches_of_a_step_are_learned_from_at_one_depth(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    simulator, fit = simulator_of("unet_small", store.spec), FitConfig(4, 8, 1e-3, microbatches=2)
    clips = ClipBatches(simulator, store, torch.arange(6), SimulatorFitConfig(0.0, 2, (1,), 0.0, 0), fit)
    depths = []
    for step in range(4):
        one, other = (clips(step, step_generator(0, step, part)) for part in range(2))
        assert not torch.equal(one["future", "frames"], other["future", "frames"])
        depths.append({*one["depth"].tolist(), *other["depth"].tolist()})
    assert [len(each) for each in depths] == [1] * 4 and len(set.union(*depths)) == 4
    assert all(0 <= depth < 1 for depth in set.union(*depths))


@pytest.mark.parametrize("unrolled", [False, True])
def test_clips_are_single_at_first_and_the_newest_have_their_share(
    tiny_store: Stores, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unrolled: bool
) -> None:
    store = tiny_store(ARM_DELTAS)
    drawn: list[tuple[int, list[int], int, int]] = []
    sample = store.sample

    def watched(episodes: torch.Tensor, count: int, spec: ClipSpec, generator: torch.Generator) -> object:
        drawn.append((spec.chunks, episodes.tolist(), count, spec.stride))
        return sample(episodes, count, spec, generator)

    monkeypatch.setattr(store, "sample", watched)
    config = SimulatorFitConfig(0.5, 2, (1, 2), 0.25 if unrolled else 1.0, 0)
    simulator = simulator_of("unet_small", store.spec)
    options = FitConfig(2, 8, 1e-3, bf16=False)
    train_simulator(simulator, store, torch.arange(6), config, options, tmp_path, newest=torch.tensor([5]))
    counts: dict[tuple[int, int], int] = {}
    for chunks, episodes, count, _ in drawn:
        counts[chunks, len(episodes)] = counts.get((chunks, len(episodes)), 0) + count
    if unrolled:
        assert counts == {(1, 6): 6, (1, 1): 2, (2, 6): 3, (2, 1): 1}
    else:
        assert counts == {(1, 1): 8, (2, 1): 4}
    for stride in (1, 2):  # each has its half
        assert sum(count for *_, count, own in drawn if own == stride) == 6


def test_a_simulator_learns_and_keeps_its_units_when_it_goes_on(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_JOINTS)
    simulator = simulator_of("unet_small", store.spec)
    config, options = (
        SimulatorFitConfig(1.0, 1, (1,), 0.0, 0),
        FitConfig(30, 8, lr=3e-3, warmup=3, bf16=False),
    )
    before = {name: value.clone() for name, value in simulator.named_buffers()}
    train_simulator(simulator, store, store.split("train"), config, options, tmp_path / "first")
    after = {name: value.clone() for name, value in simulator.named_buffers()}
    assert any(not torch.equal(after[name], before[name]) for name in after)
    rows = [json.loads(line)["simulator/loss"] for line in (tmp_path / "first/metrics.jsonl").open()]
    assert sum(rows[-5:]) < 0.8 * sum(rows[:5])
    short = FitConfig(1, 2, 1e-3, bf16=False)
    train_simulator(simulator, store, torch.arange(2), config, short, tmp_path / "next", fresh=False)
    assert all(torch.equal(value, after[name]) for name, value in simulator.named_buffers())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"single_chunk_fraction": 1.5}, "single_chunk_fraction=1.5"),
        ({"recent_fraction": -1}, "recent_fraction=-1"),
        ({"unroll": 0}, "unroll=0"),
        ({"strides": ()}, r"strides=\(\)"),
    ],
)
def test_options_that_cannot_work_are_named(change: dict[str, object], message: str) -> None:
    good = {"single_chunk_fraction": 1.0, "unroll": 1, "strides": (1,), "recent_fraction": 0.0, "lora": 0}
    with pytest.raises(ValueError, match=message):
        options(SimulatorFitConfig, good | change, "simulator_fit.first")


def test_a_tokenizer_learns_and_takes_its_units_from_data(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    simulator = simulator_of("dit_small", store.spec)
    train_tokenizer(
        simulator, store, torch.arange(8), FitConfig(40, 8, lr=3e-3, warmup=3, bf16=False), tmp_path
    )
    rows = [json.loads(line)["tokenizer/psnr"] for line in (tmp_path / "metrics.jsonl").open()]
    assert sum(rows[-5:]) > sum(rows[:5]) + 10  # 2 dB
    frames = store.frames(store.rows(torch.arange(8))).flatten(0, 1).float() / 255
    with torch.no_grad():
        latents = simulator.codec.encode(frames)  # type: ignore[operator, union-attr]
    assert float(latents.mean().abs()) < 0.2 and 0.7 < float(latents.std()) < 1.3


def test_simulators_without_a_codec_say_so(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    with pytest.raises(ValueError, match="UNetSimulator has no codec"):
        train_tokenizer(
            simulator_of("unet_small", store.spec), store, torch.arange(2), FitConfig(1, 32, 1e-3), tmp_path
        )
