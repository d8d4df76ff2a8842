"""Stages elsewhere: those that learn in several processes, those that evaluate where launch.place.evaluator
says.

Ray Train starts the processes that learn; all of them run the stage, the leading one writes. Which parts of a
stage are shared out is told in learners/training/parallel.py. A worker that dies takes the others with it;
Ray Train starts all anew, and the stage goes on from its last checkpoint.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from envs.files import write_text
from envs.targets import ConfigError
from pipeline.graph.stage import Inputs, Place, Stage, find_stage


@dataclass(frozen=True)
class Job:
    """A stage to be run, in a form that any process can take.

    Args:
        stage: Stage.path.
        name: of the node.
        cfg: the resolved config.
        folder: of the artefact, absolute.
        found: folders by role, absolute.
        settings: of the node.
    """

    stage: str
    name: str
    cfg: Mapping[str, Any]
    folder: str
    found: Mapping[str, str | list[str]]
    settings: Mapping[str, Any]

    @classmethod
    def of(cls, stage: Stage, name: str, cfg: Mapping[str, Any], folder: Path, inputs: Inputs) -> Job:
        """The job of a node."""
        found: dict[str, str | list[str]] = {
            role: str(paths.resolve()) if isinstance(paths, Path) else [str(path.resolve()) for path in paths]
            for role, paths in inputs.found.items()
        }
        return cls(stage.path, name, dict(cfg), str(folder.resolve()), found, dict(inputs.settings))

    def run(self) -> dict[str, Any]:
        """Do it here."""
        stage = find_stage(self.stage)
        found = {
            role: Path(paths) if isinstance(paths, str) else tuple(Path(path) for path in paths)
            for role, paths in self.found.items()
        }
        view = stage.view(self.name, self.cfg, self.settings)
        return dict(stage.run(view, Path(self.folder), Inputs(found, self.settings)))


def run_stage(
    stage: Stage, name: str, cfg: Mapping[str, Any], folder: Path, inputs: Inputs
) -> dict[str, Any]:
    """Run a stage where it belongs: in this process, on Ray's evaluator, or in launch.learners processes.

    Raises:
        ConfigError: if the processes cannot be placed, or failed.
    """
    run = _PLACES[stage.place](cfg)
    if run is not None:
        return run(Job.of(stage, name, cfg, folder, inputs))
    return dict(stage.run(stage.view(name, cfg, inputs.settings), folder, inputs))


def learners_of(cfg: Mapping[str, Any]) -> int:
    """Processes that train together.

    Raises:
        ConfigError: if the microbatches cannot be shared out to them.
    """
    count = int(cfg["launch"].get("learners", 1))
    if count > 1 and cfg["microbatches"] % count:
        raise ConfigError(
            f"microbatches={cfg['microbatches']} must be a multiple of launch.learners={count};"
            f" say microbatches={count}"
        )
    return count


def run_shared(job: Job) -> dict[str, Any]:
    """Run a stage in launch.learners processes; returns what the leading one returned.

    Raises:
        ConfigError: if the processes cannot be placed, or failed more than launch.patience.retries times.
    """
    # Ray Train takes seconds to import, which runs in one process need not spend.
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    from actors.fleets.cluster import Plan, connect

    launch, folder = job.cfg["launch"], Path(job.folder)
    plan = Plan.of(launch)
    plan.check(connect(launch))
    gpus = plan.gpus["learner"]
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    trainer = TorchTrainer(
        work_loop,
        train_loop_config=vars(job),
        torch_config=TorchConfig(backend="nccl" if gpus else "gloo"),
        scaling_config=ScalingConfig(
            num_workers=launch["learners"],
            use_gpu=gpus > 0,
            resources_per_worker={"CPU": plan.cpus["learner"] or 0.01, **({"GPU": gpus} if gpus else {})},
        ),
        run_config=RunConfig(
            name=folder.name,
            storage_path=str(folder / "ray-train"),
            failure_config=FailureConfig(max_failures=launch["patience"]["retries"]),
        ),
    )
    try:
        trainer.fit()
    except Exception as error:
        raise ConfigError(
            f"the {launch['learners']} learners of {folder.name} failed: {_last(error)};"
            " the same command goes on from the last checkpoint"
        ) from error
    return dict(json.loads(answer.read_text()))


def run_placed(job: Job) -> dict[str, Any]:
    """Run a stage as a Ray task with the evaluator's resources; a lost node only costs a second try.

    Raises:
        ConfigError: if the task cannot be placed.
    """
    import ray

    from actors.fleets.cluster import Plan, connect

    launch, name = job.cfg["launch"], Path(job.folder).name
    plan = Plan.of(launch)
    plan.check(connect(launch))
    retries = int(launch["patience"]["retries"])
    task = ray.remote(_measure).options(max_retries=retries, **plan.options("evaluator"))
    ref = task.remote(vars(job))
    deadline, waited = float(launch["patience"]["stage"]), 0.0
    while not ray.wait([ref], timeout=60)[0]:
        waited += 60
        tqdm.write(f"the driver waits for the evaluator ({name}), {waited:.0f} s")
        if waited >= deadline:
            ray.cancel(ref, force=True)
            raise ConfigError(
                f"{name} took over launch.patience.stage={deadline:.0f} s on the evaluator; raise it,"
                " or see whether launch.place.evaluator can be placed"
            )
    answer: dict[str, Any] = ray.get(ref)
    return answer


def _measure(job: dict[str, Any]) -> dict[str, Any]:
    return Job(**job).run()


def work_loop(job: dict[str, Any]) -> None:
    """What every learner process does."""
    import torch
    from ray.train.torch import get_device

    from learners.training.parallel import leads

    if torch.cuda.is_available():
        torch.cuda.set_device(get_device())
    result = Job(**job).run()
    if leads():
        write_text(Path(job["folder"]) / "answer.json", json.dumps(result, default=float))


# How a place runs a job under a launch; None is this process.
_PLACES: dict[Place, Callable[[Mapping[str, Any]], Callable[[Job], dict[str, Any]] | None]] = {
    Place.DRIVER: lambda cfg: None,
    Place.LEARNERS: lambda cfg: run_shared if learners_of(cfg) > 1 else None,
    Place.EVALUATOR: lambda cfg: run_placed if cfg["launch"]["backend"] == "ray" else None,
}


def _last(error: Exception) -> str:
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
