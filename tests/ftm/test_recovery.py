"""Recovery: the table of decisions, scripts that pass their check, one at a time, again after a failure."""

from typing import Final

import msgspec
import pytest
from samples import notes

from aftbed.adapt.script_check import problems
from aftbed.core.brick import CONTROL, Effect, Order
from aftbed.core.events import Event
from aftbed.core.messages import Loss, Rebound, Situation, Suspect
from aftbed.core.script import (
    Attach,
    Bind,
    Fence,
    Kill,
    Promote,
    Resume,
    Script,
    Spawn,
    Suspend,
    Transfer,
    Unbind,
)
from aftbed.ftm.failover import (
    FAILURES_MAX,
    RETRY_NS,
    Recovery,
    Suspicions,
    decide,
    drop_backup,
    failover,
    new_backup,
)

PBR: Final = (("after", "aft2aft"),)
LFR: Final = (("before", "bfr2bfr"), ("after", "aft2aft"))
STATEFUL: Final = ("protocol", "server")
WHOLE: Final = Situation("a", 1, "b", 1, 1, (), False)
ALONE: Final = Situation("a", 1, "", 0, 1, ("b",), False)
NOBODY: Final = Situation("", 0, "", 0, 1, ("a", "b"), True)


def failed(situation: Situation) -> Situation:
    return msgspec.structs.replace(situation, failed=True)


def dropped() -> Script:
    return drop_backup("a", "b", PBR)


def renewed(leader: str, replica: str) -> Script:
    return new_backup(leader, replica, PBR, STATEFUL)


def ordered(effects: list[Effect]) -> list[Script]:
    return [e.script for e in effects if isinstance(e, Order)]


def alarm(replica: str, generation: int = 1) -> Suspect:
    return Suspect(replica, generation, f"{replica}/server", Loss.CRASH, 5)


@pytest.mark.parametrize(
    ("situation", "suspects", "script"),
    [
        (WHOLE, {}, None),
        (WHOLE, {("a", 1): Loss.CRASH}, failover("a", "b", 2)),
        (WHOLE, {("a", 1): Loss.HANG}, failover("a", "b", 2)),
        (WHOLE, {("b", 1): Loss.CRASH}, dropped()),
        (WHOLE, {("a", 1): Loss.HANG, ("b", 1): Loss.HANG}, dropped()),
        (WHOLE, {("a", 1): Loss.HANG, ("b", 1): Loss.CRASH}, dropped()),
        (WHOLE, {("a", 1): Loss.CRASH, ("b", 1): Loss.CRASH}, dropped()),
        (WHOLE, {("a", 1): Loss.CRASH, ("b", 1): Loss.HANG}, failover("a", "b", 2)),  # it may go on
        (WHOLE, {("a", 2): Loss.CRASH}, None),  # another generation's
        (ALONE, {}, renewed("a", "b")),
        (ALONE, {("a", 1): Loss.CRASH}, None),  # no replica is left to take over
        (ALONE, {("a", 1): Loss.HANG}, renewed("a", "b")),  # it may serve again
        (Situation("a", 1, "", 0, 1, (), False), {}, None),  # the slot is not free yet
        (Situation("b", 3, "a", 2, 5, (), False), {("b", 3): Loss.CRASH}, failover("b", "a", 6)),
        (NOBODY, {}, None),
    ],
)
def test_the_table_of_decisions(situation: Situation, suspects: Suspicions, script: Script | None) -> None:
    assert decide(situation, suspects) == script


@pytest.mark.parametrize("script", [failover("a", "b", 2), dropped(), renewed("a", "b")])
def test_each_script_passes_its_check(script: Script) -> None:
    assert problems(script) == []


def test_a_failover_fences_before_it_promotes_and_promotes_before_it_attaches() -> None:
    assert failover("a", "b", 2).commit == (Fence("a"), Promote("b", 2), Attach("b", 2), Kill("a"))


