"""Our network computes what the public GE-Sim 2.0 network computes, and says what a fixture lacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from safetensors import safe_open
from safetensors.torch import save_file

from envs.simulators.gesim.fixture import FixtureError, verify


@pytest.fixture
def golden(shared: Path) -> Path:
    return shared / "golden/gesim_v2_tiny.safetensors"


def changed(
    golden: Path, to: Path, meta: dict[str, str] | None = None, drop: str = "", **config: Any
) -> Path:
    """A copy without some tensors and with another configuration."""
    with safe_open(str(golden), "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys() if not drop or not key.startswith(drop)}
        known = file.metadata()
    save_file(
        tensors, to, {**known, "config": json.dumps(json.loads(known["config"]) | config), **(meta or {})}
    )
    return to


def test_trunk_and_state_expert_equal_the_public_network(golden: Path) -> None:
    errors = verify(golden)
    assert errors.keys() == {"video", "fused_feature", "pose"} and max(errors.values()) < 1e-5


def test_the_frame_rate_and_the_mask_matter(golden: Path, tmp_path: Path) -> None:
    assert verify(changed(golden, tmp_path / "fps", {"fps": "10"}))["video"] > 1e-3
    assert verify(changed(golden, tmp_path / "mask", drop="in.pose_mask"))["pose"] > 1e-3


def test_damaged_and_foreign_fixtures_are_named(golden: Path, tmp_path: Path) -> None:
    (tmp_path / "cut").write_bytes(golden.read_bytes()[:-1000])
    with pytest.raises(FixtureError, match="cannot be read"):
        verify(tmp_path / "cut")
    with pytest.raises(FixtureError, match=r"lacks .*out\.pose"):
        verify(changed(golden, tmp_path / "less", drop="out.pose"))
    with pytest.raises(FixtureError, match=r"pose_blocks\.2"):
        verify(changed(golden, tmp_path / "block", drop="weights.pose_blocks.2"))
    with pytest.raises(FixtureError, match="extra_pos_embed_type"):
        verify(changed(golden, tmp_path / "pos", extra_pos_embed_type="learnable"))
    with pytest.raises(FixtureError, match="another network"):
        verify(changed(golden, tmp_path / "size", num_layers=5))
