"""FDTI, FRTI and FHTI of a fault, from histories told by hand, and the promise that `ftti` is."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tales import Sums, Tale

from aftbed.core.events import FIRST_FAULT, LATE, RERUN, Event
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import BusTimes, ReceiptState
from aftbed.judge.checks import Check, Evidence
from aftbed.judge.intervals import (
    BY_MECHANISM,
    HandlingIntervals,
    Occasion,
    Reaction,
    check_ftti,
    false_alarm,
    intervals,
    struck_alone,
)
from aftbed.judge.record import RunEnd, RunRecord
from aftbed.judge.reference import reference_run
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions

CRASH = "crash primary"
FLIP = "bitflip result in primary at server.exit"


OMISSION = "omission bus RADAR_TRACK"


def evidence(
    tale: Tale,
    *faults: str,
    bus: BusTimes | None = None,
    ftm: str = "pbr",
    ftti_ms: float = 0.0,
    starved_ms: float = 0.0,
) -> Evidence:
    options = RunOptions("", "", "", ftm, "process", 0, LoadRun(3, 0.0), ftti_ms=ftti_ms)
    reports = tuple(
        FaultReport(words, ReceiptState.ACTIVATED, bus=bus, number=number)
        for number, words in enumerate(faults)
    )
    end = RunEnd(leader="a", seconds=0.1, starved_ms=starved_ms)
    record = RunRecord(options, tale.history(), end, reports)
    return Evidence(record, reference_run(record.history, Sums()))


def only(tale: Tale, fault: str, ftm: str = "pbr") -> HandlingIntervals:
    (found,) = intervals(evidence(tale, fault, ftm=ftm))
    return found


def struck(tale: Tale, where: str = "a/server.1", request_id: int = 0) -> Tale:
    return tale.note(where, Event.FAULT_APPLIED, request_id, FIRST_FAULT)


def a_crash() -> Tale:
    """Request 2 is sent at +0, the crash at +1 ms, the alarm at +2, the reply of the next master at +6."""
    tale = struck(Tale().served(1).sent(2)).note("a/watchdog.1", Event.WATCHDOG_SUSPECT)
    return tale.fenced(1).promoted(2).accepted(2, epoch=2, replica=2).answered(2, epoch=2)


def times(found: HandlingIntervals) -> tuple[float | None, float | None, float | None, str]:
    return found.fdti_ms, found.frti_ms, found.fhti_ms, found.reaction.value


def test_a_crash_is_handled_with_the_first_good_reply_of_the_next_master() -> None:
    found = only(a_crash(), CRASH)
    assert times(found) == (1.0, 4.0, 5.0, "operational")
    assert found.bound_ms is not None and found.bound_ms > 5.0


def test_a_reply_that_was_on_its_way_does_not_end_the_handling() -> None:
    tale = struck(Tale().served(1).sent(2).executed(2)).accepted(2).answered(2)
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).sent(3).fenced(1).promoted(2)
    tale.accepted(3, epoch=2, replica=2).answered(3, epoch=2)
    assert times(only(tale, CRASH)) == (3.0, 5.0, 8.0, "operational")


def test_a_fault_begins_when_the_supervisor_strikes_and_not_when_a_node_came_to_the_point() -> None:
    tale = struck(struck(Tale().served(1).sent(2)).wait(30), "supervisor.1")
    tale.note("a/watchdog.1", Event.WATCHDOG_SUSPECT).fenced(1).promoted(2)
    tale.accepted(2, epoch=2, replica=2).answered(2, epoch=2)
    assert times(only(tale, CRASH)) == (1.0, 4.0, 5.0, "operational")


def test_a_suspicion_before_anything_struck_is_a_false_alarm() -> None:
    calm = Tale().served(1)
    assert not false_alarm(evidence(calm))
    alarmed = calm.note("b/watchdog.1", Event.WATCHDOG_SUSPECT)
    assert false_alarm(evidence(alarmed))
    assert false_alarm(evidence(struck(alarmed), CRASH))
    assert not false_alarm(evidence(a_crash(), CRASH))


@pytest.mark.parametrize(("detail", "alarmed"), [(LATE, True), (0, False)])
def test_a_stop_at_a_deadline_before_anything_struck_is_one_also_in_a_run_that_was_adapted(
    detail: int, alarmed: bool
) -> None:
    tale = Tale().served(1).sent(2).note("a/sup.after.1", Event.DETECTED_STOP, 2, detail)
    done = Outcome(1, "to sup", "drained", "sup", "done", asked="to sup")
    found = evidence(tale)
    found = msgspec.structs.replace(found, record=msgspec.structs.replace(found.record, adaptations=(done,)))
    assert false_alarm(found) == alarmed
    late = struck(Tale().served(1).sent(2)).note("a/sup.after.1", Event.DETECTED_STOP, 2, detail)
    assert not false_alarm(evidence(late, CRASH))


def test_a_fault_behind_a_failover_strikes_the_only_replica_until_a_backup_is_ready() -> None:
    lost = a_crash().note("recovery.1", Event.RECOVERY_ENTER).note("recovery.1", Event.RECOVERY_EXIT)
    assert not struck_alone(evidence(lost, CRASH))
    assert struck_alone(evidence(struck(lost, "b/server.1"), CRASH, CRASH))
    again = a_crash().note("recovery.1", Event.RECOVERY_ENTER).note("recovery.1", Event.BACKUP_READY)
    assert not struck_alone(evidence(struck(again, "b/server.1"), CRASH, CRASH))


def test_the_supervisor_detects_the_death_of_a_node_of_no_replica() -> None:
    tale = struck(Tale().served(1), "supervisor.1").note("supervisor.1", Event.NODE_DIED)
    assert times(only(tale.served(2), "crash engine")) == (1.0, 5.0, 6.0, "operational")


def test_the_alarm_of_the_other_replica_is_no_detection() -> None:
    tale = struck(Tale().served(1)).note("b/watchdog.1", Event.WATCHDOG_SUSPECT)
    assert times(only(tale.sent(2), CRASH)) == (None, None, None, "none")


def test_a_hang_that_nothing_sees_lasts_until_a_reply_behind_it() -> None:
    tale = struck(Tale().sent(1).executed(1), "supervisor.1").accepted(1).answered(1)  # was on its way
    tale.sent(2).wait(20).executed(2).accepted(2).answered(2)
    assert times(only(tale, "hang primary for 20ms")) == (None, None, 26.0, "operational")


def test_a_vote_differs_when_the_third_execution_begins() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2)
    tale.note("a/server.1", Event.SERVER_ENTER, 2, RERUN).note("a/server.1", Event.SERVER_ENTER, 2, RERUN)
    tale.note("a/tr.after.1", Event.VOTE_COMPARED, 2, 3).accepted(2).answered(2)
    assert times(only(tale, FLIP, "pbr+tr")) == (2.0, 3.0, 5.0, "operational")


def test_trials_that_agree_detect_nothing() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2)
    tale.note("a/tr.after.1", Event.VOTE_COMPARED, 2, 2).accepted(2).answered(2)
    assert only(tale, FLIP, "pbr+tr").fdti_ms is None


def test_a_wrong_reply_is_no_reaction() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2).answered(2, payload=b"00000000")
    found = only(tale, FLIP)
    assert times(found) == (None, None, None, "none") and found.asked


def test_a_right_reply_behind_a_wrong_one_does_not_make_up_for_it() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2).executed(2)
    tale.bare.execute(b"request 2")  # the next reply is right
    tale.accepted(2).answered(2, payload=b"00000000").served(3)
    assert times(only(tale, FLIP)) == (None, None, None, "none")


def test_a_detected_stop_without_a_reply_behind_it_is_safe() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2).note("a/tr.after.1", Event.DETECTED_STOP, 2)
    assert times(only(tale, FLIP, "tr")) == (1.0, 0.0, 1.0, "safe")


def test_a_stop_before_a_crash_was_noticed_is_no_reaction_to_it() -> None:
    tale = struck(Tale().served(1).sent(2)).note("b/tr.after.1", Event.DETECTED_STOP, 2)
    assert times(only(tale.note("supervisor.1", Event.NODE_DIED), CRASH)) == (2.0, None, None, "none")


def test_a_state_that_is_wrong_and_undetected_is_latent() -> None:
    tale = struck(Tale().served(1).sent(2), request_id=2).executed(2).accepted(2).answered(2)
    given = evidence(tale, FLIP)
    end = RunEnd(leader="a", states={"a": "one", "b": "other"})
    found = intervals(Evidence(msgspec.structs.replace(given.record, end=end), given.reference))
    assert [(one.latent, one.reaction, one.fhti_ms) for one in found] == [(True, Reaction.NONE, None)]


def test_a_detection_behind_the_next_fault_is_not_of_this_one() -> None:
    tale = struck(Tale().served(1), request_id=1).served(2)
    tale.note("a/server.1", Event.FAULT_APPLIED, 3, FIRST_FAULT + 1).note("a/after.1", Event.PEER_REFUSED, 3)
    first, second = intervals(evidence(tale.served(3), FLIP, FLIP))
    assert (first.fdti_ms, second.fdti_ms) == (None, 1.0)
    assert (first.bound_ms, second.bound_ms) == (None, None), "a bound is for one fault alone"


@pytest.mark.parametrize(
    ("other", "bus"),
    [
        (OMISSION, BusTimes(100, 10_100, 50_100)),
        ("radar missed for 100ms", None),
        ("bitflip result nth 70", None),  # struck as well, and no journal says when
    ],
)
def test_a_crash_beside_another_fault_has_no_bound(other: str, bus: BusTimes | None) -> None:
    told = evidence(a_crash(), CRASH)
    reports = (*told.record.faults, FaultReport(other, ReceiptState.ACTIVATED, bus=bus, number=1))
    beside = Evidence(msgspec.structs.replace(told.record, faults=reports), told.reference)
    assert [one.bound_ms for one in intervals(beside)] == [None] * (2 if bus else 1)
    armed = (*told.record.faults, FaultReport(other, ReceiptState.NOT_ACTIVATED, number=1))
    beside = Evidence(msgspec.structs.replace(told.record, faults=armed), told.reference)
    assert intervals(beside)[0].bound_ms is not None, "one that did not strike disturbs nothing"


def test_a_fault_that_did_not_strike_has_no_intervals() -> None:
    given = evidence(Tale().served(1), CRASH)
    reports = (FaultReport(CRASH, ReceiptState.ARMED),)
    assert intervals(Evidence(msgspec.structs.replace(given.record, faults=reports), given.reference)) == []


def test_the_blackout_of_an_adaptation_is_an_interval() -> None:
    given = evidence(Tale().served(1))
    done = Outcome(1, "to lfr", "paper", "lfr", "done", asked="to lfr", blackout_ms=27.0)
    found = intervals(Evidence(msgspec.structs.replace(given.record, adaptations=(done,)), given.reference))
    assert [(one.fault, one.occasion) for one in found] == [("adapt to lfr", Occasion.ADAPTATION)]
    assert times(found[0]) == (0.0, 27.0, 27.0, "operational")


NODES = ("a/server.1", "b/after.1", "a/watchdog.1", "proxy.1", "supervisor.1", "odd.1")
NOTED = (*BY_MECHANISM, Event.FAULT_APPLIED, Event.NODE_DIED, Event.VOTE_COMPARED, Event.SERVER_ENTER) + (
    *(Event.REPLICA_FENCED, Event.REPLICA_PROMOTED, Event.REPLY_ACCEPTED, Event.SERVER_EXIT),
)
WORDS = (CRASH, FLIP, "hang backup for 20ms", "crash engine", "slow primary by 2ms", "crash b/after")


@given(
    st.lists(
        st.tuples(st.sampled_from(NODES), st.sampled_from(Event), st.integers(0, 5), st.integers(0, 1027))
    ),
    st.lists(st.tuples(st.booleans(), st.integers(0, 5), st.integers(0, 3))),
    st.lists(st.sampled_from(WORDS), min_size=1, max_size=3),
)
def test_any_history_has_intervals_or_none(
    notes: list[tuple[str, Event, int, int]], entries: list[tuple[bool, int, int]], words: list[str]
) -> None:
    """A record may be a stranger's: what it says need not fit together."""
    tale = Tale()
    for journal, event, number, detail in notes:
        tale.note(
            journal, event, number, detail % 3 + FIRST_FAULT if event is Event.FAULT_APPLIED else detail
        )
    for sent, number, epoch in entries:
        if sent:
            tale.sent(number)
        else:
            tale.answered(number, epoch)
    given_ = evidence(tale, *words, ftti_ms=10.0)
    for found in intervals(given_):
        assert all(ms is None or ms >= 0 for ms in (found.fdti_ms, found.frti_ms, found.fhti_ms))
        assert (found.fhti_ms is None) is (found.reaction is Reaction.NONE)
    assert check_ftti(given_) is not None


