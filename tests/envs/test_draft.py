"""Drafts: what geometry alone says of frames to come."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipSpec, ClipStore
from envs.geometry import project
from envs.simulators.base import Simulator, WorldShape
from envs.simulators.draft import Draft


def _drafts(store: ClipStore, episode: int, move: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Drafts [K, V, 3, H, W] after an episode's first frame with its objects and cameras as recorded, or objects moved by [4] instead and cameras still; the true frames, and the first [V, 3, H, W]."""
    clip = store.clips(torch.tensor([episode]), torch.tensor([0]), ClipSpec(4, 12))
    inputs = Simulator(WorldShape(chunk=12)).asked(clip, 0)
    if move is not None:
        inputs["future", "places"] = inputs["now", "places"][:, None].expand(-1, 12, -1, -1).clone() + move
        inputs["future", "c2w"] = inputs["memory", "c2w"][:, :1].expand(-1, 12, -1, -1, -1).clone()
    draft = Draft(3, store.size)
    draft.learn(store.frames(store.start), store.arrays["c2w"][store.start])
    made = torch.stack(_drawn(draft, inputs), 2)[0]
    return made, clip["future", "frames"][0].float() / 255, inputs["memory", "frames"][0, 0].float() / 255


def _drawn(draft: Draft, inputs: TensorDict) -> list[Tensor]:
    """Drafts [1, K, 3, H, W] of all views."""
    memory = inputs["memory"]
    begin = draft.prepare(memory["frames"][:, 0], memory["places"][:, 0], inputs["intrinsic"], memory["c2w"][:, 0])
    return draft(begin, draft.look(inputs).at(slice(None), slice(1, None)), inputs["future", "c2w"], inputs["intrinsic"])


def test_where_nothing_happens_the_first_frame_stays(store: ClipStore) -> None:
    made, _, first = _drafts(store, 1, torch.zeros(4))
    assert float((made - first).abs().mean()) < 0.01


def test_a_thing_is_carried_and_leaves_the_ground(store: ClipStore) -> None:
    made, _, first = _drafts(store, 1, torch.tensor([0.12, 0.0, 0.0, 0.0]))
    row = store.start[1]
    place, camera = store.arrays["objects"][row, :1, :3], (store.intrinsic[1, 0], store.arrays["c2w"][row, 0])
    old, new = (project(value, *camera)[0][0].long() for value in (place, place + torch.tensor([0.12, 0.0, 0.0])))
    colour, ground = first[0, :, old[1], old[0]], first[0].flatten(1).median(-1).values
    assert float((made[0, 0, :, new[1], new[0]] - colour).abs().max()) < 0.1
    assert float((made[0, 0, :, old[1], old[0]] - ground).abs().max()) < 0.1


def test_moving_cameras_see_the_ground_move_and_their_hand_stay(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 12))
    moved = (clip["future", "c2w"][0, :, 1:, :3, 3] - clip["memory", "c2w"][0, 0, 0, 1:, :3, 3]).norm(dim=-1)
    hand = int(moved[-1].argmax()) + 1
    made, true, first = _drafts(store, 0)
    still = (first[hand] - true[-1, hand]).square().mean()
    assert float(moved.max()) > 0.05 and float((made[-1, hand] - true[-1, hand]).square().mean()) < 0.7 * float(still)
    draft = Draft(3, store.size)
    draft.learn(store.frames(store.start), store.arrays["c2w"][store.start])
    assert float(draft.mounted[0].max()) == 0.0 and float(draft.mounted[hand].sum()) > 100
    fingers = draft.mounted[hand, 0] > 0
    assert torch.allclose(made[-1, hand][:, fingers], first[hand][:, fingers], atol=1e-5)


def test_cameras_nobody_placed_keep_the_first_frame(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 4))
    inputs = Simulator(WorldShape(chunk=4, sides=())).asked(clip, 0)
    for part in ("memory", "future"):
        inputs[part, "c2w"] = torch.eye(4).expand_as(inputs[part, "c2w"]).clone()
    draft = Draft(3, store.size)
    first = inputs["memory", "frames"][0, 0, 0].float() / 255
    assert torch.allclose(_drawn(draft, inputs)[0][0, 2], first, atol=1e-4)
