"""What each stage of the loop does, given the config, its own folder and its parents' folders."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from actors.evaluate import evaluate
from actors.factory import (
    ConfigError,
    bench_config,
    build_judge,
    build_physics,
    build_policy,
    build_simulator,
    build_state_decoder,
    build_world,
    open_clips,
    options,
    prepare_process,
)
from actors.launch import build_fleet
from actors.recipe import Recipe
from envs.episodes import Episode, LeRobotDataset, LeRobotWriter
from envs.episodes.behind import WriteBehind
from envs.episodes.clips import ClipStore
from envs.physics.pool import BenchPool, Track
from envs.schema import Rewards
from envs.simulators.replay import replay
from envs.world import Starts
from learners.algorithm import RLConfig
from learners.factory import build_algorithm
from learners.fit import FitConfig
from learners.parallel import leads
from learners.ppo import PPO
from learners.remembered import remembered
from learners.rl import train_rl
from learners.stages.generated import generated_frames
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.judge import calibrate, train_judge, unseen_by_judge
from learners.stages.state import train_state
from learners.stages.vision import VisionConfig, train_contact, train_sight, train_vision
from pipeline import measurement
from pipeline.artefact import save_weights, write_text
from pipeline.statistics import rate_entry

Cfg = Mapping[str, Any]
Found = Mapping[str, Path]

# Episode seeds of different purposes never meet, whatever the experiment's own seed is.
_SPACE = 10_000_000
TRAIN, HELD_OUT, DEPLOY, EVALUATE = 0, 2_000_000, 4_000_000, 9_000_000


def seeds_of(cfg: Cfg, purpose: int, count: int, offset: int = 0) -> list[int]:
    """Episode seeds for a purpose. Evaluation seeds are the same for every experiment seed, so that runs can be compared."""
    base = purpose if purpose == EVALUATE else purpose + _SPACE * (1 + cfg["seed"])
    return list(range(base + offset, base + offset + count))


def fit_options(cfg: Cfg, section: Mapping[str, Any], key: str) -> FitConfig:
    """FitConfig of a section, seeded by the experiment."""
    return options(FitConfig, {**section, "seed": cfg["seed"], "microbatches": cfg["microbatches"]}, key)


def rl_options(cfg: Cfg, **more: Any) -> RLConfig:
    """RLConfig of the section rl, and what it leaves open."""
    return options(RLConfig, {**cfg["rl"], "microbatches": cfg["microbatches"], **more}, "rl")


# -- data ------------------------------------------------------------------------------------------------------------
def collect(cfg: Cfg, folder: Path, found: Found, part: str) -> dict[str, Any]:
    """Scripted episodes into a LeRobot data set; goes on after the last finished shard."""
    section, task, bench = cfg["collect"], cfg["task"], bench_config(cfg)
    total = section["episodes"] if part == "train" else section["held_out"]
    seeds = seeds_of(cfg, TRAIN if part == "train" else HELD_OUT, total)
    names = [name for name, share in section["mix"].items() for _ in range(round(100 * share))]
    if len(names) != 100:
        raise ConfigError(f"collect.mix={section['mix']} must add up to 1")
    # Consecutive episodes mix all behaviours, so that any prefix of the data has the right proportions.
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0)).tolist()
    jobs = []
    for number, seed in enumerate(seeds):
        behaviour = names[order[number % 100]]
        low, high = section["noise"]
        dial = {"expert": 0.0, "random": 1.0}.get(behaviour, low + (high - low) * ((number * 0.618) % 1.0))
        jobs.append((seed, dial, behaviour))
    writer = LeRobotWriter(folder / "dataset", bench.views, bench.size, task["control_hz"])
    size = section["shard"]
    pool = BenchPool(bench, 2 * (torch.get_num_threads()), task["horizon"], cfg["launch"]["workers"])
    done = len(LeRobotDataset(writer.root)) if writer.shards else 0
    try:
        with tqdm(total=total, initial=done, desc=f"collect {part}", unit="ep", dynamic_ncols=True) as bar, WriteBehind(writer) as behind:
            for begin in range(done, total, size):
                batch = jobs[begin : begin + size]
                tracks = pool.script([(seed, dial) for seed, dial, _ in batch])
                behind.write([Episode.from_track(t, b, bench.views, task["control_hz"]) for t, (_, _, b) in zip(tracks, batch, strict=True)])
                bar.update(len(batch))
    finally:
        pool.close()
    store = open_clips(cfg, [writer.root])
    return {"episodes": len(store), "frames": int(store.length.sum()), "successes": sum(row["success"] for row in store.episodes)}


def deploy(cfg: Cfg, folder: Path, found: Found, number: int, episodes: int) -> dict[str, Any]:
    """Episodes of the current stochastic policy in physics, recorded whole."""
    (policy_folder,) = found.values()
    policy = build_policy(cfg, policy_folder / "weights.safetensors")
    seeds = seeds_of(cfg, DEPLOY, episodes, offset=100_000 * number)
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)  # a deployment is short; half of one is begun anew
    bench, won = bench_config(cfg), []
    with WriteBehind(LeRobotWriter(data, bench.views, bench.size, cfg["task"]["control_hz"])) as behind:
        for tracks in run_recorded(cfg, policy, seeds):
            behind.write([Episode.from_track(track, f"policy-{number}", bench.views, cfg["task"]["control_hz"]) for track in tracks])
            won += [bool(track.rows["success"][-1]) for track in tracks]
    success = torch.tensor(won)
    return {"episodes": len(success), "true_stochastic": rate_entry(success), "success": float(success.float().mean())}


def run_recorded(cfg: Cfg, policy: Any, seeds: list[int], stochastic: bool = True) -> Iterator[list[Track]]:
    """Recorded episodes of a policy in physics, in the order of the seeds, as many at once as run side by side."""
    env = build_physics(cfg, batch=min(64, len(seeds)), record=True)
    try:
        for begin in range(0, len(seeds), env.batch_size[0]):
            part = seeds[begin : begin + env.batch_size[0]]
            evaluate(env, policy, part, stochastic=stochastic, label="deploy", sampling_seed=cfg["seed"] * 1000 + begin)
            tracks = {track.seed: track for track in env.pop_tracks()}
            yield [tracks[seed] for seed in part]
    finally:
        env.close()


def open_store(cfg: Cfg, found: Found, data: Iterable[str]) -> ClipStore:
    """The data sets of several stages as one store, with the commands that the simulator takes."""
    return open_clips(cfg, [found[name] / "dataset" for name in data])


def split(store: ClipStore) -> tuple[Tensor, Tensor]:
    """Training and held-out episodes: every eighth of a policy's episodes is kept from all training, for measuring."""
    numbers = torch.arange(len(store))
    kept = torch.tensor([row["behaviour"].startswith("policy") and row["seed"] % 8 == 0 for row in store.episodes])
    return numbers[~kept], numbers[kept]


