"""worldloop bench distil: what each number of function evaluations a chunk costs and buys, of a teacher and
of the students that two methods make of it, and which of them come where a student should.

Every part is a stage of a graph of its own, so the bench goes on where it was stopped. What RL gains in each
is `worldloop study study=students`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from string import Formatter
from typing import Any

import torch
from torchmetrics.functional.image import structural_similarity_index_measure as ssim

from actors.factory import build_judge, build_simulator, build_state_decoder
from actors.process import prepare_process
from envs.episodes.clips import ClipStore
from envs.files import write_json
from envs.simulators.base import Simulator
from envs.simulators.replay import Replay, replay
from envs.targets import ConfigError, target
from pipeline.acting import acting
from pipeline.cli.words import root_of
from pipeline.evaluation.judging import judge_frames, judge_table, labelled
from pipeline.evaluation.measurement import rollout_error, speed
from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.loop import add_episodes, can_be_taught
from pipeline.markdown import markdown_table
from pipeline.outside import CHECKPOINT, KINEMATICS, files_at
from pipeline.stages import world
from pipeline.stages.given import WORLD, Cfg, open_store
from pipeline.stages.judging import stage as judging

# Of 15 evaluations 4 are 3.75 times fewer: of these students 3 is the most that can be 4 times as fast.
TEACHER, STUDENT = (15, 8, 4, 2, 1), (4, 3, 2, 1)
# Where a student should come: so many evaluations at most, times the teacher's frames a second, dB lost over
# a rollout, share of the teacher's detail; and imagined success no further from the truth.
_EVALUATIONS, _FASTER, _LOST_DB, _DETAIL = 4, 4.0, 0.5, 0.8
_EPISODES = 8  # held-out ones of full length whose pictures are measured
_JUDGED = 48  # held-out ones that are judged
_MOVED = 0.05  # by which a colour differs from the first frame's where something has moved
_VERDICTS = ("tp", "fp", "fn", "tn")
_TRAJECTORY = {"_target_": "learners.stages.distill.trajectory.TrajectoryRegression"}
_FIGURES = {
    "frames/s at 1": "{speed_1:.0f}",
    "at 32": "{speed_32:.0f}",
    "PSNR of a chunk": "{chunk_psnr:.2f}",
    "SSIM": "{chunk_ssim:.3f}",
    "PSNR of {frames} frames": "{rollout_psnr:.2f}",
    "SSIM ": "{rollout_ssim:.3f}",
    "detail of what moves": "{rollout_detail:.2f}",
    "state error": "{state:.3f}",
    "judge: TP / FP / FN / TN": "{judge_tp:.0f} / {judge_fp:.0f} / {judge_fn:.0f} / {judge_tn:.0f}",
    "imagined less true success": "{judge_gap:+.1f}",
}


def distil(cfg: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Print the table, and leave it in distil.json of the run's folder; returns the figures by row.

    Raises:
        ConfigError: if the simulator has no steps.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    root = root_of(cfg)
    graph, rows, left = build_table(cfg, root / "distil")
    graph.run(list(rows.values()))
    found = {title: graph.result(name) for title, name in rows.items()}
    write_json(root / "distil.json", found)
    frames = next(iter(found.values()))["frames"]
    headings = ["", *(heading.format(frames=frames) for heading in _FIGURES)]
    cells = [
        [title, *(_cell(form, figures) for form in _FIGURES.values())] for title, figures in found.items()
    ]
    print(markdown_table(headings, cells))
    print("\n".join([*(f"{title}: left out, {why}" for title, why in left.items()), *reached(found)]))
    return found


def _cell(form: str, figures: Mapping[str, Any]) -> str:
    """Figures in the form of a column; "-" where nobody knows one of them."""
    names = [name for _, name, _, _ in Formatter().parse(form) if name]
    return "-" if any(figures[name] is None for name in names) else form.format(**figures)


def reached(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A line for each student: whether it comes where it should beside the teacher of the most evaluations,
    and by how much.
    """
    (first, teacher), *_ = found.items()
    lines = []
    for title, row in found.items():
        if row["evaluations"] == 0:
            continue
        faster = [row[f"speed_{n}"] / teacher[f"speed_{n}"] for n in (1, 32)]
        lost = teacher["rollout_psnr"] - row["rollout_psnr"]
        kept = row["rollout_detail"] / teacher["rollout_detail"]
        gaps = (row["judge_gap"], teacher["judge_gap"])
        met = {
            f"{row['evaluations']} evaluations": row["evaluations"] <= _EVALUATIONS,
            "frames/s": min(faster) >= _FASTER,
            "PSNR": lost <= _LOST_DB,
            "detail": kept >= _DETAIL,
            "gap to truth": None not in gaps and abs(gaps[0]) <= abs(gaps[1]),
        }
        missed = [name for name, there in met.items() if not there]
        told = " and ".join("unknown" if gap is None else f"{gap:+.1f}" for gap in gaps)
        lines.append(
            f"{title}: {'missed by ' + ', '.join(missed) if missed else 'met'} ({faster[0]:.1f} and"
            f" {faster[1]:.1f} times the frames/s of {first} at 1 and 32, {lost:.2f} dB lost over a rollout,"
            f" {100 * kept:.0f}% of its detail,"
            f" imagined less true success {told} points)"
        )
    return lines


