"""Commands around learning: servers, data, benches, clusters, and what there is on this machine."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from envs.targets import ConfigError
from pipeline.cli.words import Words, prepared, without_given

_LARGE = "task.size=[256,256]"  # pictures of a game without a learned world


def serve(words: Words) -> None:
    """serve a simulator to many sessions by GE-Sim's protocol: worldloop serve simulator=gesim
    simulator.checkpoint=<folder>
    """
    from actors.serving.app import listening
    from actors.serving.app import serve as run_server
    from actors.serving.sessions import ServeConfig
    from envs.targets import options
    from pipeline.commands.serving import build_session_host

    cfg, root = prepared(words)
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


def play(words: Words) -> None:
    """open a task for a person in a browser, and beside it the world that a run of the same options learned:
    worldloop play task=push [actions=<LeRobot data set>]
    """
    from actors.playing.app import play as run_game
    from actors.serving.app import listening
    from actors.serving.sessions import ServeConfig
    from envs.simulators.remote.protocol import TOKEN
    from envs.targets import options
    from pipeline.commands.play import build_game, learned_world
    from pipeline.config import load_config

    chosen = [word.removeprefix("actions=") for word in words if word.startswith("actions=")]
    words = [word for word in words if not word.startswith("actions=")]
    cfg, root = prepared(words)
    world = learned_world(cfg, root)
    if not world and (root / "stages").is_dir():
        print(f"{root} holds no world of these options and this code yet (`worldloop stages` says why)")
    larger = [*words, *without_given([_LARGE], words)]
    if not world and load_config(larger)["task"]["suite"] != cfg["task"]["suite"]:
        cfg, root = prepared(larger)  # nothing asks for small pictures, and the suite can do otherwise
    config = options(ServeConfig, cfg["serve"], "serve")
    with listening(config) as server:
        sides = " and ".join([*["physics"] * bool(cfg["task"]["suite"]), *["imagination"] * bool(world)])
        where = f"http://{config.host}:{server.getsockname()[1]}"
        if os.environ.get(TOKEN):
            where += f"/#token=<what ${TOKEN} says>"
        greeting = f"{sides} of {cfg['task']['name']}: open {where} in a browser, end with Ctrl-C"
        run_game(lambda: build_game(cfg, world, Path(chosen[-1]) if chosen else None), server, greeting)


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
    paths, cut, own = _source_and_cut(words, usage, ("tool_offset",))
    style = PoseMapStyle()
    if "tool_offset" in own:
        try:
            style = replace(style, tool_offset=float(own["tool_offset"]))
        except ValueError as error:
            raise ConfigError(f"tool_offset={own['tool_offset']}: say metres, as in 0.15") from error
    for path in draw(paths[0], paths[1], cut, style):
        print(path)


def bench(words: Words) -> None:
    """measure performance: worldloop bench NAME; names are conditioning, collection, experts, world, actors,
    learning, serving, gesim, size, distil, strides, overfit and pretrained; of serving also for how long:
    worldloop bench serving seconds=7200
    """
    from pipeline.benches.bench import run_bench

    run_bench(words)


def judge(words: Words) -> None:
    """verdicts on recorded episodes against their recorded success, and what they cost, by which frames are
    shown: worldloop judge judge=vlm judge.chat.model=<name> [data=<LeRobot set>] [split=held_out|all]
    [episodes=N] [frames=all,4,ends judge.pictures.span=clip judge.pictures.every=1] experiment=...
    """
    from pipeline.commands.worlds.judge import Selection, judge_study

    own, rest = {}, []
    for word in words:
        key, _, value = word.partition("=")
        if key in ("data", "split", "episodes", "frames"):
            own[key] = value
        else:
            rest.append(word)
    selection = Selection.of(own)
    cfg, root = prepared(rest)
    print(judge_study(cfg, root, selection))


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
    """run a command on a Ray cluster: worldloop submit http://head:8265 rl launch=ray launch.actors=8
    runs=/shared/runs
    """
    from pipeline.commands.submit import submit as send
    from pipeline.config import read_config

    if not words or not words[0].startswith("http"):
        raise ConfigError(
            "say where: worldloop submit http://head:8265 rl experiment=quickstart launch=ray launch.actors=8"
            " runs=/shared/runs"
        )
    # A command has words of its own (policy=rl-2 of evaluate), and tells mistakes itself.
    naming = ("runs", "experiment", "hydra.searchpath")
    runs = str(read_config([word for word in words[2:] if word.partition("=")[0] in naming])["runs"])
    if words[1:] and not Path(runs).is_absolute():
        raise ConfigError(
            f"runs={runs} would lie in the job's working folder, which Ray throws away; name a folder that"
            " all nodes share, as runs=/shared/runs"
        )
    send(words[0], words[1:])


def chaos(words: Words) -> None:
    """disturb a small run by a seeded schedule and check all that is promised: worldloop chaos
    chaos.events=1000
    """
    from pipeline.chaos.fleet import ChaosFailure, run_chaos
    from pipeline.chaos.soak import Soak
    from pipeline.config import load_config
    from pipeline.graph.owner import owning

    base = ("experiment=smoke", "algorithm=grpo", "launch=ray", "launch.judge_service=true", "launch.cpus=8")
    runs, fleet = ([*without_given(some, words), *words] for some in (("experiment=soak",), base))
    cfg = load_config(runs)
    folder, section = Path(cfg["runs"]) / f"chaos-{cfg['seed']}", cfg["chaos"]
    hosts = load_config(fleet) if section["seconds"] else {}
    try:
        with owning(folder, "chaos"):
            if section["events"]:
                soak = Soak(runs, cfg["seed"], folder / "soak", section["patience"])
                print(json.dumps(asdict(soak.run(section["events"])), indent=1))
            if hosts:
                print(json.dumps(run_chaos(hosts, fleet, folder / "fleet"), indent=1))
    except ChaosFailure as error:
        print(f"worldloop chaos: {error}", file=sys.stderr)
        sys.exit(1)


def tasks(words: Words) -> None:
    """list what can be tried in physics: suites, robots, tasks, scenes; of one all, and its pictures into a
    folder: worldloop tasks task=metaworld [pictures=FOLDER]
    """
    from pipeline.commands.tasks import check_chosen, chosen_tasks, table

    wanted = [word.partition("=")[2] for word in words if word.startswith("pictures=")]
    found = chosen_tasks([word for word in words if not word.startswith("pictures=")])
    for option, meant in (("pictures", "FOLDER"), ("task.name", "NAME")):
        if len(found) > 1 and any(word.startswith(f"{option}=") for word in words):
            raise ConfigError(f"say of which task: worldloop tasks task=metaworld {option}={meant}")
    if len(found) == 1:
        check_chosen(*found.values())
    print(table(found))
    if wanted:
        from pipeline.commands.task_pictures import draw  # loads torch

        for choice, task in found.items():
            for path in draw(choice, task, Path(wanted[-1])):
                print(path)


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
    from pipeline.cli.main import COMMANDS

    print(script(words[0], COMMANDS))


def _source_and_cut(
    words: Words, usage: str, more: tuple[str, ...] = ()
) -> tuple[list[Path], Any, dict[str, str]]:
    """Two paths, the Cut that frames= and size= ask for, and all options: these two and `more`."""
    from envs.episodes.formats.foreign import Cut

    paths = [Path(word) for word in words if "=" not in word]
    own = {key: value for key, _, value in (word.partition("=") for word in words if "=" in word)}
    if len(paths) != 2 or set(own) - {"frames", "size", *more}:
        raise ConfigError(usage)
    try:
        size = tuple(int(n) for n in own.get("size", "").strip("[]").split(",") if n)
        return paths, Cut(int(own.get("frames", 0)), size), own
    except ValueError as error:
        raise ConfigError(f"{usage}: {error}") from error
