"""The checkers: each one passes a good history, and refuses every history in which its promise is broken.

A history is told here as a person would tell it; each broken one differs from a good one by one thing.
"""

import zlib
from collections.abc import Callable

import pytest

from aftbed.core import check
from aftbed.core.check import LATE_NS, REASONS_MAX, Check, Failover, History, Requests
from aftbed.core.errors import PeerError
from aftbed.core.event import RERUN, Event
from aftbed.core.journal import Entry, EntryKind, Record

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
        "at_most_once": check.at_most_once(history),
        "exactly_one_answer": check.exactly_one_answer(history),
        "one_history": check.one_history(history, Sums()),
        "one_master": check.one_master(history),
    }


def test_a_good_history_passes_every_check() -> None:
    assert set(judged(good()).values()) == {Check("pass")}


@pytest.mark.parametrize(
    ("broken", "promise", "reason"),
    [
        (
            lambda: good().executed(3, "b/server.1"),
            "at_most_once",
            "b/server.1: request 3 (server.exit) after 3",
        ),
        (
            lambda: Tale().served(1).restored(1, "a/server.1"),
            "at_most_once",
            "a/server.1: request 1 (state.restored) after 1",
        ),
        (
            lambda: Tale().served(1).executed(1, "b/server.1"),
            "at_most_once",
            "b/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).served(2).restored(1, "b/server.1"),
            "at_most_once",
            "b/server.1: request 1 (state.restored) after 2",
        ),
        (
            lambda: Tale().served(1).rerun(1).executed(1),  # after the vote, from the state after it
            "at_most_once",
            "a/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).served(2).rerun(1),  # undoes what 2 did
            "at_most_once",
            "a/server.1: request 1 (server.exit) after 2",
        ),
        (
            lambda: Tale().served(1).rerun(1, "b/server.1"),  # of a checkpoint, not of an execution
            "at_most_once",
            "b/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).rerun(1).restored(1, "a/server.1"),
            "at_most_once",
            "a/server.1: request 1 (state.restored) after 1",
        ),
        (lambda: good().sent(4), "exactly_one_answer", "request 4: 0 replies"),
        (
            lambda: good().answered(3, payload=good().dialogue[-1].payload),
            "exactly_one_answer",
            "request 3: 2 replies",
        ),
        (
            lambda: good().note("client.1", Event.PEER_REFUSED, 3),
            "exactly_one_answer",
            "request 3: one reply too many reached the client",
        ),
        (lambda: good().answered(4, epoch=2), "exactly_one_answer", "request 4: answered, but never sent"),
        (
            lambda: Tale().sent(1).answered(1, payload=b"00000000"),
            "one_history",
            "request 1: the reply is not the bare server's",
        ),
        (
            lambda: Tale().served(1).sent(2).answered(2, payload=b""),
            "one_history",
            "request 2: the reply is not the bare server's",
        ),
        (
            lambda: Tale().sent(1).sent(2).answered(2).answered(1),  # executed in the wrong order
            "one_history",
            "request 1: the reply is not the bare server's",
        ),
        (lambda: Tale().served(2).served(1), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (lambda: Tale().served(1).served(3), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (lambda: Tale().served(1).sent(1), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (
            lambda: good().accepted(3, epoch=1, replica=1),
            "one_master",
            "a reply of epoch 1 accepted after one of epoch 2",
        ),
        (
            lambda: good().accepted(4, epoch=2, replica=1),
            "one_master",
            "epoch 2: replies of replicas 2 and 1",
        ),
        (
            lambda: Tale().served(1).promoted(2).served(2, epoch=2, replica=2),
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
        (
            lambda: Tale().served(1).fenced(2).promoted(2).served(2, epoch=2, replica=2),  # the wrong one
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
        (
            lambda: Tale().served(1).promoted(2).served(2, epoch=2, replica=2).fenced(1),  # too late
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
    ],
)
def test_a_broken_history_is_refused_by_its_check(
    broken: Callable[[], Tale], promise: str, reason: str
) -> None:
    found = judged(broken())[promise]
    assert found.finding == "fail" and reason in found.reasons


def test_what_one_server_did_is_not_held_against_the_next() -> None:
    """The effect of a request that died with its replica was never applied to what goes on."""
    tale = Tale().served(1).sent(2).executed(2).fenced(1).promoted(2).executed(2, "b/server.1")
    assert check.at_most_once(tale.history()) == Check("pass")
    tale.executed(3, "a/server.1").executed(3, "a/server.2")
    assert check.at_most_once(tale.history()) == Check("pass")


def test_a_rerun_stands_in_the_place_of_the_run_before_it() -> None:
    """A vote of two, a vote of three, and what follows: one effect for each request."""
    tale = Tale().sent(1).executed(1).rerun(1).sent(2).executed(2).rerun(2).rerun(2).executed(3)
    assert check.at_most_once(tale.history()) == Check("pass")


def test_a_refusal_of_something_else_is_no_second_answer() -> None:
    tale = good().note("client.1", Event.PEER_REFUSED, 0).note("proxy.1", Event.PEER_REFUSED, 3)
    assert check.exactly_one_answer(tale.history()) == Check("pass")


def test_a_reply_that_was_on_its_way_may_be_accepted_behind_the_fence() -> None:
    """The fence ends a channel after what was sent: its master is none, its last reply is still one."""
    tale = Tale().served(1).sent(2).executed(2).restored(2)
    tale.fenced(1).accepted(2, epoch=1, replica=1).answered(2)
    tale.promoted(2).served(3, epoch=2, replica=2)
    assert set(judged(tale).values()) == {Check("pass")}


def test_epochs_without_a_reply_are_skipped() -> None:
    tale = Tale().served(1).fenced(1).promoted(2).fenced(2).promoted(3).served(2, epoch=3, replica=1)
    assert check.one_master(tale.history()) == Check("pass")


def test_each_failover_needs_its_own_fence() -> None:
    tale = good().promoted(3).served(4, epoch=3, replica=1)
    assert check.one_master(tale.history()).reasons == ("replica 2 was not fenced between epochs 2 and 3",)


def test_an_empty_history_is_unknown_and_no_pass() -> None:
    found = judged(Tale())
    assert {name for name, c in found.items() if c.finding == "unknown"} == {
        "exactly_one_answer",
        "one_history",
        "one_master",
    }


def test_the_first_few_reasons_are_given() -> None:
    tale = Tale()
    for number in range(1, 2 * REASONS_MAX):
        tale.sent(number)
    assert len(check.exactly_one_answer(tale.history()).reasons) == REASONS_MAX


def test_a_request_that_the_function_refuses_is_answered_with_nothing() -> None:
    tale = Tale().sent(1, b"").answered(1, payload=b"").served(2)
    assert check.one_history(tale.history(), Sums()) == Check("pass")


# -- figures


def test_the_clients_account_of_a_good_history() -> None:
    account = check.requests(good().history(), Sums())
    assert account == Requests(sent=3, answered=3, lost=0, duplicated=0, late=0, wrong=0)


def test_the_clients_account_of_a_bad_one() -> None:
    tale = Tale().served(1).sent(2)  # lost
    tale.sent(3).wait(LATE_NS / MS).answered(3, payload=b"wrong and late")
    tale.sent(4).answered(4, payload=b"").answered(4, payload=b"")  # wrong, twice
    tale.note("client.1", Event.PEER_REFUSED, 1)  # a second one, refused by the client
    account = check.requests(tale.history(), Sums())
    assert account == Requests(sent=4, answered=3, lost=1, duplicated=2, late=1, wrong=2)


def test_an_answer_to_what_was_never_asked_makes_no_request_lost() -> None:
    account = check.requests(good().answered(4, epoch=2).history(), Sums())
    assert (account.sent, account.lost) == (3, 0)


@pytest.mark.parametrize(("more_ns", "late"), [(0, 0), (1, 1)])
def test_how_late_is_late(more_ns: int, late: int) -> None:
    entries = [
        Entry(5, 1, 0, EntryKind.SENT, b"request 1"),
        Entry(5 + LATE_NS + more_ns, 1, 1, EntryKind.ANSWERED, Sums().execute(b"request 1")),
    ]
    assert check.requests(History({}, entries), Sums()).late == late


def a_failover(*, fault: bool, alarm: bool = True) -> Tale:
    """Sent at +0, fault at +1 ms, alarm at +2, fence at +3, promotion at +4, accepted at +5."""
    tale = Tale().served(1).sent(2)
    if fault:
        tale.note("a/server.1", Event.FAULT_APPLIED)
    else:
        tale.wait(1)
    if alarm:
        tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT)
    else:
        tale.wait(1)
    return tale.fenced(1).promoted(2).accepted(2, epoch=2, replica=2).answered(2, epoch=2)


def test_the_times_of_a_failover_count_from_the_fault() -> None:
    assert check.failovers(a_failover(fault=True).history()) == [
        Failover(
            epoch=2,
            cause="fault",
            detected_ms=1.0,
            fenced_ms=2.0,
            promoted_ms=3.0,
            recovered_ms=4.0,
            blackout_ms=4.0,
        )
    ]


def test_without_a_fault_they_count_from_the_alarm() -> None:
    (found,) = check.failovers(a_failover(fault=False).history())
    assert (found.cause, found.detected_ms, found.fenced_ms, found.recovered_ms) == ("alarm", None, 1.0, 3.0)


def test_without_fault_and_alarm_they_count_from_the_fence() -> None:
    (found,) = check.failovers(a_failover(fault=False, alarm=False).history())
    assert (found.cause, found.detected_ms, found.fenced_ms, found.recovered_ms) == (
        "unknown",
        None,
        0.0,
        2.0,
    )


def test_a_promotion_without_any_of_them_has_no_time_of_its_fence() -> None:
    """A broken history, but its figures are told beside the check that refuses it."""
    (found,) = check.failovers(Tale().served(1).promoted(2).history())
    assert (found.cause, found.fenced_ms, found.promoted_ms, found.recovered_ms) == (
        "unknown",
        None,
        0.0,
        None,
    )


def test_a_request_that_came_later_did_not_wait_for_the_failover() -> None:
    tale = Tale().served(1).note("a/server.1", Event.FAULT_APPLIED)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2).wait(100)
    tale.served(2, epoch=2, replica=2)
    (found,) = check.failovers(tale.history())
    assert found.recovered_ms == 107.0, "the fault was that long ago"
    assert found.blackout_ms == 3.0, "but nobody waited"


def test_a_failover_that_nobody_lived_to_use() -> None:
    tale = Tale().served(1).note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2)
    (found,) = check.failovers(tale.history())
    assert (found.promoted_ms, found.recovered_ms, found.blackout_ms) == (2.0, None, None)


def test_an_old_fault_is_not_the_cause() -> None:
    tale = Tale().served(1).note("hub.1", Event.FAULT_APPLIED).wait(1001)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2)
    (found,) = check.failovers(tale.history())
    assert found.cause == "alarm"


def test_each_failover_is_told_in_order() -> None:
    tale = a_failover(fault=True).fenced(2).promoted(3).served(3, epoch=3, replica=1)
    assert [f.epoch for f in check.failovers(tale.history())] == [2, 3]


def test_no_failover_no_figures() -> None:
    assert check.failovers(Tale().served(1).history()) == []


def test_two_servers_in_one_node_are_two() -> None:
    """Placement `single`: what one has executed, the other restores; each by itself only grows."""

    def record(at: int, event: Event, request_id: int, brick: int) -> Record:
        return Record(at, event, request_id, 0, "single", brick)

    sound = [record(1, Event.SERVER_EXIT, 1, 4), record(2, Event.STATE_RESTORED, 1, 9)]
    assert check.at_most_once(History({"single.1": sound}, [])).finding == "pass"
    broken = [*sound, record(3, Event.SERVER_EXIT, 1, 9)]
    assert check.at_most_once(History({"single.1": broken}, [])).finding == "fail"
