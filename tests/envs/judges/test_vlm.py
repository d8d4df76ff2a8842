"""judge=vlm against a real server: what is asked, what comes of it, what it costs."""

from __future__ import annotations

import logging
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.judges import JudgeError
from envs.judges.vlm import VLMJudge
from envs.judges.vlm.answers import parse
from envs.judges.vlm.cache import AnswerCache
from envs.judges.vlm.chat import Reply
from envs.specs import Status
from envs.targets import ConfigError
from tests.envs.judges.chat_server import (
    ChatServer,
    hashing,
    refuse,
    seeing,
)
from tests.envs.judges.vlm_clips import (
    DONE,
    FAR,
    FIRST,
    Make,
    clip,
    new_command,
    score,
)
from tests.moving_square import picture
from tests.sections import merged


def test_one_chunk_is_one_question_asked_until_the_majority_is_sure(make: Make, server: ChatServer) -> None:
    said = score(make(pictures={"every": 2}), clip(0.1, 0.3, 0.6, DONE))
    assert said.success.tolist() == said.progress.tolist() == [[1.0] * 4]
    assert said.status.tolist() == [Status.OK.value]
    assert sorted(asked.seed for asked in server.seen) == [0, 1, 2]  # of five votes
    shown = server.seen[0].pictures
    assert [picture.shape for picture in shown] == [(32, 68, 3)] * 3  # both cameras of first, second and last
    for got, frame in zip(shown, (0.0, 0.3, DONE), strict=True):
        wanted = picture(np.array([frame, frame]), 2)[0].transpose(1, 2, 0)
        assert np.abs(got[:, :32].astype(int) - wanted).mean() < 4  # JPEG
    text = server.seen[0].text
    assert "move the square" in text and "The 2 that follow" in text and "corner, behind" in text
    assert "Authorization" not in server.seen[0].headers


def test_small_pictures_are_enlarged_and_one_camera_needs_no_explanation(
    make: Make, server: ChatServer
) -> None:
    score(make(cameras=["behind"], pictures={"side": 96}), clip(FAR))
    assert {picture.shape for picture in server.seen[0].pictures} == {(96, 96, 3)}
    assert "side by side" not in server.seen[0].text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Answer: Yes", True),
        ("It fell.\nanswer: no", False),
        ("Well.\n\n**Answer: Yes.**\n \n", True),
        ("**Answer:** No", False),
        ("Yes", None),
        ("Answer: Yes, I think", None),
        ("Answer: Yes\nthough one may doubt it", None),
        ("Answer: No\nAnswer: Yes", None),
        ("The answer: yes", None),
        ("Answer: Maybe", None),
        ("Answer: Yes or No", None),
        ("", None),
    ],
)
def test_answers_are_read_strictly(text: str, said: bool | None) -> None:
    assert parse(text) is said


@pytest.mark.parametrize(
    ("answers", "status", "share", "calls"),
    [
        ("YYY", Status.OK, 1.0, 3),
        ("NYNYN", Status.OK, 0.4, 5),
        ("?YNYY", Status.OK, 0.75, 5),
        ("???", Status.ABSTAIN, 0.0, 3),  # no answer can have three of five any more
        ("?YNYN", Status.ABSTAIN, 0.0, 5),
    ],
)
def test_votes(
    make: Make, server: ChatServer, answers: str, status: Status, share: float, calls: int
) -> None:
    words = {"Y": "Answer: Yes", "N": "Answer: No", "?": "I cannot tell."}
    server.answer = lambda asked: words[answers[asked.seed]]
    said = score(make(), clip(FAR))
    assert said.status.tolist() == [status.value] and len(server.seen) == calls
    assert said.success.item() == pytest.approx(share)


def test_calibration_asks_every_vote_of_every_chunk(make: Make, server: ChatServer) -> None:
    said = score(make(votes={"calibrate": True}), clip(*[DONE] * 4, 0.9, 0.9, 0.9, 0.9))
    assert said.status.tolist() == [0] and len(server.seen) == 10