def test_a_new_backup_gets_all_state_while_the_leader_is_suspended() -> None:
    script = renewed("a", "b")
    assert script.prepare == (Spawn("b"),)
    kinds = [type(verb) for verb in script.commit]
    assert kinds == [Suspend, Transfer, Transfer, Bind, Resume]
    assert {v.source for v in script.commit if isinstance(v, Transfer)} == {"a/protocol", "a/server"}


def test_what_a_leader_says_to_its_backup_is_bound_and_unbound_as_the_mechanism_has_it() -> None:
    lfr = msgspec.structs.replace(WHOLE, replication=LFR)
    script = decide(lfr, {("b", 1): Loss.CRASH})
    assert script is not None and script.commit == (
        Fence("b"),
        Unbind("a/before", "bfr2bfr"),
        Unbind("a/after", "aft2aft"),
        Kill("b"),
    )
    script = decide(msgspec.structs.replace(ALONE, replication=LFR, stateful=("server",)), {})
    assert script is not None and script.commit == (
        Suspend("a/protocol"),
        Transfer("a/server", "b/server"),
        Bind("a/before", "bfr2bfr", "b/before"),
        Bind("a/after", "aft2aft", "b/after"),
        Resume("a/protocol"),
    )
    assert problems(script) == []


@pytest.mark.parametrize("situation", [WHOLE, ALONE, Situation("a", 1, "", 0, 1, (), False)])
@pytest.mark.parametrize("suspects", [{}, {("a", 1): Loss.HANG}, {("b", 1): Loss.CRASH}])
def test_with_one_replica_there_is_nothing_to_do(situation: Situation, suspects: Suspicions) -> None:
    assert decide(msgspec.structs.replace(situation, replication=()), suspects) is None


def test_an_alarm_makes_it_act_and_the_report_ends_it() -> None:
    brick = Recovery()
    assert brick.step(CONTROL, WHOLE, 0) == []
    effects = brick.step("wdg2rec", alarm("a"), 0)
    assert ordered(effects) == [failover("a", "b", 2)] and notes(effects) == [Event.RECOVERY_ENTER]
    assert not brick.quiescent()
    effects = brick.step(CONTROL, Situation("b", 1, "", 0, 2, ("a",), False), 0)
    assert notes(effects) == [Event.RECOVERY_EXIT]
    assert ordered(effects) == [renewed("b", "a")], "redundancy is restored at once"
    effects = brick.step(CONTROL, Situation("b", 1, "a", 2, 2, (), False), 0)
    assert notes(effects) == [Event.BACKUP_READY] and ordered(effects) == []
    assert brick.quiescent()


def test_two_replicas_that_hung_for_a_while_are_both_replaced() -> None:
    """The backup at once; the leader, if it answers again, when there is a new backup to lead."""
    brick = Recovery()
    brick.step(CONTROL, WHOLE, 0)
    for replica in ("a", "b"):
        brick.step("wdg2rec", Suspect(replica, 1, f"{replica}/server", Loss.HANG, 5), 0)
    assert ordered(brick.step(CONTROL, WHOLE, 0)) == [dropped()], "no failover could begin meanwhile"
    assert ordered(brick.step(CONTROL, ALONE, 0)) == [renewed("a", "b")]
    again = Situation("a", 1, "b", 2, 1, (), False)
    assert ordered(brick.step(CONTROL, again, 0)) == [failover("a", "b", 2)]


@pytest.mark.parametrize(("lost", "script"), [("a", failover("a", "b", 2)), ("b", dropped())])
def test_a_replica_that_an_adaptation_has_left_dead_needs_no_alarm(lost: str, script: Script) -> None:
    left = msgspec.structs.replace(WHOLE, lost=(lost,))
    assert ordered(Recovery().step(CONTROL, left, 0)) == [script]


def test_one_script_at_a_time_what_comes_meanwhile_is_remembered() -> None:
    brick = Recovery()
    brick.step(CONTROL, ALONE, 0)
    assert brick.ordered is not None
    assert ordered(brick.step("wdg2rec", alarm("b", 2), 0)) == []
    effects = brick.step(CONTROL, Situation("a", 1, "b", 2, 1, (), False), 0)
    assert ordered(effects) == [dropped()]


