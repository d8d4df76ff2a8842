"""Small models of any robot, built from configs/ as the factory builds them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from envs.judges import Judge
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import ActionMode, WorldSpec
from envs.targets import build

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
POLICIES = ("chunk_gaussian", "chunk_tokens", "tiny_vla")


def section_of(kind: str, name: str, mode: ActionMode = ActionMode.RELATIVE) -> dict[str, Any]:
    """configs/<kind>/<name>.yaml with the ones that it builds on."""
    own = OmegaConf.load(CONFIGS / kind / f"{name}.yaml")
    bases = [base for base in own.pop("defaults", []) if base != "_self_"]
    merged = OmegaConf.merge(*(OmegaConf.load(CONFIGS / kind / f"{base}.yaml") for base in bases), own)
    whole = OmegaConf.create({"task": {"mode": mode.value}, "cameras": "all", kind: merged})
    return dict(OmegaConf.to_container(whole, resolve=True)[kind])  # type: ignore[call-overload, index]


def policy_of(name: str, spec: WorldSpec, mode: ActionMode = ActionMode.RELATIVE) -> TensorDictModuleBase:
    """An untrained policy."""
    torch.manual_seed(0)
    return build(section_of("policy", name, mode), "policy", spec=spec)  # type: ignore[no-any-return]


def simulator_of(name: str, spec: WorldSpec) -> Simulator:
    """An untrained simulator."""
    torch.manual_seed(0)
    section = section_of("simulator", name)
    own = {key: value for key, value in section.items() if key not in WORLD_OPTIONS}
    return build(own, "simulator", spec=spec)  # type: ignore[no-any-return]


def distilled(spec: WorldSpec, steps: int = 2) -> Simulator:
    """An untrained student of dit_small."""
    section = section_of("simulator", "dit_small")
    own = {key: value for key, value in section.items() if key not in WORLD_OPTIONS}
    return build(DiTSimulator.student_section(own, steps), "simulator", spec=spec)  # type: ignore[no-any-return]


def decoder_of(name: str, simulator: Simulator) -> StateDecoder:
    """The untrained state expert of a simulator."""
    torch.manual_seed(0)
    section = section_of("simulator", name)["state_expert"]
    return build(section, "simulator.state_expert", simulator=simulator)  # type: ignore[no-any-return]


def judge_of(spec: WorldSpec, hold: int = 2, name: str = "learned", **context: Any) -> Judge:
    """An untrained judge; `context` is what the factory would add, such as feature_shape."""
    torch.manual_seed(0)
    section = {k: v for k, v in section_of("judge", name).items() if k != "rewards"}
    return build(section | {"hold": hold}, "judge", spec=spec, **context)  # type: ignore[no-any-return]