def test_whole_episodes_are_judged_chunk_by_chunk_until_they_succeed(make: Make, server: ChatServer) -> None:
    far = [0.1, 0.2, 0.1, 0.2]
    won = clip(*far, 0.5, 0.6, 0.7, DONE, 0.5, 0.4, 0.3, 0.3)
    said = score(make(), won)
    assert said.success.tolist() == [[0.0] * 4 + [1.0] * 8] and len(server.seen) == 6
    lost = score(make(hold=5), won)  # one chunk of four does not make five in a row
    assert lost.success.tolist() == [[0.0] * 4 + [1.0] * 4 + [0.0] * 4] and len(server.seen) == 9
    padded = torch.cat([won[:, :8], won[:, 7:8].expand(-1, 6, -1, -1, -1, -1)], 1)
    assert score(make(), padded).success.tolist() == [[0.0] * 4 + [1.0] * 10] and len(server.seen) == 9
    whole = make(pictures={"span": "clip", "every": 3})
    assert score(whole, won).success.tolist() == [[0.0] * 12] and len(server.seen[-1].pictures) == 5


def test_an_unusable_chunk_spoils_the_episode_as_in_imagination(make: Make, server: ChatServer) -> None:
    server.answer = lambda asked: "no idea" if asked.pictures[-1][0, 0, 0] > 150 else seeing(asked)
    black, odd = clip(0.1, 0.2, 0.3, 0.4), clip(0.1, 0.2, 0.1, 0.0)  # the square covers the first pixel
    said = score(
        make(), torch.cat([odd, clip(*[DONE - k / 100 for k in range(4)])], 1), torch.cat([black] * 2, 1)
    )
    assert said.status.tolist() == [Status.ABSTAIN.value, Status.OK.value]


@pytest.mark.parametrize(
    ("prompt", "said"),
    [
        ("nowhere", r"judge\.prompt=nowhere is no text file, and no prompt of that name; there are .*done"),
        ("Is it done?", r"must say \$instruction, .* found \[\]"),
        ("$instruction costs 5$", r"found \['\$', '\$instruction'\]"),
        ("$instruction by $whom", r"found \['\$instruction', '\$whom'\]"),
    ],
)
def test_prompts_are_checked(make: Make, tmp_path: Path, prompt: str, said: str) -> None:
    path = tmp_path / "prompt.txt"
    path.write_text(prompt)
    with pytest.raises(ConfigError, match=said):
        make(prompt=prompt if prompt == "nowhere" else str(path))


def test_questions_are_asked_side_by_side_within_bounds(make: Make, server: ChatServer) -> None:
    server.think = 0.1
    score(make(asking={"in_flight": 3}), *(clip(k / 10) for k in range(4)))
    assert len(server.seen) == 12 and server.most == 3


def test_answers_are_remembered_by_content(make: Make, server: ChatServer, tmp_path: Path) -> None:
    server.answer = hashing
    chunk = clip(0.1, 0.2, 0.3, 0.4)
    said = score(make(), chunk, chunk)  # the second is not asked even while the first is under way
    assert len(server.seen) == (once := len({asked.seed for asked in server.seen}))
    assert torch.equal(score(make(), chunk).success, said.success[:1]) and len(server.seen) == once
    path = tmp_path / "prompt.txt"
    path.write_text("$instruction?")
    changed = chunk.clone()
    changed[0, -1, 0, 0, 0, 0] += 1
    for other, shown in (
        (make(prompt=str(path)), chunk),
        (make(chat={"model": "another"}), chunk),
        (make(chat={"temperature": 0.1}), chunk),
        (make(), changed),
    ):
        before = server.tries
        score(other, shown)
        assert server.tries > before


def test_a_damaged_answer_is_asked_for_again(make: Make, server: ChatServer, tmp_path: Path) -> None:
    score(make(), clip(DONE))
    for path in (tmp_path / "cache" / "answers").rglob("*.json"):
        path.write_text('{"text": "Answer')
    assert score(make(), clip(DONE)).status.tolist() == [0] and len(server.seen) == 6


