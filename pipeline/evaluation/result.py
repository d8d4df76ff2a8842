"""result.json: the figures of a finished run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.rollouts.evaluate import Outcome
from envs.files import write_atomically
from envs.manifest import read_manifest
from envs.physics.suite import task_names
from envs.targets import target
from pipeline.evaluation.by_task import by_scene, by_task, scenes_of_seeds, tasks_of_seeds
from pipeline.evaluation.statistics import mcnemar, rate_entry
from pipeline.evaluation.verdict import IMAGINED, verdict
from pipeline.graph.stage import Inputs

_ENTRY = ("successes", "episodes", "low", "high")
OUTCOMES = "outcomes.pt"  # success on each seed, of the stages that try a policy in physics


def build_result(cfg: Mapping[str, Any], inputs: Inputs) -> dict[str, Any]:
    """The figures of a run.

    Args:
        inputs: roles imagined, measured, stages (all of them), and, of runs with physics, physics_before and
            physics_after.

    Returns:
        name, seed, simulator, algorithm, verdict; physics_before and physics_after (rate entries) with
        paired (McNemar), None without physics; imagined_before, imagined_after; judge, rollout,
        frames_per_second (see the measure stage); tasks (the same rates by task, {} if there is one);
        scenes (the same rates of each task in each scene that occurs, [] if there is one); exploration (see
        the explore stage; None without it); rounds (gaps); trials (see `_trials`); worth (see its stage), by
        round; episodes used and held out; seconds per stage; training (see `_training`); what the judge has
        cost (stages/judging/cost.py), {} if it is free; alarms.
    """
    finished = manifests(inputs)
    imagined, measured = (result_of(inputs.folder(role)) for role in ("imagined", "measured"))
    learned = [entry for name, entry in finished.items() if name.startswith("rl-")]
    gathered = [
        entry["result"]
        for name, entry in finished.items()
        if name.split("-")[0] in ("collect", "explore", "deploy", "recordings")
    ]
    result: dict[str, Any] = {
        "name": cfg["name"],
        "seed": cfg["seed"],
        "task": ", ".join(task_names(cfg["task"]["name"])),
        "simulator": _class_name(cfg["simulator"]),
        "policy": _class_name(cfg["policy"]),
        "algorithm": cfg["algorithm"].get("name") or _class_name(cfg["algorithm"]),
        **_physics(inputs),
        "imagined_before": imagined["before"],
        "imagined_after": imagined["after"],
        "judge": measured["judge"],
        "rollout": measured["rollout"],
        "frames_per_second": measured["frames_per_second"],
        "tasks": _tasks(cfg, inputs, imagined),
        "scenes": _scenes(cfg, inputs, imagined),
        "exploration": finished["explore"]["result"] if "explore" in finished else None,
        "rounds": [entry["result"] for name, entry in finished.items() if name.startswith("gap-")],
        "trials": _trials(finished),
        "worth": [entry["result"] for name, entry in finished.items() if name.startswith("worth-")],
        "episodes_used": sum(entry["episodes"] - entry.get("held_out", 0) for entry in gathered),
        "episodes_held_out": sum(entry.get("held_out", 0) for entry in gathered),
        "imagined_episodes_used": [entry["result"]["episodes"] for entry in learned],
        "stage_seconds": {name: entry["seconds"] for name, entry in finished.items()},
        "training": _training(finished),
        "judge_cost": _judge_cost(finished),
        "alarms": [*_alarms(finished), *unjudged(cfg, imagined["after"])],
    }
    result["verdict"] = verdict(result)
    return result


def _trials(finished: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What came of each round's trial, with what the stage `keep` found: whether its policy was kept, and how
    many episodes were gained and lost against the best trial before; None in the first.
    """
    rows = []
    for name, entry in finished.items():
        if name.startswith("trial-"):
            found = finished.get(f"keep-{name.removeprefix('trial-')}", {}).get("result", {})
            compared = {key: found.get(key) for key in ("kept", "gained", "lost")}
            rows.append({**entry["result"], **compared})
    return rows


def manifests(inputs: Inputs) -> dict[str, dict[str, Any]]:
    """Manifests of the stages of a run, by name, in their order."""
    found = (read_manifest(folder) for folder in inputs.folders("stages"))
    return {manifest["stage"]: manifest for manifest in found if manifest is not None}


def result_of(folder: Path) -> dict[str, Any]:
    """What a finished stage returned."""
    manifest = read_manifest(folder)
    assert manifest is not None, f"{folder} is an input of the report and must be finished"
    return dict(manifest["result"])


def write_outcomes(folder: Path, outcome: Outcome) -> None:
    """Keep what came of each seed beside what a stage returns; see `outcomes`."""
    kept = {
        "success": outcome.success,
        "counted": outcome.counted,
        "progress": outcome.progress,
        "seeds": torch.tensor(outcome.seeds),
    }
    write_atomically(folder / OUTCOMES, lambda path: torch.save(kept, path))


