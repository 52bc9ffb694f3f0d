"""The figures of a history: the client's account, and how long each failover took."""

from typing import Final

import pytest
from tales import MS, Sums, Tale, good

from aftbed.core.events import FIRST_FAULT, Event
from aftbed.core.journal import Entry, EntryKind, History, Record
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.judge import checks
from aftbed.judge.checks import LATE_NS, Failover, Requests
from aftbed.judge.reference import reference_run
from aftbed.vehicle.ecus import HOLD_US

CRASH: Final = FaultReport("crash primary", ReceiptState.ACTIVATED)


def account_of(history: History) -> Requests:
    return checks.requests(history, reference_run(history, Sums()))


def test_the_clients_account_of_a_good_history() -> None:
    account = account_of(good().history())
    assert account == Requests(sent=3, answered=3, lost=0, duplicated=0, late=0, wrong=0)


def test_the_clients_account_of_a_bad_one() -> None:
    tale = Tale().served(1).sent(2)  # lost
    tale.sent(3).wait(LATE_NS / MS).answered(3, payload=b"wrong and late")
    tale.sent(4).answered(4, payload=b"").answered(4, payload=b"")  # wrong, twice
    tale.note("client.1", Event.PEER_REFUSED, 1)  # a second one, refused by the client
    account = account_of(tale.history())
    assert account == Requests(sent=4, answered=3, lost=1, duplicated=2, late=1, wrong=2)


def test_an_answer_to_what_was_never_asked_makes_no_request_lost() -> None:
    account = account_of(good().answered(4, epoch=2).history())
    assert (account.sent, account.lost) == (3, 0)


@pytest.mark.parametrize(("more_ns", "late"), [(0, 0), (1, 1)])
def test_how_late_is_late(more_ns: int, late: int) -> None:
    entries = [
        Entry(5, 1, 0, EntryKind.SENT, b"request 1"),
        Entry(5 + LATE_NS + more_ns, 1, 1, EntryKind.ANSWERED, Sums().execute(b"request 1")),
    ]
    assert account_of(History({}, entries)).late == late


def test_a_reply_is_late_when_the_brakes_no_longer_hold_the_request_before_it() -> None:
    assert LATE_NS == HOLD_US * 1000


def a_failover(*, fault: bool, alarm: bool = True) -> Tale:
    """Sent at +0, fault at +1 ms, alarm at +2, fence at +3, promotion at +4, accepted at +5."""
    tale = Tale().served(1).sent(2)
    if fault:
        tale.note("a/server.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    else:
        tale.wait(1)
    if alarm:
        tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT)
    else:
        tale.wait(1)
    return tale.fenced(1).promoted(2).accepted(2, epoch=2, replica=2).answered(2, epoch=2)


def test_the_times_of_a_failover_count_from_the_fault() -> None:
    assert checks.failovers(a_failover(fault=True).history(), [CRASH]) == [
        Failover(
            epoch=2,
            cause="fault",
            detected_ms=1.0,
            fenced_ms=2.0,
            promoted_ms=3.0,
            recovered_ms=4.0,
            blackout_ms=4.0,
            fault="crash primary",
        )
    ]


def test_without_a_fault_they_count_from_the_alarm() -> None:
    (found,) = checks.failovers(a_failover(fault=False).history())
    assert (found.cause, found.detected_ms, found.fenced_ms, found.recovered_ms) == ("alarm", None, 1.0, 3.0)


def test_without_fault_and_alarm_they_count_from_the_fence() -> None:
    (found,) = checks.failovers(a_failover(fault=False, alarm=False).history())
    assert (found.cause, found.detected_ms, found.fenced_ms, found.recovered_ms) == (
        "unknown",
        None,
        0.0,
        2.0,
    )


def test_a_promotion_without_any_of_them_has_no_time_of_its_fence() -> None:
    """A broken history, but its figures are told beside the check that refuses it."""
    (found,) = checks.failovers(Tale().served(1).promoted(2).history())
    assert (found.cause, found.fenced_ms, found.promoted_ms, found.recovered_ms) == (
        "unknown",
        None,
        0.0,
        None,
    )


