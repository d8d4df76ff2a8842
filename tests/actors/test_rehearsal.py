"""Classes of somebody's own are built and tried before any work, and told what they lack."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.factory import build_algorithm, build_policy
from actors.policies.safe import SafePolicyWrapper
from actors.rehearsal import _observed
from actors.world_config import check_world, world_spec
from envs.judges.base import Judge, Judgement, judgement_status
from envs.specs import CHUNK, INVALID_ACTION, LOG_PROB, STATE, ActionMode, WorldSpec
from envs.targets import ConfigError
from pipeline.cli.runs import _check_learns
from pipeline.config import load_config

HERE = __name__


class Keyless(nn.Module):
    """A policy without lists of its keys."""

    def __init__(self, spec: WorldSpec, slip: str = ""):
        super().__init__()
        if slip == "refused":
            raise ValueError("slip=refused cannot work")
        if slip == "file":
            Path("/nowhere/weights").read_bytes()
        self.slip, self.shape = slip, (spec.chunk, spec.action_dim)
        self.weights = nn.Linear(spec.state_dim, spec.chunk * spec.action_dim)

    def get_dist(self, observed: TensorDictBase) -> Any:
        mean = self.weights(observed[STATE]).unflatten(-1, self.shape)
        normal = Normal(mean, torch.ones_like(mean), validate_args=False)
        return Independent(normal, 1 if self.slip == "shape" else 2, validate_args=False)

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        if self.slip == "key":
            observed["observation", "depth"]
        observed[CHUNK] = self.get_dist(observed).sample()
        return observed


class Plain(Keyless):
    """One that says no log-probability."""

    in_keys, out_keys = [STATE], [CHUNK]


class Specless(nn.Module):
    def __init__(self, width: int = 3):
        super().__init__()


class Encoding(Plain):
    """One that can be frozen, but writes no visual features."""

    def freeze_perception(self) -> None: ...


class Copying(nn.Module):
    """One that imitates, and says no distribution."""

    def imitation_loss(self) -> None: ...


class Scoring(Judge):
    def __init__(self, spec: WorldSpec, hold: int = 2, refused: bool = False):
        super().__init__(hold)
        if refused:
            raise ValueError("refused=true cannot work")

    def score(self, frames: Tensor, first: Tensor, instruction: list[str], features: Any = None) -> Judgement:
        success = torch.zeros(frames.shape[:2])
        return Judgement(success, success, judgement_status(success))


class Silent(Judge):
    def __init__(self, spec: WorldSpec):
        super().__init__(2)


class Bare:
    """An algorithm of what it needs alone."""

    def __init__(self, policy: nn.Module, spec: WorldSpec, refused: bool = False):
        if refused:
            raise ValueError("refused=true cannot work")

    def seeds(self, *_: Any) -> Any: ...

    prepare = loss = modules = groups = seeds


class Halves(Bare):
    group_size = 3


class Lossless(Bare):
    loss = None  # type: ignore[assignment]


def config(*words: str, **sections: dict[str, Any]) -> dict[str, Any]:
    cfg = load_config(["experiment=smoke", *words])
    named = {key: {**given, "_target_": f"{HERE}.{given['_target_']}"} for key, given in sections.items()}
    if "judge" in named:
        named["judge"]["rewards"] = cfg["judge"]["rewards"]
    return {**cfg, **named}


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"policy": {"_target_": "Keyless"}}, r"policy \(.*Keyless\) has no in_keys and no out_keys: lists"),
        ({"policy": {"_target_": "Specless"}}, r"policy\._target_=.*Specless takes no argument 'spec'"),
        ({"policy": {"_target_": "Plain", "slip": "refused"}}, r"slip=refused cannot work"),
        ({"policy": {"_target_": "Plain", "slip": "file"}}, r"No such file or directory: '/nowhere/weights'"),
        ({"policy": {"_target_": "Plain", "slip": "key"}}, r"Plain\) fails on an observation .* KeyError"),
        ({"policy": {"_target_": "Plain", "slip": "shape"}}, r"log-probabilities \[2, 4\] of 2 chunks"),
        ({"judge": {"_target_": "Scoring", "refused": True}}, r"judge \(.*Scoring\): refused=true cannot"),
        ({"judge": {"_target_": "Specless"}}, r"Specless must be a subclass of envs\.judges\.base\.Judge"),
        ({"judge": {"_target_": "Silent"}}, r"Silent\) has no method score"),
        ({"algorithm": {"_target_": "Bare", "refused": True}}, r"algorithm \(.*\): refused=true cannot work"),
        ({"algorithm": {"_target_": "Lossless"}}, r"Lossless\) has no method loss"),
        ({"algorithm": {"_target_": "Halves"}}, r"rl\.shards = 8 must be a multiple of the 3 episodes"),
    ],
)
def test_what_own_classes_lack_is_told_before_any_work(sections: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_world(config(**sections))


def test_what_is_left_out_has_a_default() -> None:
    cfg = config(policy={"_target_": "Plain"}, judge={"_target_": "Scoring"}, algorithm={"_target_": "Bare"})
    before = torch.get_rng_state()
    check_world(cfg)
    assert torch.equal(torch.get_rng_state(), before)
    made = build_algorithm(cfg, build_policy(cfg))
    assert not made.bootstraps and not made.supports_delayed_reward
    assert (made.name, made.group_size) == ("Bare", 1)


def test_log_probabilities_that_a_policy_does_not_write_are_those_of_its_distribution() -> None:
    cfg = config(policy={"_target_": "Plain"})
    policy, spec = build_policy(cfg), world_spec(cfg)
    seen = _observed(spec)
    actor = SafePolicyWrapper(policy, spec, ActionMode.ABSOLUTE)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        acted = actor(seen.copy())
        assert torch.equal(acted[LOG_PROB], policy.get_dist(seen).log_prob(acted[CHUNK]))
        policy.weights.bias.fill_(torch.nan)
        spoiled = actor(seen.copy())
    assert LOG_PROB in actor.out_keys and spoiled[INVALID_ACTION].all() and not spoiled[LOG_PROB].any()


def test_perception_is_frozen_where_the_policy_can() -> None:
    for words, frozen in (([], True), (["policy=tiny_vla"], False), (["policy=openpi"], False)):
        cfg = load_config(["experiment=metaworld5", *words])
        assert cfg["rl"]["freeze_perception"] is frozen
    told = config("policy=tiny_vla", "rl.freeze_perception=true")
    with pytest.raises(ConfigError, match=r"policy .* has no freeze_perception\(\); set rl\.freeze"):
        check_world(told)
    with pytest.raises(ConfigError, match=r"Encoding\) writes no .*visual_features"):
        check_world(config("rl.freeze_perception=true", policy={"_target_": "Encoding"}))


def test_deltas_are_not_taken_for_relative() -> None:
    with pytest.raises(ConfigError, match=r"^task\.mode=relative needs absolute .* set task\.mode=absolute$"):
        check_world(config("task=metaworld", "task.mode=relative"))


def test_rl_needs_a_distribution_and_imitation_a_loss() -> None:
    cfg = config(policy={"_target_": "Copying"})
    _check_learns(cfg, ["collect", "imitation", "deploy-1"])
    with pytest.raises(ConfigError, match="has no get_dist"):
        _check_learns(cfg, ["imitation", "rl-1"])
