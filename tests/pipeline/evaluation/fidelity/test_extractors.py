"""Distances between distributions of features, and the networks that give features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from torch import Tensor, nn
from torch.nn import functional

from envs.episodes.clips import ClipStore
from envs.targets import ConfigError
from pipeline.commands.worlds.fidelity import build_extractors
from pipeline.evaluation.fidelity.extractors import I3D, Extractor, Inception, PyramidClips, PyramidFrames
from pipeline.evaluation.fidelity.frechet import Moments, frechet
from tests.second_device import DEVICE, second_device


class Numbers(Extractor):
    """The first two numbers of each picture, as they are."""

    name, clips = "numbers", False

    def __call__(self, pictures: Tensor) -> Tensor:
        return pictures[:, :2]


def moments(values: Tensor, parts: int = 1) -> Moments:
    out = Moments(Numbers())
    for some in values.chunk(parts):
        out.add(some)
    return out


def test_frechet_distances_are_those_of_the_textbook() -> None:
    draw = torch.randn(200, 2, generator=torch.Generator().manual_seed(0)).double()
    other = draw @ torch.tensor([[1.0, 0.6], [0.0, 0.5]]).double() + torch.tensor([1.0, -2.0])
    found = frechet(moments(draw, 3), moments(other))
    a, b = np.cov(draw.numpy().T), np.cov(other.numpy().T)
    means = ((draw.mean(0) - other.mean(0)) ** 2).sum()
    assert found["value"] == pytest.approx(float(means) + np.trace(a + b - 2 * sqrtm(a @ b).real), rel=1e-6)
    assert found["samples"] == 200 and found["dim"] == 2 and found["extractor"] == "numbers"
    # In one dimension it is (mean - mean)^2 + (spread - spread)^2: 3^2 and (1 - 2)^2 of these.
    line = torch.tensor([[-1.0, 0.0], [1.0, 0.0]]).double() / 2**0.5
    assert frechet(moments(line), moments(2 * line + torch.tensor([3.0, 0.0])))["value"] == pytest.approx(10)
    assert frechet(moments(draw), moments(draw))["value"] < 1e-9


def test_distances_of_different_extractors_are_never_mixed() -> None:
    frames, clips = Moments(PyramidFrames()), Moments(PyramidClips())
    pictures = torch.randint(0, 255, (8, 3, 32, 32), dtype=torch.uint8)
    frames.add(pictures)
    clips.add(pictures.unflatten(0, (4, 2)))
    with pytest.raises(ValueError, match="have no distance"):
        frechet(frames, clips)
    with pytest.raises(ValueError, match="two samples"):
        frechet(Moments(PyramidFrames()), frames)


def test_blur_is_further_from_the_truth_than_the_truth(store: ClipStore) -> None:
    true = store.frames(store.rows(torch.arange(8)))[:, 0]
    sides = {
        "true": true[::2],
        "again": true[1::2],
        "blurred": functional.avg_pool2d(true[1::2].float(), 5, 1, 2).to(torch.uint8),
    }
    gathered = {}
    for name, frames in sides.items():
        gathered[name] = Moments(PyramidFrames())
        gathered[name].add(frames)
    near, far = (frechet(gathered[name], gathered["true"])["value"] for name in ("again", "blurred"))
    assert far > 5 * near


class Network(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.width = width

    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        return x.mean([1, 2, 3])[:, None].expand(len(x), self.width)


class VideoNetwork(nn.Module):
    def forward(
        self, x: Tensor, rescale: bool = False, resize: bool = False, return_features: bool = False
    ) -> Tensor:
        return x.mean([1, 2, 3, 4])[:, None].expand(len(x), 400)


class Particular(nn.Module):
    """Says itself, within TorchScript, that it takes other pictures."""

    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        assert x.shape[2] == 299, "of 299 pixels"
        return x


class Strict(nn.Module):
    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        if x.shape[2] != 299:
            raise ValueError("of 299 pixels")
        return x


def scripted(path: Path, network: nn.Module) -> str:
    torch.jit.script(network).save(str(path))
    return str(path)


class Elsewhere(nn.Module):
    """Takes nothing that lies in main memory."""

    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        assert x.numel() == 2 * 3 * 64 * 64 or not x.is_cpu, "still in main memory"
        return x.mean([1, 2, 3])[:, None].expand(len(x), 2048)


def test_networks_compute_where_they_are_told_and_features_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = torch.full((3, 3, 32, 32), 7, dtype=torch.uint8)
    extractor = Inception(scripted(tmp_path / "elsewhere.pt", Elsewhere()))
    with pytest.raises(torch.jit.Error, match="still in main memory"):
        extractor(pictures)
    with second_device(monkeypatch):
        extractor.compute_on(DEVICE)
        assert torch.equal(extractor(pictures), torch.full((3, 2048), 7.0))


def test_weights_of_another_architecture_are_refused(tmp_path: Path) -> None:
    right = Inception(scripted(tmp_path / "inception.pt", Network(2048)))
    assert (
        right(torch.zeros(3, 3, 32, 32, dtype=torch.uint8)).shape == (3, 2048) and "Inception" in right.name
    )
    with pytest.raises(ConfigError, match=r"another architecture: features \(2, 1000\)"):
        Inception(scripted(tmp_path / "other.pt", Network(1000)))
    with pytest.raises(ConfigError, match="are no I3D"):
        I3D(scripted(tmp_path / "frames.pt", Network(2048)))
    for network in (Particular(), Strict()):
        with pytest.raises(ConfigError, match="are no Inception"):
            Inception(scripted(tmp_path / "particular.pt", network))
    torch.save({"weight": torch.zeros(2)}, tmp_path / "state.pt")
    with pytest.raises(ConfigError, match="are no Inception"):
        Inception(str(tmp_path / "state.pt"))
    with pytest.raises(ConfigError, match="is not there"):
        Inception(str(tmp_path / "nowhere.pt"))
    clips = I3D(scripted(tmp_path / "i3d.pt", VideoNetwork()))
    assert clips(torch.zeros(2, 16, 3, 8, 8, dtype=torch.uint8)).shape == (2, 400)


def test_clips_that_are_too_short_are_told_before_anything_is_measured(tmp_path: Path) -> None:
    names = {"frames": "PyramidFrames", "clips": "I3D"}
    where = f"{Extractor.__module__}."
    section = {f"{key}_extractor": {"_target_": where + name} for key, name in names.items()}
    section["clips_extractor"]["weights"] = scripted(tmp_path / "i3d.pt", VideoNetwork())
    with pytest.raises(ConfigError, match=r"fidelity\.clip=8: I3D.*10 frames or more; raise fidelity\.clip"):
        build_extractors({**section, "clip": 8})
    assert [one.clips for one in build_extractors({**section, "clip": 10})] == [False, True]
