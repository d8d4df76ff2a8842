"""worldloop ewmbench: is the scene kept, do grippers move as they should, and what does the video tell, under
the recorded actions of held-out episodes (EWMBench, Genie Envisioner, section 6).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from actors.factory import build_judge
from actors.process import device_of
from envs.embodiment import EmbodimentError
from envs.episodes.clips import ClipStore
from envs.files import write_json, write_text
from envs.judges.vlm import VLMJudge
from envs.targets import ConfigError, build, target
from pipeline.commands.worlds.subject import Subject
from pipeline.evaluation.by_task import groups_of_episodes
from pipeline.evaluation.ewmbench.choose import BenchSet, Paths, choose, in_pictures, in_space
from pipeline.evaluation.ewmbench.features import PatchExtractor, TextExtractor
from pipeline.evaluation.ewmbench.measure import Instruments
from pipeline.evaluation.ewmbench.page import build_page, summary_text
from pipeline.evaluation.ewmbench.records import Record, Records
from pipeline.evaluation.ewmbench.result import Scoring, alike, by_task, overall, scene_by_frame
from pipeline.evaluation.ewmbench.samples import Samples, without_picture
from pipeline.evaluation.ewmbench.semantics import Reader
from pipeline.evaluation.fidelity.extractors import Extractor
from pipeline.evaluation.grippers.ruler import GripperRuler, gripper_ruler, known_ends, looked_through
from pipeline.evaluation.judging import cost_text
from pipeline.graph.code_version import code_of, json_digest
from pipeline.stages.judging.cost import COST, Spending

_MODULE = "pipeline.evaluation.ewmbench.samples"
_SHORTEST = 4  # pictures of an episode: the first is given, and accelerations need three
NO_MODEL = (
    "No semantics (BLEU, steps, logic): no vision-language model is configured; say judge=vlm or"
    " judge=vlm_local, as docs/own_judge.md tells."
)
PARITY = (
    "Strict parity: figures repeat quirks of the public code (the given first frame counts; one arm alone, by"
    " a faulty measure of travel; pictures' width and height both 1; nothing for a perfect match of"
    " dynamics). It averages over all samples: compare it with the row of means. What differs still is told"
    " by docs/ewmbench.md."
)
ALIKE = (
    "All samples of each episode came out alike: this simulator draws nothing, so the best of them is any,"
    " and there is no diversity."
)


@dataclass(frozen=True)
class Extractors:
    """The named extractors of section ewmbench."""

    patches: PatchExtractor
    frames: Extractor
    texts: TextExtractor

    @classmethod
    def of(cls, section: Mapping[str, Any]) -> Extractors:
        """Those of the section.

        Raises:
            ConfigError: for weights of another architecture, or an extractor of another kind.
        """
        kinds = {"patches": PatchExtractor, "frames": Extractor, "texts": TextExtractor}
        found = {name: build(section[name], f"ewmbench.{name}") for name in kinds}
        for name, kind in kinds.items():
            if not isinstance(found[name], kind) or getattr(found[name], "clips", False):
                raise ConfigError(
                    f"ewmbench.{name}._target_={section[name]['_target_']} should be a {kind.__name__}"
                    f"{' of single frames' if kind is Extractor else ''} ({kind.__module__})"
                )
        return cls(**found)

    @property
    def names(self) -> dict[str, str]:
        """What each is called."""
        return {name: part.name for name, part in vars(self).items()}


def ewmbench(cfg: Mapping[str, Any], root: Path) -> str:
    """Measure; writes ewmbench.json and ewmbench.html into the simulator's folder (see pages_of), and keeps
    what it measures under ewmbench/ in the run's.

    Returns:
        The figures, as Markdown, and where they lie.

    Raises:
        ConfigError: if what is named is not there or cannot work.
        JudgeError: if the vision-language model cannot be asked any more; the same command goes on.
    """
    section = cfg["ewmbench"]
    # what cannot work is told before anything is measured
    extractors, subject = Extractors.of(section), Subject.of(cfg, root)
    for looking in (extractors.patches, extractors.frames):
        looking.compute_on(device_of(cfg))
    cfg = subject.cfg
    reader = reader_of(cfg)
    notes: list[str] = []
    store = subject.store()
    held = subject.held_out(store)
    held = held[store.pictures(held) >= _SHORTEST]
    if not len(held):
        raise ConfigError(f"no held-out episode has {_SHORTEST} pictures; name others by imagined.data")
    ruler: GripperRuler | None = None
    try:
        ruler = gripper_ruler(cfg, store, subject.data, root)
    except EmbodimentError as error:
        notes.append(f"No trajectories (SA, TA, DYN): {error}.")
    tasks = groups_of_episodes(cfg, store, held)
    chosen = bench_set(cfg, store, held, tasks, ruler)
    instruments = Instruments(
        extractors.patches,
        extractors.frames,
        looked_through(cfg, store),
        None if ruler is None else ruler.detector,
        () if ruler is None else ruler.views,
        reader,
        section["strict_parity"],
    )
    looked = _identity(section, subject, store, instruments, ruler)
    world = {**looked, **subject.generated(_MODULE)}
    samples = Samples(
        subject.simulator(),
        store,
        instruments,
        Records(root / "ewmbench/samples", world),
        Records(root / "ewmbench/recorded", looked),
        root / "ewmbench/videos",
        cfg["simulator"]["bf16"],
        set(chosen.episodes[: section["videos"]].tolist()),
    )
    # by world and model: others have paid their own
    with Spending(cfg["judge"], root / "ewmbench" / f"{json_digest(world)}-{COST}") as spending:
        true, made = measured(samples, chosen.episodes, section["samples"])
        cost = {} if reader is None else spending.total
    scoring = Scoring(
        store.spec.size,
        section["strict_parity"],
        extractors.texts,
        () if reader is None else reader.errors,
    )
    task_of = dict(zip(held.tolist(), tasks, strict=True))
    rows = [
        {
            "episode": number,
            "task": task_of[number],
            "instruction": store.instructions[number],
            **scoring.episode(made[number], true[number], store.instructions[number]),
        }
        for number in chosen.episodes.tolist()
    ]
    whole = overall(rows)
    notes += [NO_MODEL] * (reader is None)
    if section["strict_parity"]:
        notes.append(PARITY)
        by_frame = whole["mean"]["scene_by_frame"] = scene_by_frame([made[row["episode"]] for row in rows])
        if by_frame is not None:
            notes.append(f"Scene as a mean over all frames of all samples, not over videos: {by_frame:.3f}.")
    notes += without_picture(store, chosen.episodes)
    if reader is not None and (lost := sum(not one.whole for one in _records(true, made))):
        notes.append(f"Of {lost} videos the model answered not everything; what is missing counts nowhere.")
    if section["samples"] > 1 and alike([made[row["episode"]] for row in rows]):
        notes.append(ALIKE)
    if cost:
        notes.append(f"Asking the model: {cost_text(cost)}.")
    result = {
        **subject.about(),
        "judge_cost": cost,
        "task": cfg["task"]["name"],
        "size": list(store.spec.size),
        "fps": store.fps,
        "samples": section["samples"],
        "strict_parity": section["strict_parity"],
        "extractors": extractors.names,
        "detector": None
        if ruler is None
        else {"source": ruler.source, "weights": str(ruler.weights), "cameras": ruler.error(held)},
        "set": {**asdict(chosen), "episodes": chosen.episodes.tolist()},
        "overall": whole,
        "tasks": by_task(rows),
        "rows": rows,
        "notes": notes,
    }
    page = subject.pages / "ewmbench.html"
    write_json(page.with_suffix(".json"), result)
    films = {row["episode"]: samples.film(row["episode"], row["best"]) for row in rows}
    write_text(page, build_page(result, films))
    reused = f"{samples.made.reused} samples were reused"
    return f"{summary_text(result)}\n{page}, {page.with_suffix('.json')}\n{reused}"


def reader_of(cfg: Mapping[str, Any]) -> Reader | None:
    """What asks the judge's vision-language model; None if the judge is none."""
    kind = target(cfg["judge"], "judge")
    if not (isinstance(kind, type) and issubclass(kind, VLMJudge)):
        return None
    judge = build_judge(cfg)
    assert isinstance(judge, VLMJudge)
    return Reader.of(judge, cfg["ewmbench"]["prompts"])


