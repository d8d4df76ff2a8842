"""worldloop fidelity: a simulator's video against the truth, under the recorded actions of held-out
episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from actors.process import device_of
from envs.episodes.clips import ClipStore
from envs.files import write_json, write_text
from envs.targets import ConfigError, build
from pipeline.commands.worlds.subject import Subject
from pipeline.evaluation.fidelity.end_effector import end_effector_ruler
from pipeline.evaluation.fidelity.extractors import Extractor
from pipeline.evaluation.fidelity.grid import Settings, combinations, run_grid, with_settings
from pipeline.evaluation.fidelity.long import drift, long_episodes, longest
from pipeline.evaluation.fidelity.masks import part_labels, read_labels
from pipeline.evaluation.fidelity.open_loop import OpenLoop
from pipeline.evaluation.fidelity.page import build_page, summary_text
from pipeline.evaluation.fidelity.strides import by_stride, common_stride
from pipeline.evaluation.fidelity.verdicts import verdict_tables
from pipeline.evaluation.measurement import evenly, groups, speed
from pipeline.graph.code_version import code_of
from pipeline.graph.kept import Kept, Tensors
from pipeline.loop import has_physics

Cfg = Mapping[str, Any]
_MODULE = "pipeline.evaluation.fidelity.open_loop"


def fidelity(cfg: Cfg, root: Path) -> str:
    """Measure; writes fidelity.json and fidelity.html into the simulator's folder (see pages_of).

    Returns:
        The figures, as Markdown, and where they lie.

    Raises:
        ConfigError: if what is named is not there or cannot work.
        JudgeError: if there are strides, and the judge cannot be asked any more; the same command goes on.
    """
    section, subject = cfg["fidelity"], Subject.of(cfg, root)
    cfg = subject.cfg
    # what cannot work is told before anything is measured
    tried = {} if section["grid"] is None else section["grid"]
    settled = [with_settings(cfg, settings) for settings in combinations(tried)] if tried else []
    extractors = build_extractors(section)
    for extractor in extractors:
        extractor.compute_on(device_of(cfg))
    for other in settled:  # options that change what the weights are of are refused here
        subject.simulator(other)
    store = subject.store()
    episodes = evenly(subject.held_out(store), section["episodes"])
    strides = _checked_strides(section["strides"], store, episodes)
    simulator = subject.simulator()
    kept = Kept(root / "fidelity")
    loop = OpenLoop(
        *(store, episodes, cfg["simulator"]["bf16"], _labels(cfg, subject, store, kept), extractors),
        clip=section["clip"],
        kept=kept,
        identity={**subject.generated(_MODULE), "by": code_of(_MODULE, _extractor_sections(section))},
    )
    masked = _masked(loop)
    loop = replace(
        loop,
        labels=loop.labels if masked else None,
        hands=end_effector_ruler(cfg, store, subject.data, root),
    )
    place = {int(number): n for n, number in enumerate(episodes)}
    mine = {
        name: torch.tensor([place[n] for n in some.tolist()])
        for name, some in groups(store, episodes).items()
    }
    measured = loop.measure(simulator).result(store.spec.embodiment.views, mine)
    still, coded = loop.held_still(), loop.held_coded(simulator)
    result: dict[str, Any] = {
        **subject.about(),
        "task": cfg["task"]["name"],
        "size": list(store.spec.size),
        "fps": store.fps,
        "perceptual": loop.distance.name,
        **measured,
        "masks": {"source": (section["masks"] or "physics") if masked else None, "episodes": masked},
        "still": still.by_frame,
        "still_coded": None if coded is None else coded.by_frame,
        "held": {
            "first frame held": still.overall,
            **({} if coded is None else {"the same through the autoencoder": coded.overall}),
        },
        "frames_per_second": {f"batch {n}": speed(simulator, store, n, 1, loop.bf16) for n in (1, 32)},
        "long": _long(cfg, root, subject, store, loop) if section["long"]["frames"] else None,
        "strides": None,
        "grid": None,
    }
    alone = replace(loop, extractors=(), hands="nobody asked")
    if strides != [1]:
        result["strides"] = by_stride(_with_judge(subject, alone), simulator, strides)
    if settled:
        result["grid"] = _grid(cfg, subject, alone, tried, len(settled))
    page = subject.pages / "fidelity.html"
    write_json(page.with_suffix(".json"), result)
    write_text(page, build_page(result))
    return f"{summary_text(result)}\n{page}, {page.with_suffix('.json')}\n{kept.reused} parts were reused"


def _labels(cfg: Cfg, subject: Subject, store: ClipStore, kept: Kept) -> Callable[[Tensor], Tensor] | None:
    """See OpenLoop; what physics says is kept, for it says the same of every simulator."""
    masks = cfg["fidelity"]["masks"]
    if masks is not None:
        return partial(read_labels, Path(masks), store)
    if not has_physics(cfg):
        return None
    suite = {"suite": cfg["task"]["suite"]}
    code = code_of(part_labels.__module__, suite)
    about = {"data": subject.data_mark(), "size": list(store.spec.size), **suite, "code": code}

    def told(episodes: Tensor) -> Tensor:
        def asked() -> Tensors:
            return {"labels": part_labels(cfg, store, episodes)}

        identity = {**about, "episodes": episodes.tolist()}
        return kept.get(f"labels-{int(episodes[0])}", identity, asked)["labels"]

    return told


def _masked(loop: OpenLoop) -> int:
    """Of how many episodes there are masks; what is wrong with a file of them is told here."""
    if loop.labels is None:
        return 0
    parts = (loop.labels(loop.episodes[some]) for some in loop.batches())
    return sum(int((labels != 255).flatten(1).any(1).sum()) for labels in parts)


def build_extractors(section: Mapping[str, Any]) -> list[Extractor]:
    """The extractors of a section fidelity, of frames and of clips.

    Raises:
        ConfigError: for weights of another architecture, an extractor of the other kind, or one whose clips
            are longer than fidelity.clip.
    """
    out = []
    for key, clips in (("frames_extractor", False), ("clips_extractor", True)):
        extractor = build(section[key], f"fidelity.{key}")
        if not isinstance(extractor, Extractor) or extractor.clips is not clips:
            raise ConfigError(
                f"fidelity.{key}._target_={section[key]['_target_']} should be an Extractor of"
                f" {'clips' if clips else 'single frames'} (pipeline/evaluation/fidelity/extractors.py)"
            )
        if clips and section["clip"] < extractor.shortest:
            raise ConfigError(
                f"fidelity.clip={section['clip']}: {extractor.name} takes clips of {extractor.shortest}"
                " frames or more; raise fidelity.clip, or choose another fidelity.clips_extractor"
            )
        out.append(extractor)
    return out


def _extractor_sections(section: Mapping[str, Any]) -> dict[str, Any]:
    return {key: section[key] for key in ("frames_extractor", "clips_extractor")}


def _checked_strides(strides: Sequence[int], store: ClipStore, episodes: Tensor) -> list[int]:
    """In rising order, each once.

    Raises:
        ConfigError: if no episode lasts until a frame that all of them show.
    """
    longest, common = int(store.length[episodes].max()) - 1, common_stride(strides)
    if common > longest:
        raise ConfigError(
            f"fidelity.strides={list(strides)} first show the same frame after {common}, and no episode has"
            f" more than {longest}; choose strides that divide each other"
        )
    return sorted(set(strides))


def _with_judge(subject: Subject, loop: OpenLoop) -> OpenLoop:
    """The same, with the subject's judge asked, if it can be."""
    if not subject.has_judge():
        return loop
    code = code_of(verdict_tables.__module__, subject.cfg["judge"])
    identity = {**loop.identity, "judge": subject.identity("judge"), "judged by": code}
    return replace(loop, judge=subject.judge(), identity=identity)


