"""Supervision: each request once and in order, each to an end, and in time."""

import pytest
from samples import notes, sends

from aftbed.core.brick import CONTROL, Effect, Halt, Note, Send
from aftbed.core.events import LATE, Event
from aftbed.core.messages import Redundancy, Reply, Request, TakeOver
from aftbed.ftm.failover import HANG_DEADLINE_NS, LATE_NS_MAX
from aftbed.ftm.supervision import DEADLINE_NS, LENIENT_NS, SupAfter, SupBefore

NOW_NS = 5_000_000_000
REQUEST = Request(2, 7, b"what")
REPLY = Reply(2, 7, 1, b"that")


def stopped(effects: list[Effect], request_id: int, detail: int = 0) -> str:
    """The reason of a detected stop: nothing leaves the replica with it."""
    note, halt = effects
    assert note == Note(Event.DETECTED_STOP, request_id, detail) and isinstance(halt, Halt)
    return halt.reason


def supervising(now_ns: int = NOW_NS) -> SupAfter:
    brick = SupAfter(2, leads=True)
    assert brick.quiescent() and brick.deadline_ns() is None
    assert brick.step("bfr2aft", REQUEST, now_ns) == []
    assert brick.open_ports() == ("prd2aft",) and not brick.quiescent()
    return brick


def test_a_request_is_announced_before_it_is_computed() -> None:
    brick = SupBefore()
    effects = brick.step("pro2bfr", REQUEST, NOW_NS)
    assert sends(effects) == [("bfr2aft", REQUEST), ("bfr2prd", REQUEST)]
    assert notes(effects) == [Event.BEFORE_EXIT]
    assert sends(brick.step("pro2bfr", Request(2, 8, b"what"), NOW_NS))[0][0] == "bfr2aft"


@pytest.mark.parametrize("number", [7, 6])
def test_a_request_that_comes_again_is_not_computed(number: int) -> None:
    brick = SupBefore()
    brick.step("pro2bfr", REQUEST, NOW_NS)
    reason = stopped(brick.step("pro2bfr", Request(2, number, b"what"), NOW_NS), number)
    assert reason == f"request {number} came behind request 7"


def test_a_reply_in_time_goes_on() -> None:
    brick = supervising()
    assert brick.deadline_ns() == NOW_NS + DEADLINE_NS
    assert brick.step("prd2aft", REPLY, NOW_NS + DEADLINE_NS - 1) == [Send("aft2pro", REPLY)]
    assert brick.quiescent() and brick.deadline_ns() is None


def test_a_reply_that_does_not_come_stops_the_replica() -> None:
    brick = supervising()
    assert stopped(brick.wake(NOW_NS + DEADLINE_NS), 7, LATE) == "request 7 took more than 25 ms"


def test_a_reply_that_comes_late_does_not_leave() -> None:
    late = supervising().step("prd2aft", REPLY, NOW_NS + DEADLINE_NS)
    assert stopped(late, 7, LATE) == "request 7 took more than 25 ms"


@pytest.mark.parametrize("number", [6, 8])
def test_a_reply_to_another_request_does_not_leave(number: int) -> None:
    other = supervising().step("prd2aft", Reply(2, number, 1, b"that"), NOW_NS)
    assert stopped(other, 7) == f"a reply to request {number}, expected 7"


def test_a_reply_may_be_read_before_its_announcement() -> None:
    brick = SupAfter(2, leads=True)
    assert brick.step("prd2aft", REPLY, NOW_NS) == [] and not brick.quiescent()
    assert brick.open_ports() == ("bfr2aft",)
    assert brick.step("bfr2aft", REQUEST, NOW_NS) == [Send("aft2pro", REPLY)]
    assert brick.quiescent() and brick.deadline_ns() is None


def test_a_reply_that_was_not_announced_does_not_wait_for_ever() -> None:
    brick = SupAfter(2, leads=True)
    brick.step("prd2aft", REPLY, NOW_NS)
    assert brick.deadline_ns() == NOW_NS + DEADLINE_NS


