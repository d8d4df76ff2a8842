"""Engines are counted on shapes alone, at sizes that no machine here could hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from envs.embodiment import ActionKind, Camera, Embodiment
from envs.simulators.base import WORLD_OPTIONS
from envs.specs import WorldSpec
from envs.targets import ConfigError, build
from pipeline.benches.size import size, size_of, text_world_size
from pipeline.config import load_config
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of, moving_square
from tests.envs.simulators.test_engines import ROBOTS, build_engine, section_of
from tests.envs.simulators.test_text_world import TEXTS, section, world
from tests.sampling import every
from tests.sections import merged

# One camera and seven numbers: what WPE's robots share.
ARM = Embodiment(
    robot="wpe",
    action_names=("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
    action_kind=ActionKind.OTHER,
    delta=True,
    arms=(),
    state_names=("x",),
    cameras=(Camera("front", (256, 256)),),
    fps=10.0,
)


@pytest.mark.long
def test_forcing_full_has_the_published_size_and_shapes() -> None:
    found = size_of(section_of("forcing_full"), WorldSpec(ARM, (256, 256), 9))
    assert found.trained == pytest.approx(609e6, rel=0.005)
    # Tokens of 20 frames times two operations per weight that each of them meets, three times over; what
    # modulates meets frames alone, and attention comes on top.
    met = 16 * 2 * (4 + 8) * 1024**2
    assert 1.0 < found.training / (3 * 2 * met * 20 * 256) < 1.25
    # Nine frames before are read once, nine frames ahead ten times.
    assert 1.0 < found.generating / (2 * met * (9 + 10 * 9) * 256) < 1.25
    assert found.activations > 20 * 256 * 1024 * 4 * 16 * 2


# RoboScape-R's robot has two cameras.
TWO_VIEWS = replace(ARM, cameras=(ARM.cameras[0], replace(ARM.cameras[0], name="wrist")))


def test_worlds_of_tokens_have_the_published_size() -> None:
    spec, half_a_billion = WorldSpec(TWO_VIEWS, (256, 256), 4), pytest.approx(515e6, rel=0.002)
    cfg = load_config(["judge=golden_goal_full", "task=tabletop"])
    engine = {key: value for key, value in section_of("tokens_full").items() if key not in WORLD_OPTIONS}
    for options, key in (
        (engine, "simulator"),
        (cfg["judge"]["text_world"], "judge.text_world"),
    ):
        with torch.device("meta"):
            made = build(options, key, spec=spec)
        assert sum(p.numel() for p in made.parameters() if p.requires_grad) == half_a_billion, key


def test_worlds_of_tokens_learn_and_generate_at_the_published_width() -> None:
    spec, goal = WorldSpec(TWO_VIEWS, (256, 256), 1), load_config(["judge=golden_goal_full", "task=tabletop"])
    # One of 24 blocks that are alike, 3 of 48 frames, 2 of 8 passes: more take seconds, and no other shapes.
    few: dict[str, Any] = {"window": 3, "net": {"layers": 1}, "decoding": {"steps": 2}}
    engine, text_world = merged(section_of("tokens_full"), few), merged(goal["judge"]["text_world"], few)
    pass_of_a_frame = 2 * 16 * 1024**2 * 2 * 16 * 16  # two operations a weight of a block, and place
    for found in (size_of(engine, spec), text_world_size(text_world, spec)):
        assert found.training > 3 * pass_of_a_frame * 5  # three frames that are known, two asked for
        assert found.generating > pass_of_a_frame * 4  # a frame that is known, two passes, and what they made


@pytest.mark.parametrize(
    "name", every(2, ["forcing_small", "dit_small", "unet_small", "tokens_small", "gesim_tiny"])
)
def test_what_is_counted_without_numbers_is_what_is_computed_with_them(name: str) -> None:
    spec = world_spec(ROBOTS[BIMANUAL_POSES.robot], chunk=5)
    found = size_of(section_of(name), spec)
    engine, _ = build_engine(name, spec)
    assert found.trained == sum(p.numel() for p in engine.parameters() if p.requires_grad)
    clips = clip(spec, 1, engine.memory_frames)
    state = engine.reset(first_of(spec, clips), torch.tensor([1]))
    with FlopCounterMode(display=False) as counter:
        engine.step(state, future_of(spec, clips))
    assert found.generating == pytest.approx(counter.get_total_flops(), rel=0.1)
    assert found.training > 2 * found.generating / 10 and found.activations > 0


def test_a_text_world_is_counted_as_it_computes() -> None:
    spec, options = world_spec(ARM_DELTAS), section(ending={"max_frames": 1})
    found, made = text_world_size(options, spec), world(ending={"max_frames": 1})
    assert found.trained == sum(p.numel() for p in made.parameters() if p.requires_grad)
    with FlopCounterMode(display=False) as counter:
        made.imagine(moving_square(spec, torch.tensor([0.2])), TEXTS[:1], torch.zeros(1, dtype=torch.int64))
    assert found.generating == pytest.approx(counter.get_total_flops(), rel=0.1)
    assert found.training > found.generating and found.activations > 0


def test_an_engine_that_asks_for_numbers_is_named() -> None:
    own: dict[str, Any] = section_of("forcing_small")
    own["actions"] = {"_target_": "envs.conditioning.ActionText", "decimals": 2}
    with pytest.raises(ConfigError, match=r"ForcingSimulator\) cannot be counted on shapes alone"):
        size_of(own, replace(WorldSpec(ARM, (256, 256), 4), size=(64, 64)))


def test_the_bench_prints_what_an_engine_takes(capsys: pytest.CaptureFixture[str]) -> None:
    size(load_config(["simulator=forcing_small"]))
    said = capsys.readouterr().out
    assert "ForcingSimulator: 3 x 64 x 64, chunks of 4" in said and "GB a sample" in said
