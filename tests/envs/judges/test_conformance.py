"""What every judge that configs offer must do, for every robot."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from envs.embodiment import Embodiment
from envs.judges import Judge
from envs.specs import Status, WorldSpec
from envs.targets import build
from tests.embodiments import EMBODIMENTS, INSTRUCTIONS, world_spec
from tests.sections import offered, section


@pytest.fixture(params=offered("judge"))
def options(request: pytest.FixtureRequest) -> dict[str, object]:
    """The options of a judge."""
    options = section(f"judge/{request.param}")
    options.pop("rewards", None)  # of the environment that asks the judge
    return options


@pytest.fixture(params=EMBODIMENTS.values(), ids=EMBODIMENTS)
def spec(request: pytest.FixtureRequest) -> WorldSpec:
    """What a world shows of a robot, at a size that is no power of two."""
    robot: Embodiment = request.param
    return world_spec(robot, (32, 40))


@pytest.fixture
def judge(options: dict[str, object], spec: WorldSpec) -> Judge:
    """The judge with random weights."""
    torch.manual_seed(0)
    return build(options, "judge", spec=spec).eval()  # type: ignore[no-any-return]


def clips(spec: WorldSpec, batch: int, frames: int) -> tuple[Tensor, Tensor, list[str]]:
    g = torch.Generator().manual_seed(0)
    shape = (batch, frames, spec.views, 3, *spec.size)
    video = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    return video, video[:, 0], [INSTRUCTIONS[k % len(INSTRUCTIONS)] for k in range(batch)]


def test_judgements_are_probabilities_in_every_frame(judge: Judge, spec: WorldSpec) -> None:
    judgement = judge.score(*clips(spec, 3, 5))
    assert judgement.success.shape == judgement.progress.shape == (3, 5) and judgement.status.shape == (3,)
    assert judgement.success.dtype == judgement.progress.dtype == torch.float32
    assert judgement.status.dtype == torch.int64 and bool((judgement.status == Status.OK.value).all())
    for value in (judgement.success, judgement.progress):
        assert 0 <= float(value.min()) <= float(value.max()) <= 1


def test_a_judgement_does_not_depend_on_the_rest_of_the_batch(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts = clips(spec, 3, 4)
    together, alone = judge.score(frames, first, texts), judge.score(frames[1:2], first[1:2], texts[1:2])
    assert torch.allclose(together.success[1:2], alone.success, atol=1e-5)
    assert torch.allclose(together.progress[1:2], alone.progress, atol=1e-5)


def test_what_is_submitted_is_fetched(judge: Judge, spec: WorldSpec) -> None:
    given = clips(spec, 2, 3)
    assert torch.equal(judge.fetch(judge.submit(*given)).success, judge.score(*given).success)


def test_first_frame_instruction_and_every_view_matter(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts = clips(spec, 2, 3)
    scores = judge.score(frames, first, texts).success
    assert not torch.equal(judge.score(frames, 255 - first, texts).success, scores)
    assert not torch.equal(judge.score(frames, first, texts[::-1]).success, scores)
    for view in range(spec.views):
        other = frames.clone()
        other[:, :, view] = 255 - other[:, :, view]
        assert not torch.equal(judge.score(other, first, texts).success, scores)


def test_a_judge_of_nan_says_error(judge: Judge, spec: WorldSpec) -> None:
    with torch.no_grad():
        for parameter in judge.parameters():
            parameter.fill_(torch.nan)
    assert bool((judge.score(*clips(spec, 2, 3)).status == Status.ERROR.value).all())


def test_streaks_run_across_chunks_and_break(judge: Judge) -> None:
    judge.hold = 3
    success = torch.tensor([[0.9, 0.9, 0.1, 0.9, 0.9, 0.9]])
    done, run = judge.streak(success[:, :2], torch.tensor([1]))
    assert done.tolist() == [[False, True]] and run.tolist() == [3]
    done, run = judge.streak(success[:, 2:], run)
    assert done.tolist() == [[False, False, False, True]] and run.tolist() == [3]
    valid = torch.ones_like(success, dtype=torch.bool)
    assert judge.episode(success, valid).tolist() == [True]
    valid[:, -1] = False
    assert judge.episode(success, valid).tolist() == [False]