def test_an_alarm_against_the_past_is_forgotten() -> None:
    brick = Recovery()
    brick.step(CONTROL, WHOLE, 0)
    assert ordered(brick.step("wdg2rec", alarm("a", 7), 0)) == []
    brick.step(CONTROL, WHOLE, 0)
    assert brick.suspects == {}


def test_an_alarm_that_comes_before_the_situation_waits_for_it() -> None:
    brick = Recovery()
    assert brick.step("wdg2rec", alarm("a"), 0) == []
    assert ordered(brick.step(CONTROL, WHOLE, 0)) == [failover("a", "b", 2)]


def test_a_new_recovery_knows_as_much_as_the_old_one() -> None:
    """It died in the middle of a failover: the alarm is said again, how things stand is told."""
    brick = Recovery()
    assert brick.step(CONTROL, Rebound("wdg2rec", True, 1), 0) == []
    brick.step("wdg2rec", alarm("a"), 0)
    effects = brick.step(CONTROL, Situation("b", 1, "", 0, 2, ("a",), False), 0)
    assert ordered(effects) == [renewed("b", "a")]


def test_a_new_backup_that_failed_is_tried_again_a_while_later() -> None:
    brick = Recovery()
    brick.step(CONTROL, ALONE, 0)
    effects = brick.step(CONTROL, failed(ALONE), 1000)
    assert effects == []
    assert brick.deadline_ns() == 1000 + RETRY_NS
    assert ordered(brick.step("wdg2rec", alarm("b", 9), 1001)) == [], "an alarm is no reason to hurry"
    assert ordered(brick.wake(1000 + RETRY_NS)) == [renewed("a", "b")]
    assert brick.deadline_ns() is None


def test_a_failover_does_not_wait_for_the_retry() -> None:
    brick = Recovery()
    brick.step(CONTROL, ALONE, 0)
    brick.step(CONTROL, failed(WHOLE), 1000)
    assert ordered(brick.step("wdg2rec", alarm("a"), 1001)) == [failover("a", "b", 2)]


def test_after_enough_failures_it_gives_up() -> None:
    brick, now_ns = Recovery(), 0
    assert len(ordered(brick.step(CONTROL, ALONE, now_ns))) == 1
    for _ in range(FAILURES_MAX - 1):
        assert ordered(brick.step(CONTROL, failed(ALONE), now_ns)) == []
        due_ns = brick.deadline_ns()
        assert due_ns is not None
        now_ns = due_ns
        assert len(ordered(brick.wake(now_ns))) == 1
    assert ordered(brick.step(CONTROL, failed(ALONE), now_ns)) == []
    assert brick.deadline_ns() is None
    assert ordered(brick.step("wdg2rec", alarm("b"), now_ns + 10 * RETRY_NS)) == []


def test_a_success_lets_it_try_anew() -> None:
    brick, now_ns = Recovery(), 0
    for _ in range(FAILURES_MAX):
        brick.step(CONTROL, failed(ALONE), now_ns)
        now_ns += RETRY_NS
    brick.step(CONTROL, WHOLE, now_ns)
    brick.step("wdg2rec", alarm("b"), now_ns)
    assert (
        len(ordered(brick.step(CONTROL, ALONE, now_ns + RETRY_NS)))
        + len(ordered(brick.wake(now_ns + RETRY_NS)))
        == 1
    )


def test_when_all_is_lost_it_does_nothing() -> None:
    brick = Recovery()
    brick.step(CONTROL, WHOLE, 0)
    brick.step("wdg2rec", alarm("a"), 0)
    assert ordered(brick.step(CONTROL, NOBODY, 0)) == []
    due_ns = brick.deadline_ns()
    assert due_ns is not None and ordered(brick.wake(due_ns)) == []
    assert brick.deadline_ns() is None
