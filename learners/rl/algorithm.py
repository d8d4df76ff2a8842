"""What reinforcement-learning algorithms are made of: the contract, the options they share, and the masks of
a rollout.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn

from envs.ranges import Count, Natural, NonNegative, Positive, Share
from envs.specs import CHUNK, INVALID_ACTION, JUDGE_STATUS, LOG_PROB, LOST, Status, WorldSpec


@dataclass(frozen=True)
class RLConfig:
    """Options of the loop, shared by all algorithms.

    Args:
        iterations: rounds of collecting and updating.
        envs: episodes side by side over all hosts, and so the least number of episodes per iteration.
        shards: jobs an iteration is cut into, each of envs / shards episodes; results depend on this, not on
            who runs them.
        threads: that torch computes one job's rollout with, on whatever machine; with another number sums are
            taken in another order and the last bits differ.
        starts: imagined episodes begin "inside" the newest recorded ones, at any of their chunks, at those
            of "key" frames (episodes/key_frames.py), or at the "first" frames of all. A world errs more with
            every chunk it builds on its own; from inside, short episodes meet every stage of the task.
        horizon: actions of an imagined episode, rounded up to whole chunks; None for the task's own. What the
            judge's progress, and a critic if there is one, expect of the rest stands in for it.
        schedule: "sync" learns from rollouts of the newest policy only; "async" lets hosts run on meanwhile.
        max_policy_lag: versions a rollout may be behind, if async.
        queue: jobs submitted and not yet learned from at most, if async.
        max_dropped: share of all episodes that may be lost (dead judges, NaN actions) before the run stops.
        epochs: passes over each iteration's data.
        minibatch: transitions per update.
        microbatches: parts a minibatch is cut into, each with a backward pass of its own, to save memory or
            to be shared out to workers.
        lr: learning rate of the policy at first, if it explores as widely as its config says (else see
            actors.policies.contract.rl_rate); all rates fall to zero over the iterations, so that what is
            deployed is not one moment of a random walk.
        clip: largest gradient norm of the policy, and of the critic.
        kl_stop: mean KL to the behaviour policy at which an iteration's epochs end early.
        imagined: weight of the algorithm's loss on imagined decisions; 0 leaves them out, as a control, and
            imagines none if there are recorded ones.
        recorded: decisions of deployed policies in physics per iteration, learned from beside the imagined
            ones by the same loss; 0 for none. Algorithms without a critic, and policies that are scored on
            action tokens, learn from imagined ones only.
        recorded_rounds: rounds whose decisions those are, and whose episodes warm up the critic: so many up
            to that of the policy that RL begins with; None for all, with what explore played.
        anchor: weight of cloning what is known to have worked in physics (the newest deployed policy's true
            successes) beside the algorithm's loss; it keeps RL from wandering where only the simulator says
            it works.
        anchor_batch: frames of that per update.
        rewards_later: let rollouts go on without waiting for the judge, whose verdicts are filled in at their
            end.
        freeze_perception: train only what follows the policy's encoder, so that no picture is encoded twice.
        checkpoint_every: iterations between checkpoints.
        evaluate_every: iterations after which what has been learned so far is tried in physics, for the log
            alone; 0 for never.
        evaluate_episodes: of each such trial.
        seed: of start frames, exploration and minibatches.
        episodes: learned from in all, or a few more (see `within`), with which it ends if `iterations` are
            not over before; rates then fall by their share. None: as many as there are.
    """

    iterations: Count
    envs: Count
    shards: Count
    threads: Count
    starts: Literal["inside", "key", "first"]
    horizon: Count | None
    schedule: Literal["sync", "async"]
    max_policy_lag: Natural
    queue: Count
    max_dropped: Share
    epochs: Count
    minibatch: Count
    microbatches: Count
    lr: Positive
    clip: Positive
    kl_stop: Positive
    imagined: NonNegative
    recorded: Natural
    recorded_rounds: Count | None
    anchor: NonNegative
    anchor_batch: Count
    rewards_later: bool
    freeze_perception: bool
    checkpoint_every: Count
    evaluate_every: Natural
    evaluate_episodes: Count
    seed: Natural
    episodes: Count | None = None

    def __post_init__(self) -> None:
        if self.envs % self.shards:
            raise ValueError(f"envs={self.envs} must be a multiple of shards={self.shards}")


class Algorithm(Protocol):
    """What tells algorithms apart; one class each, built as `_target_`(policy=, spec=, **options).

    Attributes (those of the class; one that is left out is as said in parentheses):
        name: for messages (the class's).
        bootstraps: whether it values next observations, so that rollouts must carry what critics read of
            them (False).
        supports_delayed_reward: whether it learns from whole first episodes only, so that rewards may arrive
            after them (False).
        group_size: consecutive episodes that belong together, such as a group (1).
    """

    name: str
    bootstraps: bool
    supports_delayed_reward: bool
    group_size: int

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Where the episodes of one iteration begin, as numbers of `starts` starts (Starts.seeds makes seeds
        of them); more than `envs` where early endings should be refilled.
        """
        ...

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Turn a rollout [B, T] into a flat set of transitions with everything `loss` needs."""
        ...

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """Scalar loss of some transitions and figures to log."""
        ...

    def modules(self) -> nn.Module:
        """All that is trained, the policy included."""
        ...

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """Parameter groups for the optimiser; `lr` is the policy's."""
        ...


class Anchor(Protocol):
    """Something with batches and a loss that is added to the algorithm's."""

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """A batch."""
        ...

    def loss(self, data: TensorDict, generator: torch.Generator) -> Tensor:
        """Its scalar loss."""
        ...


def clip_bounds(low: float, high: float, numbers: int | None, spec: WorldSpec) -> tuple[float, float]:
    """How far below and above one the likelihood ratio of a whole chunk may go before it is clipped.

    The logarithm of a chunk's ratio is a sum over its numbers. If each of them moves as far, its spread grows
    with the root of their count: bounds meant for few numbers clip chunks of many at steps that change
    nothing else.

    Args:
        low, high: bounds for chunks of `numbers` numbers, low below one.
        numbers: see there; None: the bounds are for chunks as they are.
        spec: of the world that is acted in; its chunks count as K A numbers, of all policies alike, also
            where a policy's density has fewer (ChunkGaussian: its knots, of the numbers that vary).
    """
    if numbers is None:
        return low, high
    wider = math.sqrt(spec.chunk * spec.embodiment.action_dim / numbers)
    return 1 - (1 - low) ** wider, (1 + high) ** wider - 1


def first_episode(done: Tensor) -> Tensor:
    """Which steps [B, T] belong to the first episode of their slot, from done flags [B, T]."""
    before = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1)
    return before.long().cumsum(1) == 0


