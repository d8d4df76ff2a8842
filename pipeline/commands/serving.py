"""Which world `worldloop serve` serves: what finetune made, the experiment's last, or a released one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from actors.factory import build_simulator, build_state_decoder
from actors.serving.sessions import ServeConfig, SessionHost
from actors.world_config import build_kinematics, world_spec
from envs.conditioning.joint_commands import JointCommands
from envs.embodiment import ActionKind
from envs.simulators.remote.engine import RemoteSimulator
from envs.targets import ConfigError, target
from pipeline.commands.finetune import build_finetune
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import build_loop


def build_session_host(cfg: Mapping[str, Any], root: Path, config: ServeConfig) -> SessionHost:
    """The sessions of the configured simulator.

    With finetune.data it is what `worldloop finetune` made of those data; else the experiment's last, or,
    where nothing was trained, a released checkpoint, without joint states if it holds no state expert.

    Raises:
        ConfigError: if it has no weights yet, or is itself remote.
    """
    if issubclass(target(cfg["simulator"], "simulator"), RemoteSimulator):  # type: ignore[arg-type]
        raise ConfigError("simulator=remote is served already; serve unet, dit or gesim")
    if cfg["finetune"]["data"]:
        graph, way = build_finetune(cfg, root), "worldloop finetune"
        folders = graph.inputs("state").folder("simulator"), graph.folder("state")
    else:
        graph, way = build_loop(cfg, root), "worldloop run"
        inputs = graph.inputs("evaluate-imagined")
        folders = inputs.folder("simulator"), inputs.folder("state")
    cfg = graph.cfg  # of the data's robot, if it is a fine-tuned one, and of the world that is acted in
    weights, states = (folder / WEIGHTS for folder in folders)
    released = cfg["simulator"].get("checkpoint") and not cfg["finetune"]["data"]
    if not weights.exists() and not released:
        raise ConfigError(
            f"{weights} does not exist; run `{way}` with these words first, or serve released weights by"
            " simulator=gesim simulator.checkpoint=<folder> without finetune.data"
        )
    if weights.exists() and not states.exists():
        raise ConfigError(
            f"{states} does not exist, so nobody knows the robot's state in what this simulator draws; let"
            f" `{way}` with these words go on"
        )
    simulator = build_simulator(cfg, weights if weights.exists() else None)
    made = build_state_decoder(cfg, simulator, states if weights.exists() else None).eval()
    decoder = made if weights.exists() or made.normalised else None
    if decoder is None:
        tqdm.write(
            f"simulator.checkpoint={cfg['simulator']['checkpoint']} comes without a state expert, so frames"
            " are served without joint states; `worldloop finetune` trains one"
        )
    return SessionHost(simulator, decoder, config, _joints(cfg), cfg["simulator"]["bf16"])


def _joints(cfg: Mapping[str, Any]) -> JointCommands | None:
    """What lets clients command joints of a robot that takes end-effector poses, if it is known."""
    robot, kinematics = world_spec(cfg).embodiment, build_kinematics(cfg)
    if kinematics is None or robot.action_kind is not ActionKind.END_EFFECTOR or not robot.commands_poses:
        return None
    return JointCommands(robot, kinematics)
