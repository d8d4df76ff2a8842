"""judge=vlm against a server that misbehaves: slow, busy, cut off, of no use, not there."""

from __future__ import annotations

import json
import time
from email.utils import formatdate
from typing import Any

import pytest

from envs.judges import JudgeError
from envs.judges.vlm import VLMJudge
from envs.specs import Status
from envs.targets import ConfigError
from tests.envs.judges.chat_server import (
    ChatServer,
    completion,
    half,
    refuse,
    say,
    sleep,
)
from tests.envs.judges.vlm_clips import (
    DONE,
    FAR,
    Make,
    clip,
    new_command,
    score,
)
from tests.sections import merged


def counted(tokens: str) -> str:
    """A completion that says yes, and took so many tokens."""
    return json.dumps(completion("Answer: Yes", (1, 1))).replace(
        '"prompt_tokens": 1', f'"prompt_tokens": {tokens}'
    )


@pytest.mark.parametrize(
    "fault",
    [
        refuse(500),
        refuse(503),
        refuse(408),
        half,
        say("<html>gateway</html>"),
        say('{"choices": []}'),
        say('{"choices": [{"message": null}]}'),
        say('{"choices": [{"message": {"content": null}}]}'),
        say('{"choices": [{"message": {"content": " \\n"}}]}'),
        say('["not", "an", "object"]'),
        say("[" * 200_000),
        say(counted("1e999")),
        say(counted("9" * 400)),
        say("{}", **{"Content-Type": "application/json; charset=hex"}),
        refuse(503, **{"Retry-After": "Mon, 01 Jan 99999999999999999999 00:00:00 GMT"}),
    ],
    ids=[
        *(
            "500",
            "503",
            "408",
            "cut",
            "html",
            "no choices",
            "no message",
            "no content",
            "blank",
            "list",
            "too deep",
        ),
        *("endless tokens", "too many tokens", "no charset", "no date"),
    ],
)
def test_a_question_that_came_to_nothing_is_asked_again(make: Make, server: ChatServer, fault: Any) -> None:
    server.faults.extend([fault, fault])
    judge = make(votes={"count": 1})
    said = score(judge, clip(DONE))
    assert said.status.tolist() == [0] and said.success.item() == 1.0 and server.tries == 3
    assert judge.asker.ledger.counts["unanswered"] == 2
    server.faults.extend([fault] * 3)
    lost = score(judge, clip(FAR))
    assert lost.status.tolist() == [Status.ERROR.value] and lost.success.item() == 0.0
    assert score(judge, clip(FAR)).status.tolist() == [Status.OK.value]  # errors are not remembered


def test_what_the_server_will_never_take_is_not_asked_again(make: Make, server: ChatServer) -> None:
    server.faults.append(refuse(400, "too many pictures"))
    assert score(make(votes={"count": 1}), clip(DONE)).status.tolist() == [Status.ERROR.value]
    assert server.tries == 1


def test_a_refusal_without_words_is_an_unusable_answer(make: Make, server: ChatServer) -> None:
    server.faults.append(
        say(
            json.dumps(
                completion("", (5, 1)) | {"choices": [{"message": {"content": None, "refusal": "No."}}]}
            )
        )
    )
    judge = make(votes={"count": 1})
    assert score(judge, clip(DONE)).status.tolist() == [Status.ABSTAIN.value]
    assert judge.asker.ledger.counts["unusable"] == 1


def test_tokens_below_zero_give_nothing_back(make: Make, server: ChatServer) -> None:
    server.faults.append(say(counted("-1000")))
    judge = make(votes={"count": 1})
    assert score(judge, clip(DONE)).success.item() == 1.0
    assert judge.asker.ledger.counts["prompt_tokens"] == 0 and judge.asker.ledger.counts["calls"] == 1


@pytest.mark.parametrize("say_when", ["seconds", "date"])
def test_retry_after_is_waited_for_by_all(make: Make, server: ChatServer, say_when: str) -> None:
    when = "1" if say_when == "seconds" else formatdate(time.time() + 2, usegmt=True)
    server.faults.append(refuse(429, **{"Retry-After": when}))
    began = time.monotonic()
    said = score(make(votes={"count": 1}), clip(DONE), clip(FAR))
    assert said.status.tolist() == [0, 0] and time.monotonic() - began > 0.9


def test_a_server_that_wants_too_long_a_rest_is_not_waited_for(make: Make, server: ChatServer) -> None:
    server.faults.append(refuse(429, **{"Retry-After": "86400"}))
    judge = make(votes={"count": 1}, asking={"stop_after": 1})
    with pytest.raises(JudgeError, match=r"86400 s, longer than judge\.asking\.longest_pause_s=120"):
        score(judge, clip(DONE))


def test_slow_answers_end_at_the_deadline_even_if_they_trickle(make: Make, server: ChatServer) -> None:
    judge = make(votes={"count": 1}, asking={"deadline_s": 0.5, "retries": 1})
    score(judge, clip(0.3))  # the greeting takes no part
    server.faults.extend([sleep(60.0)] * 2)
    began = time.monotonic()
    assert score(judge, clip(DONE)).status.tolist() == [Status.ERROR.value]
    assert 0.9 < time.monotonic() - began < 20


