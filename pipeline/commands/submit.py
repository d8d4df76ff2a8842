"""worldloop submit: the same command, as a job on a Ray cluster; it tracks itself in its run's folder."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from pathlib import Path

from ray.exceptions import AuthenticationError
from ray.job_submission import JobStatus, JobSubmissionClient
from tqdm import tqdm

from envs.targets import ConfigError

# What a job needs none of; Ray refuses packages over 500 MiB, and runs/ alone may be larger.
EXCLUDES = [
    "runs",
    ".git",
    ".venv",
    "shared",
    "wandb",
    "outputs",
    "**/__pycache__",
    ".mypy_cache",
    ".ruff_cache",
    ".pytest_cache",
    "*.mp4",
]


def entrypoint(words: Sequence[str]) -> str:
    """The command that the head node runs.

    Raises:
        ConfigError: if no command is named, or one that would start a Ray of its own.
    """
    if not words or "=" in words[0]:
        raise ConfigError(
            "say what to run: worldloop submit http://head:8265 rl experiment=quickstart launch=ray"
            " launch.actors=8"
        )
    if not any(word.startswith("launch=ray") for word in words):
        raise ConfigError("a submitted command needs launch=ray, or it would run on the head node alone")
    address = [word for word in words if word.startswith("launch.address=")]
    return shlex.join(["python", "-m", "pipeline", *words, *([] if address else ["launch.address=auto"])])


def submit(address: str, words: Sequence[str]) -> str:
    """Submit, print the job's log as it grows, and return the job's id.

    Args:
        address: of the cluster's dashboard, http://head:8265.
        words: command and overrides, as for `worldloop`.

    Raises:
        ConfigError: if the cluster cannot be reached, or the job fails.
    """
    command = entrypoint(words)
    try:
        client = JobSubmissionClient(address)
        job = client.submit_job(
            entrypoint=command,
            runtime_env={"working_dir": str(Path(__file__).resolve().parents[2]), "excludes": EXCLUDES},
        )
    except (AuthenticationError, ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigError(
            f"{address} takes no jobs: {str(error).splitlines()[0]}. Is the dashboard on (ray start --head"
            " --dashboard-host ...), is ~/.ray/auth_token the head node's, and RAY_AUTH_MODE=token set here?"
        ) from error
    tqdm.write(f"job {job}: {command}\nstop it with: ray job stop {job} --address {address}")
    shown = 0
    while True:
        log = client.get_job_logs(job)
        tqdm.write(log[shown:], end="")
        shown = len(log)
        status = client.get_job_status(job)
        if status in (JobStatus.SUCCEEDED, JobStatus.FAILED, JobStatus.STOPPED):
            if status is not JobStatus.SUCCEEDED:
                raise ConfigError(
                    f"job {job} has {status.value.lower()}: {client.get_job_info(job).message}; the same"
                    " command goes on from its last checkpoint if `runs` outlives the cluster"
                )
            break
        time.sleep(2)
    return job
