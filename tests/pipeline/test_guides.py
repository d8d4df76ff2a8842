"""Commands that guides show for swapping a class with its options are taken as they are written."""

from __future__ import annotations

import re
import shlex

import pytest
import yaml

from envs.targets import ConfigError
from pipeline.config import CONFIGS, load_config, read_config

DOCS = CONFIGS.parent / "docs"
GUIDES = ("own_judge", "tokens", "trust", "ewmbench")


def commands(guide: str) -> list[list[str]]:
    """Words of a guide's commands that name a class, with placeholders filled in."""
    blocks = re.findall(r"```bash\n(.*?)```", (DOCS / f"{guide}.md").read_text(), re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = [shlex.split(re.sub(r"<[^>]*>", "/weights", line)) for line in lines if "={_target_" in line]
    return [words[2:] for words in found]


def check(words: list[str]) -> None:
    """See that each mapping among the words is its section."""
    cfg = load_config(words)
    for word in (word for word in words if "={_target_" in word):
        key, _, value = word.partition("=")
        section = cfg
        for part in key.split("."):
            section = section[part]
        assert section == yaml.safe_load(value)


@pytest.mark.parametrize("guide", GUIDES)
def test_a_guides_class_replaces_the_section(guide: str) -> None:
    found = commands(guide)
    assert found
    for words in found:
        check(words)


def test_the_class_of_a_configs_comment_replaces_the_section() -> None:
    text = (CONFIGS / "judge/golden_goal_full.yaml").read_text()
    (word,) = re.findall(r"^# '(.*_target_.*)'$", text, re.MULTILINE)
    check(["judge=golden_goal_full", word])


def test_a_class_takes_the_place_of_all_old_options_and_later_words_count() -> None:
    decoding = (
        "judge.text_world.decoding={_target_: envs.simulators.tokens.decoding.Raster, temperature: 0.25}"
    )
    cfg = read_config(["judge=golden_goal", decoding, "judge.text_world.decoding.temperature=0.75"])
    found = cfg["judge"]["text_world"]["decoding"]
    assert found == {"_target_": "envs.simulators.tokens.decoding.Raster", "temperature": 0.75}
    with pytest.raises(ConfigError, match=r"judge\.metrik is not a key"):
        read_config(["judge=golden_goal", "judge.metrik={_target_: envs.judges.lpips.LPIPS}"])
