"""Stage: teach a text world how successful episodes go on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.ranges import Count
from envs.simulators.replay import side_by_side
from envs.simulators.tokens.text_world import TextWorld
from envs.targets import ConfigError
from learners.stages.simulator import last_rows
from learners.stages.threshold import as_likely_as_not
from learners.stages.tokenizer import train_tokenizer
from learners.training.fit import FitConfig, fit


def shown(store: ClipStore, episodes: Tensor, rows: Tensor) -> Tensor:
    """Whether the task is done in frames `rows` [B, T] of `episodes` [B], float32 [B, T], NaN where nobody
    labelled the episode. Where nobody labelled any, all are demonstrations, done in their last frame.
    """
    if store.arrays["labelled"].any():
        return store.success(episodes, rows)
    return (rows == last_rows(store, rows)).float()


@dataclass(frozen=True)
class SuccessfulClips:
    """Clips of successful episodes, as TextWorld.loss takes them.

    Args:
        store: whose success counts, see `shown`.
        episodes: to learn from, int64 [N], all of them successful.
        frames: of a clip.
        stride: recorded frames between two frames of a clip: a plan needs fewer than a robot's rate.
    """

    store: ClipStore
    episodes: Tensor
    frames: int
    stride: int

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Random clips [count], each of a random episode from any of its frames on.

        The last frame repeats beyond the end, and counts: there the task is done, and stays so. A clip may
        begin there, so that a frame alone tells whether it is done.
        """
        store = self.store
        chosen = self.episodes[torch.randint(len(self.episodes), (count,), generator=generator)]
        length = store.length[chosen]
        begin = (torch.rand(count, generator=generator) * length).long()
        ahead = begin[:, None] + self.stride * torch.arange(self.frames)
        rows = store.start[chosen][:, None] + torch.minimum(ahead, length[:, None] - 1)
        return TensorDict(
            {
                "frames": store.frames(rows),
                "valid": store.arrays["present"][rows],
                "success": shown(store, chosen, rows),
                "text": store.text[chosen],
            },
            [count],
        )


def train_text_world(
    world: TextWorld,
    store: ClipStore,
    episodes: Tensor,
    stride: Count,
    options: FitConfig,
    folder: Path,
    tokenizer: FitConfig | None = None,
) -> dict[str, Any]:
    """Train `world` in place on those of the episodes that are labelled successes, or on all where nobody
    labelled any, and set how long its golden trajectories may become by the time that these took
    (TextWorld.longest).

    Args:
        stride: see SuccessfulClips.
        tokenizer: trains its tokenizer first, on all the episodes; None leaves it as it is.

    Returns:
        What `fit` does, how many episodes it learned from, and what the tokenizer's training says.

    Raises:
        ConfigError: if all that are labelled failed, or an instruction of the store, whatever its split, is
            longer than its encoder takes.
    """
    last = (store.start + store.length - 1)[episodes, None]
    good = episodes[shown(store, episodes, last)[:, 0] > 0]
    if not len(good):
        raise ConfigError(
            "no episode to learn from is labelled a success (next.success), and where others are labelled a"
            " text world learns from successes alone; record or label some, or use a judge without"
            " judge.text_world"
        )
    # All of them: calibration and measurements ask about episodes that it does not learn from.
    world.check(store.instructions)
    world.longest.fill_(longest_of(store, good, stride))
    about: dict[str, Any] = {}
    if tokenizer is not None:
        kept = train_tokenizer(world, store, episodes, tokenizer, folder / "tokenizer")
        about = {f"tokenizer_{name}": kept[name] for name in ("psnr", "codebook_use", "perplexity", "alarm")}
    clips = SuccessfulClips(store, good, world.window, stride)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        return clips.sample(options.part, generator)

    stats = fit("text_world", world, batch, world.loss, options, folder)
    return {**stats, **about, "successes": len(good)}


def longest_of(store: ClipStore, episodes: Tensor, stride: Count) -> int:
    """Frames, `stride` recorded ones apart, after which the task is done in the slowest of these successful
    episodes, int64 [N], and a quarter more; at least 1.
    """
    last = store.length[episodes][:, None] - 1
    rows = store.start[episodes][:, None] + torch.minimum(torch.arange(int(last.max()) + 1), last)
    slowest = int((shown(store, episodes, rows) > 0).long().argmax(1).max())
    return max(1, -(-5 * slowest // (4 * stride)))


def calibrate_ending(world: TextWorld, store: ClipStore, episodes: Tensor, stride: Count) -> bool:
    """Set the threshold by which golden trajectories end where a frame is as likely done as not, on recorded
    video of successes and failures that it has not learned from, of which it is too sure.

    Args:
        episodes: int64 [N]; those that nobody labelled tell nothing.
        stride: see SuccessfulClips; it looks at them as it imagines.

    Returns:
        Whether it was set; it stays where no frame shows success, or all do, or what it says does not rise
        with it.
    """
    if not len(episodes):
        return False
    last = store.length[episodes][:, None] - 1
    ahead = stride * torch.arange(1, -(-int(last.max()) // stride) + 1)  # up to the last frame of each
    rows = store.start[episodes][:, None] + torch.minimum(ahead, last)
    done = shown(store, episodes, rows)
    known = (ahead - stride < last) & store.arrays["present"][rows] & torch.isfinite(done)
    if not known.any():
        return False
    predicted = []
    for some in torch.arange(len(episodes)).split(side_by_side(store, 1 + rows.shape[1])):
        first = store.start[episodes[some]][:, None]
        frames = store.frames(torch.cat((first, rows[some]), 1))
        texts = [store.instructions[number] for number in episodes[some].tolist()]
        predicted.append(world.done_along(frames, texts)[:, 1:])
    found = as_likely_as_not(torch.cat(predicted)[known].double(), done[known] > 0)
    if found is not None:
        world.threshold.fill_(found)
    return found is not None
