"""Commands that learn, and that say what has been learned.

A command reads its words before it imports what works on them, so that a mistake is told without waiting for
torch.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.targets import ConfigError, nearest, target
from pipeline.cli.words import Words, counts_of, prepared, root_of


def run(words: Words) -> None:
    """run the whole loop of an experiment; finished stages are reused, interrupted ones resume"""
    cfg, root = prepared(words)
    from actors.fleets.launch import check_launch
    from pipeline.graph.owner import owning
    from pipeline.loop import build_loop, check_labels
    from pipeline.track import tracking

    graph = build_loop(cfg, root)
    _check_learns(cfg, graph.nodes)
    check_labels(cfg, graph)
    check_launch(cfg["launch"])
    print(f"{len(graph.nodes)} stages in {root}; each says how long it will take after its first steps")
    with owning(root, "run"), tracking(cfg, root) as tracker:
        manifests = graph.run(tracker=tracker)
        result = json.loads((root / "result.json").read_text())
        tracker.summarise(result)
    minutes = sum(manifest["seconds"] for manifest in manifests.values()) / 60
    print(f"\n{result['verdict']}\n{root}/report.html, {root}/result.json; {minutes:.1f} min of work")


def rl(words: Words) -> None:
    """the loop up to its last policy, on any launch: worldloop rl launch=ray launch.actors=4
    experiment=quickstart
    """
    from pipeline.config import load_config

    cfg = load_config(words)
    from pipeline.loop import last_round

    last = f"rl-{last_round(cfg)}"
    folder = _run_until(last, words)
    print(f"\nthe policy lies in {folder}; worldloop evaluate policy={last} {' '.join(words)}")


def stage(words: Words) -> None:
    """run one stage and what it needs: worldloop stage simulator-1 experiment=quickstart; distill is the last
    student
    """
    if not words or "=" in words[0]:
        raise ConfigError(
            "say which stage: worldloop stage imitation experiment=quickstart; `worldloop stages` lists them"
        )
    _run_until(words[0], words[1:])


def stages(words: Words) -> None:
    """list the stages of an experiment, their folders, which are finished, and why others will run again"""
    from pipeline.config import load_config

    cfg = load_config(words)
    from pipeline.loop import build_loop

    graph = build_loop(cfg, root_of(cfg))
    for name in graph.nodes:
        folder = graph.folder(name)
        done = (folder / "manifest.json").exists()
        mark = "done" if done else "half" if folder.exists() else "    "
        print(f"{mark}  {name:<18} {folder}")
        if why := graph.why(name):
            print(f"      {why}")


def evaluate(words: Words) -> None:
    """success of a policy: worldloop evaluate policy=<stage|folder> [world=physics|imagined]
    [variant=<one of task.variants>] experiment=...; one that needs no weights is a choice of
    configs/policy: policy=openpi policy.url=ws://... Or, without policy=, all figures of a simulator and its
    page: worldloop evaluate simulator=<stage|folder> experiment=..., which is fidelity, ewmbench and summary
    in turn; a choice of configs/simulator is the run's last, or a released one
    """
    from pipeline.config import offered

    own, rest, simulator = {"weights": "", "world": "physics", "variant": ""}, [], ""
    for word in words:
        key, _, value = word.partition("=")
        if key in ("world", "variant"):
            own[key] = value
        elif key == "simulator" and not offered("simulator", value, words):
            simulator = value
        elif key == "policy" and not offered("policy", value, words):
            own["weights"] = value
        else:
            rest.append(word)
    said = {word.partition("=")[0]: word.partition("=")[2] for word in words}
    if "policy" not in said and "simulator" not in said:
        raise ConfigError(
            "say what to evaluate: policy=<stage|folder>, such as policy=imitation, or policy=<a choice of"
            " configs/policy> as it is built; or simulator=<stage|folder>, such as simulator=simulator-1, or"
            " simulator=<a choice of configs/simulator>, the run's last or a released one"
        )
    measured = simulator or "policy" not in said
    if measured and said.keys() & {"policy", "world", "variant"}:
        raise ConfigError(
            f"simulator={simulator or said['simulator']} is measured by itself: leave out policy=, world= and"
            " variant=; `worldloop policy-value` says what it makes of policies, by imagined.simulator"
        )
    cfg, root = prepared(rest)
    for group, name in (("simulator", simulator), ("policy", own["weights"])):
        if name:
            _check_named(group, name, cfg, root, rest)
    if measured:
        from pipeline.cli.worlds import evaluate_simulator

        return evaluate_simulator(simulator, rest)
    from pipeline.commands.evaluate import evaluate_policy

    print(evaluate_policy(cfg, root, **own))


def _check_named(group: str, name: str, cfg: Mapping[str, Any], root: Path, words: Words) -> None:
    """Refuse what is neither a stage of the run nor a folder, with the nearest of stages and choices."""
    from pipeline.config import choices
    from pipeline.loop import build_loop

    stages = build_loop(cfg, root).nodes
    if name not in stages and not Path(name).exists():
        near = nearest(name, [*stages, *choices(group, words)])
        raise ConfigError(f"{group}={name} is no stage, folder or choice of configs/{group}{near}")


def trust(words: Words) -> None:
    """how far a round's imagined world tells better actions from worse ones: worldloop trust round=1
    [moments=160] [futures=8] [depth=3] experiment=...
    """
    from pipeline.commands.worlds.trust import trust as table

    own, rest = counts_of(words, {"round": 1, "moments": 160, "futures": 8, "depth": 3})
    cfg, root = prepared(rest)
    number = own.pop("round")
    print(table(cfg, root, number, **own))


def gradients(words: Words) -> None:
    """how much RL can learn from a round's imagined decisions, beside recorded ones, and with which lambda:
    worldloop gradients round=1 [batches=16] experiment=...
    """
    from pipeline.commands.worlds.gradients import gradients as table

    own, rest = counts_of(words, {"round": 1, "batches": 16})
    cfg, root = prepared(rest)
    print(table(cfg, root, own["round"], own["batches"]))


def cross_validate(words: Words) -> None:
    """whether what RL learns from a round's recorded decisions holds on other episodes:
    worldloop cross-validate round=1 [folds=5] experiment=...
    """
    from pipeline.commands.worlds.cross_validate import cross_validate as table

    own, rest = counts_of(words, {"round": 1, "folds": 5})
    cfg, root = prepared(rest)
    print(table(cfg, root, own["round"], own["folds"]))


def controls(words: Words) -> None:
    """whose gain is it: beside a finished run the loop without RL iterations, RL in physics, filtered BC"""
    cfg, root = prepared(words)
    from actors.fleets.launch import check_launch
    from pipeline.commands.controls import run_controls, table_text
    from pipeline.graph.owner import owning
    from pipeline.track import tracking

    check_launch(cfg["launch"])
    with owning(root, "controls"), tracking(cfg, root) as tracker:
        table = run_controls(cfg, root, tracker)
    print(f"{table_text(table)}\n{root}/controls.json, {root}/report.html")


def study(words: Words) -> None:
    """the table of an experiment: rows (ways to a policy or a world) by what is measured of them, by tasks
    and seeds; goes on where it stopped: worldloop study experiment=bench4|worlds|roboscape|reward_curves
    [study=data_size|judges] [study.minutes=60]
    """
    from pipeline.study.plan import plan_study

    made = plan_study(words)
    # a mistake in the words is told before any work
    from actors.fleets.launch import check_launch
    from actors.process import device_of, prepare_process
    from pipeline.graph.owner import owning
    from pipeline.study.run import run_study

    device_of(made.cfg)
    for row in made.rows:
        wanted = [node for nodes in row.nodes.values() for node in nodes]
        _check_learns(row.cfg, row.made.graph.needs(wanted))
    if made.cfg["study"]["minutes"] != 0:  # else the table is written as it stands
        check_launch(made.cfg["launch"])
    prepare_process(made.cfg["seed"], made.cfg["threads"])
    with owning(made.root, "study"):
        text = run_study(made)
    print(f"\n{text}\n{made.root}/study.md, study.json, study.html")


def compare(words: Words) -> None:
    """finished runs side by side as Markdown: worldloop compare runs/quickstart runs/quickstart_dit; engines
    after equal training time are compared by worldloop study experiment=worlds
    """
    from pipeline.evaluation.compare import compare as table

    if not words:
        raise ConfigError("say which runs: worldloop compare runs/quickstart runs/quickstart_dit")
    print(table([Path(word) for word in words]))


def finetune(words: Words) -> None:
    """train a simulator on any LeRobot data: worldloop finetune simulator=gesim simulator.checkpoint=<folder>
    finetune.data=[<folder>]
    """
    cfg, root = prepared(words)
    from actors.fleets.launch import check_launch
    from pipeline.commands.finetune import build_finetune
    from pipeline.graph.owner import owning
    from pipeline.track import tracking

    graph = build_finetune(cfg, root)
    check_launch(cfg["launch"])
    with owning(root, "finetune"), tracking(cfg, root / "finetune") as tracker:
        graph.run(tracker=tracker)
    made = [graph.folder(name) for name in graph.nodes]
    print(f"weights in {' and '.join(str(one) for one in made if (one / 'weights.safetensors').exists())}")


def stage_named(name: str, stages: Sequence[str]) -> str:
    """The stage that a name means; distill is the last student.

    Raises:
        ConfigError: if there is none, naming the nearest, or the option that makes students.
    """
    students = [stage for stage in stages if stage.startswith("student-")]
    if not students and (name == "distill" or name.startswith("student")):
        raise ConfigError(f"no stage {name}: distill.steps=0 is without a student; add distill.steps=2")
    name = students[-1] if name == "distill" else name
    if name not in stages:
        raise ConfigError(f"no stage {name}{nearest(name, stages)}")
    return name


def _check_learns(cfg: Mapping[str, Any], wanted: Collection[str]) -> None:
    """See that the policy can learn, if stages are wanted in which it does, before anything is recorded.

    Raises:
        ConfigError: if it can be evaluated alone.
    """
    kind = target(cfg["policy"], "policy")
    learning = [name for name in wanted if name.startswith("rl-")]
    able = any(hasattr(kind, name) for name in ("get_dist", *(() if learning else ("imitation_loss",))))
    if isinstance(kind, type) and not able and "imitation" in wanted:
        raise ConfigError(
            f"policy._target_={cfg['policy']['_target_']} cannot learn, as it has no get_dist; `worldloop"
            " evaluate` says how good it is, and what shall learn is another choice of configs/policy"
        )


def _run_until(name: str, words: Words) -> Path:
    """Run a stage and what it needs; returns its folder."""
    cfg, root = prepared(words)
    from actors.fleets.launch import check_launch
    from pipeline.graph.owner import owning
    from pipeline.loop import build_loop, check_labels
    from pipeline.track import tracking

    graph = build_loop(cfg, root)
    name = stage_named(name, list(graph.nodes))
    _check_learns(cfg, graph.needs(name))
    check_labels(cfg, graph, name)
    check_launch(cfg["launch"])
    with owning(root, f"stage {name}"), tracking(cfg, root) as tracker:
        graph.run(name, tracker)
    return graph.folder(name)
