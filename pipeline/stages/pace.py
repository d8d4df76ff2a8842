"""Training for equal time: how fast the parts of a world learn is measured once, and kept as an artefact, so
that a stage that is resumed or run again takes the steps that it took.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from actors.factory import build_simulator, build_state_decoder
from actors.process import prepare_process
from envs.manifest import read_manifest
from envs.targets import options
from learners.stages.simulator import SimulatorFitConfig, train_simulator
from learners.stages.state import StatePace, train_state
from learners.stages.tokenizer import train_tokenizer
from learners.training.fit import FitConfig
from learners.training.parallel import leads
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import SIMULATOR, Cfg, fit_options, learning_episodes, learns, open_store

Train = Callable[[FitConfig, Path], Mapping[str, Any]]
_FITS = ("tokenizer_fit", "simulator_fit.first", "state_fit.first")


def seconds_of(cfg: Cfg, part: str, phase: str) -> dict[str, float]:
    """The setting `seconds` of a node that trains the part tokenizer, simulator or state; {} where steps
    count.
    """
    section = cfg["equal_time"]
    if not section["seconds"]:
        return {}
    whole = section["seconds"] * (section["refresh"] if phase == "refresh" else 1.0)
    shares = {"tokenizer": section["tokenizer"], "state": section["state"]}
    if "codec" not in cfg["simulator"] or phase == "refresh":  # a tokenizer stays as it was first trained
        del shares["tokenizer"]
    share = shares.get(part, 1.0 - sum(shares.values()))
    return {"seconds": whole * share}


def in_time(inputs: Inputs, part: str, fit: FitConfig) -> FitConfig:
    """`fit` of a tokenizer or simulator with as many steps as take the setting `seconds` at the speed that
    the role `pace` has measured; as it is where steps count.
    """
    speed = _measured(inputs).get(f"{part}_speed")
    if speed is None:  # of what learns nothing
        return fit
    return replace(fit, steps=max(1, round(inputs.settings["seconds"] * speed / fit.batch)))


def state_in_time(inputs: Inputs, fit: FitConfig, clips: int) -> tuple[FitConfig, int]:
    """The same of a state expert, with the most clips whose features are kept."""
    found = _measured(inputs)
    if "state_sample_seconds" not in found:
        return fit, clips
    cost = StatePace(**{one.name: found[f"state_{one.name}"] for one in fields(StatePace)})
    steps, clips = cost.within(inputs.settings["seconds"], fit, clips)
    return replace(fit, steps=steps), clips


def _measured(inputs: Inputs) -> dict[str, Any]:
    """What the role `pace` has measured; {} where nobody plays it, and steps count."""
    if "pace" not in inputs.found:
        return {}
    manifest = read_manifest(inputs.folder("pace"))
    assert manifest is not None, "a role is played by finished stages"
    return dict(manifest["result"])


def fits_of(cfg: Cfg) -> dict[str, FitConfig]:
    """How tokenizer, simulator and state expert of a first world learn."""
    sections = {
        "tokenizer": (cfg["tokenizer_fit"], "tokenizer_fit"),
        "simulator": (cfg["simulator_fit"]["first"]["fit"], "simulator_fit.first.fit"),
        "state": (cfg["state_fit"]["first"]["fit"], "state_fit.first.fit"),
    }
    return {part: fit_options(cfg, *section) for part, section in sections.items()}


@stage(reads=(*SIMULATOR, *_FITS, "equal_time.measured"), place=Place.LEARNERS)
def pace(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Samples per second in which a world's tokenizer and simulator learn, and what its state expert costs
    (see StatePace), each for a few steps on parts that are thrown away; of those that learn.

    The same steps are taken twice and the second time counts: the first fills caches, and compiles what
    `launch.compile` asks for. That takes as long as thousands of steps, and clips that unroll, which come
    last, are compiled anew.
    """
    store, trial = open_store(cfg, inputs), folder / "trial"
    episodes = learning_episodes(store)
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg)
    decoder = build_state_decoder(cfg, model)
    first = {key: value for key, value in cfg["simulator_fit"]["first"].items() if key != "fit"}
    how = options(SimulatorFitConfig, first, "simulator_fit.first")
    common = (store, episodes)
    trained: dict[str, Train] = {
        "tokenizer": lambda fit, where: train_tokenizer(model, *common, fit, where),
        "simulator": lambda fit, where: train_simulator(model, *common, how, fit, where),
        "state": lambda fit, where: train_state(decoder, model, *common, fit, where),
    }
    present = {
        "tokenizer": "codec" in cfg["simulator"],
        "simulator": learns(model),
        "state": learns(decoder),
    }
    fits, out = fits_of(cfg), dict[str, float]()
    for part, train in trained.items():
        if not present[part]:
            continue
        fit = replace(fits[part], steps=cfg["equal_time"]["measured"])
        train(fit, trial / f"{part}-warm-up")
        spent = train(fit, trial / part)
        if part == "state":
            out |= {f"state_{key}": value for key, value in asdict(StatePace.of(fit, spent)).items()}
        else:
            out[f"{part}_speed"] = fit.steps * fit.batch / (spent["data_seconds"] + spent["compute_seconds"])
    if leads():
        shutil.rmtree(trial)
    return out
