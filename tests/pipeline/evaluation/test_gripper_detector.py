"""Where end effectors are known from, what a detector learns of them, and back from pixels into space."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from envs.commanded_states import as_states
from envs.embodiment import Embodiment, EmbodimentError
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.geometry.cameras import project
from envs.rng import constant_generator
from envs.simulators.replay import replay
from envs.targets import ConfigError
from pipeline.config import load_config
from pipeline.evaluation.ewmbench.choose import in_pictures
from pipeline.evaluation.ewmbench.features import ClipFrames, ClipTexts, DinoPatches
from pipeline.evaluation.fidelity.end_effector import (
    EndEffectorRuler,
    end_effector_summary,
    end_effector_text,
)
from pipeline.evaluation.grippers import ruler
from pipeline.evaluation.grippers.detecting import (
    WEIGHTS,
    Sights,
    detector_error,
    learned_from,
    taken_away,
    train_detector,
    unseen,
)
from pipeline.evaluation.grippers.end_effectors import known_end_effectors, true_end_effectors
from pipeline.evaluation.grippers.ruler import GripperRuler
from pipeline.evaluation.objects.rays import nearest_on_ray, rays, triangulate
from tests.arms import two_arms
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_JOINTS, BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square
from tests.pipeline.evaluation.fidelity.test_measures import Drawing
from tests.second_device import DEVICE, second_device

SECTION = {
    "width": 8,
    "side": 32,
    "fit": {"steps": 160, "batch": 16, "lr": 5e-3, "warmup": 10, "ema": 0.9, "bf16": False},
}
NAN = float("nan")


def test_end_effectors_are_known_from_what_the_robot_knows(
    tiny_store: Callable[[Embodiment], ClipStore], tmp_path: Path
) -> None:
    store = tiny_store(ARM_DELTAS)
    one = known_end_effectors(store, 0.15)
    assert one.source == "positions in the state" and one.measured and one.arms == ("arm",)
    assert torch.equal(one.positions[:, 0], store.arrays["states"][:, :3])
    two = known_end_effectors(tiny_store(BIMANUAL_POSES), 0.15)  # orientations are known: fingertips
    states = tiny_store(BIMANUAL_POSES).arrays["states"]
    assert two.positions.shape == (len(states), 2, 3) and two.arms == ("left", "right")
    assert torch.allclose(two.positions[:, 0], states[:, :3] + torch.tensor([0, 0, 0.15]))
    assert true_end_effectors(store, one, 0.15) is one  # measured, and physics recorded nothing else
    told = replace(two, measured=False)
    assert true_end_effectors(tiny_store(BIMANUAL_POSES), told, 0.15) is None
    for robot in (ARM_JOINTS, BIMANUAL_JOINTS):
        with pytest.raises(EmbodimentError, match=rf"end effectors of {robot.robot} are: record x, y, z"):
            known_end_effectors(tiny_store(robot), 0.15)
    robot = replace(BIMANUAL_JOINTS, kinematics=two_arms(tmp_path)).at(SIZE)
    described = ClipStore([tiny_store(BIMANUAL_JOINTS).parts[0].folder], world_spec(robot, SIZE), tmp_path)
    found = known_end_effectors(described, 0.0)
    assert found.source == "joints in the state, by kinematics" and found.measured
    assert found.positions.shape == (len(described.arrays["states"]), 2, 3)
    assert float(found.positions[..., 2].max()) == pytest.approx(0.7, abs=1e-4)  # seven links of 10 cm
    names = BIMANUAL_JOINTS.state_names
    turned = replace(robot, state_names=(*names[8:], *names[:8]))
    made = [moving_square(robot, seed) for seed in range(2)]
    for name, body in (("as", robot), ("turned", turned)):
        episodes = [replace(one, embodiment=body, states=as_states(body, one.states)) for one in made]
        LeRobotWriter(tmp_path / name, body).write(episodes)
    stores = (ClipStore([tmp_path / n], world_spec(b, SIZE)) for n, b in (("as", robot), ("turned", turned)))
    same = [known_end_effectors(store, 0.0).positions for store in stores]
    assert torch.equal(*same)


def test_a_detector_belongs_to_what_its_data_hold_and_to_the_robot(
    store: ClipStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[Path] = []
    monkeypatch.setattr(ruler, "train_detector", lambda sights, section, folder, device: used.append(folder))
    data, robot = tmp_path / "set", tmp_path / "robot.urdf"
    shutil.copytree(store.parts[0].folder, data)
    cfg = load_config(["experiment=smoke"])

    def find() -> None:
        ruler.gripper_ruler(cfg, store, [data], tmp_path)

    find()
    find()
    assert len(set(used)) == 1
    video = next((data / "videos").rglob("*.mp4"))
    content = bytearray(video.read_bytes())
    content[-100] ^= 1
    video.write_bytes(content)  # as many frames, recorded anew
    find()
    robot.write_text("one")
    cfg["simulator"]["kinematics"] = {"model": str(robot), "joints": [], "flanges": []}
    find()
    robot.write_text("three")
    find()
    assert len(set(used)) == 4


def test_a_detector_learns_what_projection_says(store: ClipStore, tmp_path: Path) -> None:
    sights = Sights.of(store, known_end_effectors(store, 0.15), (0, 1, 2))
    assert sights.views == (0,)  # the others are on wrists
    detector = train_detector(sights, SECTION, tmp_path, torch.device("cpu"))
    held = unseen(store, store.split("held_out"))
    assert len(held) and not set(held.tolist()) & set(learned_from(store).tolist())
    error = detector_error(detector, sights, held)["top"]
    assert error["px"]["median"] < 2.0 and error["missed"] < 0.2 and error["imagined"] < 0.3
    again = train_detector(sights, SECTION, tmp_path, torch.device("cpu"))  # from its file
    frames = store.frames(store.rows(held))[:, :1]
    found = [one.detect(frames, torch.arange(1)).nan_to_num(-1) for one in (detector, again)]
    assert torch.equal(*found) and (tmp_path / WEIGHTS).is_file()
    empty = frames[:1, ..., :1, :1].expand_as(frames[:1])  # the square is gone, and with it the left arm
    assert torch.isnan(detector.detect(empty, torch.arange(1))[0, 0, 0]).all()
    taught = GripperRuler(detector, sights.views, None, tmp_path / WEIGHTS)
    flat = in_pictures(store, taught, held)  # where space is unknown
    assert [tuple(path.shape) for path in flat.paths] == [(13, 2, 2)] * len(held)
    assert "picture plane" in flat.by and float(flat.paths[0].nan_to_num(0).max()) <= 1
    # In space: of one camera alone, across its line of sight. A pixel is 2.7 cm there.
    space = EndEffectorRuler(taught, sights.ends, ("top",))
    made = replay(Drawing(store.spec, "right"), store, held, bf16=False)
    summary = end_effector_summary(space, [space.measure(store, held, made, store.frames(made.rows))])
    assert summary["generated_cm"]["median"] < 6 and summary["recorded_cm"]["median"] < 6
    assert abs(summary["lost"] - summary["recorded_lost"]) < 0.1
    assert "across the line of sight of top" in end_effector_text(summary)
    grey = replay(Drawing(store.spec, "grey"), store, held, bf16=False)
    lost = space.measure(store, held, grey, store.frames(made.rows))
    assert torch.isnan(lost["made"][..., 0]).float().mean() > 0.9  # no square, no left arm
    with pytest.raises(ConfigError, match="another architecture or robot"):
        train_detector(sights, {**SECTION, "width": 16}, tmp_path, torch.device("cpu"))


def test_cameras_that_cannot_see_trajectories_are_refused(
    store: ClipStore, tiny_store: Callable[[Embodiment], ClipStore]
) -> None:
    with pytest.raises(EmbodimentError, match="are all on wrists"):
        Sights.of(store, known_end_effectors(store, 0.15), (1, 2))
    bare = tiny_store(ARM_DELTAS)
    with pytest.raises(EmbodimentError, match=r"none of the cameras \['corner'\]"):
        Sights.of(bare, known_end_effectors(bare, 0.15), (0,))


def test_a_gripper_is_taken_out_of_a_picture_where_no_other_is_near() -> None:
    seen, away = (torch.full((3, 3, 16, 16), value, dtype=torch.uint8) for value in (200, 10))
    wanted = torch.tensor([[[4.0, 4], [12, 12]], [[4, 4], [7, 4]], [[4, 4], [NAN, NAN]]])
    off = torch.full_like(wanted, NAN)
    out, left = taken_away(seen, away, wanted, off, torch.full((3, 2), 2.0), torch.tensor([0, 0, -1]))
    assert (out[0, :, 2:6, 2:6] == 10).all() and int((out[0, 0] == 10).sum()) == 16
    assert torch.isnan(left[0, 0]).all() and torch.equal(left[0, 1], wanted[0, 1])
    assert torch.equal(out[1:], seen[1:]) and torch.equal(left[1:].nan_to_num(-1), wanted[1:].nan_to_num(-1))
    pasted = off.clone()
    pasted[0, 1] = torch.tensor([5.0, 5])  # what would be pasted shows a gripper
    out, _ = taken_away(seen, away, wanted, pasted, torch.full((3, 2), 2.0), torch.tensor([0, 0, -1]))
    assert torch.equal(out, seen)


def test_rays_meet_where_they_came_from() -> None:
    draw = constant_generator(3)
    points = torch.rand(6, 3, generator=draw) * 0.4
    intrinsic = torch.tensor([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]])
    c2w = torch.eye(4).repeat(3, 1, 1)
    c2w[:, 1, 1] = c2w[:, 2, 2] = -1.0  # looking down
    c2w[:, :3, 3] = torch.tensor([[0.0, 0, 1], [0.5, 0, 1], [0, 0.4, 1.2]])
    pixels = torch.stack([project(points, intrinsic, camera)[0] for camera in c2w], 1)  # [6, 3, 2]
    origin, direction = rays(pixels, intrinsic.expand(6, 3, 3, 3), c2w.expand(6, 3, 4, 4))
    assert torch.allclose(triangulate(origin, direction), points, atol=1e-4)
    direction[0, 1:] = NAN  # one camera alone
    direction[1, 2] = NAN
    found = triangulate(origin, direction)
    assert torch.isnan(found[0]).all() and torch.allclose(found[1:], points[1:], atol=1e-4)
    alike = triangulate(origin[:, :1].repeat(1, 2, 1), direction[:, :1].repeat(1, 2, 1))
    assert torch.isnan(alike).all()
    # Along its line of sight a camera sees no error; across it, all of it.
    along, across = points + 0.1 * direction[:, 0], points + torch.tensor([0.0, 0, 0])
    assert torch.allclose(nearest_on_ray(origin[:, 0], direction[:, 0], along), along, atol=1e-5)
    side = torch.linalg.cross(direction[:, 0], torch.tensor([[1.0, 0, 0]]).expand(6, 3))
    off = nearest_on_ray(origin[:, 0], direction[:, 0], across + 0.05 * side / side.norm(dim=1, keepdim=True))
    assert torch.allclose(off, points, atol=1e-5)


def test_extractors_refuse_weights_of_another_architecture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("transformers", reason="pip install -c constraints.txt 'worldloop[vlm]'")
    from transformers import CLIPConfig, CLIPModel, Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    dino = Dinov2Model(
        Dinov2Config(hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=28)
    )
    dino.save_pretrained(tmp_path / "dino")
    vision = {**small, "image_size": 28, "patch_size": 14}
    clip = CLIPModel(
        CLIPConfig(vision_config=vision, text_config={**small, "vocab_size": 99}, projection_dim=8)
    )
    clip.save_pretrained(tmp_path / "clip")
    pictures = torch.randint(0, 255, (3, 3, 32, 48), dtype=torch.uint8, generator=constant_generator(1))
    patches = DinoPatches(str(tmp_path / "dino"), side=28)
    assert patches(pictures).shape == (3, 2 * 3, 16) and patches.name.startswith("dinov2 patches at 28 (")
    frames = ClipFrames(str(tmp_path / "clip"))
    assert frames(pictures).shape == (3, 8) and not torch.equal(*frames(pictures)[:2])
    near = [extractor(pictures) for extractor in (patches, frames)]
    with second_device(monkeypatch):  # where launch.device says
        for extractor, features in zip((patches, frames), near, strict=True):
            extractor.compute_on(DEVICE)
            assert {part.device for part in extractor._network.parameters()} == {DEVICE}
            assert torch.allclose(extractor(pictures), features, atol=1e-5)
    with pytest.raises(ConfigError, match="of another architecture: clip, and DINOv2 is one of"):
        DinoPatches(str(tmp_path / "clip"))
    with pytest.raises(ConfigError, match="of another architecture: dinov2, and CLIP"):
        ClipFrames(str(tmp_path / "dino"))
    lacking = tmp_path / "lacking"  # transformers would fill in what is missing with random numbers
    shutil.copytree(tmp_path / "dino", lacking)
    found = load_file(lacking / "model.safetensors")
    some = {f"backbone.{name}": value for name, value in found.items()}
    save_file(some, lacking / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ConfigError, match=r"lacks \d+ of the weights of Dinov2Model.*such as \['backbone"):
        DinoPatches(str(lacking))
    with pytest.raises(ConfigError, match="holds no tokenizer"):
        ClipTexts(str(tmp_path / "clip"))
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    cut = Tokenizer(models.WordLevel({"<pad>": 0, "<unk>": 1, "cup": 2}, unk_token="<unk>"))
    cut.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"pad_token": "<pad>", "unk_token": "<unk>"}
    PreTrainedTokenizerFast(tokenizer_object=cut, **special).save_pretrained(tmp_path / "clip")
    texts = ClipTexts(str(tmp_path / "clip"))
    assert texts.similarity(["a cup", "cup " * 77], ["the cup"]).shape == (2, 1)
    with pytest.raises(ConfigError, match=r"takes 77 tokens, and 'cup cup.* has 78; ask for shorter"):
        texts.similarity(["cup"], ["cup " * 78])
    with pytest.raises(ConfigError, match=r"must be a folder with config\.json"):
        DinoPatches(str(tmp_path / "nowhere"))
    (tmp_path / "dino/model.safetensors").write_bytes(b"a damaged file")
    with pytest.raises(ConfigError, match="transformers cannot load DINOv2 from it"):
        DinoPatches(str(tmp_path / "dino"))
