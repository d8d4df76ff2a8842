"""The command line. Every command takes Hydra overrides: worldloop run experiment=quickstart seed=1."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from actors.factory import ConfigError, build_openpi, build_physics, build_policy, prepare_process
from actors.fleets.fleet import FleetError
from actors.policies.openpi import PolicyServerError
from envs.conditioning import PoseMapStyle
from envs.episodes.episode import EpisodeError
from envs.episodes.formats.foreign import Cut
from envs.physics.pool import PoolError
from envs.physics.render import MissingGL
from envs.simulators.gesim.checkpoint import CheckpointError
from envs.simulators.gesim.fixture import FixtureError
from envs.simulators.remote.engine import RemoteError
from learners.training.fit import TrainingDiverged
from pipeline.config import load_config
from pipeline.evaluation.statistics import rate_entry, rate_line
from pipeline.loop import build_loop
from pipeline.stages.given import EVALUATE, load_world, open_store, seeds_of


def _root(cfg: dict[str, Any]) -> Path:
    return Path(cfg["runs"]) / cfg["name"]


def run(words: list[str]) -> None:
    """run the whole loop of an experiment; finished stages are reused, interrupted ones resume"""
    from pipeline.track import publish

    cfg = load_config(words)
    prepare_process(cfg["seed"])
    root = _root(cfg)
    graph = build_loop(cfg, root)
    print(f"{len(graph.stages)} stages in {root}; each says how long it will take after its first steps")
    manifests = graph.run()
    result = json.loads((root / "result.json").read_text())
    tracked = publish(cfg, {name: graph.folder(name) for name in graph.stages}, result, root)
    total = sum(m["seconds"] for m in manifests.values())
    print(
        f"\n{result['verdict']}\n{root}/report.html, {root}/result.json; {total / 60:.1f} min of work"
        + (f"; wandb in {tracked}" if tracked else "")
    )


def stage(words: list[str]) -> None:
    """run one stage and what it needs: worldloop stage vision-1 experiment=quickstart"""
    if not words or "=" in words[0]:
        raise ConfigError(
            "say which stage: worldloop stage imitation experiment=quickstart; `worldloop stages` lists them"
        )
    cfg = load_config(words[1:])
    prepare_process(cfg["seed"])
    graph = build_loop(cfg, _root(cfg))
    if words[0] not in graph.stages:
        raise ConfigError(f"no stage {words[0]}; choose from {list(graph.stages)}")
    graph.run(words[0])


def rl(words: list[str]) -> None:
    """the loop up to its last policy, on any launch: worldloop rl launch=ray launch.actors=4
    experiment=quickstart
    """
    cfg = load_config(words)
    prepare_process(cfg["seed"])
    graph = build_loop(cfg, _root(cfg))
    last = f"rl-{cfg['rounds']['count']}"
    graph.run(last)
    print(f"\nthe policy lies in {graph.folder(last)}; worldloop evaluate policy={last} {' '.join(words)}")


def stages(words: list[str]) -> None:
    """list the stages of an experiment, their folders, and which are finished"""
    cfg = load_config(words)
    graph = build_loop(cfg, _root(cfg))
    for name in graph.stages:
        folder = graph.folder(name)
        print(f"{'done' if (folder / 'manifest.json').exists() else '    '}  {name:<18} {folder}")


def evaluate(words: list[str]) -> None:
    """success of a policy: worldloop evaluate policy=<folder|stage|openpi url=ws://...>
    world=physics|imagined experiment=...
    """
    from actors.rollouts.evaluate import evaluate as episodes

    own = {
        word.split("=", 1)[0]: word.split("=", 1)[1]
        for word in words
        if word.startswith(("policy=", "world=", "url="))
    }
    cfg = load_config([word for word in words if word.split("=")[0] not in own])
    graph = build_loop(cfg, _root(cfg))
    name = own.get("policy", "imitation")
    folder = graph.folder(name) if name in graph.stages else Path(name)
    policy: Any = (
        build_openpi(cfg, own.get("url", ""))
        if name == "openpi"
        else build_policy(cfg, folder / "weights.safetensors")
    )
    prepare_process(cfg["seed"])
    world = own.get("world", "physics")
    if world == "physics":
        env: Any = build_physics(cfg, cfg["evaluate"]["envs"])
        seeds = seeds_of(cfg, EVALUATE, cfg["evaluate"]["episodes"])
    elif world == "imagined":
        last = cfg["rounds"]["count"]
        data = ("collect", *(f"deploy-{n}" for n in range(1, last + 1)))
        found = {stage: graph.folder(stage) for stage in graph.stages}
        store = open_store(cfg, found, data)
        seeds = list(range(min(cfg["evaluate"]["imagined"], len(store))))
        env = load_world(
            cfg, found, store, f"vision-{last}", f"state-{last}", f"judge-{last}", min(64, len(seeds))
        )
    else:
        raise ConfigError(f"world={world!r} must be physics or imagined")
    try:
        outcome = episodes(env, policy, seeds, label=world)
    finally:
        env.close()
    entry = rate_entry(outcome.success[outcome.judged])
    print(f"{folder} in {world}: {rate_line(entry)}, {int((~outcome.judged).sum())} dropped by the judge")


def submit(words: list[str]) -> None:
    """run a command on a Ray cluster: worldloop submit http://head:8265 rl launch=ray launch.actors=8"""
    from pipeline.submit import submit as send

    if not words or not words[0].startswith("http"):
        raise ConfigError(
            "say where: worldloop submit http://head:8265 rl experiment=quickstart launch=ray launch.actors=8"
        )
    load_config(words[2:])  # mistakes are better found here than there
    send(words[0], words[1:])


