"""Which world `worldloop serve` serves: the experiment's last, what finetune made of it, or a released
checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.factory import build_simulator, build_state_decoder
from actors.serving.sessions import ServeConfig, SessionHost
from actors.world_config import build_kinematics, world_spec
from envs.conditioning.joint_commands import JointCommands
from envs.embodiment import ActionKind
from envs.simulators.remote.engine import RemoteSimulator
from envs.targets import ConfigError, target
from pipeline.loop import build_loop, last_round


def build_session_host(cfg: Mapping[str, Any], root: Path, config: ServeConfig) -> SessionHost:
    """The sessions of the configured simulator.

    Raises:
        ConfigError: if it has no weights yet, or is itself remote.
    """
    if issubclass(target(cfg["simulator"], "simulator"), RemoteSimulator):  # type: ignore[arg-type]
        raise ConfigError("simulator=remote is served already; serve unet, dit or gesim")
    graph, last = build_loop(cfg, root), last_round(cfg)
    weights, states = (
        graph.folder(f"{stage}-{last}") / "weights.safetensors" for stage in ("simulator", "state")
    )
    if not weights.exists() and not cfg["simulator"].get("checkpoint"):
        raise ConfigError(
            f"{weights} does not exist; run this experiment first, or serve released weights by"
            " simulator=gesim simulator.checkpoint=<folder>"
        )
    simulator = build_simulator(cfg, weights if weights.exists() else None)
    decoder = build_state_decoder(cfg, simulator, states if states.exists() else None)
    return SessionHost(simulator, decoder.eval(), config, _joints(cfg), cfg["simulator"]["bf16"])


def _joints(cfg: Mapping[str, Any]) -> JointCommands | None:
    """What lets clients command joints of a robot that takes end-effector poses, if it is known."""
    robot, kinematics = world_spec(cfg).embodiment, build_kinematics(cfg)
    if kinematics is None or robot.action_kind is not ActionKind.END_EFFECTOR or not robot.commands_poses:
        return None
    return JointCommands(robot, kinematics)