# -- the promise


@pytest.mark.parametrize(
    ("ftti_ms", "starved_ms", "finding"),
    [(5.0, 0.0, "pass"), (4.999, 0.0, "fail"), (4.999, 30.0, "unknown"), (5.0, 30.0, "pass")],
)
def test_late_handling_breaks_the_promise_unless_the_machine_was_busy(
    ftti_ms: float, starved_ms: float, finding: str
) -> None:
    check = check_ftti(evidence(a_crash(), CRASH, ftti_ms=ftti_ms, starved_ms=starved_ms))
    assert check is not None and check.finding == finding
    if finding == "fail":
        assert check.reasons == ("crash primary: handled after 5 ms, the FTTI is 4.999",)


def test_a_fault_that_is_never_handled_breaks_the_promise() -> None:
    tale = struck(Tale().served(1).sent(2))
    assert check_ftti(evidence(tale, CRASH, ftti_ms=100)) == Check("fail", ("crash primary: never handled",))


def test_without_a_request_behind_the_fault_nothing_is_known() -> None:
    found = check_ftti(evidence(struck(Tale().served(1)), CRASH, ftti_ms=100))
    assert found == Check("unknown", ("crash primary: no request came after it",))


def test_a_death_that_is_seen_when_all_was_answered_is_not_known_to_be_unhandled() -> None:
    tale = struck(Tale().served(1), "supervisor.1").served(2).note("supervisor.1", Event.NODE_DIED)
    found = check_ftti(evidence(tale, "crash engine", ftti_ms=100))
    assert found == Check("unknown", ("crash engine: no request came after it",))


