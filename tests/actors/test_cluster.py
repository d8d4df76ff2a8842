"""Three nodes on this machine, one of them lost while running; and the words for what goes wrong with
clusters.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import ray
from ray.cluster_utils import Cluster

from actors.factory import build_policy
from actors.fleets.cluster import _advice, check_versions, connect, versions
from actors.fleets.launch import build_fleet, check_launch
from actors.fleets.ray_fleet import RayFleet
from actors.fleets.reaper import orphans
from actors.fleets.sigterm import our_sigterm
from actors.rollouts.host import Job, trained_weights
from actors.rollouts.recipe import Recipe
from envs.targets import ConfigError
from pipeline.chaos.processes import belonging, nothing_left
from pipeline.cli import tools
from pipeline.commands.submit import entrypoint
from pipeline.config import load_config


@pytest.mark.long
def test_a_lost_node_costs_no_job(recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_worker_niceness", "0")  # else workers starve beside the other tests
    # Ray gives a silent node half a minute by default. One that is gone refuses at once; one on a busy
    # machine may take its time.
    soon = {
        "health_check_initial_delay_ms": 0,
        "health_check_period_ms": 500,
        "health_check_timeout_ms": 20000,
        "health_check_failure_threshold": 3,
    }
    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "include_dashboard": False, "_system_config": soon},
    )
    nodes = [cluster.add_node(num_cpus=2) for _ in range(2)]
    cfg = load_config(
        [
            "experiment=smoke",
            "launch=ray",
            f"launch.address={cluster.address}",
            "launch.actors=4",
            "launch.place.actors.num_cpus=1",
            "launch.strategy=disaggregated",
        ]
    )
    try:
        fleet = build_fleet(replace(recipe, config=cfg))
        assert isinstance(fleet, RayFleet)
        policy = build_policy(cfg)
        policy.freeze_perception()
        fleet.publish(0, trained_weights(policy))
        for number in range(8):
            fleet.submit(Job(number, tuple(range(4 * number, 4 * number + 4)), number))
        first = fleet.take()
        cluster.remove_node(nodes[0], allow_graceful=False)
        fleet.resize(3)  # what the remaining nodes can hold
        rest = [fleet.take() for _ in range(7)]
        assert sorted(r.job.number for r in [first, *rest] if r is not None and r.batch is not None) == list(
            range(8)
        )
        fleet.close()
    finally:
        ray.shutdown()
        cluster.shutdown()


@pytest.mark.parametrize(
    ("when", "number", "status"),
    [
        ("starting", signal.SIGKILL, -9),
        ("starting", signal.SIGTERM, 143),
        ("up", signal.SIGTERM, 143),
    ],
)
@pytest.mark.long
def test_an_ended_driver_leaves_no_ray_and_the_status_that_shells_expect(
    when: str, number: int, status: int
) -> None:
    script = (
        "import time; from learners.training.interrupt import clean_ending;"
        " from actors.fleets.cluster import connect; from pipeline.config import load_config\n"
        "with clean_ending():\n"
        "    connect(load_config(['experiment=smoke', 'launch=ray'])['launch']); print('up', flush=True)\n"
        "    time.sleep(100)"
    )
    command = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert command.stdout is not None
    if when == "up":
        assert command.stdout.readline() == b"up\n"
    deadline = time.monotonic() + 90
    while not any("Agent" in line for line in belonging("", command.pid)) and time.monotonic() < deadline:
        time.sleep(0.05)
    command.send_signal(number)
    assert command.wait(60) == status
    nothing_left("", command.pid, AssertionError)


@pytest.mark.parametrize("turned", [RuntimeError, SystemExit, None])
def test_a_sigterm_counts_whatever_a_starting_ray_makes_of_it(turned: type[BaseException] | None) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended, our_sigterm():
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))  # as ray.init does
        try:
            signal.raise_signal(signal.SIGTERM)
        except SystemExit as error:  # as its C++ does, where that is at work
            if turned is not None:
                raise turned(15) from error
    assert ended.value.code == 143 and signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(ValueError, match="its own"), our_sigterm():
        raise ValueError("its own")


def test_an_agent_without_its_raylet_is_found_in_its_session() -> None:
    agent = subprocess.Popen(["bash", "-c", "exec -a ray::DashboardAgent sleep 60"], start_new_session=True)
    try:
        deadline = time.monotonic() + 20
        while not (found := orphans(agent.pid)) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert found == {agent.pid} and agent.pid not in orphans(os.getsid(0))
    finally:
        agent.kill()
        agent.wait()


class Dropped:
    """Gets a SIGTERM where Python drops what is raised, as in the handlers of a fork."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_sigterm_that_python_drops_counts_and_is_not_reported(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, our_sigterm():
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))
        Dropped()
    assert ended.value.code == 143 and "Traceback" not in capsys.readouterr().err


