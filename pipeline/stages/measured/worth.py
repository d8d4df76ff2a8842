"""Stage that measures, before RL learns in imagination, what imagined returns are worth in each task."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import tqdm

from actors.factory import build_judge, build_policy, build_simulator, build_state_decoder, build_world
from actors.policies.safe import SafePolicyWrapper
from actors.process import prepare_process
from actors.world_config import rewards_of
from envs.episodes.clips import ClipStore
from envs.initial_states import DecisionPoints
from envs.rng import order_generator, seed_process
from envs.specs import CHUNK, JUDGE_STATUS, ActionMode, Status
from learners.rl.recorded.rollout import paid_decisions
from learners.rl.recorded.worth import Estimate, Returns, Worth, worth_by_task
from learners.stages.imitation import chunks_ahead
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.result import result_of
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import WORLD, Cfg, imagined_chunks, mode_of, open_store
from pipeline.stages.judging.cost import priced
from pipeline.stages.judging.recordings import judge_of_recordings

_SIDE_BY_SIDE = 64  # imagined episodes
_LITTLE = 0.05  # so small a worth is told


@stage(reads=(*WORLD, "policy", "rl.horizon", "worth"), place=Place.EVALUATOR)
@priced
def worth(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """How far imagined returns of recorded actions are true (learners/rl/recorded/worth.py), at moments of
    held-out episodes of all deployed policies, in the simulator, state expert and judge of these roles,
    against other actions of the role `policy`.

    The role `before`, if somebody plays it, has measured it of the world before.

    Settings: number of the round.

    Returns:
        worth, of each task its value in [0, 1], by which RL weighs its imagined decisions, with what was
        measured and is known; {} where there is nothing to measure it on, or nobody said whether episodes
        succeeded.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    store, number = open_store(cfg, inputs), inputs.settings["number"]
    seed = cfg["seed"] * 100 + number  # each round asks other moments
    held = store.select(["policy-*"])
    held = held[torch.isin(held, store.split("held_out")) & store.arrays["labelled"][held]]
    if not len(held):
        return {"round": number, "worth": {}, "alarms": []}
    points = DecisionPoints(store, held)
    tasks = dict(zip(held.tolist(), tasks_of_episodes(cfg, store, held), strict=True))
    which = _shared_out([tasks[n] for n in points.episode.tolist()], cfg["worth"]["moments"], seed)
    chunks = imagined_chunks(cfg)
    true, begun = _true_returns(cfg, inputs, store, held, points, which, chunks)
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    world = build_world(
        *(cfg, simulator, build_state_decoder(cfg, simulator, inputs.weights("state"))),
        *(build_judge(cfg, inputs.weights("judge")), points, min(_SIDE_BY_SIDE, len(which))),
        horizon=chunks * int(cfg["task"]["chunk"]),
    )
    policy = SafePolicyWrapper(build_policy(cfg, inputs.weights("policy")), world.base_env.spec, mode_of(cfg))
    seed_process(seed)
    imagined = _imagined_returns(world, policy, points, which, mode_of(cfg), recorded=True)
    others = _imagined_returns(world, policy, points, which, mode_of(cfg), recorded=False)
    known = imagined.isfinite() & others.isfinite()
    returns = Returns(true, imagined, others, begun, points.episode[which])
    mine = [tasks[n] for n in points.episode[which][known].tolist()]
    found = worth_by_task(returns[known], mine, _known_before(inputs))
    said = ", ".join(f"{task} {one.value:.2f}" for task, one in found.items())
    tqdm.write(f"worth-{number}: of imagined returns {said}")
    return {
        "round": number,
        "worth": {task: asdict(one) for task, one in found.items()},
        "alarms": worth_little(found),
    }


def _known_before(inputs: Inputs) -> dict[str, Estimate]:
    """What was known of each task in the round before."""
    if "before" not in inputs.found:
        return {}
    told = ((task, one["known"]) for task, one in result_of(inputs.folder("before"))["worth"].items())
    return {task: (known[0], known[1]) for task, known in told if known is not None}


