"""What robot, suite, simulator or text world refuse is told before any work."""

from __future__ import annotations

import pytest
import torch

from actors.world_config import check_world
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.specs import WorldSpec
from envs.targets import ConfigError
from pipeline.cli.words import prepared
from pipeline.config import load_config


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("task.name=psh", r"task\.name='psh' is unknown.*'push'"),
        ("task.suite.cameras=[hed]", r"task\.suite\.cameras holds \['hed'\]"),
        ("task.suite.actions=thoughts", r"task\.suite\.actions='thoughts'"),
        ("cameras=[hed]", r"^cameras=\['hed'\] must be some of"),
        ("policy.cameras=[hed]", r"policy\.cameras=\['hed'\] must be some of .*head"),
        ("judge.cameras=most", r"judge\.cameras='most' must be all, main or"),
        ("task.suite.size=[32,48]", r"task\.size=\[64, 64\], but the suite renders \[\[32, 48\]\]"),
    ],
)
def test_what_the_robot_has_not_is_told_before_any_work(word: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        prepared([word])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["task.variants.out_of_domain.scenes=out_of_domian"],
            r"out_of_domain: task\.suite\.scenes holds 'out_of",
        ),
        (["+task.variants.swapped.phrasings=[plane]"], r"swapped: task\.suite\.phrasings holds 'plane'"),
        (["+task.variants.swapped.actions=joints"], r"swapped has another robot .*: action_names is"),
        (["+task.variants.swapped.cameras=[head]"], r"swapped has another robot .*: views is"),
        (["+task.variants.swapped.size=[32,32]"], r"swapped has another robot .*: cameras \(name, size"),
    ],
)
def test_a_variant_that_cannot_be_is_told_before_any_work(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=rf"^task\.variants\.{said}"):
        prepared(["task=tabletop", *words])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simulator=tokens", "simulator.window=4"], r"simulator\.window=4 must be more than task\.chunk=4"),
        (["simulator=tokens", "simulator.codec.bits=19"], r"codec\.bits=19 must be a multiple of"),
        (["simulator=tokens", "simulator.codec.bits=64"], r"codec\.bits=64 .* tokens of 32 bits"),
        (["simulator=forcing", "simulator.horizon=3", "task=metaworld"], r"simulator\.horizon=3 must be at"),
        (["simulator=gesim"], r"task\.chunk=4 must be 1 \+ a multiple of 4"),
        (["judge=golden_goal", "judge.text_world.net.heads=5"], r"^judge\.text_world\.net: net\.width=128"),
        (["judge=golden_goal", "judge.text_world.codec.stride=12"], r"^judge\.text_world .*codec\.stride=12"),
    ],
)
def test_what_simulator_or_text_world_refuses_is_told_before_any_work(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        prepared(words)


class Own(Simulator):
    """An engine of somebody else's, which computes with its first weights."""

    def __init__(self, spec: WorldSpec, memory_frames: int, slip: str):
        super().__init__(spec, memory_frames)
        if memory_frames > 4:
            raise ValueError(f"memory_frames={memory_frames} must be at most 4")
        weights = torch.ones(3)
        if slip == "item":  # RuntimeError
            float(weights.sum())
        elif slip == "numpy":  # TypeError
            weights.numpy()
        elif slip == "turned":
            try:
                weights.tolist()
            except RuntimeError:
                raise ValueError("weights cannot be read") from None
        elif slip == "own":
            raise KeyError(slip)


@pytest.mark.parametrize("slip", ["item", "numpy", "turned", "own"])
def test_engines_that_need_memory_are_not_refused_for_that(slip: str) -> None:
    cfg = load_config([])
    around = {key: value for key, value in cfg["simulator"].items() if key in WORLD_OPTIONS}
    own = {**around, "_target_": f"{__name__}.Own", "memory_frames": 4, "slip": slip}
    check_world({**cfg, "simulator": own})
    with pytest.raises(ConfigError, match=r"memory_frames=5 must be at most 4"):
        check_world({**cfg, "simulator": {**own, "memory_frames": 5}})
    # its weights would be read for this alone
    check_world({**cfg, "simulator": {**own, "memory_frames": 5, "checkpoint": "released"}})