def chaos(words: list[str]) -> None:
    """kill parts of a small Ray run by a seeded schedule and check its ledger: worldloop chaos
    chaos.seconds=60
    """
    from pipeline.chaos.chaos import ChaosFailure, run_chaos

    base = ["experiment=smoke", "algorithm=grpo", "launch=ray", "launch.judge_service=true", "launch.cpus=8"]
    words = [
        *(word for word in base if not any(own.startswith(word.split("=")[0] + "=") for own in words)),
        *words,
    ]
    cfg = load_config(words)
    try:
        found = run_chaos(cfg, words, Path(cfg["runs"]) / f"chaos-{cfg['seed']}")
    except ChaosFailure as error:
        print(f"worldloop chaos: {error}", file=sys.stderr)
        sys.exit(1)
    print(json.dumps(found, indent=1))


def config(words: list[str]) -> None:
    """print the resolved config"""
    print(OmegaConf.to_yaml(OmegaConf.create(load_config(words))), end="")


def bench(words: list[str]) -> None:
    """measure performance: worldloop bench
    conditioning|physics|world|actors|learning|gesim|overfit|pretrained
    """
    from pipeline.benches.bench import run_bench

    run_bench(words)


def verify(words: list[str]) -> None:
    """compare our network with a public one's outputs: worldloop verify gesim FIXTURE.safetensors"""
    from envs.simulators.gesim.fixture import verify as errors_of

    if len(words) != 2 or words[0] != "gesim":
        raise ConfigError("say what and which: worldloop verify gesim FIXTURE.safetensors")
    errors = errors_of(Path(words[1]))
    for name, error in errors.items():
        print(f"{name:<14} max abs error {error:.2e}")
    if max(errors.values()) > 1e-5:
        print("more than 1e-5: this is not the same network", file=sys.stderr)
        sys.exit(1)


def doctor(words: list[str]) -> None:
    """say what this machine has and what is missing"""
    from pipeline.doctor import examine

    sys.exit(examine())


def controls(words: list[str]) -> None:
    """the same physics budget spent without a simulator: filtered BC on the data, and RL in physics"""
    from pipeline.evaluation.controls import run_controls

    cfg = load_config(words)
    prepare_process(cfg["seed"])
    run_controls(cfg, _root(cfg))


def compare(words: list[str]) -> None:
    """finished runs side by side, as a Markdown table: worldloop compare runs/quickstart runs/quickstart_dit"""
    from pipeline.evaluation.compare import compare as table

    if not words:
        raise ConfigError("say which runs: worldloop compare runs/quickstart runs/quickstart_dit")
    print(table([Path(word) for word in words]))


