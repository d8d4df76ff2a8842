"""worldloop chaos: kill what a run is made of, by a seeded schedule, and check the ledger.

A learner process runs GRPO or PPO on Ray actors and a judge service in an untrained world. Within it a thread
kills hosts (as Ray does and as the kernel does) and the judge, and adds and removes hosts; from outside, the
learner itself is killed and started again. Afterwards every episode must be accounted for, and nothing may be
left behind.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from actors.fleets.fleet import EpisodeLedger
from envs.files import write_json
from learners.training.checkpoint import Checkpoints

LEARNER = "pipeline.chaos.learner"


class ChaosFailure(RuntimeError):
    """The ledger does not balance, or something was left behind; the message says what."""


def run_chaos(cfg: Mapping[str, Any], words: list[str], folder: Path) -> dict[str, Any]:
    """Run and check; returns what was found.

    Args:
        cfg: resolved config; its section `chaos` has the schedule.
        words: the overrides that made it, for the learner process to make the same.
        folder: of the run; removed first, for the ledger of two runs must not mix.

    Raises:
        ChaosFailure: if a check fails.
    """
    import shutil

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    section = cfg["chaos"]
    chance = random.Random(cfg["seed"])
    before = _left_behind()
    end = time.monotonic() + section["seconds"]
    kills, lives = 0, 0
    with tqdm(
        total=section["seconds"],
        desc="chaos",
        unit="s",
        dynamic_ncols=True,
        bar_format="{l_bar}{bar}| {n:.0f}/{total:.0f} s {postfix}",
    ) as bar:
        while True:
            lives += 1
            with (folder / "learner.log").open("a") as log:
                learner = subprocess.Popen(
                    [sys.executable, "-m", LEARNER, str(folder), str(lives), *words],
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            try:
                # One learner in four may be killed before it has learned anything; the others live on after
                # their first iteration.
                begun, life = len(_rows(folder)), section["learner_every"] * chance.uniform(0.7, 1.3)
                stop = time.monotonic() + life if chance.random() < 0.25 else math.inf
                enough = False
                while time.monotonic() < stop and not enough and learner.poll() is None:
                    time.sleep(0.2)
                    now, learned = time.monotonic(), len(_rows(folder))
                    if math.isinf(stop) and learned > begun:
                        stop = now + life
                    enough = now >= end and kills > 0 and learned > begun
                    bar.n = min(section["seconds"], section["seconds"] - end + now)
                    bar.set_postfix_str(f"{learned} iterations, learner killed {kills} times")
                    if now > end + 600:
                        raise ChaosFailure(
                            f"nothing was learned for ten minutes after the end; see {folder}/learner.log"
                        )
                if learner.poll() is not None:
                    raise ChaosFailure(
                        f"the learner left by itself with {learner.returncode}; see {folder}/learner.log"
                    )
                if enough:
                    # the last one finishes its iteration and writes its checkpoint
                    learner.send_signal(signal.SIGTERM)
                else:
                    os.kill(learner.pid, signal.SIGKILL)
                    kills += 1
                try:
                    learner.wait(timeout=120)
                except subprocess.TimeoutExpired as error:
                    raise ChaosFailure(
                        f"the learner did not leave within two minutes of SIGTERM; see {folder}/learner.log"
                    ) from error
                if enough:
                    if learner.returncode != 143:
                        raise ChaosFailure(
                            f"after SIGTERM the learner left with {learner.returncode}, not 143;"
                            f" see {folder}/learner.log"
                        )
                    break
            except BaseException:  # whatever ends this command ends its learner
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(learner.pid, signal.SIGKILL)
                raise
    report = _check(folder, before)
    report |= {"seconds": section["seconds"], "learner_kills": kills}
    write_json(folder / "chaos.json", report)
    return report


def _rows(folder: Path) -> list[dict[str, Any]]:
    log = folder / "learned.jsonl"
    out = []
    for line in log.read_text().splitlines() if log.exists() else []:
        try:
            out.append(json.loads(line))
        except json.JSONDecodeError:
            continue  # the line a killed learner was writing; resuming cuts it off
    return out


def _check(folder: Path, before: set[str]) -> dict[str, Any]:
    saved = Checkpoints(folder).facts()
    if saved is None:
        raise ChaosFailure(
            "no checkpoint was ever written; the run is too short for this machine, raise chaos.seconds"
            f" (see {folder}/learner.log)"
        )
    ledger = EpisodeLedger(**saved["ledger"])
    rows = _rows(folder)
    steps = [row["step"] for row in rows]
    jobs = [job for row in rows for job in row["jobs"]]
    versions = [max(row["versions"]) for row in rows]
    under_way = ledger.requested - ledger.learned - sum(ledger.dropped.values())
    events = (
        [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
        if (folder / "events.jsonl").exists()
        else []
    )
    wrong = []
    if steps != list(range(saved["iteration"])):
        wrong.append(f"iterations are {steps}, not 0 to {saved['iteration'] - 1} once each")
    if len(set(jobs)) != len(jobs):
        wrong.append("a job was learned from twice")
    if len(jobs) * saved["episodes_per_job"] != ledger.learned + ledger.dropped.get("judge", 0):
        wrong.append(
            f"{len(jobs)} jobs of {saved['episodes_per_job']} episodes were learned from, but the ledger says"
            f" {ledger.learned} and {ledger.dropped}"
        )
    if under_way < 0:
        wrong.append(
            f"{ledger.requested} requested episodes are fewer than {ledger.learned} learned and"
            f" {ledger.dropped} dropped"
        )
    if any(later < sooner for sooner, later in itertools.pairwise(versions)):
        wrong.append("versions went backwards")
    for _ in range(60):  # what was told to end may take a moment
        left = _left_behind() - before
        if not left:
            break
        time.sleep(0.2)
    if left:
        wrong.append(f"left behind: {sorted(left)[:6]}")
    parts = [str(path) for path in folder.rglob(".*.part")]
    if len(parts) > 1:  # one a killed learner was writing is overwritten by the next
        wrong.append(f"unfinished files: {parts}")
    if wrong:
        raise ChaosFailure("; ".join(wrong))
    kinds = [event["event"] for event in events]
    return {
        "iterations": saved["iteration"],
        "requested": ledger.requested,
        "learned": ledger.learned,
        "dropped": dict(ledger.dropped),
        "under_way_at_the_end": under_way,
        "rerun": ledger.rerun,
        "events": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
        "balanced": True,
    }


def _left_behind() -> set[str]:
    """Processes of learners, hosts and Ray, and files of its object store."""
    found = set()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue  # it ended while we looked
        if (
            state != "Z"
            and any(word in line for word in (LEARNER, "ray::", "raylet", "gcs_server"))
            and int(entry.name) != os.getpid()
        ):
            found.add(f"process {entry.name} {line[:60]}")
    return found | {f"/dev/shm/{path.name}" for path in Path("/dev/shm").glob("plasma*")}
