"""A vision-language model behind a server of OpenAI's chat completions: vLLM, llama.cpp, hosted ones."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import time
from collections.abc import Mapping
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import urlsplit

import aiohttp

from envs.judges.base import JudgeError
from envs.judges.vlm.chat import Question, Reply, Unanswered
from envs.judges.vlm.pictures import jpeg
from envs.ranges import Count, NonNegative
from envs.targets import ConfigError, nearest

_GREETING_S = 20.0  # for a list of models
_QUALITY = 95
_LATER = (408, 409, 425, 429)  # refusals that may end by themselves, as those from 500 on
_SHOWN = 300  # characters of a server's words that are passed on
_NO_JSON = (ValueError, OverflowError, RecursionError)  # of texts that are none, are out of range or too deep
_COUNTABLE = 2.0**53  # from there on floats skip whole numbers


class HTTPChat:
    """Questions as POST <url>/chat/completions.

    Args:
        url: up to and with the version, such as http://127.0.0.1:8000/v1.
        model: as the server names it.
        key: name of the environment variable that holds the key; null for servers that ask for none. The key
            itself is read when a question is sent and kept nowhere.
        max_tokens: of an answer.
        temperature: of sampling; at 0 all votes say the same.
        body: more of the request, by the server's names; null leaves one of ours out.

    Raises:
        ConfigError: if url or model are missing, or the variable is not set.
    """

    def __init__(
        self,
        url: str,
        model: str,
        key: str | None,
        max_tokens: Count,
        temperature: NonNegative,
        body: Mapping[str, Any],
    ):
        place = urlsplit(url)
        if place.scheme not in ("http", "https") or not place.hostname or "@" in place.netloc:
            shown = "" if "@" in url else f"; got {url!r}"  # a name or a password may stand before it
            raise ConfigError(
                "judge.chat.url must be the address of a chat server up to its version, such as"
                f" http://127.0.0.1:8000/v1, without a user, password or key in it{shown}"
            )
        if not model:
            raise ConfigError(
                f"judge.chat.model is empty: name a model that {url} serves (GET {url}/models lists them)"
            )
        self.url, self.model, self.key, self.body = url.rstrip("/"), model, key, dict(body)
        self.max_tokens, self.temperature = max_tokens, temperature
        self._secret()

    @property
    def name(self) -> str:
        """See Chat.name. The address is no part of it: answers stay paid for where a model moves to another
        port or machine. A server's name must therefore stand for one and the same weights.
        """
        return json.dumps([self.model, self.max_tokens, self.temperature, self.body], sort_keys=True)

    def _secret(self) -> str:
        """The key, "" without one.

        Raises:
            ConfigError: if there is none although there should be.
        """
        if self.key is None:
            return ""
        secret = os.environ.get(self.key, "").strip()
        if not secret:
            # Somebody may have put the key itself here: only what looks like a variable's name is shown.
            shown = f"={self.key}" if re.fullmatch(r"[A-Z][A-Z0-9_]*", self.key) else ""
            raise ConfigError(
                f"judge.chat.key{shown} should be the name of an environment variable that holds the key, and"
                " no such variable is set; export it, or say judge.chat.key=null for a server without keys"
            )
        return secret

    def _hidden(self, text: str) -> str:
        """A server's words without the key, should it repeat it."""
        secret = self._secret()
        return text.replace(secret, "[key]") if secret else text

    def _words(self, text: str) -> str:
        """The first words of an answer, or of its error message if it is JSON with one, without the key."""
        found = " ".join(self._hidden(_message(self._hidden(text))).split())
        return found[:_SHOWN] or "nothing"

    def _session(self, seconds: float | None = None) -> aiohttp.ClientSession:
        # One for each question, which takes seconds: so nothing is left open when a run is interrupted.
        secret = self._secret()
        return aiohttp.ClientSession(
            headers={"Authorization": f"Bearer {secret}"} if secret else {},
            timeout=aiohttp.ClientTimeout(total=seconds),
            trust_env=True,  # proxies
        )

    async def greet(self) -> None:
        """See Chat.greet; a server that lists no models is taken at its word."""
        try:
            async with self._session(_GREETING_S) as http:
                async with http.get(f"{self.url}/models", allow_redirects=False) as answer:
                    status, text = answer.status, await answer.text("utf-8", errors="replace")
        except (aiohttp.ClientError, asyncio.TimeoutError, OSError) as error:
            raise JudgeError(
                f"judge.chat.url={self.url}: nobody answers ({self._hidden(_reason(error))}); start the"
                " server, or correct the address"
            ) from None
        if status in (401, 403):
            raise self._unwelcome(status, text)
        names = _model_names(text) if status == 200 else []
        if names and self.model not in names:
            raise JudgeError(
                f"judge.chat.model={self.model} is not served by {self.url}{nearest(self.model, names)}"
            )

    async def ask(self, question: Question, vote: int) -> Reply:
        """See Chat.ask; the vote is sent as the seed."""
        request = {
            "model": self.model,
            "messages": [{"role": "user", "content": _content(question)}],
            "max_tokens": self.max_tokens,
            "temperature": self.temperature,
            "seed": vote,
            **self.body,
        }
        request = {name: value for name, value in request.items() if value is not None}
        try:
            async with self._session() as http:
                where = f"{self.url}/chat/completions"
                async with http.post(where, json=request, allow_redirects=False) as answer:
                    status, wait = answer.status, _wait(answer.headers.get("Retry-After", ""))
                    text = await answer.text("utf-8", errors="replace")
        except aiohttp.ClientConnectorError as error:
            raise Unanswered(f"{self.url}: {self._hidden(_reason(error))}", paid=False) from None
        except (aiohttp.ClientError, OSError) as error:
            raise Unanswered(f"{self.url}: the answer broke off ({self._hidden(_reason(error))})") from None
        if status != 200:
            raise self._refused(status, text, wait)
        return self._read(text)

    def _refused(self, status: int, text: str, wait: float) -> Exception:
        """What to raise for an answer that is none."""
        if status in (401, 403):
            return self._unwelcome(status, text)
        reason = f"{self.url} answered {status}: {self._words(text)}"
        if status in (404, 405) or 300 <= status < 400:
            return JudgeError(
                f"{reason}. It knows no judge.chat.model={self.model}, or judge.chat.url is not the address"
                " up to its version"
            )
        return Unanswered(reason, wait, paid=False, again=status in _LATER or status >= 500)

    def _unwelcome(self, status: int, text: str) -> JudgeError:
        key = "null" if self.key is None else self.key
        return JudgeError(
            f"{self.url} answered {status}: {self._words(text)}; judge.chat.key={key} must name the"
            " environment variable of a key that it takes"
        )

    def _read(self, text: str) -> Reply:
        """The answer in a completion.

        Raises:
            Unanswered: if it is no completion, or one without a word, as of a server that is out of order.
        """
        try:
            found = json.loads(text)
            message = found["choices"][0]["message"]
            content, usage = message.get("content"), found.get("usage") or {}
            refused = bool(message.get("refusal"))
            tokens = [_count(usage.get(name)) for name in ("prompt_tokens", "completion_tokens")]
        except (*_NO_JSON, KeyError, IndexError, TypeError, AttributeError):
            raise Unanswered(f"{self.url} answered no chat completion: {self._words(text)}") from None
        said = self._hidden(content).strip() if isinstance(content, str) else ""
        if not said and not refused:
            raise Unanswered(f"{self.url} answered a completion without a word")
        return Reply(said, *tokens)  # a refusal has none: an answer that is neither yes nor no


