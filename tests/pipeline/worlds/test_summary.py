"""A simulator on one page: what is there is joined, what is not is called unmeasured."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from envs.embodiment import Embodiment
from envs.targets import ConfigError
from pipeline.cli.runs import evaluate
from pipeline.commands.worlds.ewmbench import ewmbench
from pipeline.commands.worlds.fidelity import fidelity
from pipeline.commands.worlds.policy_value import policy_value
from pipeline.commands.worlds.summary import summary
from pipeline.config import load_config
from tests.embodiments import ARM_DELTAS
from tests.worlds import untrained_world


def test_what_was_measured_stands_on_one_page(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    root = tmp_path / "run"
    with pytest.raises(ConfigError, match=r"nothing was measured .* first `worldloop fidelity`"):
        summary(root)
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "fidelity.episodes=2"]
    words += ["fidelity.long={frames: 8, episodes: 1, noise_level: 1.0}", "ewmbench.samples=1"]
    words += ["ewmbench.episodes=1", "ewmbench.videos=0"]
    words += ["policy_value={repeats: 1, starts: 2, noise: [0.5]}"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]"]
    fidelity(load_config(words), root)
    alone = summary(root)
    psnr = json.loads((root / "fidelity.json").read_text())["overall"]["psnr"]
    assert f"| PSNR dB ↑ | {psnr:.2f} |" in alone and "| arm MSE ↓ | unmeasured |" in alone
    assert "| object off where it is found, cm ↓ | unmeasured |" in alone
    assert "| object lost ↓ | unmeasured |" in alone
    assert "| **Policies** | unmeasured; worldloop policy-value |" in alone
    ewmbench(load_config(words), root)
    policy_value(load_config(words), root)
    whole = summary(root)
    assert "worldloop policy-value" not in whole and "| Pearson ↑ | unmeasured |" in whole  # no physics
    assert re.search(r"\| scene ↑ \| 0\.\d+ \| \d\.\d+ \| \d\.\d+ \|", whole)
    page = (root / "summary.html").read_text()
    assert "1 held-out episodes, one sample of each; features by" in page
    assert page.count("<table>") == 3 and not re.findall(r'(?:src|href)=(?!"#)', page)
    other = json.loads((root / "ewmbench.json").read_text())
    weights = Path(other["weights"]["simulator"])
    save_file({name: value * 2 for name, value in load_file(weights).items()}, weights)  # trained anew
    ewmbench(load_config(words), root)
    with pytest.raises(ConfigError, match=rf"fidelity: {weights}, \w+; ewmbench: {weights}, \w+;"):
        summary(root)
    other["weights"]["simulator"] = "elsewhere"
    (root / "ewmbench.json").write_text(json.dumps(other))
    with pytest.raises(ConfigError, match=r"different weights were measured .*ewmbench: elsewhere"):
        summary(root)


def test_a_simulator_is_evaluated_by_one_command(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += [
        "task.size=[32,32]",
        "task.chunk=4",
        "task.horizon=8",
        "fidelity.episodes=2",
        f"runs={tmp_path}",
    ]
    words += ["fidelity={episodes: 2, long: {frames: 0}}", "ewmbench={samples: 1, episodes: 1, videos: 0}"]
    words += untrained_world(load_config(words), tmp_path)[1:]
    evaluate([*words, f"simulator={tmp_path / 'simulator'}"])
    said = capsys.readouterr().out
    assert "fidelity.html" in said and "ewmbench.html" in said and "| PSNR dB" in said
    assert (tmp_path / "smoke/summary.html").is_file()
    with pytest.raises(ConfigError, match=r"simulator=simulator-9 is no stage, .* did you mean simulator-"):
        evaluate([*words, "simulator=simulator-9"])
    with pytest.raises(ConfigError, match="is measured by itself: leave out policy="):
        evaluate([*words, "simulator=simulator-1", "policy=imitation"])
