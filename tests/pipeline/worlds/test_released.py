"""A released checkpoint is measured as it is, with nothing trained, and known by its files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from envs.episodes import LeRobotWriter
from envs.episodes.splits import write_splits
from envs.simulators.gesim.checkpoint import load_released, load_state_network
from envs.simulators.gesim.engine import GESimulator
from envs.simulators.gesim.state_expert import GESimStateExpert
from envs.targets import ConfigError
from pipeline.cli.runs import evaluate
from pipeline.commands.serving import build_session_host
from pipeline.commands.worlds.fidelity import fidelity
from pipeline.commands.worlds.subject import Subject
from pipeline.config import load_config
from tests.actors.serving import serve_config
from tests.arms import two_arms
from tests.embodiments import BIMANUAL_JOINTS
from tests.envs.simulators.gesim_tiny import write_checkpoint
from tests.moving_square import SIZE, moving_square


@pytest.fixture
def words(tmp_path: Path) -> list[str]:
    """What names a tiny released checkpoint, and short recordings of its robot."""
    data, body = tmp_path / "data", BIMANUAL_JOINTS.at(SIZE)
    LeRobotWriter(data, body).write([moving_square(body, seed, length=6) for seed in range(2)])
    write_splits(data, {"train": 0, "held_out": 2, "calibration": 0})
    robot, checkpoint = two_arms(tmp_path), write_checkpoint(tmp_path / "released")
    joints, flanges = (str([*names]).replace("'", "") for names in (robot.joints, robot.flanges))
    joints = joints.replace("(", "[").replace(")", "]")
    return [
        *("experiment=smoke", "track=disabled", f"runs={tmp_path / 'runs'}", "simulator=gesim"),
        f"simulator.checkpoint={checkpoint}",
        f"simulator.kinematics={{model: {robot.model}, joints: {joints}, flanges: {flanges}}}",
        *("task=lerobot", f"task.data=[{data}]", "task.mode=absolute"),
        *("task.size=[32,32]", "task.chunk=5", "task.horizon=10"),
        *("fidelity={episodes: 1, long: {frames: 0}}", "fidelity.end_effectors=false"),
        "ewmbench={samples: 1, episodes: 1, videos: 0}",
    ]


def test_a_released_world_is_measured_and_known_by_its_files(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    cfg, root, checkpoint = load_config(words), tmp_path / "runs/smoke", tmp_path / "released"
    subject = Subject.of(cfg, root)
    simulator = subject.simulator()
    assert isinstance(simulator, GESimulator) and not simulator.training
    own = load_released(checkpoint).net.state_dict()
    decoder = subject.decoder(simulator)
    assert isinstance(decoder, GESimStateExpert)
    for name, value in simulator.net.named_parameters():
        assert torch.equal(value, own[name]), name
    found = load_state_network(checkpoint)
    assert found is not None
    for name, value in decoder.net.named_parameters():
        assert torch.equal(value, found[0].state_dict()[name]), name

    assert "\n0 parts were reused" in fidelity(cfg, root)
    first = json.loads((root / "fidelity.json").read_text())
    assert first["weights"]["simulator"] == first["weights"]["state"] == str(checkpoint)
    same = Subject.of(cfg, root)
    assert same.identity("simulator", "state") == subject.identity("simulator", "state")
    tensors = load_file(checkpoint / "model.safetensors")
    changed = {name: 2 * value if "proj_out" in name else value for name, value in tensors.items()}
    save_file(changed, checkpoint / "model.safetensors")
    evaluate(words)  # without policy=, simulator=gesim is what is evaluated
    said = capsys.readouterr().out
    assert "\n0 parts were reused" in said and "ewmbench.html" in said and "summary.html" in said
    second = json.loads((root / "fidelity.json").read_text())
    assert all(first["marks"][role] != second["marks"][role] for role in ("simulator", "state"))
    assert first["overall"]["psnr"] != second["overall"]["psnr"]


@pytest.mark.long
def test_weights_of_ones_own_come_before_released_ones(tmp_path: Path, words: list[str]) -> None:
    root = tmp_path / "runs/smoke"
    bare = Subject.of(load_config([*words, "simulator.state_expert.checkpoint=null"]), root)
    with pytest.raises(ConfigError, match=r"state-1-\w+/weights\.safetensors does not exist"):
        bare.decoder(bare.simulator())
    tuned = Subject.of(load_config([*words, "finetune.data=[elsewhere]"]), root)
    with pytest.raises(ConfigError, match=r"simulator-1-\w+/weights\.safetensors does not exist"):
        tuned.simulator()
    folder = bare.graph.folder("simulator-1")
    folder.mkdir(parents=True)
    save_file({}, folder / "weights.safetensors")
    trained = Subject.of(load_config([*words, "simulator.state_expert.checkpoint=null"]), root)
    assert not trained.released and trained.weights["simulator"] == folder / "weights.safetensors"
    first = write_checkpoint(tmp_path / "older", expert=False)
    other = Subject.of(load_config([*words, f"simulator.checkpoint={first}"]), root)
    with pytest.raises(ConfigError, match=r"ge_sim_v1\.safetensors holds no state expert; train one"):
        other.decoder(other.simulator())


def test_what_has_no_state_expert_is_served_without_states(
    tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    host = build_session_host(load_config(words), tmp_path / "runs/smoke", serve_config())
    assert (
        isinstance(host.decoder, GESimStateExpert) and "without joint states" not in capsys.readouterr().out
    )
    frames_alone = write_checkpoint(tmp_path / "older", expert=False)
    cfg = load_config([*words, f"simulator.checkpoint={frames_alone}"])
    host = build_session_host(cfg, tmp_path / "runs/smoke", serve_config())
    assert host.decoder is None and "without joint states" in capsys.readouterr().out
