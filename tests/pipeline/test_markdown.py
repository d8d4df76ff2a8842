"""Tables in Markdown."""

from __future__ import annotations

import pytest

from pipeline.markdown import markdown_table


def test_a_table_and_its_bars() -> None:
    assert markdown_table(["a", "b"], [["1", "x|y"], ["", "-"]]) == (
        "| a | b |\n| --- | --- |\n| 1 | x\\|y |\n|  | - |"
    )
    with pytest.raises(ValueError, match="1 cells"):
        markdown_table(["a", "b"], [["1"]])
