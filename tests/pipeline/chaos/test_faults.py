"""Whatever moment a process is killed at or a disk is full at: what was written is whole, and goes on."""

from __future__ import annotations

import errno
import itertools
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from envs.episodes import LeRobotDataset, LeRobotWriter
from envs.episodes.clips import ClipStore
from learners.training.checkpoint import Checkpoints
from pipeline.chaos.faults import Fault, Stopped, faulty
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, moving_square

KINDS: list[Literal["stop", "full"]] = ["stop", "full"]


def at_every_write(
    folder: Callable[[int], Path], kind: Literal["stop", "full"], work: Callable[[Path], Any]
) -> list[Path]:
    """Do the work once for each of its writes, each time broken off there; the folders it left."""
    left = []
    for number in itertools.count():
        place = folder(number)
        place.mkdir()
        fault = Fault(place, number, kind)
        try:
            with faulty(fault):
                work(place)
        except Stopped:
            assert kind == "stop"
        except OSError as error:
            assert kind == "full" and error.errno == errno.ENOSPC and str(place) in str(error)
        else:
            assert not fault.tripped  # a write that failed is never overlooked
            return left
        assert fault.tripped
        left.append(place)
    raise AssertionError


@pytest.mark.parametrize("kind", ["stop", "full"])
@pytest.mark.long
def test_any_prefix_of_a_data_sets_writes_resumes_to_the_same_set(
    kind: Literal["stop", "full"], tmp_path: Path
) -> None:
    made = [moving_square(ARM_DELTAS, seed, length=6) for seed in range(4)]

    def work(place: Path) -> None:
        writer = LeRobotWriter(place / "set", ARM_DELTAS.at(SIZE))
        while writer.episodes < len(made):
            writer.write(made[writer.episodes : writer.episodes + 2])

    left = at_every_write(lambda number: tmp_path / str(number), kind, work)
    assert len(left) > 12
    whole = tmp_path / "whole"
    work(whole)
    names = {path.relative_to(whole) for path in whole.rglob("*") if path.is_file()}
    for place in left:
        work(place)
        back = LeRobotDataset(place / "set")
        assert [episode.seed for episode in back] == [0, 1, 2, 3], place
        assert back.info["total_episodes"] == 4 and back.info["total_frames"] == 24
        # shards that were begun in vain leave a gap in the numbers of files, but no file
        found = {path.relative_to(place) for path in place.rglob("*") if path.is_file()}
        assert len(found) == len(names) and not [path for path in found if path.name.endswith(".part")]


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_is_the_old_one_or_the_new_one(kind: Literal["stop", "full"], tmp_path: Path) -> None:
    def tensors(value: float) -> dict[str, Any]:
        return {"module": {"w": torch.full((3,), value)}}

    def work(place: Path) -> None:
        for step in (1, 2):
            Checkpoints(place / "run").save(step, tensors(step), {"step": step})

    left = at_every_write(lambda number: tmp_path / str(number), kind, work)
    assert len(left) >= 8
    steps = []
    for place in left:
        held = tensors(0)
        facts = Checkpoints(place / "run").load(held) or {"step": 0}
        assert torch.equal(held["module"]["w"], torch.full((3,), float(facts["step"])))
        steps.append(facts["step"])
        Checkpoints(place / "run").save(3, tensors(3), {"step": 3})
        assert Checkpoints(place / "run").load(held) == {"step": 3}
        assert len(list((place / "run").iterdir())) == 1
    assert steps == sorted(steps) and set(steps) >= {0, 1}


@pytest.mark.parametrize("kind", KINDS)
def test_a_cache_is_whole_or_not_there(kind: Literal["stop", "full"], tmp_path: Path) -> None:
    data = tmp_path / "data"
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write([moving_square(ARM_DELTAS, 1, length=6)])
    spec = world_spec(ARM_DELTAS)

    def work(place: Path) -> ClipStore:
        return ClipStore([data], spec, cache=place / "cache")

    left = at_every_write(lambda number: tmp_path / str(number), kind, work)
    assert len(left) > 4
    wanted = work(tmp_path / "whole")
    for place in left:
        found = work(place)
        rows = torch.arange(len(found.arrays["commands"]))
        assert torch.equal(found.frames(rows), wanted.frames(rows))


def test_faults_count_what_python_writes_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with faulty(Fault(tmp_path / "in", 1, "full")) as fault:
        (tmp_path / "elsewhere").write_text("fine")
        (tmp_path / "in/one").write_text("fine")
        assert (tmp_path / "in/one").read_text() == "fine" and not fault.tripped
        with pytest.raises(OSError, match="No space"):
            (tmp_path / "in/two").write_text("no")
        (tmp_path / "in/one").unlink()  # a full disk lets files go
    (tmp_path / "in/two").write_text("room again")
    with faulty(Fault(tmp_path / "in", 0, "stop")), pytest.raises(Stopped):
        (tmp_path / "in/two").unlink()


@pytest.mark.long
def test_a_disk_that_is_really_full_is_told_and_work_goes_on_when_there_is_room(tmp_path: Path) -> None:
    own = ["unshare", "--map-root-user", "--mount"]
    if not shutil.which("unshare") or subprocess.run([*own, "true"], capture_output=True).returncode:
        pytest.skip("no small disk can be mounted here (unshare --map-root-user --mount)")
    done = subprocess.run(
        [*own, sys.executable, "-m", "tests.pipeline.chaos.full_disk", str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).resolve().parents[3],
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout.split()[0]) >= 10, done.stdout
