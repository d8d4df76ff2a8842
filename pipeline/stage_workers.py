"""Stages elsewhere: those that learn in several processes, those that evaluate where launch.place.evaluator
says.

Ray Train starts the processes that learn; all of them run the stage, the leading one writes. Which parts of a
stage are shared out is told in learners/parallel.py. A worker that dies takes the others with it; Ray
Train starts all anew, and the stage goes on from its last checkpoint.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from actors.factory import ConfigError
from pipeline.artefact import write_text

# Stages that are more than one worker's work; the others run in the driver.
SHARED = ("imitation", "tokenizer", "vision", "state", "judge", "clone", "rl")
# Stages that measure policies and worlds.
EVALUATORS = ("gap", "evaluate_physics", "evaluate_imagined", "measure")


def run_stage(
    function: str, cfg: Mapping[str, Any], folder: Path, found: Mapping[str, Path], known: Mapping[str, Any]
) -> dict[str, Any]:
    """Run a stage of pipeline/work where the config wants it: in this process, on Ray's evaluator, or in
    launch.learners processes.

    Raises:
        ConfigError: if the processes cannot be placed, or failed.
    """
    from pipeline import stages as work

    if function in SHARED and learners_of(cfg) > 1:
        return run_shared(function, cfg, folder, found, known)
    if function in EVALUATORS and cfg["launch"]["backend"] == "ray":
        return run_placed(function, cfg, folder, found, known)
    return dict(getattr(work, function)(cfg, folder, found, **known))


def learners_of(cfg: Mapping[str, Any]) -> int:
    """Processes that train together.

    Raises:
        ConfigError: if the microbatches cannot be shared out to them.
    """
    count = int(cfg["launch"].get("learners", 1))
    if count > 1 and cfg["microbatches"] % count:
        raise ConfigError(
            f"microbatches={cfg['microbatches']} must be a multiple of launch.learners={count}; say microbatches={count}"
        )
    return count


def run_shared(
    function: str, cfg: Mapping[str, Any], folder: Path, found: Mapping[str, Path], known: Mapping[str, Any]
) -> dict[str, Any]:
    """Run a stage of pipeline/work in launch.learners processes; returns what the leading one returned.

    Raises:
        ConfigError: if the processes cannot be placed, or failed more than launch.patience.retries times.
    """
    # Ray Train takes seconds to import, which runs in one process need not spend.
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    from actors.fleets.cluster import Plan, connect

    launch = cfg["launch"]
    plan = Plan.of(launch)
    plan.check(connect(launch))
    gpus = plan.gpus["learner"]
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    asked = {
        "function": function,
        "cfg": dict(cfg),
        "folder": str(folder.resolve()),
        "found": {name: str(path.resolve()) for name, path in found.items()},
        "known": dict(known),
    }
    trainer = TorchTrainer(
        work_loop,
        train_loop_config=asked,
        torch_config=TorchConfig(backend="nccl" if gpus else "gloo"),
        scaling_config=ScalingConfig(
            num_workers=launch["learners"],
            use_gpu=gpus > 0,
            resources_per_worker={"CPU": plan.cpus["learner"] or 0.01, **({"GPU": gpus} if gpus else {})},
        ),
        run_config=RunConfig(
            name=folder.name,
            storage_path=str((folder / "ray-train").resolve()),
            failure_config=FailureConfig(max_failures=launch["patience"]["retries"]),
        ),
    )
    try:
        trainer.fit()
    except Exception as error:
        raise ConfigError(
            f"the {launch['learners']} learners of {folder.name} failed: {_last(error)}; the same command goes on from the last checkpoint"
        ) from error
    return dict(json.loads(answer.read_text()))


def run_placed(
    function: str, cfg: Mapping[str, Any], folder: Path, found: Mapping[str, Path], known: Mapping[str, Any]
) -> dict[str, Any]:
    """Run a stage of pipeline/work as a Ray task with the evaluator's resources; a lost node only costs a
    second try.

    Raises:
        ConfigError: if the task cannot be placed.
    """
    import ray

    from actors.fleets.cluster import Plan, connect

    plan = Plan.of(cfg["launch"])
    plan.check(connect(cfg["launch"]))
    task = ray.remote(_measure).options(
        max_retries=int(cfg["launch"]["patience"]["retries"]), **plan.options("evaluator")
    )
    paths = {name: str(path.resolve()) for name, path in found.items()}
    ref = task.remote(function, dict(cfg), str(folder.resolve()), paths, dict(known))
    deadline, waited = float(cfg["launch"]["patience"]["stage"]), 0.0
    while not ray.wait([ref], timeout=60)[0]:
        waited += 60
        tqdm.write(f"the driver waits for the evaluator ({folder.name}), {waited:.0f} s")
        if waited >= deadline:
            ray.cancel(ref, force=True)
            raise ConfigError(
                f"{folder.name} took over launch.patience.stage={deadline:.0f} s on the evaluator; raise it, or see whether launch.place.evaluator can be placed"
            )
    answer: dict[str, Any] = ray.get(ref)
    return answer


def _measure(
    function: str, cfg: dict[str, Any], folder: str, found: dict[str, str], known: dict[str, Any]
) -> dict[str, Any]:
    from pipeline import stages as work

    return dict(
        getattr(work, function)(
            cfg, Path(folder), {name: Path(path) for name, path in found.items()}, **known
        )
    )


def work_loop(asked: dict[str, Any]) -> None:
    """What every worker does."""
    import torch
    from ray.train.torch import get_device

    from learners.training.parallel import leads
    from pipeline import stages as work

    if torch.cuda.is_available():
        torch.cuda.set_device(get_device())
    folder = Path(asked["folder"])
    result = getattr(work, asked["function"])(
        asked["cfg"], folder, {name: Path(path) for name, path in asked["found"].items()}, **asked["known"]
    )
    if leads():
        write_text(folder / "answer.json", json.dumps(result, default=float))


def _last(error: Exception) -> str:
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
