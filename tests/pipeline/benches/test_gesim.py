"""The bench of GE-Sim, at a size that says nothing but that it runs, and that it finds all the parts."""

from __future__ import annotations

import pytest

from pipeline.benches.gesim import chunk as bench
from pipeline.benches.gesim.floor import goal_line
from pipeline.config import load_config
from tests.envs.simulators.gesim_tiny import NET, SPEC, VAE

PARTS = {
    *("memory encoded", "conditioning", "prompt read", "noise", "trunk", "chunk decoded", "state expert"),
    "bookkeeping",
}


@pytest.mark.long
def test_the_bench_times_chunks_their_parts_and_single_changes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, tiny in (("SMALL", SPEC), ("SMALL_NET", NET), ("SMALL_VAE", VAE)):
        monkeypatch.setattr(bench, name, tiny)
    monkeypatch.setenv("PATH", "")  # no compiler: compiling takes longer than all else
    bench.gesim(load_config(["simulator=gesim", "launch.device=cpu"]))
    first, *said = capsys.readouterr().out.splitlines()
    assert first.endswith(" parameters, 3 x 32 x 48, 5 frames, CPU")
    assert [line.partition(":")[0] for line in said[:4]] == [f"batch {count}" for count in (1, 2, 4, 8)]
    parts = [part.rpartition(" ") for part in said[4].partition(": ")[2].split(", ")]
    shares = {name: int(share.rstrip("%")) for name, _, share in parts}
    assert set(shares) == PARTS
    assert min(shares.values()) >= 0 and sum(shares.values()) == pytest.approx(100, abs=len(PARTS) / 2)
    changes = [line.partition(":")[0].strip() for line in said[6:8]]
    assert changes == [
        "the text's keys computed anew for every view, block and step",
        "views encoded and decoded one after another",
    ]
    assert "torch.compile was not tried" in said[8]
    assert [line.partition(":")[0].strip() for line in said[10:12]] == ["all weights", "adapters of rank 16"]
    assert said[-1] == goal_line(bench.FULL, "CPU")
