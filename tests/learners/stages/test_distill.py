"""Few-step students: they make what the teacher makes, go on exactly where they were killed, and every engine
that denoises in steps has them.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.samplers import Euler, Sampler, few_steps
from envs.simulators.stepwise import Stepwise
from envs.specs import WorldSpec
from envs.targets import ConfigError, build
from learners.stages.distill.method import Method
from learners.stages.distill.stage import check_pair, train_student
from learners.stages.simulator import ClipBatches, SimulatorFitConfig
from learners.training.fit import FitConfig
from learners.training.lora import TARGETS
from learners.training.optimisers import optimiser_state
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.learners.models import section_of, simulator_of, stepwise_engines, stepwise_pair
from tests.moving_square import SIZE
from tests.sampling import every
from tests.sections import section

Stores = Callable[[Embodiment], ClipStore]
METHODS, SMALL = ("dmd2", "trajectory"), stepwise_engines()
# Matching by critics circles around its goal, the less the slower its student goes.
PACE = {"dmd2": (900, 3e-3, 0.99), "trajectory": (200, 1e-2, 0.98)}  # steps, learning rate, EMA
CLIPS = SimulatorFitConfig(single_chunk_fraction=1.0, unroll=1, strides=(1,), recent_fraction=0.0, lora=0)


class Bell(Stepwise):
    """A world of 32 normal numbers, each of mean 2 and spread 1/2. What it begins with is exact in many
    steps; in one it makes the mean, and nothing else.
    """

    def __init__(self, spec: WorldSpec, sampler: Sampler):
        super().__init__(spec, 2)
        self.net = nn.Sequential(nn.Linear(2, 64), nn.SiLU(), nn.Linear(64, 1))
        nn.init.zeros_(self.net[2].weight), nn.init.zeros_(self.net[2].bias)
        self.codec, self._sampler = nn.Identity(), sampler

    @property
    def sampler(self) -> Sampler:
        return self._sampler

    def chunk_of(self, clip: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor]:
        seeds = torch.randint(2**40, (16,), generator=generator)
        return TensorDict({"seed": seeds}, [16]), torch.ones(16, 1)

    def prepare(self, inputs: TensorDict) -> None:
        return None

    def noise(self, inputs: TensorDict, given: None) -> Tensor:
        return torch.randn(16, 32, generator=torch.Generator().manual_seed(int(inputs["seed"][0])))

    def velocity(self, z: Tensor, level: Tensor, given: None) -> Tensor:
        s = level[:, None]
        kept = 0.25 * (1 - s) / (0.25 * (1 - s) ** 2 + s**2)
        exact = 2 + kept * (z - 2 * (1 - s))  # the mean of all that may lie behind z
        return (z - exact - self.net(torch.stack([z, s.expand_as(z)], -1))[..., 0]) / s

    def sample(self) -> Tensor:
        """Numbers [64, 32] that it makes."""
        noise = torch.randn(64, 32, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            return self.sampler(lambda z, s: self.velocity(z, torch.full((len(z),), s), None), noise)


def learned(student: Bell, options: FitConfig) -> Tensor:
    """What a student makes at the steps that it learns, each as often as it is drawn."""
    method, nothing = Method(deepcopy(student), student, options), torch.Generator().manual_seed(0)
    with torch.no_grad():
        made = [method.generated(student.chunk_of(TensorDict(), nothing)[0], step) for step in range(64)]
    return torch.cat([chunk.latents for chunk in made])


@pytest.mark.parametrize(("count", "name"), every(3, product((1, 2), METHODS)))
def test_a_student_makes_what_the_teacher_makes(
    count: int, name: str, tiny_store: Stores, tmp_path: Path
) -> None:
    store = tiny_store(ARM_DELTAS)
    torch.manual_seed(0)
    teacher = Bell(store.spec, Euler(32, 1.0))
    student = Bell(store.spec, few_steps(count, 1.0))
    student.load_state_dict(teacher.state_dict())
    assert float(teacher.sample().std()) == pytest.approx(0.5, abs=0.05)
    assert float(student.sample().std()) < (0.05 if count == 1 else 0.25)
    method = section(f"distiller/{name}", **({"critic_lr": 1e-2} if name == "dmd2" else {}))
    steps, lr, ema = PACE[name]
    options = FitConfig(steps, 1, lr, warmup=5, bf16=False, ema=ema, checkpoint_every=1000)
    train_student(teacher, method, ClipBatches(student, store, torch.arange(4), CLIPS, options), tmp_path)
    # Of several steps DMD2 matches the mixture, not each: its critic does not know them apart, and what is
    # sampled, by the last, may lie a little beside what the first makes.
    mixed = name == "dmd2" and count > 1
    made = student.sample()
    assert float(made.mean()) == pytest.approx(2.0, abs=0.2 if mixed else 0.12)
    assert float(made.std()) == pytest.approx(0.5, abs=0.1)
    if mixed:
        made = learned(student, options)
        assert float(made.mean()) == pytest.approx(2.0, abs=0.12)
        assert float(made.std()) == pytest.approx(0.5, abs=0.1)


def test_each_level_that_a_student_samples_at_is_learned_as_often_and_no_other(tiny_store: Stores) -> None:
    spec, options = tiny_store(ARM_DELTAS).spec, FitConfig(1, 1, 1e-3, bf16=False)
    student = Bell(spec, few_steps(4, 1.0))
    method, seen, counts = (
        Method(Bell(spec, Euler(32, 1.0)), student, options),
        list[float](),
        Counter[float](),
    )

    def watch(z: Tensor, level: Tensor, given: None) -> Tensor:
        seen.append(float(level[0]))
        return Bell.velocity(student, z, level, given)

    student.velocity = watch  # type: ignore[method-assign]
    for step in range(400):
        seen.clear()
        method.generated(student.chunk_of(TensorDict(), torch.Generator())[0], step)
        assert seen == list(few_steps(4, 1.0).sigmas[: len(seen)])
        counts[seen[-1]] += 1
    assert len(counts) == 4 and all(70 < times < 130 for times in counts.values())


@pytest.mark.parametrize(
    ("engine", "method", "lora"),
    [
        *((engine, method, 0) for engine in SMALL for method in METHODS),
        *((engine, "dmd2", 2) for engine in SMALL),  # student and critic have adapters
        ("gesim_tiny", "trajectory", 2),
    ],
)
def test_a_killed_distillation_goes_on_bit_for_bit(
    engine: str, method: str, lora: int, tiny_store: Stores, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ClipStore(
        [part.folder for part in tiny_store(BIMANUAL_POSES).parts],
        replace(world_spec(BIMANUAL_POSES.at(SIZE), SIZE), chunk=5),
    )
    clips, how = replace(CLIPS, lora=lora), section(f"distiller/{method}")
    if "critic_updates" in how:
        how["critic_updates"] = 1
    options = FitConfig(4, 2, 1e-3, warmup=1, bf16=False, ema=0.5, checkpoint_every=2)
    teacher, student = stepwise_pair(engine, store.spec)
    assert isinstance(teacher, Stepwise) and isinstance(student, Stepwise)
    begun = {name: value.clone() for name, value in student.state_dict().items()}

    def learn(folder: Path) -> dict[str, Tensor]:
        torch.manual_seed(7)  # adapters are drawn
        world = deepcopy(student)
        batches = ClipBatches(world, store, torch.arange(20), clips, options)
        train_student(deepcopy(teacher), how, batches, folder)
        return world.state_dict()

    whole = learn(tmp_path / "whole")
    changed = {name for name, value in whole.items() if not torch.equal(value, begun[name])}
    assert changed and not any(name.startswith("codec.") for name in changed)
    assert not lora or all(name.removesuffix(".weight").endswith(TARGETS) for name in changed)
    assert list(whole) == list(begun)
    sample, seen = store.sample, []

    def killed(*given: Any) -> TensorDict:
        seen.append(given)
        if len(seen) == 4:
            raise KeyboardInterrupt
        return sample(*given)

    with monkeypatch.context() as patch:
        patch.setattr(store, "sample", killed)
        with pytest.raises(KeyboardInterrupt):
            learn(tmp_path / "cut")
    resumed = learn(tmp_path / "cut")
    assert all(torch.equal(value, whole[name]) for name, value in resumed.items())
    rows = [json.loads(line) for line in (tmp_path / "cut/metrics.jsonl").open()]
    assert [row["step"] for row in rows] == [0, 1, 2, 3]


@pytest.mark.parametrize("method", METHODS)
def test_muon_moves_the_hidden_layers_that_the_engine_names(method: str, tiny_store: Stores) -> None:
    teacher, student = stepwise_pair("forcing_small", tiny_store(BIMANUAL_POSES).spec)
    options = FitConfig(1, 2, 1e-3, bf16=False, optimiser="muon")
    made = build(
        section(f"distiller/{method}"), "distill.method", teacher=teacher, student=student, config=options
    )
    trained = {name: p for name, p in made.named_parameters() if p.requires_grad}
    state = optimiser_state(made.optimise(trained, 1e-3, 0.0), trained)
    matrices = {name for name, held in state.items() if "momentum_buffer" in held}
    assert matrices and all(set(student.hidden) & set(name.split(".")) for name in matrices)


def test_teacher_and_student_must_belong_together(tiny_store: Stores) -> None:
    spec = tiny_store(BIMANUAL_POSES).spec
    teacher, student = stepwise_pair("dit_small", spec)
    check_pair(teacher, student)
    with pytest.raises(ValueError, match=r"conditioned differently: simulator\.pose_map: True and False"):
        check_pair(teacher, stepwise_pair("dit_small", replace(spec, pose_map=False))[1])
    forcing, words = stepwise_pair("forcing_small", spec)[0], {"_target_": "envs.conditioning.ActionText"}
    one = other_than("forcing_small", spec, {"actions": {**words, "decimals": 0}})
    other = other_than("forcing_small", spec, {"actions": {**words, "decimals": 2}})
    with pytest.raises(ValueError, match=r"simulator\.actions: .*ActionVector .* and .*ActionText "):
        check_pair(forcing, one)
    with pytest.raises(ValueError, match=r"simulator\.actions: .*'decimals': 0.* and .*'decimals': 2"):
        check_pair(one, other)
    drifting = {"prediction": {**section_of("simulator", "forcing_small")["prediction"], "drift": 0.2}}
    with pytest.raises(ValueError, match=r"simulator\.prediction: .*'drift': 0\.1.* and .*'drift': 0\.2"):
        check_pair(forcing, other_than("forcing_small", spec, drifting))
    schedule = {"start": -2.0, "end": 3.0, "temperature": 1.0}
    steps = section_of("simulator", "forcing_small")["denoising"]
    for changes, said in (
        ({"context": 2}, r"context: 4 and 2"),
        ({"horizon": 1}, r"horizon: \d and 1"),
        ({"denoising": {**steps, "stabilisation": 0.1}}, r"denoising\.stabilisation: 0\.015 and 0\.1"),
        ({"denoising": {**steps, "schedule": schedule}}, r"denoising\.schedule: .*'start': -3\.0.*-2\.0"),
    ):
        # as many frames are remembered in training
        like = {"window": spec.chunk + forcing.memory_frames}
        with pytest.raises(ValueError, match=rf"conditioned differently: simulator\.{said}"):
            check_pair(forcing, other_than("forcing_small", spec, like | changes))
    folded = replace(spec, chunk=5)
    with pytest.raises(ValueError, match=r"differently: simulator\.parity: .*False.* and .*True"):
        check_pair(
            stepwise_pair("gesim_tiny", folded)[0],
            other_than("gesim_tiny", folded, {"parity": "released"}),
        )
    own = section_of("simulator", "dit_small")
    denoising, codec = own["denoising"], own["codec"]
    velocity = other_than("dit_small", spec, {"denoising": {**denoising, "prediction": "velocity"}})
    with pytest.raises(ValueError, match=r"simulator\.denoising\.prediction: 'Clean .* and 'Velocity "):
        check_pair(teacher, velocity)
    for changes in ({"codec": {**codec, "width": 64}}, {"net": {**own["net"], "layers": 4}}):
        with pytest.raises(
            ValueError, match=rf"of different sizes: {next(iter(changes))}\..*the same simulator"
        ):
            check_pair(teacher, other_than("dit_small", spec, changes))
    with pytest.raises(ValueError, match=r"distill\.steps=2 are more than the teacher's 1"):
        check_pair(other_than("dit_small", spec, {"denoising": {**denoising, "steps": 1}}), student)
    with pytest.raises(ValueError, match=r"a student samples in distilled steps; set"):
        check_pair(teacher, teacher)
    unet = simulator_of("unet_small", spec)
    with pytest.raises(ValueError, match="the teacher, UNetSimulator, does not denoise in steps"):
        check_pair(unet, student)


def other_than(name: str, spec: WorldSpec, changes: dict[str, Any]) -> Simulator:
    """An engine of a config with other options."""
    own = {k: v for k, v in section_of("simulator", name).items() if k not in WORLD_OPTIONS}
    return build(own | changes, "simulator", spec=spec)  # type: ignore[no-any-return]


@pytest.mark.parametrize("method", METHODS)
def test_latents_of_another_autoencoder_are_refused(method: str, tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(BIMANUAL_POSES)
    teacher, student = stepwise_pair("dit_small", store.spec)
    assert isinstance(student, Stepwise)
    with torch.no_grad():
        next(student.codec.parameters()).add_(1e-3)
    batches = ClipBatches(student, store, torch.arange(2), CLIPS, FitConfig(1, 2, 1e-3, bf16=False))
    with pytest.raises(ConfigError, match="teacher and student have autoencoders of different weights"):
        train_student(teacher, section(f"distiller/{method}"), batches, tmp_path)


def test_jumps_are_no_trajectories(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(BIMANUAL_POSES)
    _, student = stepwise_pair("dit_small", store.spec)
    options = FitConfig(1, 2, 1e-3, bf16=False)
    with pytest.raises(ConfigError, match=r"simulator\.sampling\.kind=edm"):
        batches = ClipBatches(student, store, torch.arange(2), CLIPS, options)
        train_student(deepcopy(student), section("distiller/trajectory"), batches, tmp_path)
