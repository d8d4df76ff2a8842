"""The command line. Every command takes Hydra overrides: worldloop run experiment=quickstart seed=1.

What a command needs is imported when it runs, so that help and mistakes answer at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from envs.targets import ConfigError, nearest

Words = list[str]


def run(words: Words) -> None:
    """run the whole loop of an experiment; finished stages are reused, interrupted ones resume"""
    from pipeline.graph.owner import owning
    from pipeline.loop import build_loop
    from pipeline.track import tracking

    cfg, root = _prepared(words)
    graph = build_loop(cfg, root)
    print(f"{len(graph.nodes)} stages in {root}; each says how long it will take after its first steps")
    with owning(root, "run"), tracking(cfg, root) as tracker:
        manifests = graph.run(tracker=tracker)
        result = json.loads((root / "result.json").read_text())
        tracker.summarise(result)
    minutes = sum(manifest["seconds"] for manifest in manifests.values()) / 60
    print(f"\n{result['verdict']}\n{root}/report.html, {root}/result.json; {minutes:.1f} min of work")


def stage(words: Words) -> None:
    """run one stage and what it needs: worldloop stage simulator-1 experiment=quickstart"""
    if not words or "=" in words[0]:
        raise ConfigError(
            "say which stage: worldloop stage imitation experiment=quickstart; `worldloop stages` lists them"
        )
    _run_until(words[0], words[1:])


def rl(words: Words) -> None:
    """the loop up to its last policy, on any launch: worldloop rl launch=ray launch.actors=4
    experiment=quickstart
    """
    from pipeline.config import load_config
    from pipeline.loop import last_round

    last = f"rl-{last_round(load_config(words))}"
    folder = _run_until(last, words)
    print(f"\nthe policy lies in {folder}; worldloop evaluate policy={last} {' '.join(words)}")


def stages(words: Words) -> None:
    """list the stages of an experiment, their folders, which are finished, and why others will run again"""
    from pipeline.config import load_config
    from pipeline.loop import build_loop

    cfg = load_config(words)
    graph = build_loop(cfg, _root(cfg))
    for name in graph.nodes:
        folder = graph.folder(name)
        done = (folder / "manifest.json").exists()
        mark = "done" if done else "half" if folder.exists() else "    "
        print(f"{mark}  {name:<18} {folder}")
        if why := graph.why(name):
            print(f"      {why}")


def evaluate(words: Words) -> None:
    """success of a policy: worldloop evaluate policy=<stage|folder> world=physics|imagined experiment=...;
    one that needs no weights is a choice of configs/policy: policy=openpi policy.url=ws://...
    """
    from pipeline.commands.evaluate import evaluate_policy
    from pipeline.config import choices

    own, rest = {"weights": "", "world": "physics"}, []
    for word in words:
        key, _, value = word.partition("=")
        if key == "world":
            own["world"] = value
        elif key == "policy" and value not in choices("policy"):
            own["weights"] = value
        else:
            rest.append(word)
    cfg, root = _prepared(rest)
    print(evaluate_policy(cfg, root, **own))


def controls(words: Words) -> None:
    """whose gain is it: beside a finished run the loop without RL iterations, RL in physics, filtered BC"""
    from pipeline.commands.controls import run_controls, table_text
    from pipeline.graph.owner import owning
    from pipeline.track import tracking

    cfg, root = _prepared(words)
    with owning(root, "controls"), tracking(cfg, root) as tracker:
        table = run_controls(cfg, root, tracker)
    print(f"{table_text(table)}\n{root}/controls.json, {root}/report.html")


def compare(words: Words) -> None:
    """finished runs side by side as Markdown: worldloop compare runs/quickstart runs/quickstart_dit"""
    from pipeline.evaluation.compare import compare as table

    if not words:
        raise ConfigError("say which runs: worldloop compare runs/quickstart runs/quickstart_dit")
    print(table([Path(word) for word in words]))


def finetune(words: Words) -> None:
    """train a simulator on any LeRobot data: worldloop finetune simulator=gesim simulator.checkpoint=<folder>
    finetune.data=[<folder>]
    """
    from pipeline.commands.finetune import build_finetune
    from pipeline.graph.owner import owning
    from pipeline.track import tracking

    cfg, root = _prepared(words)
    graph = build_finetune(cfg, root)
    with owning(root, "finetune"), tracking(cfg, root / "finetune") as tracker:
        graph.run(tracker=tracker)
    print(f"weights in {graph.folder('simulator')} and {graph.folder('state')}")


def serve(words: Words) -> None:
    """serve a simulator to many sessions by GE-Sim's protocol: worldloop serve simulator=gesim
    simulator.checkpoint=<folder>
    """
    from actors.serving.app import listening
    from actors.serving.app import serve as run_server
    from actors.serving.sessions import ServeConfig
    from envs.targets import options
    from pipeline.commands.serving import build_session_host

    cfg, root = _prepared(words)
    config = options(ServeConfig, cfg["serve"], "serve")
    with listening(config) as server:
        host = build_session_host(cfg, root, config)
        name, port = cfg["simulator"]["_target_"].rpartition(".")[2], server.getsockname()[1]
        print(
            f"{name} at http://{config.host}:{port}, up to {config.sessions} sessions; look at it in a"
            " browser, end with Ctrl-C",
            flush=True,
        )
        run_server(host, name, server)


def convert(words: Words) -> None:
    """GE-Sim, AgiBot or Bridge recordings to LeRobot v3.0, and LeRobot back to GE-Sim 2.0 bundles: worldloop
    convert SRC DST [frames=N] [size=[H,W]]
    """
    from pipeline.commands.convert import convert as write

    usage = "say from where to where: worldloop convert SRC DST [frames=N] [size=[H,W]]"
    paths, cut, _ = _source_and_cut(words, usage)
    print(f"{write(paths[0], paths[1], cut)} episodes in {paths[1]}")


def inspect(words: Words) -> None:
    """pictures of recordings with the commanded grippers drawn over them: worldloop inspect SRC DST
    [frames=N] [tool_offset=0.15]
    """
    from envs.conditioning import PoseMapStyle
    from pipeline.commands.convert import inspect as draw

    usage = "say from where to where: worldloop inspect SRC DST [frames=N] [size=[H,W]] [tool_offset=0.15]"
    paths, cut, own = _source_and_cut(words, usage)
    style = PoseMapStyle(tool_offset=float(own.get("tool_offset", 0.15)))
    for path in draw(paths[0], paths[1], cut, style):
        print(path)


def bench(words: Words) -> None:
    """measure performance: worldloop bench
    conditioning|physics|world|actors|learning|serving|gesim|overfit|pretrained
    """
    from pipeline.benches.bench import run_bench

    run_bench(words)


def verify(words: Words) -> None:
    """see that every file of a run is what its stage left: worldloop verify runs/quickstart; or compare our
    network with a public one's outputs: worldloop verify gesim FIXTURE.safetensors
    """
    from pipeline.commands.verify import verify_run

    if len(words) == 1 and words[0] != "gesim":
        print(verify_run(Path(words[0])))
        return
    if len(words) != 2 or words[0] != "gesim":
        raise ConfigError("say what: worldloop verify runs/quickstart, or gesim FIXTURE.safetensors")
    from envs.simulators.gesim.fixture import verify as errors_of

    errors = errors_of(Path(words[1]))
    for name, error in errors.items():
        print(f"{name:<14} max abs error {error:.2e}")
    if max(errors.values()) > 1e-5:
        print("more than 1e-5: this is not the same network", file=sys.stderr)
        sys.exit(1)


def submit(words: Words) -> None:
    """run a command on a Ray cluster: worldloop submit http://head:8265 rl launch=ray launch.actors=8"""
    from pipeline.commands.submit import submit as send
    from pipeline.config import load_config

    if not words or not words[0].startswith("http"):
        raise ConfigError(
            "say where: worldloop submit http://head:8265 rl experiment=quickstart launch=ray launch.actors=8"
        )
    load_config([word for word in words[2:] if "=" in word])  # mistakes are better found here than there
    send(words[0], words[1:])