# -- learning -----------------------------------------------------------------------------------------------------------
def imitation(cfg: Cfg, folder: Path, found: Found) -> dict[str, Any]:
    """Behaviour cloning of the first few expert episodes."""
    store = open_store(cfg, found, found)
    experts = store.select(["expert"], succeeded=True)[: cfg["imitation"]["demos"]]
    if len(experts) < cfg["imitation"]["demos"]:
        raise ConfigError(f"imitation.demos={cfg['imitation']['demos']}, but the data hold {len(experts)} successful expert episodes; raise collect.episodes or collect.mix.expert")
    prepare_process(cfg["seed"])
    policy = build_policy(cfg)
    stats = train_imitation(policy, store, experts, fit_options(cfg, cfg["imitation"]["fit"], "imitation.fit"), folder)
    save_weights(policy, folder)
    return {**stats, "demos": len(experts)}


def worked(cfg: Cfg, store: ClipStore) -> Tensor:
    """Episodes known to have worked in physics: the demonstrations, and the successes of deployed policies."""
    known = torch.cat([store.select(["expert"], succeeded=True)[: cfg["imitation"]["demos"]], store.select(["policy-*"], succeeded=True)])
    return known[torch.isin(known, split(store)[0])]


def clone(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], policy: str, vision: str) -> dict[str, Any]:
    """The deployed policy, perception and all, learns from what worked in physics, and to see generated pictures as it sees true ones; RL then leaves its perception as it is."""
    store = open_store(cfg, found, data)
    prepare_process(cfg["seed"])
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    episodes = worked(cfg, store)
    section = dict(cfg["clone"])
    own = store.select(["policy-*"])
    own = own[torch.isin(own, split(store)[0])].flip(0)[: section.pop("imagined")]  # the newest first
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    made = generated_frames(simulator, store, own, cfg["simulator"]["bf16"])
    stats = train_imitation(actor, store, episodes, fit_options(cfg, section, "clone"), folder, fresh=False, generated=made)
    save_weights(actor, folder)
    return {**stats, "episodes": len(episodes), "generated_frames": len(made)}


