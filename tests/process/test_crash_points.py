"""A crash at every point of a request's way: nothing lost, doubled or wrong, and the car stops where it did.

In lockstep the drive does not depend on the machine, so "the car did not notice" is an equality.
"""

from functools import cache
from typing import Final

import pytest
from liveruns import SHORT, aftbed
from requestpath import REQUEST_PATH
from sampling import every

from aftbed.ftm.failover import HANG_DEADLINE_NS
from aftbed.judge.intervals import Reaction
from aftbed.judge.verdict import Verdict
from aftbed.runtime.devices import LOOK_NS

pytestmark = pytest.mark.process

DRIVE: Final = ("run", "--scenario", SHORT, "--pace", "max", "--json")  # of 128 requests
POINTS: Final = tuple(event.label for event in REQUEST_PATH)


def drive(*faults: str, placement: str = "process") -> Verdict:
    """The verdict of a drive under PBR, which must have ended with exit code 0."""
    injected = [word for fault in faults for word in ("--inject", fault)]
    done = aftbed(*DRIVE, "--ftm", "pbr", "--placement", placement, *injected)
    assert done.code == 0, done.out + done.err
    return done.verdict()


@cache
def undisturbed() -> Verdict:
    """The drive without a fault."""
    return drive()


def assert_masked(verdict: Verdict, failovers: int, faults: int = 1) -> None:
    """The client and the car have noticed nothing."""
    assert verdict.verdict == "pass", verdict.reasons
    assert set(verdict.checks.values()) == {"pass"}
    requests = verdict.requests
    assert requests.sent == requests.answered == undisturbed().requests.sent
    assert (requests.lost, requests.duplicated, requests.wrong) == (0, 0, 0)
    assert verdict.vehicle == undisturbed().vehicle
    assert verdict.vehicle is not None
    assert not verdict.vehicle.collision
    assert len(verdict.failovers) == failovers
    assert [fault.receipt.value for fault in verdict.faults] == ["activated"] * faults


@pytest.mark.parametrize("event", every(3, POINTS))
def test_a_crash_of_the_primary_at_any_point_is_masked(event: str) -> None:
    assert_masked(drive(f"crash primary at {event} nth 60"), failovers=1)


@pytest.mark.parametrize("event", every(2, POINTS[1::3]))
def test_a_replica_in_one_node_crashes_as_masked(event: str) -> None:
    assert_masked(drive(f"crash primary at {event} nth 60", placement="replica"), failovers=1)


@pytest.mark.deep
@pytest.mark.parametrize("nth", [1, 2, 3, 17, 60, 120])
@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize("event", POINTS)
def test_a_crash_of_the_primary_at_any_time_is_masked(event: str, placement: str, nth: int) -> None:
    assert_masked(drive(f"crash primary at {event} nth {nth}", placement=placement), failovers=1)


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_a_crash_of_the_backup_is_no_failover(placement: str) -> None:
    assert_masked(drive("crash backup at checkpoint.applied nth 60", placement=placement), failovers=0)


@pytest.mark.parametrize("part", every(2, ["protocol", "before", "proceed", "after", "server"]))
def test_a_crash_of_one_node_of_the_primary_is_a_failover(part: str) -> None:
    assert_masked(drive(f"crash a/{part} at server.exit nth 60"), failovers=1)


@pytest.mark.parametrize(
    "event", every(2, ["checkpoint.sent", "request.received", "reply.stored", "reply.sent"])
)
def test_whoever_waits_for_the_blow_may_die_of_it(event: str) -> None:
    """The node that reaches the point asks for the blow; the failover kills it before it hears of it."""
    assert_masked(drive(f"crash a/server at {event} nth 60"), failovers=1)


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_the_new_backup_takes_over_in_its_turn(placement: str) -> None:
    """The eleventh checkpoint is sent to it: meanwhile there are none, however long it takes to be made."""
    faults = ("crash primary at checkpoint.sent nth 10", "crash primary at checkpoint.sent nth 15")
    assert_masked(drive(*faults, placement=placement), failovers=2, faults=2)


@pytest.mark.parametrize(
    ("fault", "failovers"),
    [
        ("crash recovery at recovery.enter", 1),
        ("crash a/watchdog at watchdog.suspect", 1),
        ("crash proxy at recovery.enter", 1),
        ("crash zygote at watchdog.suspect", 1),
        ("crash recovery at recovery.exit", 1),
    ],
)
def test_a_crash_during_the_failover_is_masked_too(fault: str, failovers: int) -> None:
    verdict = drive("crash primary at checkpoint.sent nth 60", fault)
    assert_masked(verdict, failovers=failovers, faults=2)


def test_a_replica_that_hangs_is_replaced() -> None:
    verdict = drive("hang primary at server.enter nth 60")
    assert_masked(verdict, failovers=1)
    (found,) = verdict.intervals
    assert found.reaction is Reaction.OPERATIONAL and found.fdti_ms is not None and found.frti_ms is not None
    assert found.fdti_ms >= (HANG_DEADLINE_NS - LOOK_NS) / 1e6 and found.frti_ms > 0
    assert found.fhti_ms == pytest.approx(found.fdti_ms + found.frti_ms, abs=0.002)


def test_without_a_mechanism_a_crash_is_not_masked() -> None:
    done = aftbed(*DRIVE, "--ftm", "none", "--inject", "crash primary at server.enter nth 126")
    verdict = done.verdict()
    assert done.code == 1, done.out
    assert verdict.verdict == "fail"
    assert verdict.requests.lost > 0
    assert verdict.checks["exactly_one_answer"] == "fail"
    assert verdict.failovers == []


def test_a_fault_that_never_fires_is_no_pass() -> None:
    done = aftbed(*DRIVE, "--inject", "crash primary at checkpoint.sent nth 100000")
    assert done.code == 3, done.out
    assert done.verdict().verdict == "inconclusive"
    assert done.verdict().faults[0].receipt.value == "armed"
