"""Where requests come from when no car makes them: a list, in a closed loop or at a fixed rate.

The dialogue is written ahead of each request and behind each reply, so that a successor of a dead Client
knows what was asked, and asks again whatever it cannot know to be answered.
"""

from collections.abc import Iterable
from typing import Final, Protocol

import msgspec

from aftbed.core.journal import Entry, EntryKind
from aftbed.core.messages import Reply, Request, Submit
from aftbed.ftm.client import Client

CATCH_UP: Final = 10  # periods: a load that was held up makes good for no more


class Dialogue(Protocol):
    """Requests and replies with their bytes, as the client saw them."""

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        """Append an entry."""
        ...


def resume_client(client: Client, history: Iterable[Entry]) -> None:
    """Give a new Client the state that its predecessors' dialogues tell."""
    waiting: dict[int, Request] = {}
    answered = set()
    next_id = 1
    for entry in history:
        if entry.kind is EntryKind.SENT:
            waiting[entry.request_id] = Request(0, entry.request_id, entry.payload)
            next_id = max(next_id, entry.request_id + 1)
        else:
            answered.add(entry.request_id)
    left = [request for number, request in waiting.items() if number not in answered]
    client.restore(msgspec.msgpack.encode((next_id, left)))


class Load:
    """`rate_hz` 0 is a closed loop: the next request follows the reply. Stops after `count`."""

    port = "submit"

    def __init__(
        self, client: Client, dialogue: Dialogue, requests: list[bytes], count: int, rate_hz: float
    ) -> None:
        self._client, self._dialogue, self._requests, self._count = client, dialogue, requests, count
        self._period_ns = round(1e9 / rate_hz) if rate_hz else 0
        self._next_ns = 0

    def fds(self) -> tuple[int, ...]:
        """None: the load comes from within."""
        return ()

    def ready(self, fd: int, now_ns: int) -> None:
        """Never called."""
        raise AssertionError(f"no descriptor {fd}")

    def _due(self, now_ns: int) -> bool:
        if self._client.next_id > self._count:
            return False
        return now_ns >= self._next_ns if self._period_ns else not self._client.unanswered

    def take(self, now_ns: int) -> Submit | None:
        """The next request, if it is due. Written ahead: a successor knows it even if we die now."""
        if not self._due(now_ns):
            return None
        request_id = self._client.next_id
        payload = self._requests[(request_id - 1) % len(self._requests)]
        if self._period_ns:
            earliest_ns = now_ns - CATCH_UP * self._period_ns
            self._next_ns = max(self._next_ns or now_ns, earliest_ns) + self._period_ns
        self._dialogue.write(now_ns, request_id, 0, EntryKind.SENT, payload)
        return Submit(payload)

    def wait(self, now_ns: int) -> None:
        """A load that is held up makes good for it later, as far as it does."""

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Keep the reply in the dialogue."""
        self._dialogue.write(now_ns, reply.request_id, reply.epoch, EntryKind.ANSWERED, reply.payload)

    def quiet(self) -> None:
        """The load is at its end now."""
        self._count = self._client.next_id - 1

    def deadline_ns(self) -> int | None:
        """When the next request is due."""
        if not self._period_ns or self._client.next_id > self._count:
            return None
        return self._next_ns

    @property
    def done(self) -> bool:
        """All is asked and answered."""
        return self._client.next_id > self._count and not self._client.unanswered

    def stats(self) -> bytes:
        """How far the load is."""
        waiting = len(self._client.unanswered)
        return msgspec.msgpack.encode(
            {"sent": self._client.next_id - 1, "unanswered": waiting, "done": self.done}
        )