def bench_set(
    cfg: Mapping[str, Any], store: ClipStore, held: Tensor, tasks: Sequence[str], ruler: GripperRuler | None
) -> BenchSet:
    """The set out of held-out episodes int64 [N] of `tasks`, by paths in space, else in pictures, else by
    none.
    """
    section = cfg["ewmbench"]
    paths: Paths | None
    try:
        paths = in_space(store, known_ends(cfg, store), held)
    except EmbodimentError:
        paths = None if ruler is None else in_pictures(store, ruler, held)
    return choose(held, tasks, section["episodes"], section["voxel"], paths)


def _identity(
    section: Mapping[str, Any],
    subject: Subject,
    store: ClipStore,
    instruments: Instruments,
    ruler: GripperRuler | None,
) -> dict[str, Any]:
    """What measurements of recorded videos depend on."""
    return {
        "data": subject.data_mark(),
        "size": list(store.spec.size),
        "extractors": [instruments.patches.name, instruments.frames.name, list(instruments.views)],
        "detector": None if ruler is None else ruler.identity,
        "reader": None if instruments.reader is None else instruments.reader.identity,
        "strict_parity": instruments.strict_parity,
        "code": code_of(_MODULE, {name: section[name] for name in ("patches", "frames")}),
    }


def measured(
    samples: Samples, episodes: Tensor, count: int
) -> tuple[dict[int, Record], dict[int, list[Record]]]:
    """Records of the recordings, and of `count` samples each, of episodes int64 [N], by number."""
    total = len(episodes) * (1 + count)
    with tqdm(total=total, desc="ewmbench", unit="video", dynamic_ncols=True) as bar:
        true = samples.recorded(episodes, bar.update)
        drawn = [samples.generated(episodes, draw, true, bar.update) for draw in range(count)]
    return true, {number: [some[number] for some in drawn] for number in true}


def _records(true: Mapping[int, Record], made: Mapping[int, list[Record]]) -> list[Record]:
    return [*true.values(), *(record for some in made.values() for record in some)]
