"""Policy, judge and algorithm as a config names them, built once on a small scale before any work.

Classes may be somebody else's. What they lack, or refuse, would be found at their own stages, hours later.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.policies.contract import VISUAL_FEATURES, action_key, distribution, inputs_for
from actors.policies.safe import SafePolicyWrapper, check_scores
from envs.judges.base import Judge
from envs.specs import (
    CHUNK,
    COMMAND,
    IMAGE,
    INSTRUCTION_UTF8,
    STATE,
    TEXT_BYTES,
    ActionMode,
    WorldSpec,
)
from envs.targets import TARGET, ConfigError, build, target

METHODS = ("seeds", "prepare", "loss", "modules", "groups")  # of an algorithm
_UNFROZEN = "set rl.freeze_perception=false"
_SMALL = 50_000_000  # numbers of a policy that is tried in about a second
_BATCH = 2


def refusals(section: Mapping[str, Any], key: str, **context: Any) -> tuple[Any, list[str]]:
    """A part built without memory (torch's meta device), in hundredths of a second whatever its size, or
    None; and what its class says against its options, [] for nothing.

    Only a ValueError counts, which is how options are refused, or a file or package that is not there, and
    none that goes back to a RuntimeError or TypeError: so torch answers where a class asks for the values of
    tensors that have no memory. Whatever cannot be built without is left to its first stage; so are a
    checkpoint, which would be read for this alone, and classes that say `rehearsed = False`.
    """
    if section.get("checkpoint") or not getattr(target(section, key), "rehearsed", True):
        return None, []
    try:
        with torch.device("meta"):
            return build(section, key, **context), []
    except ValueError as error:
        reason: BaseException | None = error
        if not isinstance(error.__cause__, (ValueError, OSError, ImportError, type(None))):
            return None, []
        while reason is not None and not isinstance(reason, (RuntimeError, TypeError)):
            reason = reason.__cause__ or reason.__context__
        return None, [str(error)] if reason is None else []
    except Exception:  # somebody else's class may raise anything
        return None, []


def judge_faults(cfg: Mapping[str, Any], spec: WorldSpec, simulator: Any) -> list[str]:
    """What is wrong with the judge's class or options.

    Args:
        simulator: built without memory, or None; a judge that reads its features is then left to its stage.
    """
    section = {name: value for name, value in cfg["judge"].items() if name != "rewards"}
    kind: Any = target(section, "judge")
    if not isinstance(kind, type) or not issubclass(kind, Judge):
        return [f"judge.{TARGET}={section[TARGET]} must be a subclass of envs.judges.base.Judge"]
    try:
        kind.check(cfg["judge"])
    except ConfigError as error:
        return [str(error)]
    if kind.score is Judge.score:
        return [f"judge ({section[TARGET]}) has no method score; see docs/own_judge.md"]
    context: dict[str, Any] = {"spec": spec}
    if kind.reads_features:
        if not hasattr(simulator, "feature_shape"):
            return []
        context["feature_shape"] = simulator.feature_shape
    return refusals(section, "judge", **context)[1]


def policy_faults(cfg: Mapping[str, Any], spec: WorldSpec) -> list[str]:
    """What is wrong with the policy's class or options, and with the algorithm around it.

    A policy of at most 50 million numbers is built as it is, and acts once on observations of zeros; nothing
    else draws other numbers for that.
    """
    section, frozen = cfg["policy"], cfg["rl"]["freeze_perception"]
    kind, who = target(section, "policy"), f"policy ({section[TARGET]})"
    if frozen and isinstance(kind, type) and not hasattr(kind, "freeze_perception"):
        return [f"rl.freeze_perception=true, but {who} has no freeze_perception(); {_UNFROZEN}"]
    if not getattr(kind, "rehearsed", True):
        return []
    policy, wrong = refusals(section, "policy", spec=spec)
    if wrong:
        return wrong
    large = isinstance(policy, nn.Module) and sum(map(_numbers, policy.parameters())) > _SMALL
    with torch.random.fork_rng(devices=[]):
        try:
            policy = policy if large else build(section, "policy", spec=spec)
        except Exception as error:  # somebody else's class may raise anything
            return [str(error)]
        wrong = list(_lacking(policy, who))
        if not wrong and frozen and VISUAL_FEATURES not in policy.out_keys:
            wrong = [f"rl.freeze_perception=true, but {who} writes no {VISUAL_FEATURES}; {_UNFROZEN}"]
        if not wrong and not large:
            wrong = _acting_faults(policy.eval(), who, spec, ActionMode(cfg["task"]["mode"]))
        return wrong or _algorithm_faults(cfg, policy, spec, large)


def _numbers(weight: torch.Tensor) -> int:
    """Of a tensor; those of a layer that takes its size from its first input are unknown."""
    return 0 if nn.parameter.is_lazy(weight) else weight.numel()


def _lacking(policy: Any, who: str) -> Iterator[str]:
    """What an object has not that every policy has."""
    missing = [name for name in ("in_keys", "out_keys") if not hasattr(policy, name)]
    if not isinstance(policy, nn.Module):
        yield f"{who} makes a {type(policy).__name__}, which is no torch.nn.Module"
    elif missing:
        yield (
            f"{who} has no {' and no '.join(missing)}: lists of the keys of envs/specs.py that it reads and"
            " writes, such as [STATE] and [CHUNK]; see docs/own_policy.md"
        )
    elif CHUNK not in getattr(policy, "out_keys", ()):
        yield f"{who} does not write {CHUNK}; add it to its out_keys"


def _algorithm_faults(cfg: Mapping[str, Any], policy: Any, spec: WorldSpec, large: bool) -> list[str]:
    """What is wrong with the algorithm around a policy, which is used up; a `large` one has no memory."""
    section, rl = cfg["algorithm"], cfg["rl"]
    who, kind = f"algorithm ({section[TARGET]})", target(section, "algorithm")
    if not hasattr(policy, "get_dist") or not getattr(kind, "rehearsed", True):  # it can be evaluated alone
        return []
    try:
        if rl["freeze_perception"]:
            policy.freeze_perception()
        given = {"policy": policy, "spec": spec}
        made, wrong = (
            refusals(section, "algorithm", **given) if large else (build(section, "algorithm", **given), [])
        )
    except Exception as error:  # somebody else's class may raise anything
        return [str(error)]
    if made is None:
        return wrong
    if lacking := [name for name in METHODS if not callable(getattr(made, name, None))]:
        return [f"{who} has no method {' and none '.join(lacking)}; see learners/rl/algorithm.py"]
    episodes, group = rl["envs"] // rl["shards"], getattr(made, "group_size", 1)
    if episodes % group:
        return [
            f"rl.envs / rl.shards = {episodes} must be a multiple of the {group} episodes that {who} keeps"
            " together (group_size), or groups would be torn apart; change rl.envs"
        ]
    return []


def _acting_faults(policy: TensorDictModuleBase, who: str, spec: WorldSpec, mode: ActionMode) -> list[str]:
    """What is wrong with a policy that acts once."""
    seen = _observed(spec)
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            acted = SafePolicyWrapper(policy, spec, mode)(seen.copy())
            if hasattr(policy, "get_dist"):
                known = distribution(policy, inputs_for(seen, policy))
                check_scores(known.log_prob(acted[action_key(policy)]), _BATCH)
    except ConfigError as error:
        return [f"{who}: {error}"]
    except Exception as error:  # somebody else's class may raise anything
        return [
            f"{who} fails on an observation of {spec.embodiment.robot}: {type(error).__name__}: {error}. Of"
            f" {[*seen.keys(True, True)]} and the text language_instruction it gets what its in_keys name"
        ]
    return []


def _observed(spec: WorldSpec) -> TensorDict:
    """Observations [2] of zeros."""
    return TensorDict(
        {
            IMAGE: torch.zeros(_BATCH, spec.views, 3, *spec.size, dtype=torch.uint8),
            STATE: torch.zeros(_BATCH, spec.state_dim),
            COMMAND: torch.zeros(_BATCH, spec.action_dim),
            INSTRUCTION_UTF8: torch.zeros(_BATCH, TEXT_BYTES, dtype=torch.uint8),
        },
        [_BATCH],
    )