def finetune(words: list[str]) -> None:
    """train a simulator on any LeRobot data: worldloop finetune simulator=gesim simulator.checkpoint=<folder>
    finetune.data=[<folder>]
    """
    from pipeline.finetune import build_finetune

    cfg = load_config(words)
    prepare_process(cfg["seed"])
    graph = build_finetune(cfg, _root(cfg))
    graph.run()
    print(f"weights in {graph.folder('vision')} and {graph.folder('state')}")


def serve(words: list[str]) -> None:
    """serve a simulator to many sessions by GE-Sim's protocol: worldloop serve simulator=gesim
    simulator.checkpoint=<folder>
    """
    from actors.serving.app import serve as run_server
    from pipeline.serving import build_session_host

    cfg = load_config(words)
    prepare_process(cfg["seed"])
    host, config = build_session_host(cfg, _root(cfg))
    print(
        f"{cfg['simulator']['engine']} at http://{config.host}:{config.port}, up to {config.sessions} sessions; look at it in a browser, end it with Ctrl-C",
        flush=True,
    )
    run_server(host, cfg["simulator"]["engine"], config)


def _source_and_cut(words: list[str], count: int, usage: str) -> tuple[list[Path], Cut, dict[str, str]]:
    paths = [Path(word) for word in words if "=" not in word]
    own = {word.split("=", 1)[0]: word.split("=", 1)[1] for word in words if "=" in word}
    if len(paths) != count or set(own) - {"frames", "size", "tool_offset"}:
        raise ConfigError(usage)
    try:
        return (
            paths,
            Cut(
                int(own.get("frames", 0)),
                tuple(int(n) for n in own.get("size", "").strip("[]").split(",") if n),
            ),
            own,
        )
    except ValueError as error:
        raise ConfigError(f"{usage}: {error}") from error


def convert(words: list[str]) -> None:
    """GE-Sim, AgiBot or Bridge recordings to LeRobot v3.0, and LeRobot back to GE-Sim 2.0 bundles: worldloop
    convert SRC DST [frames=N] [size=[H,W]]
    """
    from pipeline.convert import convert as write

    paths, cut, _ = _source_and_cut(
        words, 2, "say from where to where: worldloop convert SRC DST [frames=N] [size=[H,W]]"
    )
    print(f"{write(paths[0], paths[1], cut)} episodes in {paths[1]}")


def inspect(words: list[str]) -> None:
    """pictures of recordings with the commanded grippers drawn over them: worldloop inspect SRC DST
    [frames=N] [tool_offset=0.15]
    """
    from pipeline.convert import inspect as draw

    paths, cut, own = _source_and_cut(
        words,
        2,
        "say from where to where: worldloop inspect SRC DST [frames=N] [size=[H,W]] [tool_offset=0.15]",
    )
    for path in draw(paths[0], paths[1], cut, PoseMapStyle(tool_offset=float(own.get("tool_offset", 0.15)))):
        print(path)


COMMANDS: dict[str, Callable[[list[str]], None]] = {
    f.__name__: f
    for f in (
        run,
        rl,
        stage,
        stages,
        evaluate,
        controls,
        compare,
        finetune,
        serve,
        convert,
        inspect,
        bench,
        verify,
        submit,
        chaos,
        config,
        doctor,
    )
}


def _help() -> str:
    lines = [f"  {name:<10} {function.__doc__}" for name, function in COMMANDS.items()]
    return (
        "worldloop <command> [key=value ...]\n\n"
        + "\n".join(lines)
        + "\n\nKeys are those of configs/; `worldloop config` prints them."
    )


def main() -> None:
    """Entry point of `worldloop` and `python -m pipeline`."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help())
        return
    if words[0] not in COMMANDS:
        print(f"no command {words[0]!r}\n\n{_help()}", file=sys.stderr)
        sys.exit(2)
    try:
        COMMANDS[words[0]](words[1:])
    except (
        CheckpointError,
        ConfigError,
        EpisodeError,
        FixtureError,
        FleetError,
        MissingGL,
        PolicyServerError,
        PoolError,
        RemoteError,
        TrainingDiverged,
        OSError,
    ) as error:
        print(f"worldloop {words[0]}: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
