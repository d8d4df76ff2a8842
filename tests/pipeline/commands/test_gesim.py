"""The commands around GE-Sim: convert, inspect, finetune, serve, and the benchmark's floor."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from actors.factory import build_simulator, build_state_decoder
from envs.episodes import EpisodeError, LeRobotWriter
from envs.episodes.formats.foreign import Cut, read_foreign
from envs.simulators.dit.shape import DiTShape
from envs.simulators.samplers import few_steps
from envs.targets import ConfigError
from pipeline.benches.gesim.chunk import gesim
from pipeline.benches.gesim.floor import count_flops, goal_line
from pipeline.benches.gesim.world import FULL
from pipeline.cli import tools
from pipeline.commands.finetune import build_finetune
from pipeline.commands.serving import build_session_host
from pipeline.commands.verify import verify_run
from pipeline.config import load_config
from tests.actors.serving import serve_config
from tests.envs.simulators.gesim_tiny import write_checkpoint

WORDS = [
    "simulator=gesim",
    "task.size=[32,48]",
    "task.chunk=5",
    "task.horizon=10",
    "task.mode=absolute",
    "track=disabled",
]


def test_convert_and_inspect(shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tools.convert([str(shared / "data/gesim_v2"), str(tmp_path / "out"), "frames=6", "size=[32,48]"])
    tools.inspect([str(tmp_path / "out"), str(tmp_path / "pictures")])
    assert "1 episodes" in capsys.readouterr().out and len(list((tmp_path / "pictures").glob("*.png"))) == 1
    paths = [str(tmp_path / "out"), str(tmp_path / "other")]
    for wrong in (paths[:1], *([*paths, word] for word in ("size=[32]", "frames=-1", "tool_offset=0.1"))):
        with pytest.raises(ConfigError, match="worldloop convert SRC DST"):
            tools.convert(wrong)
    with pytest.raises(ConfigError, match="tool_offset=far: say metres"):
        tools.inspect([str(tmp_path / "out"), str(tmp_path / "pictures"), "tool_offset=far"])


def test_finetune_a_checkpoint_distil_it_again_and_serve_what_came_of_it(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (bundle,) = read_foreign(shared / "data/gesim_v2", Cut(12, (32, 48)))
    still = replace(bundle, frames=bundle.frames[[0] * 12], present=np.ones(12, bool))  # it has one picture
    for name, episode in (("data", still), ("bundle", bundle)):
        LeRobotWriter(tmp_path / name, episode.embodiment).write([episode])
    checkpoint = write_checkpoint(tmp_path / "released")
    words = [
        *WORDS,
        f"simulator.checkpoint={checkpoint}",
        f"runs={tmp_path / 'runs'}",
        f"finetune.data=[{tmp_path / 'data'}]",
    ]
    words += [
        "finetune.simulator.fit.steps=2",
        "finetune.simulator.fit.batch=2",
        "finetune.simulator.lora=2",
        "distill.steps=2",
        "distiller=dmd2_gesim",
        "distill.first={lora: 2, fit: {steps: 2, batch: 2, lr: 1e-2, warmup: 1}}",
        "distill.method={critic_updates: 1, critic_lr: 1e-2}",
        "finetune.state.fit.steps=2",
        "finetune.state.fit.batch=2",
    ]
    with pytest.raises(ConfigError, match=r"knows 16 joints.*states of 20.*state_expert\.checkpoint=null"):
        build_finetune(load_config(words), tmp_path / "none")  # bundles have head and waist joints, too
    words += ["simulator.state_expert.checkpoint=null"]
    with pytest.raises(EpisodeError, match="a picture after its first frame"):
        bare = load_config([*words, f"finetune.data=[{tmp_path / 'bundle'}]"])
        build_finetune(bare, tmp_path / "bare").run()
    cfg = load_config(words)
    graph = build_finetune(cfg, tmp_path / "runs/default")
    done = graph.run()
    assert set(done) == {"simulator", "student", "state"}
    said, alarm = capsys.readouterr().out, done["student"]["result"]["alarm"]
    lost = done["simulator"]["result"]["alarm"]
    assert "these weights sample in 4 distilled steps, and flow matching takes that out" in lost
    assert lost in said
    assert alarm in said and "lacks [2, 3, 4] of finetune.simulator.strides" in alarm
    rows = [json.loads(line) for line in (graph.folder("student") / "metrics.jsonl").open()]
    assert "distill/critic" in rows[0] and "distill/matching" in rows[1]
    first = json.loads(next((graph.folder("simulator") / "metrics.jsonl").open()))
    assert first["simulator/loss"] > 0 and first["simulator/grad_norm"] > 0
    simulator = build_simulator(graph.cfg, graph.folder("student") / "weights.safetensors")
    assert simulator.sampler == few_steps(2, 5.0)
    build_state_decoder(graph.cfg, simulator, graph.folder("state") / "weights.safetensors")
    assert verify_run(tmp_path / "runs/default").startswith("3 stages of")
    host = build_session_host(cfg, tmp_path / "runs/default", serve_config())
    assert host.simulator.spec.chunk == 5
    for served, stage in ((host.simulator, "student"), (host.decoder, "state")):
        tuned = load_file(graph.folder(stage) / "weights.safetensors")
        for name, value in served.named_parameters():  # buffers of the mix are handed over by the decoder
            assert torch.equal(value, tuned[name].to(value.dtype)), (stage, name)
    with pytest.raises(ConfigError, match="worldloop run"):
        build_session_host(load_config(WORDS), tmp_path / "nowhere", serve_config())
    with pytest.raises(ConfigError, match="worldloop finetune"):
        build_session_host(cfg, tmp_path / "nowhere", serve_config())
    with pytest.raises(ConfigError, match=r"finetune\.data"):
        build_finetune(load_config(WORDS), tmp_path / "none").run()


def test_what_no_gpu_has_shown_is_called_unmeasured() -> None:
    goal = "goal, 25 frames x 3 views at 384 x 512 in 1.15 s on one H200: "
    command = "; worldloop bench gesim launch.device=cuda"
    assert goal_line(FULL, "CPU") == f"{goal}unmeasured, for this is CPU{command}"
    assert goal_line(FULL, "NVIDIA H200") == f"{goal}measured above{command}"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_asked_for_and_not_there_is_told() -> None:
    with pytest.raises(ConfigError, match=r"launch\.device=cuda, but this machine has no CUDA device"):
        gesim(load_config([*WORDS, "launch.device=cuda"]))


def test_the_floor_counts_what_the_network_does() -> None:
    small = count_flops(FULL, 4, DiTShape(num_layers=2), 1, {"base_dim": 16})
    twice = count_flops(FULL, 4, DiTShape(num_layers=4), 1, {"base_dim": 16})
    # Per layer: 24 width^2 a token for attention and feed-forward to itself, and attention over 8448 or 25344
    # tokens.
    tokens, width = 3 * 8448, 2048
    least = 2 * (4 + 8) * width**2 * tokens * 2
    assert (
        twice["trunk"] - small["trunk"] > least and torch.isfinite(torch.tensor(list(small.values()))).all()
    )
    assert json.dumps(small)
