"""The training loop: exact resume with every optimiser, checkpoints without code in them, clear errors."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from learners.training.checkpoint import Checkpoints, clear_checkpoints
from learners.training.fit import FitConfig, TrainingDiverged, fit, follow
from learners.training.muon import Muon
from learners.training.optimisers import OPTIMISERS, optimiser_state


class Net(nn.Module):
    """A matrix, a convolution, vectors and a buffer that training moves."""

    seen: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.line = nn.Conv1d(1, 4, 3, padding=1), nn.Linear(24, 1)
        self.register_buffer("seen", torch.zeros(()))

    def loss(self, data: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        self.seen += 1
        noise = torch.rand(len(data), 1, generator=generator)
        error = self.line(torch.tanh(self.conv(data)).flatten(1)) - data.sum(-1) - 0.1 * noise
        return error.square().mean(), {}


def train(
    folder: Path,
    optimiser: str = "adamw",
    stop: int = -1,
    spoil: int = -1,
    look: Callable[[Net, int], None] | None = None,
) -> tuple[Net, list[dict[str, float]]]:
    """The trained network and its log; stops, as if killed, or meets NaN at a step."""
    torch.manual_seed(0)
    net = Net()
    options = FitConfig(20, 8, lr=1e-2, warmup=3, bf16=False, checkpoint_every=6, seed=5, optimiser=optimiser)

    def batch(step: int, generator: torch.Generator) -> Tensor:
        if step == stop:
            raise KeyboardInterrupt
        data = torch.randn(8, 1, 6, generator=generator)
        return data * math.nan if step == spoil else data

    fit("toy", net, batch, net.loss, options, folder, look=None if look is None else partial(look, net))
    return net, [json.loads(line) for line in (folder / "metrics.jsonl").open()]


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_a_killed_run_goes_on_bit_for_bit(tmp_path: Path, optimiser: str) -> None:
    whole, log = train(tmp_path / "whole", optimiser)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "cut", optimiser, stop=15)
    assert [path.name for path in (tmp_path / "cut").glob("checkpoint-*")] == ["checkpoint-000000012"]
    resumed, rest = train(tmp_path / "cut", optimiser)
    assert rest == log
    assert all(torch.equal(value, whole.state_dict()[name]) for name, value in resumed.state_dict().items())
    again, rest = train(tmp_path / "cut", optimiser)  # it has ended: nothing is trained twice
    assert rest == log
    assert all(torch.equal(value, whole.state_dict()[name]) for name, value in again.state_dict().items())
    clear_checkpoints(tmp_path)
    assert not list((tmp_path / "cut").glob("*checkpoint-*"))


def test_a_look_sees_what_will_be_handed_on_and_changes_nothing(tmp_path: Path) -> None:
    looks: dict[int, dict[str, Tensor]] = {}

    def look(net: Net, step: int) -> None:
        assert not net.training and not torch.is_grad_enabled()
        torch.rand(7)
        looks[step] = {name: value.clone() for name, value in net.state_dict().items()}

    blind, log = train(tmp_path / "blind")
    seen, rest = train(tmp_path / "seen", look=look)
    assert list(looks) == [6, 12, 18, 20] and rest == log
    for name, value in blind.state_dict().items():
        assert torch.equal(value, seen.state_dict()[name]) and torch.equal(value, looks[20][name])
    assert not torch.equal(looks[6]["line.weight"], looks[20]["line.weight"])


def test_nothing_that_a_killed_run_was_looking_at_is_left_unseen(tmp_path: Path) -> None:
    looked: list[int] = []

    def look(_: Net, step: int) -> None:
        looked.append(step)
        if looked.count(20) == 1 and step == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "killed", look=look)
    net, rows = train(tmp_path / "killed", look=look)
    assert looked == [6, 12, 18, 20, 20]
    whole, wanted = train(tmp_path / "whole")
    assert rows == wanted
    assert all(torch.equal(value, net.state_dict()[key]) for key, value in whole.state_dict().items())


def test_checkpoints_hold_numbers_and_no_code(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, stop=15)
    checkpoint = Checkpoints(tmp_path).newest
    assert checkpoint is not None
    assert {path.suffix for path in checkpoint.iterdir()} == {".safetensors", ".json"}
    assert Checkpoints(tmp_path).facts()["step"] == 12  # type: ignore[index]


@pytest.mark.parametrize(
    ("other", "what"), [({"w": torch.zeros(3)}, "w is"), ({"v": torch.zeros(2)}, "v is in only one")]
)
def test_a_checkpoint_of_another_architecture_is_refused(
    tmp_path: Path, other: dict[str, Tensor], what: str
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"module": {"w": torch.ones(2)}}, {})
    with pytest.raises(RuntimeError, match=f"another architecture: module: {what}"):
        checkpoints.load({"module": other})
    with pytest.raises(RuntimeError, match="another architecture: optimiser"):
        checkpoints.load({"optimiser": {}})


def test_a_damaged_checkpoint_is_refused_by_name(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"module": {"w": torch.ones(2)}}, {})
    (tmp_path / "checkpoint-000000001/module.safetensors").write_bytes(b"\x00" * 20)
    with pytest.raises(RuntimeError, match="checkpoint-000000001"):
        checkpoints.load({"module": {"w": torch.zeros(2)}})


def test_a_checkpoint_that_cannot_be_written_keeps_its_predecessor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"module": {"w": torch.ones(2)}}, {"step": 1})
    with pytest.raises(TypeError):
        checkpoints.save(2, {"module": {"w": torch.ones(2)}}, {"step": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000001"]
    value = {"w": torch.zeros(2)}
    assert checkpoints.load({"module": value}) == {"step": 1} and value["w"].tolist() == [1.0, 1.0]


def test_what_a_killed_process_left_of_the_same_step_is_written_anew(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"module": {"w": torch.ones(2)}}, {"step": 1})
    (tmp_path / ".checkpoint-000000002.part").mkdir()
    checkpoints.save(2, {"module": {"w": torch.ones(2)}}, {"step": 2})
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000002"]


def test_strange_tensors_come_back_as_they_were(tmp_path: Path) -> None:
    conv = torch.randn(4, 3, 2, 2).to(memory_format=torch.channels_last)
    shared = torch.randn(5)
    held = {"a": {"conv": conv, "one": shared, "two": shared[1:]}, "count": torch.tensor(7), "none": {}}
    Checkpoints(tmp_path).save(1, {"module": held}, {})
    empty = {
        "a": {"conv": torch.empty_like(conv), "one": torch.zeros(5), "two": torch.zeros(4)},
        "count": torch.tensor(0),
        "none": {},
    }
    Checkpoints(tmp_path).load({"module": empty})
    assert torch.equal(empty["a"]["conv"], conv) and empty["a"]["conv"].stride() == conv.stride()
    assert torch.equal(empty["a"]["two"], shared[1:]) and int(empty["count"]) == 7


def test_divergence_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(TrainingDiverged, match=r"toy: loss nan.*at step 4; lower lr$"):
        train(tmp_path, spoil=4)


@pytest.mark.parametrize(
    ("bf16", "said"),
    [
        (False, r"lower state_fit\.first\.fit\.lr$"),
        (True, r"lower state_fit\.first\.fit\.lr or say \+\+state_fit\.first\.fit\.bf16=false$"),
    ],
)
def test_divergence_is_said_with_the_keys_of_the_config(tmp_path: Path, bf16: bool, said: str) -> None:
    net, options = Net(), FitConfig(2, 8, lr=1e-2, bf16=bf16, key="state_fit.first.fit")
    with pytest.raises(TrainingDiverged, match=f"state: loss nan.*at step 0; {said}"):
        fit("state", net, lambda *_: torch.full((8, 1, 6), math.nan), net.loss, options, tmp_path)


def test_the_average_follows_the_weights() -> None:
    average, weights = {"w": torch.tensor([1.0])}, {"w": torch.tensor([3.0])}
    follow(average, weights, 0.75)
    assert average["w"].tolist() == [1.5]


def test_muon_steps_are_orthogonal_whatever_the_gradient(tmp_path: Path) -> None:
    torch.manual_seed(0)
    for shape in ((6, 20), (20, 6), (8, 2, 3, 3)):
        weight = nn.Parameter(torch.zeros(shape))
        weight.grad = torch.randn(shape) * 1e-6
        Muon([weight], lr=1.0, weight_decay=0.0).step()
        step = weight.detach().flatten(1)
        scale = 0.2 * max(step.shape) ** 0.5
        values = torch.linalg.svdvals(step) / scale
        assert float(values.min()) > 0.5 and float(values.max()) < 1.3
        assert float(step.square().mean().sqrt()) == pytest.approx(0.2, rel=0.3)  # as AdamW's


def test_muon_takes_matrices_and_adamw_the_rest() -> None:
    net = Net()
    trained = dict(net.named_parameters())
    for hidden, matrices in (((), {"line.weight", "conv.weight"}), (("conv",), {"conv.weight"})):
        state = optimiser_state(OPTIMISERS["muon"](trained, 1e-3, 0.0, hidden), trained)
        assert set(state) == set(trained)
        assert {name for name, held in state.items() if "momentum_buffer" in held} == matrices


def test_unknown_optimisers_are_refused() -> None:
    with pytest.raises(ValueError, match=r"optimiser=sgd must be one of \['adamw', 'muon'\]"):
        FitConfig(1, 32, 1e-3, optimiser="sgd")


def test_batches_are_made_while_others_are_learned_from(tmp_path: Path) -> None:
    made: list[int] = []

    def batch(step: int, generator: torch.Generator) -> Tensor:
        made.append(step)
        return torch.randn(8, 1, 6, generator=generator)

    def loss(data: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        learned.append(len(made))
        while len(made) < min(6, len(learned) + 1):  # hangs, if nobody makes the next one meanwhile
            time.sleep(0.001)
        return net.loss(data, generator)

    net, learned = Net(), list[int]()
    stats = fit("toy", net, batch, loss, FitConfig(6, 8, 1e-3, bf16=False), tmp_path)
    assert made == [0, 1, 2, 3, 4, 5] and len(learned) == 6
    total = stats["data_seconds"] + stats["compute_seconds"]
    assert stats["samples_per_second"] == pytest.approx(48 / total)
