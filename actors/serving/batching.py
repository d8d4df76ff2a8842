"""How long a step waits for other sessions' steps, so that free-running clients share forward passes."""

from __future__ import annotations

from dataclasses import dataclass

_SLACK = 1.5  # a client is given this many times its usual pause
_MEMORY = 0.5  # share of the newest pause in what is usual


@dataclass
class _Client:
    answered: float = 0.0  # when its last step was answered; 0 while one is under way
    pause: float | None = None  # what it usually takes from an answer to its next step, seconds


class Company:
    """Which sessions are about to step.

    A shared pass saves about one pass, so no step waits longer than the last pass took, nor longer than
    `longest_s`; and it waits only for sessions that usually come back within that time. Clients that share
    one pass are answered together, come back together and so share the next.

    Args:
        longest_s: longest wait in seconds.
    """

    def __init__(self, longest_s: float):
        self.longest_s, self.pass_s = longest_s, longest_s
        self._clients: dict[str, _Client] = {}

    def arrived(self, client_id: str, now: float) -> None:
        """A session asks for a step."""
        client = self._clients.setdefault(client_id, _Client())
        if client.answered:
            pause = now - client.answered
            client.pause = pause if client.pause is None else client.pause + _MEMORY * (pause - client.pause)
        client.answered = 0.0

    def answered(self, client_ids: list[str], now: float, pass_s: float) -> None:
        """A pass of `pass_s` seconds ended, whose sessions are answered now."""
        self.pass_s = pass_s
        for client_id in client_ids:
            self._clients.setdefault(client_id, _Client()).answered = now

    def left(self, client_id: str) -> None:
        """A session ended."""
        self._clients.pop(client_id, None)

    def wait_until(self, began: float) -> float:
        """Until when a pass that could begin at `began` should wait for the sessions that are expected."""
        limit = min(self.longest_s, self.pass_s)
        due = began
        for client in self._clients.values():
            if client.answered and (client.pause is None or client.pause <= limit):
                usual = limit if client.pause is None else _SLACK * client.pause
                due = max(due, min(client.answered + usual, began + limit))
        return due