def build_table(cfg: Mapping[str, Any], root: Path) -> tuple[Graph, dict[str, str], dict[str, str]]:
    """The stages, the names of those that measure, by the titles of their rows, and by those of rows that are
    left out why the engine cannot take so many steps.

    A student learns at the levels of its own steps, so there is one of each method for each number of them,
    with as many updates. "not distilled" has the weights of the teacher jump as students do: a jump that
    nobody has taught ends in the mean of all that may come, which PSNR likes, and which has no detail.
    """
    engine, most = target(cfg["simulator"], "simulator"), cfg["distill"]["steps"]
    if not most:
        raise ConfigError("distill.steps=0 is without a student; say distill.steps=4")
    acting(cfg)  # says what cannot be distilled
    graph = Graph(cfg, root)
    data, released = add_episodes(graph, cfg), files_at(cfg, CHECKPOINT, KINEMATICS)
    warm = ""
    if "codec" in cfg["simulator"]:
        warm = graph.add("tokenizer", world.tokenizer, {"data": data}, **released)
    roles = {"data": data, "warm": warm}
    teacher = graph.add("simulator", world.simulator, roles, phase="first", **released)
    rows, left = dict[str, str](), dict[str, str]()
    judge_class: Any = target(cfg["judge"], "judge")
    golden = (
        graph.add("text_world", judging.text_world, {"data": data}, phase="first")
        if "text_world" in cfg["judge"]
        else ""
    )

    def judged(own: Graph, name: str, simulator: str, state: str) -> str:
        """The judge of a simulator, "" if nobody can teach it; one that learned from recorded pictures alone
        is the same for all.
        """
        if not can_be_taught(cfg):
            return ""
        if not judge_class.reads_features and not cfg["judge_fit"]["first"]["imagined"]:
            own, name, simulator, state = graph, "all", teacher, ""
        if f"judge-{name}" in own.nodes:
            return f"judge-{name}"
        roles = {"data": data, "simulator": simulator, "text_world": golden, "state": state}
        return own.add(f"judge-{name}", judging.judge, roles, phase="first")

    def measured(title: str, name: str, simulator: str, section: Mapping[str, Any], evaluations: int) -> None:
        own, roles = graph.under({**cfg, "simulator": section}), {"data": data, "simulator": simulator}
        state = own.add(f"state-{name}", world.state, roles, phase="first")
        roles |= {"state": state, "judge": judged(own, name, simulator, state)}
        rows[title] = own.add(f"measure-{name}", measure, roles, evaluations=evaluations)

    for steps in TEACHER:
        try:
            section = engine.stepped_section(cfg["simulator"], steps)  # type: ignore[attr-defined]
        except ValueError as error:
            left[f"teacher, {steps}"] = str(error)
            continue
        measured(f"teacher, {steps}", f"teacher-{steps}", teacher, section, 0)
    few = [steps for steps in STUDENT if steps <= most]
    for steps in few:
        section = acting({**cfg, "distill": {**cfg["distill"], "steps": steps}})["simulator"]
        measured(f"not distilled, {steps}", f"undistilled-{steps}", teacher, section, 0)
    for name, section in _methods(cfg["distill"]).items():
        for steps in few:
            own = graph.under({**cfg, "distill": {**section, "steps": steps}})
            roles = {"data": data, "simulator": teacher}
            student = own.add(f"student-{name}-{steps}", world.student, roles, phase="first")
            measured(f"{name}, {steps}", f"{name}-{steps}", student, acting(own.cfg)["simulator"], steps)
    return graph, rows, left


