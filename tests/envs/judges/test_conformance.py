"""What every judge that configs offer must do, for every robot; the example's judge among them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.embodiment import Embodiment
from envs.judges import Judge, Judgement, MissingFeatures, RuleJudge
from envs.judges.golden_goal import GoldenGoalJudge
from envs.simulators.features import pooled_size
from envs.specs import Status, WorldSpec, text_to_bytes
from envs.targets import build, target
from tests.embodiments import EMBODIMENTS, INSTRUCTIONS, world_spec
from tests.envs.judges.chat_server import MODEL, hashing, serving
from tests.envs.judges.tiny_vlm import save_tiny_vlm
from tests.envs.nearing import nearing
from tests.sampling import every
from tests.sections import CONFIGS, offered, section

EXAMPLES = CONFIGS.parent / "examples/configs"


@contextmanager
def goal() -> Iterator[dict[str, Any]]:
    """A grey goal picture."""
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "goal.png")
        cv2.imwrite(path, np.full((40, 40, 3), 200, np.uint8))
        yield {"picture": path}


# Of pictures whose sides are multiples of 8, and sure that the first frame it imagines is the goal: what it
# says of other frames then shows in the judgement.
TINY_TEXT_WORLD = {
    "window": 3,
    "codec": {"bits": 8, "stride": 8, "width": 16},
    "net": {"layers": 1, "width": 16, "heads": 1, "ratio": 1},
    "conditioning": {"tokens": 2},
    "decoding": {"steps": 1},
    "ending": {"threshold": 0.0, "max_frames": 2},
}


@contextmanager
def server() -> Iterator[dict[str, Any]]:
    """A chat server whose model looks at every pixel and letter, and a cache for its answers."""
    with TemporaryDirectory() as folder, serving(hashing) as chat:
        yield {
            "chat": {"url": chat.url, "model": MODEL},
            "votes": {"count": 9, "calibrate": True},
            "pictures": {"side": 0},
            "asking": {"cache": folder},
        }


@contextmanager
def weights() -> Iterator[dict[str, Any]]:
    """A tiny vision-language model on disk, and a cache for its answers."""
    pytest.importorskip("transformers", reason="pip install -c constraints.txt 'worldloop[vlm]'")
    with TemporaryDirectory() as folder:
        path, prompt = save_tiny_vlm(Path(folder) / "model"), Path(folder) / "prompt.txt"
        prompt.write_text("$instruction?")
        yield {
            "chat": {"path": str(path), "device": "cpu", "max_tokens": 1},
            "prompt": str(prompt),
            "votes": {"count": 15, "calibrate": True},
            "pictures": {"side": 0},
            "asking": {"cache": folder},
        }


# What a judge needs that is not in its config, a file or a server: while the context lasts it is there, at
# the options that the context gives. A judge that is not named here is built as its config says.
SURROUNDINGS: dict[str, Callable[[], AbstractContextManager[dict[str, Any]]]] = {
    "goal_picture": goal,
    "goal_image": goal,
    "golden_goal": partial(nullcontext, {"text_world": TINY_TEXT_WORLD}),
    "golden_goal_action": partial(nullcontext, {"text_world": TINY_TEXT_WORLD}),
    "vlm": server,
    "vlm_local": weights,
}
# What a judge does not look at beside the words, of which its class says it; all others look at everything.
IGNORES: dict[str, tuple[str, ...]] = {
    "goal_picture": ("other views",),
    "goal_image": ("other views",),
    "proxy": ("first frame",),
    "embedding": ("first frame", "frames"),
}
# Weights that say where an imagined goal ends, and nothing of frames: golden_goal has them judge frames, too.
ENDINGS = {"golden_goal_action": ("text_world.video.done_head", "text_world.video.net.norm_seen")}
FEATURES = (6, 10)  # of a simulator whose features judges read: tokens and their width
WIDTH = 4  # of one that says itself whether a task is done, for every frame and view of a chunk
FULL = (
    "_full"  # of a published size, which is counted on the meta device (tests/pipeline/benches/test_size.py)
)
JUDGES = {name: CONFIGS for name in offered("judge") if not name.endswith(FULL)} | {
    path.stem: EXAMPLES for path in (EXAMPLES / "judge").glob("*.yaml")
}


# Every judge with some robots, every robot with some judges.
for_each = pytest.mark.parametrize(
    ("name", "spec"),
    every(3, product(JUDGES, EMBODIMENTS.values())),
    indirect=True,
    ids=lambda value: getattr(value, "robot", value),
)


@pytest.fixture(scope="module")
def name(request: pytest.FixtureRequest) -> str:
    """Of a judge."""
    return str(request.param)


@pytest.fixture(scope="module")
def options(name: str) -> Iterator[dict[str, Any]]:
    """The options of a judge, with what it needs around it."""
    with SURROUNDINGS.get(name, partial(nullcontext, {}))() as around:
        options = section(f"judge/{name}", root=JUDGES[name], **around)
        options.pop("rewards", None)  # of the environment that asks the judge
        yield options


@pytest.fixture
def spec(request: pytest.FixtureRequest) -> WorldSpec:
    """What a world shows of a robot, at a size that is no power of two."""
    robot: Embodiment = request.param
    return world_spec(robot, (32, 40))


@pytest.fixture
def judge(options: dict[str, Any], spec: WorldSpec) -> Judge:
    """The judge with random weights."""
    torch.manual_seed(0)
    kind = target(options, "judge")
    context = {"feature_shape": shape_of(kind, spec)} if kind.reads_features else {}
    return build(options, "judge", spec=spec, **context).eval()  # type: ignore[no-any-return]


def shape_of(kind: Judge | type[Judge], spec: WorldSpec) -> tuple[int, ...]:
    """Of the features that a judge reads."""
    return ((spec.chunk + spec.views) * WIDTH,) if kind.asks_world else FEATURES


Clips = tuple[Tensor, Tensor, list[str], tuple[Tensor, ...]]


def clips(judge: Judge, spec: WorldSpec, batch: int, frames: int) -> Clips:
    """What `score` takes; the last are features, none of a judge that reads none."""
    g = torch.Generator().manual_seed(0)
    shape = (batch, frames, spec.views, 3, *spec.size)
    video = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    features = torch.randn(batch, -(-frames // spec.chunk), pooled_size(shape_of(judge, spec)), generator=g)
    texts = [INSTRUCTIONS[k % len(INSTRUCTIONS)] for k in range(batch)]
    return video, video[:, 0], texts, (features,) if judge.reads_features else ()


@for_each
def test_judgements_are_probabilities_in_every_frame(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts, seen = clips(judge, spec, 3, 5)
    judgement = judge.score(frames, first, texts, *seen)
    assert judgement.success.shape == judgement.progress.shape == (3, 5) and judgement.status.shape == (3,)
    assert judgement.success.dtype == judgement.progress.dtype == torch.float32
    assert judgement.status.dtype == torch.int64 and bool((judgement.status == Status.OK.value).all())
    for value in (judgement.success, judgement.progress):
        assert 0 <= float(value.min()) <= float(value.max()) <= 1


def same(one: Judgement, other: Judgement) -> bool:
    return all(torch.equal(mine, theirs) for mine, theirs in zip(one, other, strict=True))


def rows(judgement: Judgement, at: slice) -> Judgement:
    return Judgement(*(value[at] for value in judgement))


@for_each
def test_a_judgement_does_not_depend_on_the_rest_of_the_batch(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts, seen = clips(judge, spec, 3, 4)
    together = judge.score(frames, first, texts, *seen)
    turned = judge.score(frames.flip(0), first.flip(0), texts[::-1], *(part.flip(0) for part in seen))
    # Where a row lies in a batch, or how large the batch is, may choose a kernel that sums in another order.
    near = partial(torch.allclose, rtol=0, atol=1e-5)
    assert near(turned.success.flip(0), together.success) and near(turned.progress.flip(0), together.progress)
    assert torch.equal(turned.status.flip(0), together.status)
    frames, first = frames.clone(), first.clone()
    frames[[0, 2]], first[[0, 2]] = 255 - frames[[0, 2]], 99
    others = ["stop", texts[1], "put the small green cube that lies beside the drawer onto the plate"]
    changed = [part * torch.tensor([2.0, 1.0, 2.0])[:, None, None] for part in seen]
    assert same(rows(judge.score(frames, first, others, *changed), slice(1, 2)), rows(together, slice(1, 2)))
    alone = judge.score(frames[1:2], first[1:2], texts[1:2], *(part[1:2] for part in seen))
    assert near(alone.success, together.success[1:2]) and near(alone.progress, together.progress[1:2])


@for_each
def test_every_weight_is_learned_or_at_least_used(name: str, judge: Judge, spec: WorldSpec) -> None:
    """What is trained gets a gradient from the loss; what is frozen changes the judgement when it changes."""
    frames, first, texts, seen = clips(judge, spec, 6, 1)
    first = first.flip(0)
    if isinstance(judge, GoldenGoalJudge):  # which pays noise nothing
        frames = nearing(judge, first, texts)[:, None]
    trained = [(key, value) for key, value in judge.named_parameters() if value.requires_grad]
    frozen = [(key, value) for key, value in judge.named_parameters() if not value.requires_grad]
    if trained:
        data = TensorDict({"frames": frames[:, 0], "first": first, "text": text_to_bytes(texts)}, [6])
        data["label"], data["progress"] = torch.tensor([0.0, 1.0] * 3), torch.linspace(0, 1, 6)
        for part in seen:
            data["features"], data["offset"] = part[:, 0], torch.arange(6) % spec.chunk
        judge.loss(data)[0].backward()
        assert not [key for key, value in trained if value.grad is None or not bool(value.grad.any())]
    before = judge.score(frames, first, texts, *seen)
    turn = [*EMBODIMENTS].index(spec.embodiment.robot)  # all robots have the same; they share the work
    for key, value in frozen[turn :: len(EMBODIMENTS)]:
        if key.startswith(ENDINGS.get(name, ("-",))):
            continue
        kept = value.detach().clone()
        value.copy_(kept + torch.randn(kept.shape, generator=torch.Generator().manual_seed(0)))
        judge.load_state_dict(judge.state_dict())  # as weights come, so that what hangs on them is made anew
        assert not same(judge.score(frames, first, texts, *seen), before), f"{key} is used for nothing"
        value.copy_(kept)


@for_each
def test_what_is_submitted_is_fetched(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts, seen = clips(judge, spec, 2, 3)
    given = (frames, first, texts, *seen)
    assert torch.equal(judge.fetch(judge.submit(*given)).success, judge.score(*given).success)


@for_each
def test_first_frame_instruction_and_every_view_matter(name: str, judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts, seen = clips(judge, spec, 2, 3)
    if isinstance(judge, GoldenGoalJudge):
        frames[:, 1:] = nearing(judge, first, texts)[:, None]
    scores, ignored = judge.score(frames, first, texts, *seen), IGNORES.get(name, ())
    assert same(judge.score(frames, 255 - first, texts, *seen), scores) == ("first frame" in ignored)
    assert same(judge.score(frames, first, texts[::-1], *seen), scores) == (not judge.reads_instruction)
    for part in seen:
        assert not same(judge.score(frames, first, texts, 2 * part), scores)
    for view in range(spec.views):
        other = frames.clone()
        other[:, :, view] = 255 - other[:, :, view]
        beside = "other views" in ignored and view != spec.embodiment.main_view
        assert same(judge.score(other, first, texts, *seen), scores) == (beside or "frames" in ignored)


@for_each
def test_a_judge_that_reads_features_says_when_it_has_none(judge: Judge, spec: WorldSpec) -> None:
    frames, first, texts, seen = clips(judge, spec, 2, spec.chunk + 1)
    if not judge.reads_features:
        return
    for given in ((), (seen[0][:, :1],)):
        with pytest.raises(MissingFeatures, match="reads the simulator's features"):
            judge.score(frames, first, texts, *given)


@for_each
def test_a_judge_of_nan_says_error(judge: Judge, spec: WorldSpec) -> None:
    numbers = [*judge.parameters(), *(value for value in judge.buffers() if value is not judge.threshold)]
    if not numbers:
        pytest.skip("this judge has no numbers of its own; what errors of a model come to is in test_vlm.py")
    for value in numbers:
        if value.is_floating_point():
            value.detach().fill_(torch.nan)
    frames, first, texts, seen = clips(judge, spec, 2, 3)
    assert bool((judge.score(frames, first, texts, *seen).status == Status.ERROR.value).all())


def test_the_rule_has_no_weights_and_judges_each_episode_by_itself() -> None:
    judge = RuleJudge(hold=1)
    assert not list(judge.parameters())
    generator = torch.Generator().manual_seed(0)
    progress = torch.rand(4, 5, generator=generator)
    together = judge.judgement(progress > 0.7, progress)
    for slot in range(4):
        at = slice(slot, slot + 1)
        assert same(judge.judgement(progress[at] > 0.7, progress[at]), rows(together, at))


@for_each
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
