"""The imagined world that a command looks at: the run's last, or whatever the section `imagined` names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from actors.factory import build_judge, build_simulator, build_state_decoder, open_clips
from actors.weights import load
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.manifest import mark_of, read_manifest
from envs.simulators.base import Simulator
from envs.simulators.state_experts.base import StateDecoder
from envs.targets import ConfigError
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.result import result_of
from pipeline.graph.code_version import code_of, json_digest
from pipeline.graph.graph import Graph, decisive
from pipeline.graph.kept import Kept, Tensors
from pipeline.graph.stage import WEIGHTS, Inputs
from pipeline.loop import build_loop, has_physics
from pipeline.outside import CHECKPOINT, KINEMATICS, STATE_CHECKPOINT, files_at, fingerprint, judge_files
from pipeline.stages.given import datasets, learns

Cfg = Mapping[str, Any]
Keep = Callable[[str, Mapping[str, Any], Callable[[], Tensors]], Tensors]

_RELEASED = {"simulator": CHECKPOINT, "state": STATE_CHECKPOINT}  # keys of the config, by role


@dataclass
class Subject:
    """What is looked at.

    Args:
        cfg: the resolved config.
        graph: of the run.
        weights: files of simulator, state and judge, by role; of released ones what the config names.
        released: those of simulator and state that are released as they are, which no stage has trained.
        data: data sets.
        student: function evaluations of a chunk, if the simulator is a few-step student; else 0.
        pages: folder of what is measured of it.
    """

    cfg: Cfg
    graph: Graph
    weights: Mapping[str, Path]
    released: frozenset[str]
    data: list[Path]
    student: int
    pages: Path

    @classmethod
    def of(cls, cfg: Cfg, root: Path) -> Subject:
        """That of a run, or a released one where the run has trained none; nothing is loaded yet.

        Raises:
            ConfigError: if what is named is not there.
        """
        graph, section = build_loop(cfg, root), cfg["imagined"]
        inputs = graph.inputs("evaluate-imagined")
        weights = {
            role: weights_at(graph, section[role], f"imagined.{role}")
            if section[role]
            else inputs.folder(role) / WEIGHTS
            for role in ("simulator", "state", "judge")
        }
        released = released_in(cfg, weights)
        weights |= released
        named = section["simulator"]
        made_as = stage_of(weights["simulator"]) if named else ""
        student = 0 if made_as == "simulator" or released else cfg["distill"]["steps"]
        learned = result_of(weights["simulator"].parent)["evaluations"] if made_as == "student" else student
        if student != learned:
            raise ConfigError(
                f"imagined.simulator={named} is a student of {learned} evaluations, and"
                f" distill.steps={student} would sample it in a way that it has not learned; say"
                f" distill.steps={learned}"
            )
        cfg = graph.cfg if student else cfg  # a teacher is sampled as one, whatever the run acts in
        if section["data"]:
            data = [Path(folder) for folder in section["data"]]
        elif has_physics(cfg):
            data = datasets(inputs.folders("data"))
        else:
            data = [Path(folder) for folder in cfg["task"]["data"]]
        missing = [str(folder) for folder in data if not (folder / "meta/info.json").is_file()]
        if missing:
            raise ConfigError(
                f"{missing[0]} is no LeRobot data set (yet); run the stages that record, or name data sets by"
                " imagined.data=[folder]"
            )
        pages = pages_of(root, graph, section)
        return cls(cfg, graph, weights, frozenset(released), data, student, pages)

    def store(self) -> ClipStore:
        """Its data sets."""
        return open_clips(self.cfg, self.data)

    def held_out(self, store: ClipStore) -> Tensor:
        """Numbers int64 [N] of the episodes of 2 frames or more that no part of the world has learned from.

        Raises:
            ConfigError: if there are none.
        """
        held = store.split("held_out")
        if not len(held):
            raise ConfigError(
                f"no episode of {[str(folder) for folder in self.data]} is held out; name other data sets by"
                " imagined.data=[folder], or say in meta/info.json of these which are, as in"
                ' "splits": {"train": "0:4", "held_out": "4:5"}'
            )
        if not len(held := followed(store, held)):
            raise ConfigError("no held-out episode has 2 frames or more; name others by imagined.data")
        return held

    def simulator(self, cfg: Cfg | None = None) -> Simulator:
        """The simulator, of another config than the subject's own if that is given."""
        return self._with_weights(build_simulator(cfg or self.cfg), "simulator").eval()

    def decoder(self, simulator: Simulator) -> StateDecoder:
        """The state expert on that simulator.

        Raises:
            ConfigError: if it is to be a released one, and the checkpoint has none, as of GE-Sim 1.
        """
        decoder = self._with_weights(build_state_decoder(self.cfg, simulator), "state").eval()
        if "state" in self.released and not decoder.normalised:
            raise ConfigError(
                f"{STATE_CHECKPOINT}={self.weights['state']} holds no state expert; train one by `worldloop"
                " finetune`, and name it by imagined.state=<folder>"
            )
        decoder.attach(simulator)
        return decoder

    def _with_weights(self, part: Any, role: str) -> Any:
        """A part with its weights; a released one has its own."""
        return part if role in self.released else _with_weights(part, self.weights[role])

    def generated(self, module: str) -> dict[str, Any]:
        """What videos that its simulator generates of recorded episodes depend on, beside which episodes and
        options that are tried.

        Args:
            module: that makes them, by name.
        """
        return {
            "world": self.identity("simulator"),
            "task": {key: self.cfg["task"][key] for key in ("size", "chunk", "horizon")},
            "data": self.data_mark(),
            "kinematics": files_at(self.cfg, KINEMATICS),
            "engine": code_of(module, self.cfg["simulator"]),
        }

    def data_mark(self) -> str:
        """Changes when its data sets do."""
        return fingerprint([str(folder) for folder in self.data], "imagined.data")

    def judge(self) -> Judge:
        """The judge."""
        return _with_weights(build_judge(self.cfg), self.weights["judge"]).eval()

    def has_judge(self) -> bool:
        """Whether its judge can be asked: it has learned, or learns nothing, such as a client of a server."""
        return self.weights["judge"].is_file() or not learns(build_judge(self.cfg))

    def about(self) -> dict[str, Any]:
        """What is looked at, for people: name, classes of simulator and judge, the weights' files, their
        marks, by which a file that was written anew is another, and options, that of the section simulator.
        """
        engine = str(self.cfg["simulator"]["_target_"]).rpartition(".")[2]
        return {
            "name": self.cfg["name"],
            "simulator": f"{engine}, a student of {self.student} evaluations" if self.student else engine,
            "judge": str(self.cfg["judge"]["_target_"]).rpartition(".")[2],
            "weights": {role: str(path) for role, path in self.weights.items()},
            "marks": {role: self.mark(role) for role in self.weights},
            "options": json_digest(self.cfg["simulator"]),
        }

    def identity(self, *roles: str) -> dict[str, Any]:
        """What tells this world from others, as far as some of its parts go: what decides of their sections,
        weights, and the files that decide what a judge says.
        """
        sections = {"simulator": "simulator", "state": "simulator", "judge": "judge"}
        read = sorted({sections[role] for role in roles})
        return {
            "sections": {name: decisive(name, self.cfg[name]) for name in read},
            "weights": {role: self.mark(role) for role in roles},
            **(judge_files(self.cfg) if "judge" in roles else {}),
        }

    def mark(self, role: str) -> str:
        """What tells its weights from others: of released ones all files of the checkpoint."""
        if role in self.released:
            return json_digest(files_at(self.cfg, _RELEASED[role]))
        return mark_of(self.weights[role])