def tokenizer(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...]) -> dict[str, Any]:
    """The DiT's video autoencoder."""
    from learners.stages.tokenizer import train_tokenizer

    store = open_store(cfg, found, data)
    train, _ = split(store)
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg)
    stats = train_tokenizer(simulator, store, train, fit_options(cfg, cfg["tokenizer"], "tokenizer"), folder)  # type: ignore[arg-type]
    save_weights(simulator, folder)
    return stats


def vision(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], warm: tuple[str, ...], steps: str) -> dict[str, Any]:
    """The simulator, from nothing in the first round and from its predecessor after that."""
    section = dict(cfg["vision"][steps])
    fit_section, sight_section, contact_section = (section.pop(name) for name in ("fit", "sight", "contact"))
    store = open_store(cfg, found, data)
    train, kept = split(store)
    newest = train[train >= len(store) - len(open_store(cfg, found, data[-1:]))]
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[warm[0]] / "weights.safetensors" if warm else None)
    train_sight(simulator, store, train, fit_options(cfg, sight_section, f"vision.{steps}.sight"), folder / "sight")
    train_contact(simulator, store, train, kept, fit_options(cfg, contact_section, f"vision.{steps}.contact"), folder / "contact")
    stats = train_vision(simulator, store, train, options(VisionConfig, section, f"vision.{steps}"), fit_options(cfg, fit_section, f"vision.{steps}.fit"), folder, newest)
    save_weights(simulator, folder)
    return {**stats, "parameters": sum(p.numel() for p in simulator.parameters())}


def state(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, warm: str, steps: str) -> dict[str, Any]:
    """The state decoder on the frozen simulator."""
    store = open_store(cfg, found, data)
    train, _ = split(store)
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[warm] / "weights.safetensors" if warm else None)
    if not warm and not decoder.normalised:
        rows = torch.cat([torch.arange(int(store.start[n]), int(store.start[n] + store.length[n])) for n in train.tolist()])
        decoder.normalise(store.arrays["states"][rows])
    stats = train_state(decoder, simulator, store, train, fit_options(cfg, cfg["state"][steps], f"state.{steps}"), folder)
    save_weights(decoder, folder)
    return stats


def judge(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, warm: str, steps: str) -> dict[str, Any]:
    """The judge on real and on generated frames, its threshold calibrated on real video that no judge learns from."""
    section = dict(cfg["judge_fit"][steps])
    fit_section = section.pop("fit")
    store = open_store(cfg, found, data)
    train, _ = split(store)
    unseen = unseen_by_judge(store)
    train = train[~torch.isin(train, unseen)]
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    judge = build_judge(cfg, found[warm] / "weights.safetensors" if warm else None)
    pick = train[torch.randperm(len(train), generator=torch.Generator().manual_seed(cfg["seed"]))[: section["imagined"]]]
    # Half a centimetre is what the judge is to tell apart; labels further off would blur that.
    imagined = generated_frames(simulator, store, pick, cfg["simulator"]["bf16"], within=0.005) if len(pick) else None
    stats = train_judge(judge, store, train, fit_options(cfg, fit_section, f"judge_fit.{steps}.fit"), folder, imagined)
    if len(unseen):
        rows, valid = store.whole(unseen)
        success = measurement.judge_frames(judge, store.frames(rows), store, unseen)
        rate = torch.tensor([store.episodes[n]["success"] for n in unseen.tolist()]).float().mean()
        calibrate(judge, torch.where(valid, success, 0.0), float(rate))
    save_weights(judge, folder)
    return {**stats, "threshold": float(judge.threshold), "generated_frames": len(imagined) if imagined is not None else 0}


