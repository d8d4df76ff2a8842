"""The judge as a service: same judgements, remembered, within its budget, and an ERROR when it is gone."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import ray
import torch

from actors.factory import build_judge
from actors.fleets.cluster import connect
from actors.fleets.fleet import LocalFleet
from actors.rollouts.host import Job
from actors.rollouts.recipe import Recipe, build_host
from actors.serving.judge_service import JudgeClient, JudgeServer, ServiceConfig, start_service
from envs.judges import JudgeError
from envs.specs import EPISODE, JUDGE_STATUS, SUCCESS, Status
from envs.targets import ConfigError
from learners.rl.algorithm import first_episode
from pipeline.config import load_config
from pipeline.graph.artefact import save_weights
from tests.envs.judges.chat_server import MODEL, refuse, serving

OPTIONS = ServiceConfig(batch=8, wait_ms=20.0, cache=1000, budget=40, deadline=20.0, retries=1, pause=0.1)


@pytest.fixture(scope="module")
def weights(cfg: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("judge")
    torch.manual_seed(0)
    save_weights(build_judge(cfg), folder)
    return str(folder / "weights.safetensors")


@pytest.fixture(scope="module")
def service(cfg: dict[str, Any], weights: str) -> Iterator[Any]:
    connect(cfg["launch"])
    yield start_service("judge-test", cfg, weights, OPTIONS, {"num_cpus": 0.5}, 1)
    ray.shutdown()


def clips(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, list[str]]:
    draw = torch.Generator().manual_seed(seed)
    frames = torch.randint(0, 256, (count, 4, 3, 3, 64, 64), dtype=torch.uint8, generator=draw)
    return frames, frames[:, 0], [f"push block {k % 2}" for k in range(count)]


def arrays(count: int, seed: int) -> tuple[Any, Any, list[str]]:
    """The same, as they come to the server."""
    frames, first, texts = clips(count, seed)
    return frames.numpy(), first.numpy(), texts


def test_service_agrees_remembers_and_gathers(cfg: dict[str, Any], weights: str, service: Any) -> None:
    inline, client = build_judge(cfg, Path(weights)).eval(), JudgeClient("judge-test", OPTIONS)
    assert client.hold == inline.hold and torch.equal(client.threshold, inline.threshold)
    asked = clips(6, 0)
    said, wanted = client.score(*asked), inline.score(*asked)
    assert torch.allclose(said.success, wanted.success, atol=1e-5) and torch.equal(said.status, wanted.status)
    tickets = [client.submit(*clips(2, 1)), client.submit(*clips(2, 2)), client.submit(*asked)]
    for ticket in tickets:
        client.fetch(ticket)
    stats = ray.get(service.stats.remote())
    assert stats["clips"] == 16 and stats["judged"] == 10 and stats["remembered"] == 6
    assert stats["batches"] < 4  # two callers' clips were judged together


def test_a_judge_that_reads_features_is_served_them(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", "judge=embedding"])
    torch.manual_seed(0)
    save_weights(build_judge(cfg), tmp_path)
    path = tmp_path / "weights.safetensors"
    inline, server = build_judge(cfg, path).eval(), JudgeServer(cfg, str(path), OPTIONS, 1)
    frames, first, texts = clips(3, 0)
    size = inline.norm.normalized_shape[0]
    features = torch.randn(2, 3, 1, size, generator=torch.Generator().manual_seed(1))

    async def ask() -> list[Any]:
        assert (await server.describe())["reads_features"]
        given = (frames.numpy(), first.numpy(), texts)
        return [await server.score(*given, some.numpy()) for some in features]

    one, other = asyncio.run(ask())
    assert torch.allclose(torch.tensor(one[0]), inline.score(frames, first, texts, features[0]).success)
    assert not torch.allclose(torch.tensor(one[0]), torch.tensor(other[0]))
    assert server.counts["judged"] == 6 and not server.counts["remembered"]


def test_spent_budget_abstains(cfg: dict[str, Any], weights: str) -> None:
    server = JudgeServer(cfg, weights, replace(OPTIONS, budget=20), 1)

    async def ask() -> list[Any]:
        first = asyncio.create_task(server.score(*arrays(12, 7)))
        while not server.counts["batches"]:  # some are judged, others wait or are being judged
            await asyncio.sleep(0.001)
        both = await asyncio.gather(first, server.score(*arrays(12, 8)))
        return [*both, await server.score(*arrays(12, 7))]

    one, other, again = (said[2].tolist() for said in asyncio.run(ask()))
    ok, abstain = Status.OK.value, Status.ABSTAIN.value
    assert one == again == [ok] * 12 and sorted(other) == sorted([ok] * 8 + [abstain] * 4)
    assert server.counts["judged"] == 20 and server.counts["refused"] == 4


@pytest.mark.long
def test_restarted_service_is_found_again_and_a_lost_one_is_an_error(service: Any) -> None:
    client = JudgeClient("judge-test", replace(OPTIONS, deadline=60.0, retries=6, pause=1.0))
    ray.kill(service, no_restart=False)
    assert client.score(*clips(2, 9)).status.tolist() == [Status.OK.value] * 2
    ray.kill(service, no_restart=True)
    client.options = replace(client.options, retries=1, pause=0.1)
    said = client.score(*clips(2, 10))
    assert said.status.tolist() == [Status.ERROR.value] * 2
    with pytest.raises(ConfigError, match="does not answer"):
        JudgeClient("judge-test", OPTIONS)


@pytest.mark.long
def test_a_service_hosts_a_vision_language_model_and_passes_on_why_it_stops(
    service: Any, tmp_path: Path
) -> None:
    with serving(lambda asked: "Answer: Yes") as chat:
        words = [f"judge.chat.url={chat.url}", f"judge.chat.model={MODEL}", "judge.budget.calls=6"]
        words += [f"judge.asking.cache={tmp_path}/cache", "judge.asking.in_flight=2", "judge.pictures.side=0"]
        cfg = load_config(["experiment=smoke", "judge=vlm", *words])
        weights = save_weights(build_judge(cfg), tmp_path)
        actor = start_service("vlm-test", cfg, str(weights), OPTIONS, {"num_cpus": 0.5}, 1)
        client = JudgeClient("vlm-test", OPTIONS)
        said = client.score(*clips(2, 3))
        assert said.status.tolist() == [Status.OK.value] * 2 and bool((said.success == 1).all())
        with pytest.raises(JudgeError, match=r"judge\.budget\.calls=6 is spent"):
            client.score(*clips(2, 4))
        assert len(chat.seen) == 6  # three votes of five for each chunk
        ray.kill(actor)


def test_errors_of_the_judge_are_asked_about_again(tmp_path: Path) -> None:
    with serving(lambda asked: "Answer: Yes") as chat:
        words = [f"judge.chat.url={chat.url}", f"judge.chat.model={MODEL}", "judge.asking.retries=0"]
        words += [f"judge.asking.cache={tmp_path}/cache", "judge.pictures.side=0", "judge.votes.count=1"]
        cfg = load_config(["experiment=smoke", "judge=vlm", *words])
        server = JudgeServer(cfg, str(save_weights(build_judge(cfg), tmp_path)), OPTIONS, 1)
        frames, first, texts = clips(1, 3)
        chat.faults.append(refuse(500))
        for status in (Status.ERROR, Status.OK, Status.OK):
            said = asyncio.run(server.score(frames.numpy(), first.numpy(), texts))
            assert said[2].tolist() == [status.value]
        assert chat.tries == 2 and server.counts["remembered"] == 1


def test_rewards_that_come_later_are_those_that_come_at_once(recipe: Recipe) -> None:
    now, later = (
        LocalFleet(build_host(replace(recipe, later=flag, bootstrap=False))) for flag in (False, True)
    )
    now.host._judging.judge.threshold.fill_(0.0)  # type: ignore[union-attr]
    later.host._judging.judge.threshold.fill_(0.0)  # type: ignore[union-attr]
    job = Job(0, tuple(range(8)), 5)
    one, other = now.host.run(job), later.host.run(job)
    mine = first_episode(one["next", "done"].squeeze(-1))
    assert torch.equal(mine, first_episode(other["next", "done"].squeeze(-1)))
    assert bool(one["next", SUCCESS][:, 0].all())  # a threshold of zero lets everything through
    # slots began anew
    assert one[EPISODE][:, 0, 0].tolist() == [0, 1, 2, 3] and not torch.equal(
        one[EPISODE][:, 0], one[EPISODE][:, 1]
    )
    for key in ("reward", SUCCESS, "terminated", JUDGE_STATUS):
        assert torch.allclose(one["next", key][mine].float(), other["next", key][mine].float(), atol=1e-6), (
            key
        )