def test_a_fault_without_a_time_is_not_taken_for_handled() -> None:
    found = check_ftti(evidence(Tale().served(1), OMISSION, ftti_ms=100))
    assert found is not None and found.finding == "unknown"


@pytest.mark.parametrize(
    ("bus", "expected", "word"),
    [
        (BusTimes(100, 10_100, 50_100), (10.0, 40.0, 50.0, "operational"), "pass"),
        (BusTimes(100, 10_100, 50_200), (10.0, 40.1, 50.1, "operational"), "fail"),
        (BusTimes(100, 10_100, 50_100, 30_100), (10.0, 40.0, 50.0, "operational"), "pass"),
        (BusTimes(100, 10_100, None, 30_100), (10.0, 20.0, 30.0, "safe"), "pass"),
        (BusTimes(100, 10_100), (10.0, None, None, "none"), "fail"),
        (BusTimes(100, None, 3_100, believed=True), (None, None, 3.0, "operational"), "pass"),
        (BusTimes(100, believed=True), (None, None, None, "none"), "fail"),
        (BusTimes(100), (None, None, None, "none"), "unknown"),
    ],
)
def test_a_fault_of_the_bus_has_its_intervals_in_bus_time(
    bus: BusTimes, expected: tuple[float | None, float | None, float | None, str], word: str
) -> None:
    told = evidence(Tale().served(1), OMISSION, bus=bus, ftti_ms=50)
    (found,) = intervals(told)
    assert (times(found), found.in_bus_time) == (expected, True)
    check = check_ftti(told)
    assert check is not None and check.finding == word


def test_what_no_receiver_noticed_is_said_to_be_that() -> None:
    told = evidence(Tale().served(1), OMISSION, bus=BusTimes(100), ftti_ms=50)
    assert str(intervals(told)[0]) == f"{OMISSION}: none: no receiver noticed it"
    assert check_ftti(told) == Check("unknown", (f"{OMISSION}: no receiver noticed it",))


def test_the_ftti_of_the_bus_is_not_divided_by_the_pace() -> None:
    told = evidence(Tale().served(1), OMISSION, bus=BusTimes(0, 0, 50_000), ftti_ms=50)
    record = told.record
    paced = msgspec.structs.replace(record.options, work=CarRun("ccrs-50", 4.0, "latch"))
    told = Evidence(msgspec.structs.replace(record, options=paced), told.reference)
    assert check_ftti(told) == Check("pass")


def test_without_an_ftti_there_is_no_promise() -> None:
    assert check_ftti(evidence(a_crash(), CRASH)) is None
