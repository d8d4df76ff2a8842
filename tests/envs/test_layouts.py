"""Layouts are types, and long chunks are compressed as GE-Sim does it."""

from __future__ import annotations

import pytest
import torch

from envs.layouts import CommandLayout, JointLayout, Joints, compress


def test_layouts_turn_into_each_other_and_are_never_confused() -> None:
    state = torch.arange(16.0)
    last = Joints(state, JointLayout.PER_ARM).to(JointLayout.GRIPPERS_LAST)
    assert last.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 7, 15]
    assert torch.equal(Joints(last, JointLayout.GRIPPERS_LAST).to(JointLayout.PER_ARM), state)
    assert Joints(state, JointLayout.PER_ARM).to(JointLayout.PER_ARM) is state
    with pytest.raises(ValueError, match="16 numbers"):
        Joints(torch.zeros(14), JointLayout.PER_ARM)


def test_compression_keeps_ends_averages_the_middle_and_samples_grippers() -> None:
    rows = torch.arange(50.0)[:, None].repeat(1, 16)
    rows[25:, 7] = 1.0
    rows[:25, 7] = 0.0
    short = compress(rows, 25, CommandLayout.JOINTS)
    assert short.shape == (25, 16) and short[0, 0] == 0 and short[-1, 0] == 49
    assert set(short[:, 7].tolist()) == {0.0, 1.0} and short[0, 15] == 0 and short[-1, 15] == 49
    assert short[1, 0] == 2.0 and (short[1:, 0] > short[:-1, 0]).all()
    assert torch.equal(compress(rows[:25], 25, CommandLayout.JOINTS), rows[:25])
    assert compress(rows[None, :, :14], 10, CommandLayout.EEF).shape == (1, 10, 14)
    with pytest.raises(ValueError, match="cannot be compressed"):
        compress(rows[:20], 25, CommandLayout.JOINTS)
    with pytest.raises(ValueError, match="14 numbers a row"):
        compress(rows, 25, CommandLayout.EEF)