def worth_little(found: dict[str, Worth]) -> list[str]:
    """What to know of tasks in which imagination tells good actions from bad ones hardly or not at all."""
    lost = [task for task, one in found.items() if one.value < _LITTLE]
    if not lost:
        return []
    return [
        f"imagined returns say nothing of true ones in {', '.join(lost)}, so RL hardly learns there in"
        " imagination; train the simulator for longer (simulator_fit), show it the task from nearer, or"
        " deploy more episodes (rounds.deploy)"
    ]


def _shared_out(tasks: list[str], count: int, seed: int) -> Tensor:
    """So many of the moments of these tasks at random, int64, of each as many as of the others, as far as
    there are.
    """
    order = torch.randperm(len(tasks), generator=order_generator(seed)).tolist()
    turns, turn = dict.fromkeys(tasks, 0), []
    for moment in order:
        turn.append(turns[tasks[moment]])
        turns[tasks[moment]] += 1
    first = torch.tensor(turn).argsort(stable=True)[:count]
    return torch.tensor(order)[first].sort().values


def _true_returns(
    cfg: Cfg,
    inputs: Inputs,
    store: ClipStore,
    held: Tensor,
    points: DecisionPoints,
    which: Tensor,
    chunks: int,
) -> tuple[Tensor, Tensor]:
    """Recorded returns float32 [N] over so many chunks from the moments `which` [N] on, and the progress at
    these.
    """
    rewards, judge, features = rewards_of(cfg), None, None
    if rewards.progress:
        judge, features = judge_of_recordings(cfg, inputs, store, held)
    paid = paid_decisions(store, held, rewards, judge, features)
    row = torch.searchsorted(held, points.episode[which])
    at = points.frame[which] // store.spec.chunk
    reward = torch.cat((paid["reward"] * paid["valid"], torch.zeros(len(held), chunks)), 1)
    ahead = at[:, None] + torch.arange(chunks)
    return reward[row[:, None], ahead].sum(1), paid["progress"][row, at]


@torch.no_grad()
def _imagined_returns(
    world: TransformedEnv,
    policy: SafePolicyWrapper,
    points: DecisionPoints,
    which: Tensor,
    mode: ActionMode,
    recorded: bool,
) -> Tensor:
    """Imagined returns float32 [N] from the moments `which` [N] on, of the actions recorded there or of
    others that the policy draws; NaN where the judge gave no judgement.
    """
    base, store, width, out = world.base_env, points.store, world.batch_size[0], []
    # the same moments in other noise
    seeds = which if recorded else which + len(points)
    label = "recorded actions" if recorded else "other actions"
    bar = tqdm(which.split(width), desc=label, unit="batch", dynamic_ncols=True, leave=False)
    with set_exploration_type(ExplorationType.RANDOM):
        for some, mine in zip(bar, seeds.split(width), strict=True):
            filled = torch.cat((some, some[-1:].expand(width - len(some))))
            base.schedule([*mine.tolist(), *[int(mine[-1])] * (width - len(mine))])
            now = world.reset()
            total, over, fine = torch.zeros(width), torch.zeros(width).bool(), torch.ones(width).bool()
            for begin in range(0, base.horizon, base.chunk):
                acted = policy(now)
                if recorded:
                    first, last = (
                        store.start[points.episode[filled]],
                        store.length[points.episode[filled]] - 1,
                    )
                    rows = first + torch.minimum(points.frame[filled] + begin, last)
                    acted[CHUNK] = chunks_ahead(store, rows, mode).to(acted[CHUNK])
                after = world.step(acted)
                result = after["next"]
                total += result["reward"].squeeze(-1).cpu() * ~over
                fine &= over | (result[JUDGE_STATUS].squeeze(-1).cpu() == Status.OK.value)
                over |= result["done"].squeeze(-1).cpu()
                if over.all():
                    break
                now = step_mdp(after)
            out.append(torch.where(fine, total, torch.nan)[: len(some)])
    return torch.cat(out)