def replied_twice() -> SupAfter:
    brick = supervising()
    brick.step("prd2aft", REPLY, NOW_NS)
    assert brick.step("prd2aft", REPLY, NOW_NS) == []
    return brick


def test_a_reply_that_comes_twice_stops_the_replica_before_the_next_one_leaves() -> None:
    at_next = replied_twice().step("bfr2aft", Request(2, 8, b"what"), NOW_NS)
    at_deadline = replied_twice().wake(NOW_NS + DEADLINE_NS)
    for effects in (at_next, at_deadline):
        assert stopped(effects, 7) == "a reply to request 7, which was not announced"


@pytest.fixture(params=["a follower", "a leader whose backup is lost", "a leader since this request"])
def irreplaceable(request: pytest.FixtureRequest) -> SupAfter:
    """A replica that no other can replace, with a request inside."""
    brick = SupAfter(1 if "since" in request.param else 2, leads="leader" in request.param)
    if "lost" in request.param:
        assert brick.step(CONTROL, Redundancy(2, alone=True), NOW_NS) == []
    brick.step("bfr2aft", REQUEST, NOW_NS)
    return brick


def test_of_a_replica_that_no_other_can_replace_a_late_reply_leaves(irreplaceable: SupAfter) -> None:
    assert irreplaceable.deadline_ns() == NOW_NS + LENIENT_NS
    assert irreplaceable.step("prd2aft", REPLY, NOW_NS + 2 * LENIENT_NS) == [Send("aft2pro", REPLY)]


def test_a_replica_that_no_other_can_replace_stops_without_a_reply(irreplaceable: SupAfter) -> None:
    late = irreplaceable.wake(NOW_NS + LENIENT_NS + LATE_NS_MAX)
    assert stopped(late, 7, LATE) == "request 7 took more than 500 ms"


def test_a_machine_that_stood_still_does_not_stop_a_replica_that_no_other_can_replace(
    irreplaceable: SupAfter,
) -> None:
    resumed_ns = NOW_NS + LENIENT_NS + LATE_NS_MAX + 1
    assert irreplaceable.wake(resumed_ns) == []
    assert irreplaceable.deadline_ns() == resumed_ns + LENIENT_NS
    assert stopped(irreplaceable.wake(resumed_ns + LENIENT_NS), 7, LATE)


def test_a_leader_that_has_a_backup_again_is_held_to_its_deadline(irreplaceable: SupAfter) -> None:
    irreplaceable.step(CONTROL, Redundancy(2, alone=False), NOW_NS + 1)
    assert irreplaceable.deadline_ns() == NOW_NS + DEADLINE_NS
    assert stopped(irreplaceable.step("prd2aft", REPLY, NOW_NS + DEADLINE_NS), 7, LATE)


def test_a_backup_that_stands_before_the_first_request_of_an_epoch_counts() -> None:
    brick = SupAfter(1, leads=False)
    brick.step(CONTROL, Redundancy(2, alone=False), NOW_NS)
    brick.step("bfr2aft", REQUEST, NOW_NS)
    assert brick.deadline_ns() == NOW_NS + DEADLINE_NS


def test_a_machine_that_stood_still_does_not_excuse_a_leader_with_a_backup() -> None:
    assert stopped(supervising().wake(NOW_NS + 10 * LENIENT_NS), 7, LATE)


def test_a_take_over_goes_the_way_of_a_request() -> None:
    assert sends(SupBefore().step("pro2bfr", TakeOver(2), NOW_NS)) == [("bfr2prd", TakeOver(2))]
    assert sends(SupAfter(1, leads=True).step("prd2aft", TakeOver(2), NOW_NS)) == [("aft2pro", TakeOver(2))]


def test_what_is_late_is_not_yet_taken_for_a_hang() -> None:
    assert DEADLINE_NS < HANG_DEADLINE_NS