def chaos(words: Words) -> None:
    """disturb a small run by a seeded schedule and check all that is promised: worldloop chaos
    chaos.events=1000
    """
    from pipeline.chaos.fleet import ChaosFailure, run_chaos
    from pipeline.chaos.soak import Soak
    from pipeline.config import load_config

    base = ("experiment=smoke", "algorithm=grpo", "launch=ray", "launch.judge_service=true", "launch.cpus=8")
    fleet = [*without_given(base, words), *words]
    cfg = load_config(fleet)
    folder, section = Path(cfg["runs"]) / f"chaos-{cfg['seed']}", cfg["chaos"]
    try:
        if section["events"]:
            soak = Soak(cfg, [*without_given(("experiment=soak",), words), *words], folder / "soak")
            print(json.dumps(asdict(soak.run(section["events"])), indent=1))
        if section["seconds"]:
            print(json.dumps(run_chaos(cfg, fleet, folder / "fleet"), indent=1))
    except ChaosFailure as error:
        print(f"worldloop chaos: {error}", file=sys.stderr)
        sys.exit(1)


def config(words: Words) -> None:
    """print the resolved config"""
    from omegaconf import OmegaConf

    from pipeline.config import load_config

    print(OmegaConf.to_yaml(OmegaConf.create(load_config(words))), end="")