def episode_counts(batch: TensorDict, algorithm: Algorithm) -> Tensor:
    """How many episodes of each slot of a rollout [B, T] are for learning, int64 [B]: all, with the
    unfinished last one, or the first one alone, if the algorithm learns from no other.
    """
    done = batch["next", "done"].squeeze(-1)
    if algorithm.supports_delayed_reward:
        return torch.ones(len(done), dtype=torch.int64)
    return done.sum(1) + (~done[:, -1]).long()


def within(batch: TensorDict, algorithm: Algorithm, episodes: int) -> TensorDict:
    """The first slots of a rollout [B, T] that hold so many episodes, if it holds as many; groups stay whole.

    All that a slot holds is kept, and two slots at least: of a single number there is no spread. What is left
    out was played, but nobody learns from it.
    """
    counts, size = episode_counts(batch, algorithm), max(2, algorithm.group_size)
    needed = int((counts.cumsum(0) - counts < episodes).sum())
    return batch[: -(-needed // size) * size]


def judged(batch: TensorDict) -> Tensor:
    """Which steps [B, T] belong to episodes that no judge's error or abstention has spoiled."""
    if JUDGE_STATUS not in batch["next"].keys(True, True):
        return torch.ones(batch.shape, dtype=torch.bool, device=batch.device)
    return ~_episodes_with(
        batch["next", JUDGE_STATUS].squeeze(-1) != Status.OK.value, batch["next", "done"].squeeze(-1)
    )


def finite(batch: TensorDict) -> Tensor:
    """Which steps [B, T] belong to episodes in which the policy never said NaN."""
    if INVALID_ACTION not in batch.keys(True, True):
        return torch.ones(batch.shape, dtype=torch.bool, device=batch.device)
    return ~_episodes_with(batch[INVALID_ACTION].squeeze(-1), batch["next", "done"].squeeze(-1))


def whole(batch: TensorDict) -> Tensor:
    """Which steps [B, T] belong to episodes in which physics, if it is that, did not crash."""
    if LOST not in batch["next"].keys(True, True):
        return torch.ones(batch.shape, dtype=torch.bool, device=batch.device)
    return ~_episodes_with(batch["next", LOST].squeeze(-1), batch["next", "done"].squeeze(-1))


def sound(batch: TensorDict) -> Tensor:
    """Which steps [B, T] may be learned from."""
    return judged(batch) & finite(batch) & whole(batch)


def _episodes_with(bad: Tensor, done: Tensor) -> Tensor:
    """Spreads a flag [B, T] to all steps of the episode it is raised in."""
    number = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1).long().cumsum(1)
    hit = torch.zeros(bad.shape, dtype=torch.long, device=bad.device).scatter_add(1, number, bad.long())
    return hit.gather(1, number) > 0


def transitions(batch: TensorDict, keep: Tensor, keys: Iterable[NestedKey], **extra: Tensor) -> TensorDict:
    """The flat set of kept steps: what losses read by key, chunk and behaviour log-probability, plus tensors
    [B, T, ...] by name.
    """
    flat = keep.reshape(-1).nonzero().squeeze(-1)
    source = {key: batch[key].flatten(0, 1)[flat] for key in (*keys, CHUNK, LOG_PROB)}
    out = TensorDict(source, [len(flat)])
    for key, value in extra.items():
        out[key] = value.flatten(0, 1)[flat]
    return out
