"""The whole loop as a graph: collect, imitate, then rounds of deploy -> refresh the world -> RL in it, then
the proof.

Reading this file top to bottom is reading the method. What each stage does is in pipeline/work.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline import stages as work
from pipeline.graph import Graph, Stage
from pipeline.stage_workers import learners_of, run_stage

Cfg = Mapping[str, Any]


def build_loop(cfg: Cfg, root: Path) -> Graph:
    """The graph of an experiment; `cfg` is the resolved config as plain containers."""
    graph = Graph(root / "stages")
    seed = cfg["seed"]
    learners_of(cfg)  # what cannot be shared out is refused before anything starts
    world = {"task": cfg["task"], "seed": seed}
    learned = {**world, "simulator": cfg["simulator"], "microbatches": cfg["microbatches"]}

    def add(name: str, parents: tuple[str, ...], config: dict[str, Any], run: Any, **known: Any) -> str:
        def go(folder: Path, found: dict[str, Path]) -> Mapping[str, Any]:
            return run_stage(run.__name__, cfg, folder, found, known)

        return graph.add(Stage(name, parents, config, go))

    collect = add("collect", (), {**world, "collect": cfg["collect"]}, work.collect, part="train")
    held_out = add("held-out", (), {**world, "collect": cfg["collect"]}, work.collect, part="held_out")
    imitation = add(
        "imitation",
        (collect,),
        {
            **world,
            "policy": cfg["policy"],
            "imitation": cfg["imitation"],
            "microbatches": cfg["microbatches"],
        },
        work.imitation,
    )
    policy, data = imitation, [collect]
    vision = state = judge = ""
    for number in range(1, cfg["rounds"]["count"] + 1):
        size = cfg["rounds"]["deploy"][min(number, len(cfg["rounds"]["deploy"])) - 1]
        deploy = add(
            f"deploy-{number}",
            (policy,),
            {**world, "deploy": size, "policy": cfg["policy"]},
            work.deploy,
            number=number,
            episodes=size,
        )
        data = [*data, deploy]
        steps = "first" if number == 1 else "refresh"
        warm = (vision,) if vision else ()
        if cfg["simulator"]["engine"] == "dit" and not vision:
            warm = (
                add(
                    "tokenizer",
                    tuple(data),
                    {**learned, "tokenizer": cfg["tokenizer"]},
                    work.tokenizer,
                    data=tuple(data),
                ),
            )
        vision = add(
            f"vision-{number}",
            (*data, *warm),
            {**learned, "vision": cfg["vision"][steps]},
            work.vision,
            data=tuple(data),
            warm=warm,
            steps=steps,
        )
        state = add(
            f"state-{number}",
            (*data, vision, *((state,) if state else ())),
            {**learned, "state": cfg["state"][steps]},
            work.state,
            data=tuple(data),
            vision=vision,
            warm=state,
            steps=steps,
        )
        settings = {**learned, "judge": cfg["judge"], "judge_fit": cfg["judge_fit"][steps]}
        judge = add(
            f"judge-{number}",
            (*data, vision, *((judge,) if judge else ())),
            settings,
            work.judge,
            data=tuple(data),
            vision=vision,
            warm=judge,
            steps=steps,
        )
        settings = {**settings, "policy": cfg["policy"]}
        gap = add(
            f"gap-{number}",
            (*data, vision, state, judge, policy, held_out),
            {**settings, "measure": cfg["measure"]},
            work.gap,
            data=tuple(data),
            vision=vision,
            state=state,
            judge=judge,
            policy=policy,
            number=number,
        )
        cloned = add(
            f"clone-{number}",
            (*data, policy, vision),
            {**learned, "policy": cfg["policy"], "imitation": cfg["imitation"], "clone": cfg["clone"]},
            work.clone,
            data=tuple(data),
            policy=policy,
            vision=vision,
            number=number,
        )
        iterations = cfg["rounds"]["iterations"][min(number, len(cfg["rounds"]["iterations"])) - 1]
        settings = {**settings, "algorithm": cfg["algorithm"], "rl": cfg["rl"], "iterations": iterations}
        policy = add(
            f"rl-{number}",
            (*data, vision, state, judge, cloned, gap),
            settings,
            work.rl,
            data=tuple(data),
            vision=vision,
            state=state,
            judge=judge,
            policy=cloned,
            iterations=iterations,
            number=number,
        )
    measured = {**learned, "judge": cfg["judge"], "policy": cfg["policy"], "measure": cfg["measure"]}
    world_parents = (*data, vision, state, judge)
    known = {"data": tuple(data), "vision": vision, "state": state, "judge": judge}
    add(
        "evaluate-before",
        (imitation,),
        {**world, "policy": cfg["policy"], "evaluate": cfg["evaluate"]},
        work.evaluate_physics,
        policy=imitation,
    )
    add(
        "evaluate-after",
        (policy,),
        {**world, "policy": cfg["policy"], "evaluate": cfg["evaluate"]},
        work.evaluate_physics,
        policy=policy,
    )
    add(
        "evaluate-imagined",
        (*world_parents, imitation, policy),
        {**measured, "evaluate": cfg["evaluate"]},
        work.evaluate_imagined,
        before=imitation,
        after=policy,
        **known,
    )
    add("measure", (*world_parents, held_out), measured, work.measure, held_out=held_out, **known)
    add(
        "videos",
        (*world_parents, held_out, imitation, policy),
        measured,
        work.videos,
        held_out=held_out,
        before=imitation,
        after=policy,
        **known,
    )
    everything = tuple(graph.stages)
    add(
        "report",
        everything,
        {"name": cfg["name"], "seed": seed},
        work.report,
        rounds=cfg["rounds"]["count"],
        root=root,
    )
    return graph