def test_votes_that_are_missing_do_not_count_as_no(make: Make, server: ChatServer) -> None:
    server.faults.extend([refuse(500)] * 3)
    judge = make(asking={"retries": 0, "in_flight": 1})
    assert score(judge, clip(DONE)).status.tolist() == [Status.ERROR.value]  # two of five could still come


def test_a_model_that_never_says_what_it_is_asked_for_stops_the_run(make: Make, server: ChatServer) -> None:
    judge = make(votes={"count": 1}, asking={"stop_after": 3, "in_flight": 1})
    said = iter(["Perhaps.", "Perhaps.", "Answer: Yes", *["I cannot say."] * 20])
    server.answer = lambda asked: next(said)
    status = [int(score(judge, clip(k / 20)).status) for k in range(3)]
    assert status == [Status.ABSTAIN.value] * 2 + [Status.OK.value]  # two in a row, and one that was usable
    with pytest.raises(
        JudgeError, match=r"3 answers in a row .*stop_after=3.*judge\.prompt=done.*I cannot say"
    ):
        score(judge, *(clip(k / 20) for k in range(3, 20)))
    assert len(server.seen) < 20  # nobody is asked any more
    new_command()
    asked = len(server.seen)
    with pytest.raises(JudgeError, match="nothing usable"):  # what was remembered says no more
        score(make(votes={"count": 1}, asking={"stop_after": 3}), *(clip(k / 20) for k in range(3, 6)))
    assert len(server.seen) == asked


def test_useless_and_remembered_answers_are_told_beside_the_cost(
    make: Make, options: dict[str, Any], server: ChatServer
) -> None:
    new_command()
    server.answer = lambda asked: "I cannot say."
    for remembered in (0, 3):
        assert score(make(), clip(FAR)).status.tolist() == [Status.ABSTAIN.value]
        spent = VLMJudge.spent(options)
        assert spent["calls"] == 3 and spent["remembered"] == remembered
        assert spent["unusable"] == 3 + remembered


@pytest.mark.parametrize(
    "usage", [{}, {"usage": None}, {"usage": {}}, {"usage": {"prompt_tokens": 90}}], ids=str
)
def test_answers_of_unknown_tokens_are_told_and_not_taken_for_free(
    make: Make, options: dict[str, Any], server: ChatServer, usage: dict[str, Any]
) -> None:
    new_command()
    server.faults.append(say(json.dumps(completion("Answer: Yes", None) | usage)))
    score(make(asking={"in_flight": 1}), clip(DONE))
    budget = {"input_price": 1e4, "output_price": 0.0}
    known = sum((usage.get("usage") or {}).values())
    spent = VLMJudge.spent(merged(options, {"budget": budget}))
    assert spent["calls"] == 3 and spent["uncounted"] == 1
    assert spent["prompt_tokens"] == known + 200 and spent["cost"] == pytest.approx(2.0 + known / 100)


def test_a_dead_server_stops_the_run(make: Make, server: ChatServer) -> None:
    judge = make(votes={"count": 1}, asking={"retries": 0, "stop_after": 3, "in_flight": 1})
    score(judge, clip(0.3))
    server.faults.extend([refuse(500, "out of memory")] * 20)
    with pytest.raises(JudgeError, match=r"3 questions in a row .*stop_after=3.* 500: out of memory"):
        score(judge, *(clip(k / 20) for k in range(8)))
    assert server.tries == 4


@pytest.mark.parametrize(
    ("chat", "said"),
    [
        ({"url": "http://127.0.0.1:9/v1"}, r"judge\.chat\.url=http://127\.0\.0\.1:9/v1: nobody answers"),
        ({"url": "nonsense"}, r"judge\.chat\.url must be the address"),
        *(
            ({"url": f"{begin}secret@127.0.0.1/v1"}, r"without a user, password or key in it$")
            for begin in ("http://me:", "http://:", "http://", "http//:", "//me:")
        ),
        ({"model": ""}, r"judge\.chat\.model is empty"),
        ({"model": "tiny-vml"}, r"judge\.chat\.model=tiny-vml is not served by .*did you mean tiny-vlm"),
        (
            {"key": "NO_SUCH_KEY"},
            r"judge\.chat\.key=NO_SUCH_KEY should be the name of an environment variable",
        ),
        ({"key": "sk-aBc123"}, r"judge\.chat\.key should be the name"),
    ],
)
def test_what_is_missing_is_told_by_its_key(make: Make, chat: dict[str, Any], said: str) -> None:
    with pytest.raises((JudgeError, ConfigError), match=said) as told:
        score(make(chat=chat), clip(DONE))
    assert "\n" not in str(told.value) and "aBc123" not in str(told.value) and "secret" not in str(told.value)


def test_a_wrong_address_and_an_unwelcome_key_stop_the_run_at_once(
    options: dict[str, Any], make: Make, server: ChatServer
) -> None:
    server.faults.append(refuse(404, "no such path"))
    with pytest.raises(JudgeError, match=r"404: no such path.*judge\.chat\.url"):
        score(make(), clip(DONE))
    server.key = "right"
    with pytest.raises(JudgeError, match=r"401: wrong key: None; judge\.chat\.key=null"):
        score(make(), clip(DONE))