@pytest.mark.long
def test_a_wrong_token_is_named() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    mine, wrong = ({**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": letter * 64} for letter in "ab")
    command = [
        str(Path(sys.executable).with_name("ray")),
        "start",
        "--head",
        "--block",
        f"--port={port}",
        "--num-cpus=1",
        "--include-dashboard=false",
        "--node-ip-address=127.0.0.1",
        "--disable-usage-stats",
    ]
    head = subprocess.Popen(
        command, env=mine, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        for _ in range(120):
            time.sleep(0.5)
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
        script = f"from actors.fleets.cluster import connect; connect({{'address': '127.0.0.1:{port}'}})"
        stranger = subprocess.run(
            [sys.executable, "-c", script], env=wrong, capture_output=True, text=True, timeout=240
        )
        assert "refused our token" in stranger.stderr and "auth_token" in stranger.stderr, stranger.stderr[
            -2000:
        ]
    finally:
        os.killpg(head.pid, signal.SIGKILL)
        head.wait()


def test_unreachable_clusters_and_other_versions_are_named() -> None:
    cfg: dict[str, Any] = load_config(["experiment=smoke", "launch=ray", "launch.address=127.0.0.1:1"])
    with pytest.raises(ConfigError, match=r"launch\.address=127\.0\.0\.1:1 cannot be reached"):
        connect(cfg["launch"])
    mine = versions()
    check_versions(mine, dict(mine))
    with pytest.raises(ConfigError, match=r"torch 1\.0 instead of .*constraints\.txt"):
        check_versions(mine, mine | {"torch": "1.0"})
    assert "constraints.txt" in _advice(
        "head:6379", RuntimeError("Version mismatch: the cluster was started with Ray 2.50")
    )


def test_a_cluster_is_asked_before_any_work() -> None:
    here = load_config(["experiment=soak", "launch=ray", "launch.cpus=2"])["launch"]
    check_launch(here)
    with pytest.raises(ConfigError, match=r"launch\.place\.actors \(process 5 of 8\) needs 0\.5 CPU"):
        check_launch({**here, "actors": 8})
    with pytest.raises(ConfigError, match=r"launch\.address=127\.0\.0\.1:1 cannot be reached"):
        check_launch({**here, "address": "127.0.0.1:1"})
    assert not ray.is_initialized()
    check_launch(load_config(["experiment=soak"])["launch"])


def test_what_is_submitted_runs_on_the_cluster() -> None:
    assert (
        entrypoint(["rl", "launch=ray", "launch.actors=8"])
        == "python -m pipeline rl launch=ray launch.actors=8 launch.address=auto"
    )
    for words in ([], ["launch=ray"], ["rl", "seed=1"]):
        with pytest.raises(ConfigError):
            entrypoint(words)
    with pytest.raises(ConfigError, match="runs=runs would lie in the job's working folder"):
        tools.submit(["http://127.0.0.1:1", "rl", "experiment=soak", "launch=ray"])
    with pytest.raises(ConfigError, match="takes no jobs"):
        tools.submit(["http://127.0.0.1:1", "rl", "experiment=soak", "launch=ray", "runs=/runs"])
