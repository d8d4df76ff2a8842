"""Randomness is a function of what it is for, and these numbers have been drawn before: they stay."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from envs.rng import (
    Noise,
    Purpose,
    Shared,
    Stream,
    constant_generator,
    episode_rng,
    episode_seeds,
    episode_stream,
    iteration_generator,
    noise_generator,
    order_generator,
    resampling_generator,
    sampling_seed,
    seed_process,
    shared_generator,
    step_generator,
    update_seed,
)


def drawn(generator: torch.Generator) -> list[int]:
    return torch.randint(1000, (4,), generator=generator).tolist()


@pytest.mark.parametrize(
    ("stream", "numbers"),
    [
        (Stream.START, [707, 700, 315, 937]),
        (Stream.BEHAVIOUR, [266, 719, 618, 737]),
        (Stream.SCENE, [386, 328, 962, 35]),
        (Stream.LAYOUT, [722, 720, 978, 94]),
        (Stream.REQUEST, [276, 312, 792, 167]),
    ],
)
def test_streams_of_an_episode(stream: Stream, numbers: list[int]) -> None:
    assert episode_rng(14_000_003, stream).integers(1000, size=4).tolist() == numbers


def test_a_start_is_what_the_seed_alone_draws() -> None:
    for seed in (0, 7, 34_100_000, 2**40 + 1):
        alone = np.random.default_rng(seed).normal(size=8)
        assert np.array_equal(episode_rng(seed, Stream.START).normal(size=8), alone)


def test_generators_of_chunks_steps_and_iterations() -> None:
    noise = [drawn(noise_generator(9, 2, kind))[:2] for kind in Noise]
    assert noise == [[178, 802], [197, 208], [814, 256]] and drawn(noise_generator(9, 2))[:2] == noise[0]
    assert drawn(iteration_generator(9, 2)) == [252, 120, 984, 977]
    assert drawn(step_generator(9, 2, 1)) == [386, 313, 466, 870]
    assert [drawn(shared_generator(9, 2, shared))[:2] for shared in Shared] == [[905, 623], [482, 556]]
    assert (update_seed(9, 2), sampling_seed(9, 2, 3)) == (18_000_029, 3_000_071_294)
    seed_process(4)
    assert torch.randint(1000, (4,)).tolist() == [530, 694, 631, 773]
    for generator in (order_generator, episode_stream, resampling_generator, constant_generator):
        assert torch.randperm(8, generator=generator(3)).tolist() == [2, 4, 3, 5, 1, 0, 6, 7]


def test_no_noise_of_an_episode_is_another_ones() -> None:
    seeds = [high + low for high in (0, 2**32, 2**40, 2**41) for low in range(30)]
    made = {
        tuple(drawn(noise_generator(seed, chunk, kind))): (seed, chunk, kind)
        for seed in seeds
        for chunk in range(3)
        for kind in Noise
    }
    assert len(made) == len(seeds) * 3 * len(Noise)


def test_episode_seeds_of_every_purpose() -> None:
    assert [episode_seeds(2, purpose, 2, 5)[0] for purpose in Purpose] == [
        30_000_005,
        34_000_005,
        36_000_005,
        38_000_005,
        9_000_005,
        39_500_005,
    ]
