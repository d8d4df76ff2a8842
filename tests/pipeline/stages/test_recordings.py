"""Data sets in LeRobot's own file layout to finetune on, for the judge, and as starts of episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from safetensors.torch import load_file

from actors.factory import build_judge, build_simulator, build_state_decoder, build_world, open_clips
from actors.world_config import world_spec
from envs.episodes import EpisodeError, LeRobotDataset
from envs.episodes.splits import write_splits
from envs.episodes.video import read_video
from envs.initial_states import DecisionPoints, InitialStates
from envs.specs import CHUNK, IMAGE, STATE
from envs.targets import ConfigError
from pipeline.commands.finetune import build_finetune
from pipeline.config import load_config
from pipeline.graph.graph import Graph
from pipeline.loop import build_loop, check_labels
from tests.envs.episodes.lerobot.sets import SETS, write_set


def config(root: Path, kind: str, *words: str) -> Any:
    """The smallest loop on one of the seven sets, written under `root`."""
    write_set(root / "set", SETS[kind])
    return load_config(
        [
            *("experiment=smoke", "track=disabled", f"runs={root}", "task=lerobot"),
            *(f"task.data=[{root / 'set'}]", "task.size=[32,48]", "task.chunk=2", "task.horizon=4", *words),
        ]
    )


def smoke(*sections: str) -> tuple[str, ...]:
    return tuple(f"{section}.fit.{key}" for section in sections for key in ("steps=2", "batch=2"))


@pytest.mark.parametrize("kind", ["single_arm", "many_files"])
def test_finetune_on_a_set_of_lerobots(kind: str, tmp_path: Path) -> None:
    cfg = config(
        *(tmp_path, kind, f"finetune.data=[{tmp_path / 'set'}]"),
        *smoke("finetune.simulator", "finetune.state"),
    )
    graph = build_finetune(cfg, tmp_path / "smoke")
    done = graph.run()
    assert set(done) == {"simulator", "state"}
    (film,) = (graph.folder("simulator") / "media").iterdir()  # of its last step, here its only checkpoint
    video = read_video(film)
    assert film.name.endswith("-step000002.mp4") and len(video) > 5 and video.std() > 10
    robot = world_spec(graph.cfg).embodiment
    about = SETS[kind]
    assert (robot.robot, robot.fps, len(robot.cameras)) == (about.robot, about.fps, len(about.cameras))
    trained = build_simulator(graph.cfg, graph.folder("simulator") / "weights.safetensors")
    torch.manual_seed(cfg["seed"])
    untrained = build_simulator(graph.cfg).state_dict()
    tuned = load_file(graph.folder("simulator") / "weights.safetensors")
    assert any(not torch.equal(untrained[name].to(value.dtype), value) for name, value in tuned.items())
    decoder = build_state_decoder(graph.cfg, trained, graph.folder("state") / "weights.safetensors")
    starts = InitialStates.of(open_clips(graph.cfg, [tmp_path / "set"]))
    world = build_world(graph.cfg, trained, decoder, build_judge(graph.cfg), starts, 2)
    rolled = world.rollout(2, break_when_any_done=False)  # an untrained judge says anything
    assert rolled["next", STATE].shape == (2, 2, robot.state_dim)


def test_a_world_of_latents_is_finetuned_on_a_tokenizer_that_has_learned(tmp_path: Path) -> None:
    words = (
        "simulator=dit_small",
        f"finetune.data=[{tmp_path / 'set'}]",
        "tokenizer_fit={steps: 2, batch: 4}",
    )
    cfg = config(tmp_path, "labelled", *words, *smoke("finetune.simulator", "finetune.state"))
    graph = build_finetune(cfg, tmp_path / "smoke")
    assert list(graph.run("simulator")) == ["tokenizer", "simulator"]
    coded, tuned = (
        load_file(graph.folder(name) / "weights.safetensors") for name in ("tokenizer", "simulator")
    )
    torch.manual_seed(cfg["seed"])
    untrained = build_simulator(graph.cfg).state_dict()
    codec = [name for name in coded if name.startswith("codec.")]
    assert any(not torch.equal(untrained[name], coded[name]) for name in codec)
    assert codec and all(torch.equal(coded[name], tuned[name]) for name in codec)
    going_on = {**cfg, "finetune": {**cfg["finetune"], "weights": str(graph.folder("simulator"))}}
    assert "tokenizer" not in build_finetune(going_on, tmp_path / "smoke").nodes


def test_finetuning_leaves_held_out_episodes_alone(tmp_path: Path) -> None:
    cfg = config(tmp_path, "single_arm", f"finetune.data=[{tmp_path / 'set'}]", *smoke("finetune.simulator"))
    write_splits(tmp_path / "set", {"train": 0, "calibration": 0, "held_out": 4})
    with pytest.raises(EpisodeError, match="no episode is left to draw clips from"):
        build_finetune(cfg, tmp_path / "smoke").run("simulator")


@pytest.fixture(scope="module", params=["labelled", "pusht"])
def judged(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Graph:
    """The loop up to its judge, on a set that says success."""
    cfg = config(
        *(tmp_path_factory.mktemp("judged"), request.param),
        *smoke("simulator_fit.first", "state_fit.first", "judge_fit.first"),
    )
    graph = build_loop(cfg, Path(cfg["runs"]) / "smoke")
    graph.run(until=("judge-1", "state-1"))
    return graph


def test_the_judge_learns_from_next_success(judged: Graph) -> None:
    manifests = judged.run(until="judge-1")
    assert manifests["recordings"]["result"]["labelled"] == 4
    assert manifests["recordings"]["result"]["successes"] == 3
    result = manifests["judge-1"]["result"]
    assert result["generated_frames"] > 0 and 0.0 <= result["threshold"] <= 1.0


def test_imagined_episodes_begin_inside_recorded_ones(judged: Graph) -> None:
    cfg = judged.cfg
    weights = {name: judged.folder(f"{name}-1") / "weights.safetensors" for name in ("simulator", "state")}
    simulator = build_simulator(cfg, weights["simulator"])
    decoder = build_state_decoder(cfg, simulator, weights["state"])
    judge = build_judge(cfg, judged.folder("judge-1") / "weights.safetensors")
    store = open_clips(cfg, cfg["task"]["data"])
    starts = DecisionPoints(store, store.split("train"))
    chosen = [0, len(starts) - 1, len(starts) // 2]
    world = build_world(cfg, simulator, decoder, judge, starts, 3)
    world.base_env.schedule(chosen)
    begun = world.reset()
    rows = (store.start[starts.episode] + starts.frame)[chosen]
    assert rows.unique().numel() == 3 and int(starts.frame[chosen].max()) > 0
    assert torch.equal(begun[IMAGE], store.frames(rows))
    assert torch.equal(begun[STATE], store.arrays["states"][rows])
    begun[CHUNK] = world.action_spec.zero()[CHUNK]
    after = world.step(begun)["next"]
    assert after[IMAGE].shape == begun[IMAGE].shape
    # What two steps of training draw is much like the moment that each episode went on from.
    apart = (after[IMAGE].int()[:, None] - begun[IMAGE].int()[None]).abs().float().mean((2, 3, 4, 5))
    assert apart.argmin(1).tolist() == [0, 1, 2]
    assert bool(torch.isfinite(after["reward"]).all())


def test_a_set_without_labels_teaches_no_judge(tmp_path: Path) -> None:
    cfg = config(tmp_path, "so101", *smoke("simulator_fit.first"))
    with pytest.raises(ConfigError, match=r"no training episode of the data says; record next\.success"):
        build_loop(cfg, tmp_path / "smoke").run(until="judge-1")


def test_missing_labels_are_told_before_anything_runs(tmp_path: Path) -> None:
    cfg, other = config(tmp_path, "so101"), config(tmp_path / "other", "labelled")
    graph = build_loop(cfg, tmp_path / "smoke")
    with pytest.raises(ConfigError, match=r"record next\.success, or choose a judge that needs none"):
        check_labels(cfg, graph)
    check_labels(cfg, graph, "simulator-1")  # which asks for none
    check_labels(other, build_loop(other, tmp_path / "other/smoke"))
    order = list(graph.nodes)
    assert order.index("imitation") < order.index("simulator-1")  # missing demonstrations are told early, too


def test_where_nobody_says_success_ends_of_demonstrations_calibrate_a_goal(tmp_path: Path) -> None:
    picture = tmp_path / "goal.png"
    write_set(tmp_path / "other", SETS["single_arm"])
    shown = LeRobotDataset(tmp_path / "other", (64, 64)).episode(2).frames[-1, 0]
    cv2.imwrite(str(picture), shown.transpose(1, 2, 0)[..., ::-1])
    cfg = config(
        *(tmp_path, "single_arm", "judge=goal_image", f"judge.picture={picture}"),
        *smoke("simulator_fit.first", "state_fit.first"),
    )
    made = build_loop(cfg, tmp_path / "smoke").run(until="judge-1")["judge-1"]["result"]
    assert made["calibration_demonstrations"] == made["calibration_failures"] == 1
    assert made["auc"] == 1 and 0.02 <= made["threshold"] < cfg["judge"]["threshold"]


def test_from_nothing_a_world_learns_as_in_the_loop_and_from_weights_in_small_steps(tmp_path: Path) -> None:
    def fits(*words: str) -> list[tuple[object, ...]]:
        cfg = load_config(["simulator=unet_small", *words])
        return [
            tuple(cfg["finetune"][part]["fit"].get(key) for key in ("lr", "optimiser", "batch"))
            for part in ("simulator", "state")
        ]

    loop, on = load_config([]), (1e-4, "adamw")
    first, state = loop["simulator_fit"]["first"]["fit"], loop["state_fit"]["first"]["fit"]
    mine = (first["lr"], first["optimiser"], 8), (state["lr"], None, state["batch"])
    assert fits() == [*mine] and first["lr"] > 10 * on[0]
    assert fits("finetune.weights=some.safetensors") == [(*on, 8), mine[1]]
    assert fits("finetune.simulator.fit.lr=0.5")[0] == (0.5, *mine[0][1:])
    released = load_config(["simulator=gesim", "simulator.state_expert.checkpoint=some"])["finetune"]
    assert released["state"]["fit"] == {"steps": 1000, "batch": 8, "lr": 1e-4}