def outcomes(*folders: Path) -> tuple[list[int], list[torch.Tensor]]:
    """The seeds that all of these stages, which tried policies on the same ones, could count, and success
    bool [N] on them in each.
    """
    kept = [torch.load(folder / OUTCOMES, weights_only=True) for folder in folders]
    counted = torch.stack([one["counted"] for one in kept]).all(0)
    return kept[0]["seeds"][counted].tolist(), [one["success"][counted] for one in kept]


def _physics(inputs: Inputs) -> dict[str, Any]:
    """True success before and after, and their paired test; None without physics."""
    if "physics_before" not in inputs.found:
        return {"physics_before": None, "physics_after": None, "paired": None}
    folders = {when: inputs.folder(f"physics_{when}") for when in ("before", "after")}
    entries = {
        f"physics_{when}": {key: result_of(folder)[key] for key in _ENTRY} for when, folder in folders.items()
    }
    return {**entries, "paired": mcnemar(*outcomes(folders["before"], folders["after"])[1])}


def _tasks(cfg: Mapping[str, Any], inputs: Inputs, imagined: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """For each of several tasks: physics_before, physics_after and paired, None without physics;
    imagined_before and imagined_after, absent where no imagined episode began in it.
    """
    shown = {f"imagined_{when}": imagined[when]["tasks"] for when in ("before", "after")}
    names = sorted(set().union(*shown.values()))
    true: dict[str, Mapping[str, Any]] = {}
    if "physics_before" in inputs.found:
        seeds, pair = outcomes(*(inputs.folder(f"physics_{when}") for when in ("before", "after")))
        true = by_task(tasks_of_seeds(cfg, seeds), _pair, *pair)
        names = sorted({*names, *true})
    nothing = {"physics_before": None, "physics_after": None, "paired": None}
    return {
        name: {
            **true.get(name, nothing),
            **{when: entries[name] for when, entries in shown.items() if name in entries},
        }
        for name in names
    }


def _scenes(cfg: Mapping[str, Any], inputs: Inputs, imagined: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each task in each scene task, scene, and those of physics_before, physics_after, paired,
    imagined_before and imagined_after of which there are episodes.
    """
    parts = [
        {"task": cell["task"], "scene": cell["scene"], f"imagined_{when}": cell}
        for when in ("before", "after")
        for cell in imagined[when]["scenes"]
    ]
    if "physics_before" in inputs.found:
        seeds, pair = outcomes(*(inputs.folder(f"physics_{when}") for when in ("before", "after")))
        tasks, scenes = tasks_of_seeds(cfg, seeds), scenes_of_seeds(cfg, seeds)
        parts += by_scene(tasks, scenes, _pair, *pair)
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for part in parts:
        found.setdefault((part["task"], part["scene"]), {}).update(part)
    return [found[where] for where in sorted(found)]


def _alarms(finished: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What stages were alarmed by, each with the stage's name: RL that goes nowhere, tokenizers that keep
    little, simulators whose few steps training takes out.
    """
    out = []
    for name, entry in finished.items():
        made = entry["result"]
        texts = [*made.get("alarms", []), made.get("alarm", ""), made.get("tokenizer_alarm", "")]
        out += [f"{name}: {text}" for text in texts if text]
    return out


def unjudged(cfg: Mapping[str, Any], imagined: Mapping[str, Any]) -> list[str]:
    """What to change in a judge that gave no judgement on most of the imagined evaluation episodes."""
    dropped = imagined["dropped"]
    asked = dropped + imagined["episodes"]
    if 2 * dropped <= asked:
        return []
    kind: Any = target(cfg["judge"], "judge")
    return [
        f"{IMAGINED}: the judge gave no judgement on {dropped} of {asked} imagined episodes."
        f" {kind.__name__}: {kind.remedy(cfg['judge'])}"
    ]


def _training(finished: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """By the name of what was trained: samples_per_second, and data_share, the share of the time in which it
    waited for data.
    """
    out = {}
    for stage, manifest in finished.items():
        made = manifest["result"]
        for key in made:
            if not key.endswith("samples_per_second"):
                continue
            part = key.removesuffix("samples_per_second")
            waited, worked = made[f"{part}data_seconds"], made[f"{part}compute_seconds"]
            name = f"{stage}, {part.rstrip('_')}" if part else stage
            out[name] = {"samples_per_second": made[key], "data_share": waited / ((waited + worked) or 1.0)}
    return out


def _pair(before: torch.Tensor, after: torch.Tensor) -> dict[str, Any]:
    return {
        "physics_before": rate_entry(before),
        "physics_after": rate_entry(after),
        "paired": mcnemar(before, after),
    }


def _judge_cost(finished: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """What all stages together asked the judge for and paid."""
    total: dict[str, float] = {}
    for entry in finished.values():
        for name, value in entry["result"].get("judge_cost", {}).items():
            total[name] = total.get(name, 0.0) + value
    return total


def _class_name(section: Mapping[str, Any]) -> str:
    """The class that a config section chooses, without its module."""
    return str(section.get("_target_", "")).rpartition(".")[2]