def doctor(words: Words) -> None:
    """say what this machine has and what is missing"""
    from pipeline.commands.doctor import examine

    sys.exit(examine())


def completion(words: Words) -> None:
    """print what completes commands and choices in a shell: eval "$(worldloop completion bash)", or zsh"""
    from pipeline.commands.completion import SHELLS, script

    if len(words) != 1 or words[0] not in SHELLS:
        raise ConfigError(f"say which shell: worldloop completion {'|'.join(SHELLS)}")
    print(script(words[0], COMMANDS))


COMMANDS: dict[str, Callable[[Words], None]] = {
    command.__name__: command
    for command in (
        *(run, rl, stage, stages, evaluate, controls, compare, finetune, serve, convert, inspect),
        *(bench, verify, submit, chaos, config, doctor, completion),
    )
}
_ROOMS = ("envs", "actors", "learners", "pipeline")


def without_given(base: Sequence[str], words: Sequence[str]) -> list[str]:
    """Those overrides of `base` whose keys the words do not set themselves."""
    given = {word.split("=")[0] for word in words}
    return [word for word in base if word.split("=")[0] not in given]


def _root(cfg: dict[str, Any]) -> Path:
    return Path(cfg["runs"]) / cfg["name"]


def _prepared(words: Words) -> tuple[dict[str, Any], Path]:
    """The config and the run's folder, with this process made ready for work."""
    from actors.factory import device_of, prepare_process
    from pipeline.config import load_config

    cfg = load_config(words)
    device_of(cfg)  # one that is not there is told before any work
    prepare_process(cfg["seed"])
    return cfg, _root(cfg)


def _run_until(name: str, words: Words) -> Path:
    """Run a stage and what it needs; returns its folder."""
    from pipeline.graph.owner import owning
    from pipeline.loop import build_loop
    from pipeline.track import tracking

    cfg, root = _prepared(words)
    graph = build_loop(cfg, root)
    if name not in graph.nodes:
        raise ConfigError(f"no stage {name}{nearest(name, graph.nodes)}")
    with owning(root, f"stage {name}"), tracking(cfg, root) as tracker:
        graph.run(name, tracker)
    return graph.folder(name)


def _source_and_cut(words: Words, usage: str) -> tuple[list[Path], Any, dict[str, str]]:
    """Two paths, the Cut that frames= and size= ask for, and all options of convert and inspect."""
    from envs.episodes.formats.foreign import Cut

    paths = [Path(word) for word in words if "=" not in word]
    own = {key: value for key, _, value in (word.partition("=") for word in words if "=" in word)}
    if len(paths) != 2 or set(own) - {"frames", "size", "tool_offset"}:
        raise ConfigError(usage)
    try:
        size = tuple(int(n) for n in own.get("size", "").strip("[]").split(",") if n)
        return paths, Cut(int(own.get("frames", 0)), size), own
    except ValueError as error:
        raise ConfigError(f"{usage}: {error}") from error


def _help() -> str:
    lines = [
        f"  {name:<10} {' '.join((command.__doc__ or '').split())}" for name, command in COMMANDS.items()
    ]
    return (
        "worldloop <command> [key=value ...]\n\n"
        + "\n".join(lines)
        + "\n\nKeys are those of configs/; `worldloop config` prints them. `worldloop <command> --help` says"
        " more of one, `worldloop --version` which this is."
    )


def _help_of(name: str) -> str:
    words = " ".join((COMMANDS[name].__doc__ or "").split())
    return (
        f"worldloop {name} [key=value ...]\n\n{words}\n\n"
        "Keys are those of configs/, as in experiment=smoke rl.lr=1e-4; `worldloop config` prints all with"
        " their values."
    )


def _explained(error: Exception) -> bool:
    """Whether an error's message is all that a user needs: the system's, and those that Worldloop defines."""
    return isinstance(error, OSError) or type(error).__module__.split(".")[0] in _ROOMS


def main() -> None:
    """Entry point of `worldloop` and `python -m pipeline`."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help())
        return
    if words[0] in ("-V", "--version", "version"):
        from importlib.metadata import version

        print(f"worldloop {version('worldloop')}")
        return
    if words[0] not in COMMANDS:
        print(f"no command {words[0]!r}{nearest(words[0], COMMANDS)}; worldloop --help", file=sys.stderr)
        sys.exit(2)
    if {"-h", "--help"} & set(words[1:]):
        print(_help_of(words[0]))
        return
    from learners.training.interrupt import clean_ending

    try:
        with clean_ending():
            COMMANDS[words[0]](words[1:])
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if not _explained(error):
            raise
        print(f"worldloop {words[0]}: {error}", file=sys.stderr)
        sys.exit(1)
