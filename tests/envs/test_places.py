"""Places of objects: geometry of what is seen, data without pictures, contact learned in seconds, worlds without any."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from envs.episodes.clips import ClipSpec, ClipStore
from envs.geometry import project
from envs.simulators.base import WorldShape
from envs.simulators.contact import Contact
from envs.simulators.in_view import in_view, place_map
from envs.simulators.places import Places
from envs.simulators.sight import turn
from envs.simulators.unet import UNetConfig, UNetSimulator
from learners.fit import FitConfig
from learners.stages.vision import train_contact, train_sight


def test_spots_lie_where_cameras_see_the_places(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0, 1]), torch.tensor([0, 2]), ClipSpec(4, 4))
    places, c2w = clip["future", "objects"], clip["future", "c2w"]
    seen = in_view(places, clip["intrinsic"], c2w, store.size)
    spots = place_map(seen, 64, 64)
    assert spots.shape == (2, 3, 4, 2, 64, 64)
    pixels, _ = project(places[1, 2, :, :3], clip["intrinsic"][1, 0], c2w[1, 2, 0])
    peak = spots[1, 0, 2, 0].flatten().argmax()
    assert (torch.stack((peak % 64, peak // 64)) + 0.5 - pixels[0]).abs().max() <= 0.51
    unknown = in_view(places * torch.nan, clip["intrinsic"], c2w, store.size)
    assert not bool(unknown.visible.any()) and float(place_map(unknown, 8, 8).abs().max()) == 0.0


def test_axes_in_view_follow_the_heading(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 4))
    places = clip["future", "objects"].clone()
    ahead = places.clone()
    ahead[..., 0] += 0.01 * places[..., 3].nan_to_num().cos()
    ahead[..., 1] += 0.01 * places[..., 3].nan_to_num().sin()
    here, there = (in_view(value, clip["intrinsic"], clip["future", "c2w"], store.size) for value in (places, ahead))
    moved = (there.where - here.where)[:, 0]
    assert torch.allclose(0.01 * here.axes[:, 0, ..., 0], moved, atol=1e-4)


def test_motions_stay_within_their_episode(store: ClipStore) -> None:
    batch = store.motions(torch.tensor([2]), 64, 4, torch.Generator().manual_seed(0))
    rows = slice(int(store.start[2]), int(store.start[2] + store.length[2]))
    mine = store.arrays["objects"][rows].nan_to_num()
    for now, ahead in zip(batch["now", "objects"].nan_to_num(), batch["future", "objects"].nan_to_num(), strict=True):
        at = int((mine == now).all(-1).all(-1).nonzero()[0])
        matches = [torch.equal(mine[n + 1 : n + 5], ahead) for n in range(at, len(mine) - 4) if torch.equal(mine[n], now)]
        assert any(matches)


def test_contact_is_learned_and_a_rollout_follows_it(store: ClipStore, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = UNetSimulator(WorldShape(chunk=4), UNetConfig(width=16, blocks=(1, 1)))
    rows = store.start[:3]
    args = (store.frames(rows), store.intrinsic[:3], store.arrays["c2w"][rows], store.arrays["commands"][rows], store.arrays["states"][rows], store.pose_maps(rows), torch.arange(3))
    assert bool(model.reset(*args)["history", "places"].isnan().all())
    train_sight(model, store, torch.arange(6), FitConfig(200, 16, 3e-3, bf16=False), tmp_path / "sight")
    train_contact(model, store, torch.arange(6), torch.arange(6, 8), FitConfig(150, 256, 3e-3, bf16=False), tmp_path / "contact")
    state, luck = model.reset(*args, likeliest=True), torch.zeros(3, 2, 3)
    truth = store.arrays["objects"][rows]
    assert float((state["history", "places"][:, 0] - truth)[..., :2].norm(dim=-1).mean()) < 0.03
    ahead = rows[:, None] + torch.arange(1, 5)
    start, recent = state["history", "places"][:, 0].clone(), store.arrays["commands"][rows][:, None]  # nothing came before
    _, _, after = model.step(state, store.arrays["commands"][ahead], store.pose_maps(ahead), store.arrays["c2w"][ahead])
    expected = model.places.push(start, recent, store.arrays["commands"][ahead], luck)[:, -1]
    assert torch.allclose(after["history", "places"][:, 4], expected, equal_nan=True)


def _turned(values: torch.Tensor, angle: float) -> torch.Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.stack((cos * values[..., 0] - sin * values[..., 1], sin * values[..., 0] + cos * values[..., 1]), -1)


def test_contact_knows_no_direction_no_side_and_no_hand(store: ClipStore) -> None:
    torch.manual_seed(0)
    contact = Contact((4, 0)).eval()
    for layer in contact.layers[::2]:
        torch.nn.init.normal_(layer.weight, std=0.1)
    places = torch.tensor([[[0.2, 0.1, 0.03, 0.3], [0.9, 0.9, 0.0, torch.nan]]])
    commands = torch.zeros(1, 5, 14)
    commands[:, :, 2::7], commands[:, :, 3::7] = 0.17, math.pi  # fingertips down, two centimetres above the table
    commands[0, :, 0], commands[0, :, 1] = torch.linspace(0.12, 0.18, 5), torch.linspace(0.1, 0.11, 5)
    commands[0, :, 7], commands[0, :, 8] = -0.5, -0.5  # the other hand is elsewhere
    way, _ = contact.foresee(places, commands[:, :1], commands[:, 1:])
    moved = way[0, -1, 0] - places[0, 0]
    assert float(moved[:2].norm()) > 1e-4 and torch.equal(way[0, -1, 1, :2], places[0, 1, :2])

    quarter = places.clone()
    quarter[0, 0, 3] += math.pi / 2  # the same block to look at
    assert torch.allclose(contact.foresee(quarter, commands[:, :1], commands[:, 1:])[0][0, -1, 0, :2], way[0, -1, 0, :2], atol=1e-5)

    swapped = torch.cat((commands[..., 7:], commands[..., :7]), -1)
    assert torch.allclose(contact.foresee(places, swapped[:, :1], swapped[:, 1:])[0][0, -1, 0], way[0, -1, 0], atol=1e-5)

    angle = 0.7
    around, other = commands.clone(), places.clone()
    for hand in (0, 7):
        around[..., hand : hand + 2] = _turned(commands[..., hand : hand + 2], angle)
        around[..., hand + 5] += angle
    other[..., :2], other[..., 3] = _turned(places[..., :2], angle), places[..., 3] + angle
    found = contact.foresee(other, around[:, :1], around[:, 1:])[0][0, -1, 0]
    assert torch.allclose(found[:2], _turned(way[0, -1, 0, :2], angle), atol=1e-5)
    assert torch.allclose(found[3] - other[0, 0, 3], moved[3], atol=1e-5)

    flip = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0] * 2)
    mirrored = contact.foresee(places * torch.tensor([1.0, -1.0, 1.0, -1.0]), (commands * flip)[:, :1], (commands * flip)[:, 1:])[0][0, -1, 0]
    assert torch.allclose(mirrored, way[0, -1, 0] * torch.tensor([1.0, -1.0, 1.0, -1.0]), atol=1e-5)


def test_however_doubtful_a_push_it_can_be_learned_from(store: ClipStore) -> None:
    contact = Contact((4, 0))
    motion = store.motions(torch.arange(len(store)), 64, 4, torch.Generator().manual_seed(0))
    with torch.no_grad():
        contact.layers[-1].bias[3:] = 200.0  # e to its power is no number
    value, _ = contact.loss(torch.cat((motion["now", "objects"][:, None], motion["future", "objects"]), 1), motion)
    value.backward()
    assert all(bool(torch.isfinite(p.grad).all()) for p in contact.parameters())


def test_turn_is_within_half_a_side() -> None:
    angles = torch.tensor([[math.pi / 2 + 0.1, 3.0], [-0.2, -3.0]])
    assert torch.allclose(turn(angles, torch.tensor([4, 0])), torch.tensor([[0.1, 0.0], [-0.2, 0.0]]), atol=1e-6)


def test_objects_nobody_placed_teach_nothing(store: ClipStore) -> None:
    torch.manual_seed(0)
    places = Places((4, 0, 0))
    found = places.of(store.arrays["objects"][:2])
    assert found.shape == (2, 3, 4) and bool(found[:, 2].isnan().all())
    shown, motion = store.shots(torch.tensor([0]), 4, torch.Generator()), store.motions(torch.tensor([0]), 4, 4, torch.Generator())
    nowhere = torch.full((4, 5, 3, 4), torch.nan)
    for loss, figures in (places.sight.loss(shown, nowhere[:, 0]), places.contact.loss(nowhere, motion)):
        assert float(loss.detach()) == 0.0 and all(float(value) == 0.0 for value in figures.values())


def test_a_world_draws_the_object_where_its_place_says(simulator: UNetSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 4))
    inputs = simulator.asked(clip, 0)
    there = simulator.predict(inputs)[0]
    moved = inputs.clone()
    moved["future", "places"][..., 0, 1] += 0.1
    elsewhere = simulator.predict(moved)[0]
    changed = (there - elsewhere).abs().amax((2, 3))[0, :, :]  # largest change of any pixel row, of any view
    assert float(changed.max()) > 0.05