def round_inputs(graph: Graph, root: Path, number: int, stage: str) -> Inputs:
    """What the stage `stage`-`number` of a run begins with.

    Raises:
        ConfigError: if there is no such round, or the run has not come so far.
    """
    if f"{stage}-{number}" not in graph.nodes:
        raise ConfigError(f"round={number}: the rounds of this run are 1 to {graph.cfg['rounds']['count']}")
    missing = [name for name in graph.nodes[f"{stage}-{number}"].parents if not graph.finished(name)]
    if missing:
        raise ConfigError(
            f"{root} has not come to round {number} with this config: {', '.join(missing)} are not finished"
            " (`worldloop stages` says what differs); first `worldloop run` with the same options"
        )
    return graph.inputs(f"{stage}-{number}")


def kept_of_round(graph: Graph, folder: Path, number: int, module: str) -> Keep:
    """Keeps parts of what is measured of a round's RL in a folder, by what tells them apart; what `make` gave
    at some earlier time is not made again.

    Args:
        module: that measures, by name.
    """
    # folders of stages are named by all that they hang on, code included
    identity = {"stage": graph.folder(f"rl-{number}").name, "code": code_of(module, {})}
    kept = Kept(folder)
    return lambda name, about, make: kept.get(name, {**identity, **about}, make)


def pages_of(root: Path, graph: Graph, section: Mapping[str, Any]) -> Path:
    """The folder of what is measured of a run's simulator: the run's own, and one of its own for each that
    imagined.simulator names.

    Args:
        section: imagined.
    """
    name = section["simulator"]
    if not name:
        return root
    path = weights_at(graph, name, "imagined.simulator")
    place = path.parent.name if path.name == WEIGHTS else path.stem
    return root / "simulators" / (name if name in graph.nodes else f"{place}-{mark_of(path)[:8]}")


def released_in(cfg: Cfg, weights: Mapping[str, Path]) -> dict[str, Path]:
    """The checkpoints, by role, that are looked at as they are: that of the simulator where neither
    imagined.simulator nor a stage of the run has weights of one, and on it that of the state expert, unless
    imagined.state names another. With finetune.data, tuned weights are meant.
    """
    section, named = cfg["simulator"], cfg["imagined"]
    if not section.get("checkpoint") or cfg["finetune"]["data"] or weights["simulator"].is_file():
        return {}
    found = {"simulator": section["checkpoint"]}
    if not named["state"]:
        found["state"] = section["state_expert"].get("checkpoint")
    return {role: Path(path) for role, path in found.items() if path}


def stage_of(weights: Path) -> str:
    """The stage that left weights, without its round, such as simulator or student; "" of others."""
    return str((read_manifest(weights.parent) or {}).get("stage", "")).partition("-")[0]


def weights_at(graph: Graph, name: str, key: str) -> Path:
    """The weights of a stage of the run, of a folder, or a file of weights itself.

    Raises:
        ConfigError: if there are none.
    """
    folder = graph.folder(name) if name in graph.nodes else Path(name)
    path = folder if folder.suffix == ".safetensors" else folder / WEIGHTS
    if not path.is_file():
        stages = [stage for stage in graph.nodes if (graph.folder(stage) / WEIGHTS).is_file()]
        raise ConfigError(
            f"{key}={name}: {path} does not exist; name a folder with weights, or one of the finished stages"
            f" {stages}"
        )
    return path


def _with_weights(part: Any, weights: Path) -> Any:
    """A part with its weights; one that learns nothing, such as a client of a server, does without."""
    assert isinstance(part, nn.Module)
    return part if not learns(part) and not weights.is_file() else load(part, weights)
