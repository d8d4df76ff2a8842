"""How much of what an action changes survives in imagination.

From moments inside recorded episodes a policy draws several futures. Each is imagined, and carried out in
physics: the episode is replayed from its seed by its recorded commands up to that moment, and goes on with
the same chunks. Among the futures of one moment everything but the actions is equal, so what is compared is
what reinforcement learning learns from; rates of success and errors of pixels say little of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import tqdm

from actors.policies.safe import SafePolicyWrapper
from envs.episodes.clips import ClipStore
from envs.initial_states import DecisionPoints
from envs.judges.base import Judge, ask
from envs.physics.env import PhysicsEnv
from envs.rng import resampling_generator, sampling_seed, seed_process
from envs.specs import CHUNK, LOST, PROGRESS, SUCCESS, Status, to_chunk
from pipeline.graph.kept import Kept, Tensors

_RESAMPLES = 400  # of the moments, for intervals


@dataclass
class Branches:
    """Futures of N moments, G of each, by the number of chunks D since then; all float32.

    imagined [D, N, G]: the judge's progress on generated frames; seen [D, N, G]: the same judge's on the true
    frames of the same actions, by the same rule; outcome [N, G]: whether the true episode succeeded in the
    end, the policy going on in physics after the D chunks. Moments in one of whose futures physics crashed
    are left out.
    """

    imagined: Tensor
    seen: Tensor
    outcome: Tensor


@dataclass(frozen=True)
class Branching:
    """Where futures are imagined and carried out, as many side by side in both.

    Args:
        world: imagined, W slots that begin at DecisionPoints, D chunks long.
        physics: of the episodes' own task, that records; of W slots, too.
        policy: whose stochastic chunks are tried.
        judge: of the imagined world.
        seed: of what the policy draws.
        kept: where what came of every W futures is kept.
        identity: what that depends on, beside which futures they are.
    """

    world: TransformedEnv
    physics: PhysicsEnv
    policy: SafePolicyWrapper
    judge: Judge
    seed: int
    kept: Kept
    identity: Mapping[str, Any]

    def branches(self, which: Tensor, futures: int) -> Branches:
        """Imagine and carry out `futures` futures of some moments.

        Args:
            which: of the decision points, int64 [N], with at least D chunks of the task left.
        """
        parts = which.repeat_interleave(futures).split(self.physics.batch_size[0])
        bar = tqdm(parts, desc="carried out", unit="batch", dynamic_ncols=True, leave=False)
        made = [self._part(number, slots) for number, slots in enumerate(bar)]
        imagined, seen = (torch.cat([part[name] for part in made], 1) for name in ("imagined", "seen"))
        shape = (len(which), futures)
        outcome = torch.cat([part["outcome"] for part in made]).reshape(shape)
        whole = outcome.isfinite().all(1)
        return Branches(
            imagined.unflatten(-1, shape)[:, whole], seen.unflatten(-1, shape)[:, whole], outcome[whole]
        )

    def _part(self, number: int, slots: Tensor) -> Tensors:
        """What comes of W futures or fewer, now or at some earlier time: imagined and seen [D, w], outcome
        [w].
        """
        base = self.world.base_env
        points, drawn = base.starts, sampling_seed(self.seed, number, 0)
        identity = {
            **self.identity,
            "slots": slots.tolist(),  # noise is drawn by them
            "episodes": points.episode[slots].tolist(),
            "frames": points.frame[slots].tolist(),
            "chunks": base.horizon // base.chunk,
            "width": self.physics.batch_size[0],
            "seed": drawn,
        }
        return self.kept.get(f"futures-{number}", identity, lambda: self._tried(slots, drawn))

    @torch.no_grad()
    def _tried(self, slots: Tensor, seed: int) -> Tensors:
        """See _part; by what the policy draws after this seed, whatever was drawn before."""
        points: DecisionPoints = self.world.base_env.starts
        seed_process(seed)
        with set_exploration_type(ExplorationType.RANDOM):
            begun, imagined, chunks = _imagine(self.world, self.policy, slots)
            frames, outcome = carry_out(self.physics, self.policy, points, slots, chunks)
        first = points.store.frames(points.store.start[points.episode[slots]])
        texts = [points.instructions[number] for number in slots.tolist()]
        seen = watched(self.judge, frames, first, texts, begun)
        return {"imagined": imagined, "seen": seen, "outcome": outcome}


def _imagine(world: EnvBase, policy: SafePolicyWrapper, slots: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Progress [w] at the moments, that [D, w] of what follows, and the chunks [D, w, K, A] that led to it; a
    success stays one.
    """
    base, count = world.base_env, len(slots)
    slots = _filled(slots, world.batch_size[0])
    base.schedule(slots.tolist())
    now, progress, chunks = world.reset(), [], []
    begun = now[PROGRESS].squeeze(-1).cpu()
    won = torch.zeros(len(slots), dtype=torch.bool)
    for _ in range(base.horizon // base.chunk):
        after = world.step(policy(now))
        won |= after["next", SUCCESS].squeeze(-1).cpu()
        progress.append(torch.where(won, 1.0, after["next", PROGRESS].squeeze(-1).cpu()))
        chunks.append(after[CHUNK].cpu())
        now = step_mdp(after)
    return begun[:count], torch.stack(progress)[:, :count], torch.stack(chunks)[:, :count]


def _filled(slots: Tensor, width: int) -> Tensor:
    """Slots [w] and the last one again, up to a batch [W]."""
    return torch.cat((slots, slots[-1:].expand(width - len(slots))))


def carry_out(
    physics: PhysicsEnv,
    policy: SafePolicyWrapper,
    points: DecisionPoints,
    which: Tensor,
    chunks: Tensor,
) -> tuple[Tensor, Tensor]:
    """Carry out chunks [D, W, K, A] from the decision points `which` [W], and go on by the policy.

    Returns:
        The frames of these chunks, uint8 [D, W, K, V, 3, H, W], of an episode that is over its last one; and
        the outcome float32 [W], NaN where physics crashed, whose frames are black.
    """
    store, count, depth = points.store, len(which), len(chunks)
    which = _filled(which, physics.batch_size[0])
    episode, moment = points.episode[which], points.frame[which]
    seeds = [int(store.episodes[number]["seed"]) for number in episode.tolist()]
    over = torch.zeros(len(which), dtype=torch.bool)
    won, lost = over.clone(), over.clone()
    physics.schedule(seeds)
    now = physics.reset()
    for begin in range(0, physics.horizon, physics.chunk):
        acted = policy(now)
        chunk, since = acted[CHUNK].clone(), (begin - moment) // physics.chunk
        chunk[since < 0] = _recorded(store, episode, begin, physics)[since < 0].to(chunk.device)
        for number in range(depth):
            mine = (since[:count] == number).nonzero().flatten()
            chunk[mine] = chunks[number, mine].to(chunk.device)
        acted[CHUNK] = chunk
        after = physics.step(acted)
        won |= ~over & after["next", SUCCESS].squeeze(-1)
        lost |= after["next", LOST].squeeze(-1)
        over |= after["next", "done"].squeeze(-1)
        now = step_mdp(after)
    spec = physics.spec
    frames = torch.zeros(depth, count, spec.chunk, spec.views, 3, *spec.size, dtype=torch.uint8)
    for slot, track in physics.tracks:
        if slot < count:
            ahead = int(moment[slot]) + torch.arange(1, depth * spec.chunk + 1)
            seen = [track.rows["frames"][row] for row in ahead.clamp(max=len(track) - 1).tolist()]
            frames[:, slot] = torch.from_numpy(np.stack(seen)).unflatten(0, (depth, spec.chunk))
    physics.tracks.clear()
    return frames, won.float().masked_fill(lost, torch.nan)[:count]


def watched(judge: Judge, frames: Tensor, first: Tensor, texts: list[str], begun: Tensor) -> Tensor:
    """Progress [D, W] after each of the chunks uint8 [D, W, K, V, 3, H, W] as an imagined world has it
    (JudgeReward): `hold` successes in a row among all frames since the moment are one that stays, and a chunk
    that was not judged changes nothing.

    Args:
        first: uint8 [W, V, 3, H, W], of the episodes.
        texts: their W instructions.
        begun: progress [W] at the moment.
    """
    device, out = judge.threshold.device, []
    run = torch.zeros(len(begun), dtype=torch.int64, device=device)
    won = torch.zeros(len(begun), dtype=torch.bool)
    for chunk in frames:
        judgement = ask(judge, chunk.to(device), first.to(device), texts)
        done, run = judge.streak(judgement.success.to(device), run)
        known = judgement.status.cpu() == Status.OK.value
        won |= done.any(1).cpu() & known
        begun = torch.where(won, 1.0, torch.where(known, judgement.progress[:, -1].cpu(), begun))
        out.append(begun)
    return torch.stack(out)


def _recorded(store: ClipStore, episode: Tensor, begin: int, physics: PhysicsEnv) -> Tensor:
    """The chunks [B, K, A] that episodes [B] record from frame `begin` on, in the world's mode."""
    last, start = store.length[episode] - 1, store.start[episode]
    commands = store.arrays["commands"]
    ahead = begin + torch.arange(1, physics.chunk + 1)
    rows = start[:, None] + torch.minimum(ahead[None], last[:, None])
    in_force = commands[start + torch.minimum(torch.tensor(begin), last)]
    return to_chunk(commands[rows], in_force, physics.mode)


def agreement(branches: Branches, seed: int = 0) -> list[dict[str, list[float | None]]]:
    """Correlations among the futures of one moment, by chunks since then.

    Of each depth: "frames", imagined progress with what the judge makes of the true frames (what the
    simulator loses); "judged", that with the outcome (what judge and chance lose); "imagined", imagined
    progress with the outcome. Each [value, low, high], 95% by resampling moments; None where one of the two
    is the same in all futures of a moment, so that nothing can be said.
    """
    generator = resampling_generator(seed)
    moments, out = len(branches.outcome), []
    draws = torch.randint(moments, (_RESAMPLES, moments), generator=generator)
    for imagined, seen in zip(branches.imagined, branches.seen, strict=True):
        pairs = {
            "frames": (imagined, seen),
            "judged": (seen, branches.outcome),
            "imagined": (imagined, branches.outcome),
        }
        out.append({name: _interval(*pair, draws) for name, pair in pairs.items()})
    return out


def _interval(one: Tensor, other: Tensor, draws: Tensor) -> list[float | None]:
    """[value, low, high] of the correlation within rows of [N, G], by rows resampled as draws [R, N] say."""
    one, other = (values - values.mean(1, keepdim=True) for values in (one, other))
    sums = torch.stack([(one * other).sum(1), one.square().sum(1), other.square().sum(1)])  # [3, N]
    some = sums[:, draws].sum(-1)  # [3, R]
    value = _ratio(sums.sum(-1))
    low, high = torch.nanquantile(_ratio(some), torch.tensor([0.025, 0.975]))
    return [round(float(x), 3) if torch.isfinite(x) else None for x in (value, low, high)]


def _ratio(sums: Tensor) -> Tensor:
    """Correlations of sums [3, ...]; NaN where one of the two never varies."""
    scale = (sums[1] * sums[2]).sqrt()
    return torch.where(scale > 1e-9, sums[0] / scale, torch.nan)