def rl(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, state: str, judge: str, policy: str, iterations: int, number: int) -> dict[str, Any]:
    """Reinforcement learning inside the simulator."""
    prepare_process(cfg["seed"])
    store = open_store(cfg, found, data)
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    settings = rl_options(cfg, iterations=iterations, seed=cfg["seed"] * 100 + number)
    anchor = Cloning(actor, store, worked(cfg, store))
    if settings.freeze_perception:
        actor.freeze_perception()
        anchor.look()
    algorithm = build_algorithm(cfg, actor)
    knew: dict[str, float] = {}
    if isinstance(algorithm, PPO):
        # Of a deployed policy whose perception stays: of another the critic would know pictures that nobody sees any more.
        past = store.select([f"policy-{number}"])
        past = past[torch.isin(past, split(store)[0])]
        if settings.freeze_perception and len(past):
            knew["critic_knew"] = algorithm.acquaint(remembered(actor.perception, store, past, options(Rewards, cfg["judge"]["rewards"], "judge.rewards"), cfg["task"]["chunk"]), settings.seed)
    weights = [str((found[name] / "weights.safetensors").resolve()) for name in (policy, vision, state, judge)]
    datasets = tuple(str((found[name] / "dataset").resolve()) for name in data)
    recipe = Recipe(cfg, settings.envs // settings.shards, weights[0], weights[1], weights[2], weights[3], datasets, settings.freeze_perception, algorithm.bootstraps, settings.rewards_later)
    fleet = build_fleet(recipe) if leads() else None
    try:
        stats = train_rl(fleet, actor, algorithm, settings, folder, starts=len(store), anchor=anchor)
    finally:
        if fleet is not None:
            fleet.close()
    save_weights(actor, folder)
    return {**knew, **{k: v for k, v in stats.items() if k != "last"}, **{f"last_{k}": v for k, v in stats["last"].items()}}


def load_world(cfg: Cfg, found: Found, store: ClipStore, vision: str, state: str, judge: str, batch: int, episodes: Tensor | None = None) -> Any:
    """The imagined world with the weights of three stages, starting where the store's episodes start."""
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[state] / "weights.safetensors")
    referee = build_judge(cfg, found[judge] / "weights.safetensors")
    return build_world(cfg, simulator, decoder, referee, Starts.of(store, episodes), batch)


# -- proof --------------------------------------------------------------------------------------------------------------
def gap(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, state: str, judge: str, policy: str, number: int) -> dict[str, Any]:
    """How far imagination and truth lie apart for the policy just deployed: same starts, same stochastic policy."""
    store = open_store(cfg, found, data)
    mine = store.select([f"policy-{number}"])[: cfg["measure"]["starts"]]
    prepare_process(cfg["seed"])
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    truth = torch.tensor([store.episodes[n]["success"] for n in mine.tolist()])
    world = load_world(cfg, found, store, vision, state, judge, min(64, len(mine)), mine)
    outcome = evaluate(world, actor, list(range(len(mine))), stochastic=True, label="gap", sampling_seed=cfg["seed"])
    said = outcome.success[outcome.judged]
    result = {"round": number, "true": rate_entry(truth), "imagined": rate_entry(said), "gap": float(said.float().mean() - truth.float().mean())}
    _, held = split(store)
    if len(held):
        simulator = world.base_env.simulator
        made = replay(simulator, store, held, bf16=cfg["simulator"]["bf16"])
        referee = build_judge(cfg, found[judge] / "weights.safetensors")
        result["replayed"] = measurement.judge_table(referee, made.frames, made.valid, store, held)
    return result


def evaluate_physics(cfg: Cfg, folder: Path, found: Found, policy: str) -> dict[str, Any]:
    """Deterministic success in physics on the held-out seeds."""
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    env = build_physics(cfg, cfg["evaluate"]["envs"])
    began = time.perf_counter()
    try:
        outcome = evaluate(env, actor, seeds_of(cfg, EVALUATE, cfg["evaluate"]["episodes"]), label="physics")
    finally:
        env.close()
    torch.save({"success": outcome.success, "progress": outcome.progress}, folder / "outcomes.pt")
    return {"rate": outcome.rate, **rate_entry(outcome.success), "progress": float(outcome.progress.mean()), "evaluation_seconds": time.perf_counter() - began}