def _methods(section: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Sections distill by the method's name: as given, and the baseline with as many updates of the student;
    others of the given one's steps are its critic's.
    """
    first, method = section["first"], section["method"]
    updates = max(1, first["fit"]["steps"] // (1 + method.get("critic_updates", 0)))
    fit = {**first["fit"], "steps": updates}
    baseline = {**section, "method": _TRAJECTORY, "first": {**first, "fit": fit}}
    return {str(one["method"]["_target_"]).rpartition(".")[2]: dict(one) for one in (section, baseline)}


@stage(reads=(*WORLD, "measure.speed_chunks"), place=Place.EVALUATOR)
def measure(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Speed, and errors of held-out episodes that last until the horizon: chunk by chunk from true frames,
    and rolled out as a whole; verdicts of the judge on whole episodes of any length.

    Settings: evaluations of a student, 0 of the teacher.

    Raises:
        ConfigError: if all held-out episodes end before.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, simulator, inputs.weights("state"))
    store, bf16 = open_store(cfg, inputs), cfg["simulator"]["bf16"]
    held = store.split("held_out")
    held = held[store.length[held] > cfg["task"]["horizon"]][:_EPISODES]
    if not len(held):
        raise ConfigError(
            f"no held-out episode lasts task.horizon={cfg['task']['horizon']} frames; raise"
            " collect.episodes.held_out, or lower the horizon"
        )
    chunks, whole = (replay(simulator, store, held, decoder, bf16=bf16, alone=n) for n in (1, None))
    state = rollout_error(store, held, whole)["state"]
    return {
        "evaluations": inputs.settings["evaluations"],
        **_verdicts(cfg, inputs, simulator, store),
        "frames": whole.frames.shape[1],
        **{f"chunk_{name}": value for name, value in _pictures(store, chunks).items()},
        **{f"rollout_{name}": value for name, value in _pictures(store, whole).items()},
        "rollout_detail": _detail(store, whole),
        "state": None if state is None else state["median"],
        **{f"speed_{n}": speed(simulator, store, n, cfg["measure"]["speed_chunks"], bf16) for n in (1, 32)},
    }


def _verdicts(cfg: Cfg, inputs: Inputs, simulator: Simulator, store: ClipStore) -> dict[str, float | None]:
    """Confusion of the judge's verdicts on generated video with recorded success, and imagined less true
    success in points, of the episodes that it could judge; None of all where there is no judge, or nothing
    says success.
    """
    held, bf16 = labelled(store, store.split("held_out"))[:_JUDGED], cfg["simulator"]["bf16"]
    if "judge" not in inputs.found or not len(held):
        return dict.fromkeys((*(f"judge_{name}" for name in _VERDICTS), "judge_gap"))
    made, judge = replay(simulator, store, held, bf16=bf16), build_judge(cfg, inputs.weights("judge"))
    scores = judge_frames(judge.eval(), made.frames, made.valid, store, held, made.features)
    found = judge_table(judge, scores, made.valid, store, held)
    count = {name: float(found.get(name, 0)) for name in _VERDICTS}
    judged = sum(count.values())
    gap = 100 * (count["fp"] - count["fn"]) / judged if judged else None
    return {**{f"judge_{name}": value for name, value in count.items()}, "judge_gap": gap}


def _pictures(store: ClipStore, made: Replay) -> dict[str, float]:
    """PSNR in dB and SSIM, means over the frames of all views that exist."""
    psnr, alike = [], []
    for frames, rows, valid in zip(made.frames, made.rows, made.valid, strict=True):
        one, other = (some[valid].flatten(0, 1).float() / 255 for some in (frames, store.frames(rows)))
        psnr.append(-10 * (one - other).square().mean((1, 2, 3)).clamp(min=1e-8).log10())
        found = ssim(one, other, data_range=1.0, reduction="none")
        assert isinstance(found, torch.Tensor)
        alike.append(found)
    return {"psnr": float(torch.cat(psnr).mean()), "ssim": float(torch.cat(alike).mean())}


def _detail(store: ClipStore, made: Replay) -> float:
    """Energy of the differences of neighbouring pixels in generated over that in true frames, of all views,
    where what is truly seen differs from the first frame. A blurred edge has as much of a difference in all,
    and less of its energy.
    """
    energy = torch.zeros(2)
    for frames, rows, valid in zip(made.frames, made.rows, made.valid, strict=True):
        one, true, first = (
            some.float() / 255
            for some in (frames[valid], store.frames(rows[valid]), store.frames(rows[:1] - 1))
        )
        moved = (true - first).abs().amax(-3, keepdim=True) > _MOVED
        for dim in (-1, -2):
            length = true.shape[dim] - 1
            near = moved.narrow(dim, 0, length) | moved.narrow(dim, 1, length)
            energy += torch.stack([(near * some.diff(dim=dim).square()).sum() for some in (one, true)])
    return float(energy[0] / energy[1].clamp(min=1e-6))