def _content(question: Question) -> list[dict[str, Any]]:
    """A question as parts of a message."""
    files = [base64.b64encode(jpeg(picture, _QUALITY)).decode() for picture in question.pictures]
    return [
        {"type": "text", "text": question.text},
        *({"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{file}"}} for file in files),
    ]


def _model_names(text: str) -> list[str]:
    """Names in a server's list of models, [] if it is none."""
    try:
        return [str(entry["id"]) for entry in json.loads(text)["data"]]
    except (*_NO_JSON, KeyError, TypeError):
        return []


def _count(tokens: Any) -> int:
    """Tokens as a server counts them, 0 if it does not.

    Raises:
        ValueError, TypeError: if that is no number.
        OverflowError: if it is past counting.
    """
    found = float(tokens or 0)
    if found > _COUNTABLE:
        raise OverflowError(f"{found} tokens")
    return max(0, int(found))


def _wait(header: str) -> float:
    """Seconds of a header Retry-After, which says seconds or a date; 0 if it says neither."""
    try:
        return max(0.0, float(header))
    except ValueError:
        pass
    try:
        return max(0.0, parsedate_to_datetime(header).timestamp() - time.time())
    except (ValueError, TypeError, OverflowError):
        return 0.0


def _message(text: str) -> str:
    """The error message in an answer that is JSON with one, else all of it."""
    try:
        found = json.loads(text)["error"]
        return str(found["message"] if isinstance(found, dict) else found)
    except (*_NO_JSON, KeyError, TypeError):
        return text


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
