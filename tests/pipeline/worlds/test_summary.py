"""A simulator on one page: what is there is joined, what is not is called unmeasured."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from envs.embodiment import Embodiment
from envs.manifest import write_manifest
from envs.simulators.stepwise import Stepwise
from envs.targets import ConfigError
from pipeline.cli.runs import evaluate
from pipeline.commands.worlds.ewmbench import ewmbench
from pipeline.commands.worlds.fidelity import fidelity
from pipeline.commands.worlds.policy_value import policy_value
from pipeline.commands.worlds.subject import Subject, pages_of
from pipeline.commands.worlds.summary import summary
from pipeline.config import load_config
from pipeline.evaluation.fidelity.grid import with_settings
from pipeline.loop import build_loop
from tests.embodiments import ARM_DELTAS
from tests.worlds import scripted_set, untrained_world, written


def test_what_was_measured_stands_on_one_page(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    root = tmp_path / "run"
    with pytest.raises(ConfigError, match=r"nothing was measured .* first `worldloop fidelity`"):
        summary(load_config(["experiment=smoke"]), root)
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "fidelity.episodes=2"]
    words += ["fidelity.long={frames: 8, episodes: 1, noise_level: 1.0}", "ewmbench.samples=1"]
    words += ["ewmbench.episodes=1", "ewmbench.videos=0"]
    words += ["policy_value={repeats: 1, starts: 2, noise: [0.5]}"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]"]
    fidelity(load_config(words), root)
    alone = summary(load_config(words), root)
    found = json.loads(written(root, "fidelity.json").read_text())
    psnr, still = found["overall"]["psnr"], found["held"]["first frame held"]["psnr"]
    assert f"| PSNR dB ↑ | {psnr:.2f} |  | {still:.2f} |" in alone and "| arm MSE ↓ | unmeasured |" in alone
    assert "| object off where it is found, cm ↓ | unmeasured |" in alone
    assert "| object lost ↓ | unmeasured |" in alone
    assert "| **Policies** | unmeasured; worldloop policy-value |" in alone
    ewmbench(load_config(words), root)
    policy_value(load_config(words), root)
    whole = summary(load_config(words), root)
    assert "worldloop policy-value" not in whole and "| Pearson ↑ | unmeasured |" in whole  # no physics
    assert re.search(r"\| scene ↑ \| 0\.\d+ \| \d\.\d+ \| \d\.\d+ \|", whole)
    page = written(root, "summary.html").read_text()
    assert "1 held-out episodes, one sample of each; features by" in page
    assert page.count("<table>") == 3 and not re.findall(r'(?:src|href)=(?!"#)', page)
    bf16 = load_config(words)["simulator"]["bf16"]
    fidelity(load_config([*words, f"simulator.bf16={not bf16}"]), root)
    other = summary(load_config(words), root)
    assert (
        "| PSNR dB" in other and "| scene ↑" not in other and other.count("the same weights with other") == 2
    )
    fidelity(load_config(words), root)
    assert "with other options" not in summary(load_config(words), root)
    first = json.loads(written(root, "fidelity.json").read_text())
    weights = Path(first["weights"]["simulator"])
    save_file({name: value * 2 for name, value in load_file(weights).items()}, weights)  # trained anew
    for folder in (root / "simulators").iterdir():  # as if it had one name still
        folder.rename(pages_of(root, build_loop(load_config(words), root), load_config(words)["imagined"]))
    ewmbench(load_config(words), root)
    newer = summary(load_config(words), root)
    mark = first["marks"]["simulator"]
    assert re.search(r"\| scene ↑ \| \d\.\d+ \|", newer) and "| PSNR dB" not in newer
    assert (
        f"unmeasured; worldloop fidelity; What fidelity.json says is of other weights: {weights}, {mark}."
        in newer
    )
    assert "fidelity.json says is of other weights" in written(root, "summary.html").read_text()


@pytest.mark.long
def test_a_teacher_and_its_student_are_each_sampled_as_they_were_made(tmp_path: Path) -> None:
    root, few = tmp_path / "run", ["simulator=dit_small", "simulator.denoising.steps=4", "distill.steps=2"]
    words = ["experiment=soak", "track=disabled", "launch.workers=1", *few]
    cfg = load_config(words)
    data = scripted_set(cfg, tmp_path / "set", 1)
    words += [*untrained_world(cfg, tmp_path)[1:], f"imagined.data=[{data}]"]
    graph, made = build_loop(cfg, root), load_file(tmp_path / "simulator/weights.safetensors")
    for name in ("simulator-1", "student-1"):  # untrained ones in their place
        folder = graph.folder(name)
        folder.mkdir(parents=True)
        save_file(made, folder / "weights.safetensors")
        write_manifest(folder, {"stage": name, "key": graph.key(name), "result": {"evaluations": 2}})
    samplers, pages = {}, {}
    for name in ("simulator-1", "student-1"):
        subject = Subject.of(load_config([*words, f"imagined.simulator={name}"]), root)
        simulator = subject.simulator()
        assert isinstance(simulator, Stepwise)
        samplers[name], pages[name] = simulator.sampler, subject.pages
        told = "DiTSimulator, a student of 2 evaluations" if name == "student-1" else "DiTSimulator"
        assert subject.about()["simulator"] == told
        grid = subject.simulator(with_settings(subject.cfg, {"simulator.denoising.shift": 2.0}))
        assert isinstance(grid, Stepwise) and grid.sampler.jumps == simulator.sampler.jumps
    assert not samplers["simulator-1"].jumps and samplers["simulator-1"].evaluations == 4
    assert samplers["student-1"].jumps and samplers["student-1"].evaluations == 2
    assert pages == {name: root / "simulators" / name for name in pages}
    alone = [word for word in words if not word.startswith("distill")]
    for steps in (0, 1):  # at levels that it has not learned it is not that student
        other = [*alone, f"distill.steps={steps}", f"imagined.simulator={graph.folder('student-1')}"]
        with pytest.raises(
            ConfigError, match=rf"student of 2 .*distill\.steps={steps} .*say distill\.steps=2"
        ):
            Subject.of(load_config(other), root)


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
    assert written(tmp_path / "smoke", "summary.html").is_file()
    with pytest.raises(ConfigError, match=r"simulator=simulator-9 is no stage, .* did you mean simulator-"):
        evaluate([*words, "simulator=simulator-9"])
    with pytest.raises(ConfigError, match="is measured by itself: leave out policy="):
        evaluate([*words, "simulator=simulator-1", "policy=imitation"])
