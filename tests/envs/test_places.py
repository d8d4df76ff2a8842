"""Places of objects: geometry of what is seen, data without pictures, contact learned in seconds, worlds without any."""

from __future__ import annotations

import torch

from envs.episodes.clips import ClipSpec, ClipStore
from envs.geometry import project
from envs.simulators.base import WorldShape
from envs.simulators.places import Places, in_view, place_map
from envs.simulators.unet import UNetConfig, UNetSimulator
from learners.fit import FitConfig
from learners.stages.vision import train_places


def test_spots_lie_where_cameras_see_the_places(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0, 1]), torch.tensor([0, 2]), ClipSpec(4, 4))
    places, c2w = clip["future", "objects"], clip["future", "c2w"]
    seen = in_view(places, clip["intrinsic"], c2w, store.size)
    spots = place_map(seen, 64, 64)
    assert spots.shape == (2, 3, 4, 2, 64, 64)
    pixels, _ = project(places[1, 2], clip["intrinsic"][1, 0], c2w[1, 2, 0])
    peak = spots[1, 0, 2, 0].flatten().argmax()
    assert (torch.stack((peak % 64, peak // 64)) + 0.5 - pixels[0]).abs().max() <= 0.51
    unknown = in_view(places * torch.nan, clip["intrinsic"], c2w, store.size)
    assert not bool(unknown.visible.any()) and float(place_map(unknown, 8, 8).abs().max()) == 0.0


def test_motions_stay_within_their_episode(store: ClipStore) -> None:
    batch = store.motions(torch.tensor([2]), 64, 4, torch.Generator().manual_seed(0))
    rows = slice(int(store.start[2]), int(store.start[2] + store.length[2]))
    mine = store.arrays["objects"][rows]
    for now, ahead in zip(batch["now", "objects"], batch["future", "objects"], strict=True):
        at = int((mine == now).all(-1).all(-1).nonzero()[0])
        matches = [torch.equal(mine[n + 1 : n + 5], ahead) for n in range(at, len(mine) - 4) if torch.equal(mine[n], now)]
        assert any(matches)


def test_contact_is_learned_and_a_rollout_follows_it(store: ClipStore, tmp_path: object) -> None:
    torch.manual_seed(0)
    model = UNetSimulator(WorldShape(chunk=4), UNetConfig(width=16, blocks=(1, 1)))
    rows = store.start[:3]
    args = (store.frames(rows), store.intrinsic[:3], store.arrays["c2w"][rows], store.arrays["commands"][rows], store.arrays["states"][rows], store.pose_maps(rows), torch.arange(3))
    assert bool(model.reset(*args)["history", "places"].isnan().all())
    train_places(model, store, torch.arange(6), torch.arange(6, 8), FitConfig(200, 512, 3e-3, bf16=False), tmp_path)  # type: ignore[arg-type]
    state, luck = model.reset(*args, likeliest=True), torch.zeros(3, 2, 3)
    truth = store.arrays["objects"][rows]
    assert float((state["history", "places"][:, 0] - truth)[..., :2].norm(dim=-1).mean()) < 0.03
    ahead = rows[:, None] + torch.arange(1, 5)
    start, recent = state["history", "places"][:, 0].clone(), store.arrays["commands"][rows][:, None].expand(-1, 5, -1)  # nothing came before
    _, _, after = model.step(state, store.arrays["commands"][ahead], store.pose_maps(ahead), store.arrays["c2w"][ahead])
    assert torch.equal(after["history", "places"][:, 4], model.places.push(start, recent, store.arrays["commands"][ahead], luck)[:, -1])


def test_objects_nobody_placed_teach_nothing(store: ClipStore) -> None:
    torch.manual_seed(0)
    places = Places(3, 4)
    found = places.of(store.arrays["objects"][:2])
    assert found.shape == (2, 3, 3) and bool(found[:, 2].isnan().all())
    shown, motion = store.shots(torch.tensor([0]), 4, torch.Generator()), store.motions(torch.tensor([0]), 4, 4, torch.Generator())
    shown["objects"] = shown["objects"] * torch.nan
    motion["now", "objects"] = motion["now", "objects"] * torch.nan
    loss, _ = places.loss(shown, motion)
    assert float(loss.detach()) == 0.0


def test_a_world_draws_the_object_where_its_place_says(simulator: UNetSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 4))
    inputs = simulator.asked(clip, 0)
    there = simulator.predict(inputs)[0]
    moved = inputs.clone()
    moved["future", "places"][..., 0, 1] += 0.1
    elsewhere = simulator.predict(moved)[0]
    changed = (there - elsewhere).abs().amax((2, 3))[0, :, :]  # largest change of any pixel row, of any view
    assert float(changed.max()) > 0.05