def evaluate_imagined(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, state: str, judge: str, before: str, after: str) -> dict[str, Any]:
    """Deterministic success in imagination, from the starts of the data, for both policies in the last world."""
    store = open_store(cfg, found, data)
    count = min(cfg["evaluate"]["imagined"], len(store))
    world = load_world(cfg, found, store, vision, state, judge, min(64, count))
    out: dict[str, Any] = {}
    for label, name in (("before", before), ("after", after)):
        outcome = evaluate(world, build_policy(cfg, found[name] / "weights.safetensors"), list(range(count)), label=f"imagined {label}")
        out[label] = {**rate_entry(outcome.success[outcome.judged]), "dropped": int((~outcome.judged).sum())}
    return out


def measure(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, state: str, judge: str, held_out: str) -> dict[str, Any]:
    """Rollout error, state error, speed and the judge's tables on held-out episodes of every kind."""
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[state] / "weights.safetensors")
    referee = build_judge(cfg, found[judge] / "weights.safetensors")
    scripted = open_store(cfg, found, [held_out])
    store = open_store(cfg, found, data)
    groups = {name: (scripted, scripted.select([name])) for name in ("expert", "noisy", "random")}
    groups["on-policy"] = (store, split(store)[1])
    result: dict[str, Any] = {"rollout": {}, "judge": {}}
    for name, (source, episodes) in groups.items():
        if not len(episodes):
            continue
        made = replay(simulator, source, episodes, decoder, bf16=cfg["simulator"]["bf16"])
        result["rollout"][name] = measurement.rollout_error(source, episodes, made)
        real = source.frames(made.rows)
        result["judge"][name] = {
            "physics video": measurement.judge_table(referee, real, made.valid, source, episodes),
            "simulator rollouts": measurement.judge_table(referee, made.frames, made.valid, source, episodes),
        }
    result["frames_per_second"] = {f"batch {n}": measurement.speed(simulator, scripted, n, cfg["measure"]["speed_chunks"]) for n in (1, 32)}
    return result


def videos(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, state: str, judge: str, held_out: str, before: str, after: str) -> dict[str, Any]:
    """Paired videos: the policy in physics, and the same actions in the simulator."""
    from pipeline.media import paired_frames, paired_video, write_gif

    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    seeds = seeds_of(cfg, EVALUATE, cfg["measure"]["videos"])
    names = []
    for label, name in (("before", before), ("after", after)):
        tracks = [track for some in run_recorded(cfg, build_policy(cfg, found[name] / "weights.safetensors"), seeds, stochastic=False) for track in some]
        bench = bench_config(cfg)
        data_folder = folder / f"dataset-{label}"
        shutil.rmtree(data_folder, ignore_errors=True)
        LeRobotWriter(data_folder, bench.views, bench.size, cfg["task"]["control_hz"]).write([Episode.from_track(t, f"policy-{label}", bench.views, cfg["task"]["control_hz"]) for t in tracks])
        store = open_clips(cfg, [data_folder])
        made = replay(simulator, store, torch.arange(len(store)), bf16=cfg["simulator"]["bf16"])
        for number, row in enumerate(store.episodes):
            path = folder / "media" / f"{label}-{row['seed']}.mp4"
            paired_video(path, store, number, made, f"{label}: {'success' if row['success'] else 'failure'}")
            names.append(path.name)
            if label == "after" and number == 0:
                frames = paired_frames(store, number, made, "the policy's own actions")
                write_gif(folder / "media" / "rollout.gif", [*frames, *[frames[-1]] * 8], cfg["task"]["control_hz"])
    return {"videos": names}


def report(cfg: Cfg, folder: Path, found: Found, rounds: int, root: Path) -> dict[str, Any]:
    """result.json and report.html of the whole run."""
    from pipeline.report import build_report, build_result

    result = build_result(cfg, found, rounds)
    write_text(root / "result.json", json.dumps(result, indent=1, default=float))
    build_report(cfg, found, result, rounds, root / "report.html")
    shutil.copy(root / "report.html", folder / "report.html")
    return {"verdict": result["verdict"]}
