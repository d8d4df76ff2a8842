"""worldloop sweep: one number of the action at a time is moved from a start, and the imagined frames are laid
out as a contact sheet for each, so that one sees whether a world has understood what each number does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from actors.factory import build_world
from envs.episodes.clips import ClipStore
from envs.episodes.filming import side_by_side, titled
from envs.files import write_atomically, write_json
from envs.initial_states import InitialStates
from envs.specs import CHUNK, COMMAND, WorldSpec, at_rest, to_chunk
from envs.targets import ConfigError
from pipeline.commands.worlds.subject import Subject
from pipeline.evaluation.value.candidates import action_spread
from pipeline.stages.given import mode_of

_HEIGHT = 128  # pixels of a picture, about


def sweep(cfg: Mapping[str, Any], root: Path) -> list[Path]:
    """Draw a contact sheet for each number of the action into the simulator's folder (see pages_of); beside
    them sweep.json says what was commanded, and by how much pictures changed against a robot's at rest.

    Raises:
        ConfigError: if there is no such episode, or what is named is not there.
    """
    section, subject = cfg["sweep"], Subject.of(cfg, root)
    cfg = subject.cfg
    store = subject.store()
    if section["episode"] >= len(store):
        raise ConfigError(f"sweep.episode={section['episode']}: there are {len(store)}, from 0 on")
    spread = usual_travel(store, cfg)
    names = store.spec.embodiment.action_names
    simulator = subject.simulator()
    parts = (simulator, subject.decoder(simulator), None)  # nobody is rewarded
    levels = [0.0, *section["levels"]]
    starts = InitialStates.of(store, torch.tensor([section["episode"]]))
    horizon = section["chunks"] * store.spec.chunk
    shared = {**cfg, "simulator": {**cfg["simulator"], "shared_noise": True}}  # rows differ by actions alone
    world = build_world(shared, *parts, starts, len(levels), horizon=horizon)
    folder, about, made = subject.pages / "sweep", [], []
    for number, name in enumerate(tqdm(names, desc="sweep", unit="number", dynamic_ncols=True)):
        travel = torch.zeros(len(levels), len(names))
        travel[:, number] = torch.tensor(levels) * spread[number]
        frames = imagined(world, travel)
        path = folder / f"{number:02d}-{re.sub(r'[^a-zA-Z0-9_.-]+', '_', name)}.png"
        titles = [f"{name} {value:+.3g}" if value else "at rest" for value in travel[:, number].tolist()]
        picture = contact_sheet(frames, titles, section["pictures"])
        _write(path, picture)
        made.append(path)
        moved = (frames.float() - frames[:1].float()).abs().mean((1, 2, 3, 4, 5))
        about.append({"name": name, "travel": travel[:, number].tolist(), "changed": moved.tolist()})
    write_json(folder / "sweep.json", {**subject.about(), "numbers": about})
    return made


def usual_travel(store: ClipStore, cfg: Mapping[str, Any]) -> Tensor:
    """How far each number of an action goes in recordings, float32 [A]: the standard deviation of absolute
    commands, and of deltas that of the deltas themselves.
    """
    if store.spec.embodiment.delta:
        return action_spread(store, mode_of(cfg))
    return store.arrays["commands"].std(0)


def commanded(spec: WorldSpec, start: Tensor, travel: Tensor, steps: int) -> Tensor:
    """Commands float32 [B, steps, A] by which numbers go from where they are, `start` [B, A], by `travel`
    [B, A] in a straight line. Changes and velocities (Embodiment.changes) are that one again and again.
    """
    robot = spec.embodiment
    share = (torch.arange(1, steps + 1) / steps)[:, None].repeat(1, robot.action_dim)
    share[:, list(robot.changes)] = 1.0
    return at_rest(start, robot)[:, None] + share * travel[:, None]


@torch.no_grad()
def imagined(world: TransformedEnv, travel: Tensor) -> Tensor:
    """Frames uint8 [B, 1 + T, V, 3, H, W], the real first one among them, of a world whose B slots begin
    alike and are moved by `travel` [B, A].
    """
    base = world.base_env
    base.schedule([0] * len(travel))
    now = world.reset()
    plan = commanded(base.spec, now[COMMAND].cpu(), travel, base.horizon)
    for begin in range(0, base.horizon, base.chunk):
        in_force = now[COMMAND]
        chunk = to_chunk(plan[:, begin : begin + base.chunk].to(in_force.device), in_force, base.mode)
        now[CHUNK] = chunk
        now = step_mdp(world.step(now), exclude_reward=True, exclude_done=True)
    return torch.stack([base.video(slot) for slot in range(len(travel))])


def contact_sheet(frames: Tensor, titles: list[str], count: int) -> NDArray[np.uint8]:
    """A picture RGB [H, W, 3]: a row for each of frames uint8 [B, T, V, 3, H, W] with its title above,
    `count` moments from the first to the last across, their views side by side.
    """
    at = torch.linspace(0, frames.shape[1] - 1, count).round().long().unique()
    rows = []
    for row, title in zip(frames[:, at], titles, strict=True):
        moments = side_by_side(row.numpy(), _HEIGHT)
        gap = np.full((moments[0].shape[0], 4, 3), 255, np.uint8)
        line = np.concatenate([part for moment in moments for part in (moment, gap)], 1)
        rows += titled([line], title)
    return np.ascontiguousarray(np.concatenate(rows))


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(".png", picture[..., ::-1])
    assert done, f"{path}: OpenCV cannot encode a picture of {picture.shape}"
    write_atomically(path, lambda part: part.write_bytes(data.tobytes()))