def test_a_request_that_came_later_did_not_wait_for_the_failover() -> None:
    tale = Tale().served(1).note("a/server.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2).wait(100)
    tale.served(2, epoch=2, replica=2)
    (found,) = checks.failovers(tale.history(), [CRASH])
    assert found.recovered_ms == 107.0, "the fault was that long ago"
    assert found.blackout_ms == 3.0, "but no request waited"


def test_a_failover_that_nobody_lived_to_use() -> None:
    tale = Tale().served(1).note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2)
    (found,) = checks.failovers(tale.history())
    assert (found.promoted_ms, found.recovered_ms, found.blackout_ms) == (2.0, None, None)


@pytest.mark.parametrize(
    ("words", "wait_ms", "cause"),
    [
        ("crash primary at server.exit nth 2", 3000, "fault"),  # on a busy machine
        ("crash a/after", 1, "fault"),
        ("crash a", 1, "fault"),
        ("hang primary", 500, "fault"),
        ("hang primary for 100ms", 60, "fault"),
        ("hang primary for 100ms", 400, "alarm"),  # it was over by then
        ("crash b/after", 1, "alarm"),  # of the other replica
        ("crash backup", 1, "alarm"),
        ("crash a/watchdog", 1, "alarm"),
        ("crash proxy", 1, "alarm"),
        ("bitflip result bit 3 nth 2", 1, "alarm"),  # ends no process
        ("slow primary by 2ms", 1, "alarm"),
    ],
)
def test_the_cause_is_what_ended_the_leader_and_nothing_beside_it(
    words: str, wait_ms: float, cause: str
) -> None:
    tale = Tale().served(1).note("supervisor.1", Event.FAULT_APPLIED, detail=FIRST_FAULT).wait(wait_ms)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2)
    (found,) = checks.failovers(tale.history(), [FaultReport(words, ReceiptState.ACTIVATED)])
    assert (found.cause, found.fault) == (cause, words if cause == "fault" else "")
    assert (found.detected_ms is None) is (cause != "fault")


def test_a_fault_of_an_earlier_mastership_is_not_the_cause() -> None:
    tale = a_failover(fault=True).note("b/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(2).promoted(3)
    assert [f.cause for f in checks.failovers(tale.history(), [CRASH])] == ["fault", "alarm"]


def test_a_fence_of_a_replica_that_there_is_not_has_no_cause() -> None:
    tale = Tale().served(1).note("a/server.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(9).promoted(2)
    crash = FaultReport("crash a", ReceiptState.ACTIVATED)
    assert [f.cause for f in checks.failovers(tale.history(), [crash])] == ["alarm"]


def test_a_reply_to_request_0_is_compared() -> None:
    tale = Tale().sent(0).answered(0, payload=b"").answered(0, payload=b"")
    assert account_of(tale.history()).wrong == 1


def test_each_failover_is_told_in_order() -> None:
    tale = a_failover(fault=True).fenced(2).promoted(3).served(3, epoch=3, replica=1)
    assert [f.epoch for f in checks.failovers(tale.history())] == [2, 3]


def test_no_failover_no_figures() -> None:
    assert checks.failovers(Tale().served(1).history()) == []


def test_two_servers_in_one_node_are_two() -> None:
    """Placement `single`: what one has executed, the other restores; each by itself only grows."""

    def record(at: int, event: Event, request_id: int, brick: int) -> Record:
        return Record(at, event, request_id, 0, "single", brick)

    sound = [record(1, Event.SERVER_EXIT, 1, 4), record(2, Event.STATE_RESTORED, 1, 9)]
    assert checks.at_most_once(History({"single.1": sound}, [])).finding == "pass"
    broken = [*sound, record(3, Event.SERVER_EXIT, 1, 9)]
    assert checks.at_most_once(History({"single.1": broken}, [])).finding == "fail"