def _long(cfg: Cfg, root: Path, subject: Subject, store: ClipStore, loop: OpenLoop) -> dict[str, Any]:
    section, simulator = cfg["fidelity"]["long"], subject.simulator()
    if has_physics(cfg):
        store = long_episodes(cfg, root / "fidelity-long")
        episodes = torch.arange(len(store))
    else:
        episodes = longest(store, subject.held_out(store), section["episodes"])
    code = code_of(drift.__module__, cfg["simulator"])
    about = {**loop.identity, "long": dict(section), "episodes": episodes.tolist(), "code": code}
    if has_physics(cfg):  # which records them, whatever data are looked at
        about["physics"] = cfg["task"]

    def keep(places: list[int], make: Callable[[], Tensors]) -> Tensors:
        assert loop.kept is not None
        return loop.kept.get(f"long-{places[0]}", {**about, "places": places}, make)

    out = drift(simulator, store, episodes, cfg["simulator"]["bf16"], loop.distance, keep)
    return {"wanted": section["frames"], **out}


def _grid(cfg: Cfg, subject: Subject, loop: OpenLoop, tried: Mapping[str, Any], count: int) -> dict[str, Any]:
    with tqdm(total=count, desc="fidelity grid", unit="setting", dynamic_ncols=True) as bar:

        def measure(settings: Settings) -> Mapping[str, Any]:
            settled = with_settings(cfg, settings)
            simulator, bf16 = subject.simulator(settled), settled["simulator"]["bf16"]
            found = replace(loop, bf16=bf16).measure(simulator, {"settings": dict(settings)})
            overall = found.result(loop.store.spec.embodiment.views, {})["overall"]
            bar.update()
            return {**overall, "frames_per_second": speed(simulator, loop.store, 1, 1, bf16)}

        return run_grid(tried, measure)
