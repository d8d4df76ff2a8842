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
from envs.simulators.stepwise import Stepwise
from envs.specs import ActionMode, WorldSpec
from envs.targets import build, target
from tests.sections import offered

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


def stepwise_engines() -> list[str]:
    """The small configs of configs/simulator whose engine denoises in steps."""
    small = [name for name in offered("simulator") if name.endswith(("_small", "_tiny"))]
    kinds = {name: target(section_of("simulator", name), "simulator") for name in small}
    return [name for name in small if issubclass(kinds[name], Stepwise)]


def stepwise_pair(name: str, spec: WorldSpec) -> tuple[Simulator, Simulator]:
    """An untrained teacher of four steps whose frames are not trivial, and a student of two."""
    own = {k: v for k, v in section_of("simulator", name).items() if k not in WORLD_OPTIONS}
    if "sampling" in own:
        own["sampling"] = {"kind": "edm", "steps": 4}
    torch.manual_seed(0)
    teacher: Simulator = build(own, "simulator", spec=spec)
    few = target(own, "simulator").student_section(own, 2)  # type: ignore[attr-defined]
    student: Simulator = build(few, "simulator", spec=spec)
    with torch.no_grad():
        for parameter in teacher.parameters():
            # what begins at zero, or near it, makes frames that nothing moves
            if float(parameter.abs().max()) < 0.02:
                parameter.normal_(std=0.05)
    student.load_state_dict(teacher.state_dict())
    return teacher, student


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
