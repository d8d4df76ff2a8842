"""Ray itself: start it on this machine or join a cluster, and refuse plans that cannot be scheduled."""

from __future__ import annotations

import os
import platform
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import ray
import tensordict
import torch

from actors.fleets.reaper import reap_after_me
from actors.fleets.sigterm import our_sigterm
from envs.targets import ConfigError

ROLES = ("learner", "actors", "judge", "evaluator")


@dataclass(frozen=True)
class Plan:
    """Who gets what: for every role how many processes, and of each process the CPUs and GPUs (fractions
    allowed).

    Strategies: "collocated" packs all roles on as few nodes as possible, "disaggregated" spreads them,
    "hybrid" keeps learner and judge together and spreads the actors.
    """

    strategy: str
    counts: Mapping[str, int]
    cpus: Mapping[str, float]
    gpus: Mapping[str, float]

    @classmethod
    def of(cls, launch: Mapping[str, Any]) -> Plan:
        """The plan of configs/launch.

        Raises:
            ConfigError: naming the key that is wrong.
        """
        place = launch["place"]
        if launch["strategy"] not in ("collocated", "disaggregated", "hybrid"):
            raise ConfigError(
                f"launch.strategy={launch['strategy']!r} must be collocated, disaggregated or hybrid"
            )
        unknown = sorted(set(place) - set(ROLES))
        if unknown or set(ROLES) - set(place):
            raise ConfigError(f"launch.place must name {list(ROLES)}, it names {sorted(place)}")
        counts = {
            "learner": launch["learners"],
            "actors": launch["actors"],
            "judge": int(launch["judge_service"]),
            "evaluator": 1,
        }
        for role in ROLES:
            for key in ("num_cpus", "num_gpus"):
                if place[role].get(key, 0) < 0:
                    raise ConfigError(f"launch.place.{role}.{key}={place[role][key]} must not be negative")
        return cls(
            launch["strategy"],
            counts,
            {r: float(place[r]["num_cpus"]) for r in ROLES},
            {r: float(place[r].get("num_gpus", 0)) for r in ROLES},
        )

    def bundles(self) -> list[dict[str, float]]:
        """One bundle of resources per process."""
        return [
            {"CPU": self.cpus[role], "GPU": self.gpus[role]}
            for role in ROLES
            for _ in range(self.counts[role])
        ]

    def check(self, nodes: list[Mapping[str, float]]) -> None:
        """Refuse a plan that these nodes can never run.

        Args:
            nodes: total resources of each node.

        Raises:
            ConfigError: naming the role, what it needs and what there is.
        """
        free = [dict(node) for node in nodes]
        # The largest first, as a packer would.
        wanted = sorted(
            ((role, k) for role in ROLES for k in range(self.counts[role])),
            key=lambda item: (-self.gpus[item[0]], -self.cpus[item[0]]),
        )
        for role, number in wanted:
            need = {"CPU": self.cpus[role], "GPU": self.gpus[role]}
            fits = [
                node
                for node in free
                if all(node.get(key, 0.0) + 1e-6 >= value for key, value in need.items())
            ]
            if not fits:
                total = {key: sum(node.get(key, 0.0) for node in nodes) for key in ("CPU", "GPU")}
                requested = {key: sum(bundle[key] for bundle in self.bundles()) for key in ("CPU", "GPU")}
                where = f"launch.place.{role}" + (
                    f" (process {number + 1} of {self.counts[role]})" if self.counts[role] > 1 else ""
                )
                raise ConfigError(
                    f"{where} needs {_listed(need)}, which no node has left: all roles together ask for"
                    f" {_listed(requested)}, the {len(nodes)} node(s) have {_listed(total)}. "
                    "Lower launch.actors or the shares in launch.place, or add nodes"
                )
            # Collocated fills the fullest node first, the others the emptiest.
            fits.sort(key=lambda node: node.get("CPU", 0.0), reverse=self.strategy != "collocated")
            for key, value in need.items():
                fits[0][key] = fits[0].get(key, 0.0) - value

    def options(self, role: str) -> dict[str, Any]:
        """Options of that role's Ray actors."""
        spread = {
            "collocated": "DEFAULT",
            "disaggregated": "SPREAD",
            "hybrid": "SPREAD" if role == "actors" else "DEFAULT",
        }[self.strategy]
        return {"num_cpus": self.cpus[role], "num_gpus": self.gpus[role], "scheduling_strategy": spread}


def _listed(need: Mapping[str, float]) -> str:
    return " and ".join(f"{value:g} {key}" for key, value in need.items() if value or key == "CPU")