def test_many_may_keep_the_same_answer_at_once(tmp_path: Path) -> None:
    cache, reply = AnswerCache(tmp_path), Reply("Answer: Yes", 1, 1)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: cache.put("ab12", reply), range(400)))
    assert cache.get("ab12") == reply and len(list(tmp_path.rglob("*"))) == 3  # nothing is left beside it


@pytest.mark.parametrize("limit", [{"calls": 7}, {"tokens": 700}])
def test_a_spent_budget_stops_the_run_which_then_goes_on_at_no_cost(
    make: Make, options: dict[str, Any], server: ChatServer, limit: dict[str, int]
) -> None:
    new_command()
    key = next(iter(limit))
    episodes = [clip(DONE, k / 10) for k in range(4)]  # of three votes each
    budget = {**limit, "input_price": 10.0, "output_price": 100.0}
    with pytest.raises(
        JudgeError, match=rf"judge\.budget\.{key}={limit[key]} is spent .* same command goes on"
    ):
        score(make(budget=budget, asking={"in_flight": 1}), *episodes)
    assert len(server.seen) == 7
    with pytest.raises(JudgeError, match="is spent"):  # another judge of the same command
        score(make(budget=budget), episodes[3])
    new_command()
    said = score(make(budget=budget, asking={"in_flight": 1}), *episodes)
    assert said.status.tolist() == [0] * 4 and len(server.seen) == 12
    spent = VLMJudge.spent(merged(options, {"budget": budget}))
    assert spent["calls"] == 12 and spent["prompt_tokens"] == 1200 and spent["completion_tokens"] == 120
    assert spent["cost"] == pytest.approx(1200 * 10e-6 + 120 * 100e-6)


def test_tokens_that_nobody_counts_cannot_be_budgeted(make: Make, server: ChatServer) -> None:
    server.usage = None
    with pytest.raises(JudgeError, match=r"judge\.budget\.tokens=50 cannot be kept"):
        score(make(budget={"tokens": 50}), clip(DONE))


def test_the_key_is_sent_and_found_nowhere_else(
    make: Make,
    server: ChatServer,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    secret = "sk-very-5ecret"
    monkeypatch.setenv("VLM_KEY", secret)
    server.key = secret
    server.answer = lambda asked: f"You sent {asked.headers['Authorization']}.\nAnswer: Yes"
    judge = make(chat={"key": "VLM_KEY"}, asking={"retries": 0, "stop_after": 1})
    told = ""
    with caplog.at_level(logging.DEBUG):
        assert score(judge, clip(DONE)).success.item() == 1.0
        for status in (401, 500):
            server.faults.extend([refuse(status, f"wrong key: Bearer {secret}")] * 5)
            with pytest.raises(JudgeError, match=r"wrong key: Bearer \[key\]") as error:
                score(
                    make(chat={"key": "VLM_KEY"}, asking={"retries": 0, "stop_after": 1}), clip(status / 1000)
                )
            server.faults.clear()
            told += "".join(traceback.format_exception(error.value)) + repr(error.value)
    held = (
        f"{judge!r}{judge.asker.__dict__}{vars(judge.asker.chat)}{judge.state_dict()}{judge.asker.chat.name}"
    )
    kept = "".join(path.read_text() for path in (tmp_path / "cache").rglob("*.json"))
    assert "[key]" in kept
    assert not [text for text in (told, held, kept, caplog.text) if secret in text]


def test_what_it_asks_is_under_way_before_anybody_fetches(make: Make, server: ChatServer) -> None:
    judge = make()
    ticket = judge.submit(clip(DONE), FIRST[None], ["move the square"])
    until = time.monotonic() + 20
    while len(server.seen) < 3 and time.monotonic() < until:
        time.sleep(0.01)
    assert len(server.seen) == 3 and judge.fetch(ticket).success.item() == 1.0


def test_it_has_no_weights_and_its_threshold_is_the_majority(make: Make) -> None:
    judge = make()
    assert not list(judge.parameters()) and list(judge.state_dict()) == ["threshold"]
    assert not judge.calibrates and make(votes={"calibrate": True}).calibrates
    for share, done in ((0.6, True), (0.4, False)):
        assert judge.episode(torch.tensor([[share]]), torch.tensor([[True]])).tolist() == [done]
