"""Histories told as a person would tell them: the checkers are tried on these."""

import zlib

from aftbed.core.errors import PeerError
from aftbed.core.events import RERUN, Event
from aftbed.core.journal import Entry, EntryKind, History, Record
from aftbed.judge import checks
from aftbed.judge.checks import Check
from aftbed.judge.reference import reference_run

MS = 1_000_000
FIRST_GENERATION = 1 << 8


class Sums:
    """The bare function: each reply depends on all requests so far; it refuses an empty one."""

    def __init__(self) -> None:
        self.sum = 0

    def execute(self, request: bytes) -> bytes:
        if not request:
            raise PeerError("an empty request")
        self.sum = zlib.crc32(request, self.sum)
        return b"%08x" % self.sum

    def capture(self) -> bytes:
        return b"%d" % self.sum

    def restore(self, state: bytes) -> None:
        self.sum = int(state)


class Tale:
    """A history in the making; each thing told happens 1 ms after the one before."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.journals: dict[str, list[Record]] = {}
        self.dialogue: list[Entry] = []
        self.bare = Sums()

    def wait(self, ms: float) -> "Tale":
        self.t_ns += round(ms * MS)
        return self

    def note(self, journal: str, event: Event, request_id: int = 0, detail: int = 0) -> "Tale":
        self.t_ns += MS
        node = journal.partition(".")[0]
        self.journals.setdefault(journal, []).append(Record(self.t_ns, event, request_id, detail, node))
        return self

    def sent(self, number: int, payload: bytes | None = None) -> "Tale":
        self.t_ns += MS
        payload = b"request %d" % number if payload is None else payload
        self.dialogue.append(Entry(self.t_ns, number, 0, EntryKind.SENT, payload))
        return self

    def executed(self, number: int, server: str = "a/server.1") -> "Tale":
        return self.note(server, Event.SERVER_EXIT, number)

    def rerun(self, number: int, server: str = "a/server.1") -> "Tale":
        return self.note(server, Event.SERVER_EXIT, number, RERUN)

    def restored(self, number: int, server: str = "b/server.1") -> "Tale":
        return self.note(server, Event.STATE_RESTORED, number)

    def accepted(self, number: int, epoch: int = 1, replica: int = 1) -> "Tale":
        return self.note("proxy.1", Event.REPLY_ACCEPTED, number, epoch << 8 | replica)

    def answered(self, number: int, epoch: int = 1, payload: bytes | None = None) -> "Tale":
        self.t_ns += MS
        payload = self.bare.execute(b"request %d" % number) if payload is None else payload
        self.dialogue.append(Entry(self.t_ns, number, epoch, EntryKind.ANSWERED, payload))
        return self

    def served(self, number: int, epoch: int = 1, replica: int = 1) -> "Tale":
        """A request as it should go, under PBR."""
        leader, other = ("a", "b") if replica == 1 else ("b", "a")
        self.sent(number).executed(number, f"{leader}/server.1").restored(number, f"{other}/server.1")
        return self.accepted(number, epoch, replica).answered(number, epoch)

    def fenced(self, replica: int) -> "Tale":
        return self.note("supervisor.1", Event.REPLICA_FENCED, detail=FIRST_GENERATION | replica)

    def promoted(self, epoch: int) -> "Tale":
        return self.note("b/protocol.1", Event.REPLICA_PROMOTED, detail=epoch)

    def history(self) -> History:
        return History(self.journals, self.dialogue)


def good() -> Tale:
    """Two requests, a failover, one more request."""
    return Tale().served(1).served(2).fenced(1).promoted(2).served(3, epoch=2, replica=2)


def judged(tale: Tale) -> dict[str, Check]:
    history = tale.history()
    return {
        "at_most_once": checks.at_most_once(history),
        "exactly_one_answer": checks.exactly_one_answer(history),
        "one_history": checks.one_history(history, reference_run(history, Sums())),
        "one_master": checks.one_master(history),
    }