def versions() -> dict[str, str]:
    """What must be alike on all nodes."""
    from importlib.metadata import version

    names = {
        "python": platform.python_version(),
        "torch": torch.__version__.split("+")[0],
        "tensordict": str(tensordict.__version__).split("+")[0],
    }
    return {
        **names,
        "torchrl": version("torchrl").split("+")[0],
        "ray": ray.__version__,
        "worldloop": version("worldloop"),
    }


def connect(launch: Mapping[str, Any]) -> list[Mapping[str, float]]:
    """Start Ray here, on loopback and without a dashboard, or join launch.address; returns the resources of
    the nodes.

    Raises:
        ConfigError: if the cluster cannot be reached, refuses the token, or has other versions.
    """
    if not ray.is_initialized():
        _knock(str(launch["address"]))
        try:
            with our_sigterm():
                _start(launch)
        except Exception as error:
            raise ConfigError(_advice(str(launch["address"]), error)) from error
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if launch["address"] != "local":
        _compare(len(nodes), float(launch["patience"]["start"]))
    return nodes


def _start(launch: Mapping[str, Any]) -> None:
    if launch["address"] != "local":
        ray.init(address=launch["address"], log_to_driver=True, configure_logging=False)
        return
    reap_after_me()
    # Ray makes its workers nice, by 15: beside anything else that computes here they would starve. A user's
    # own choice stands.
    os.environ.setdefault("RAY_worker_niceness", "0")
    ray.init(
        address="local",
        num_cpus=launch["cpus"] or None,
        include_dashboard=False,
        object_store_memory=int(launch["object_store_mb"]) * 2**20,
        _node_ip_address="127.0.0.1",
        log_to_driver=False,
        configure_logging=False,
    )


def _knock(address: str) -> None:
    """Fail in seconds where nobody listens; Ray itself tries for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except OSError as error:
            raise ConfigError(
                f"launch.address={address} cannot be reached ({error}); is `ray start --head` running there,"
                " and the port open?"
            ) from error


def _advice(address: str, error: Exception) -> str:
    message = str(error).splitlines()[0] if str(error) else ""
    if "version" in message.lower():
        return f"launch.address={address}: {message}; install the versions of constraints.txt on every node"
    if (
        isinstance(error, ConnectionError)
        or "token" in message.lower()
        or "unauthenticated" in message.lower()
    ):
        # Ray logs InvalidAuthToken and then only says that it could not connect.
        return (
            f"launch.address={address} listens, but does not let us in; most often it refused our token: copy"
            " ~/.ray/auth_token of the head node to this machine and set RAY_AUTH_MODE=token, "
            f"or set RAY_AUTH_MODE=disabled everywhere on a network you trust ({type(error).__name__}:"
            f" {message})"
        )
    return f"launch.address={address}: {type(error).__name__}: {message}; see /tmp/ray/session_latest/logs"


def _compare(nodes: int, patience: float) -> None:
    """Every node must have our versions: rollouts and weights of another would fail late and darkly.

    Args:
        patience: seconds that nodes may take to answer.

    Raises:
        ConfigError: if one differs, or starts no workers of ours.
    """
    mine = versions()
    probe = ray.remote(versions).options(num_cpus=0, scheduling_strategy="SPREAD")
    try:
        answers = ray.get([probe.remote() for _ in range(2 * nodes)], timeout=patience)
    except ray.exceptions.GetTimeoutError as error:
        raise ConfigError(
            f"not all nodes of the cluster answered within launch.patience.start={patience:.0f} s; are they"
            " busy, or no longer there? `ray status` lists them"
        ) from error
    except ray.exceptions.RayError as error:
        raise ConfigError(
            f"a node of the cluster starts no workers of ours ({type(error).__name__}:"
            f" {str(error).strip().splitlines()[-1]}); is worldloop installed there? See"
            " /tmp/ray/session_latest/logs on it"
        ) from error
    for theirs in answers:
        check_versions(mine, theirs)


def check_versions(mine: Mapping[str, str], theirs: Mapping[str, str]) -> None:
    """Refuse a node whose versions differ.

    Raises:
        ConfigError: naming what differs.
    """
    wrong = {key: (theirs.get(key), value) for key, value in mine.items() if theirs.get(key) != value}
    if wrong:
        differences = ", ".join(f"{key} {other} instead of {own}" for key, (other, own) in wrong.items())
        raise ConfigError(
            f"a node of the cluster has {differences}; install the versions of constraints.txt on every node"
        )
