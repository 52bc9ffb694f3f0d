"""What options ask for, and whether it happened (G8).

A run in which something that was asked for did not happen proves nothing about it, so its verdict is no pass.
`ASKED_FOR` is the list of all such things: what is asked for, the check that reports it, and what finds in
the record that it did not happen. A new option that asks for something is a row of it.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.engine import DONE
from aftbed.core.journal import Entry, EntryKind
from aftbed.core.messages import Scheduled
from aftbed.judge.checks import REASONS_MAX, Check, Evidence, Finding
from aftbed.judge.record import RunRecord
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix.closed_loop import SETTLED
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun
from aftbed.vehicle.scenarios.library import load_scenario

NOT_BEGUN: Final = "not begun"
NOT_ENDED: Final = "not ended"
WITHOUT_END: Final = (NOT_BEGUN, NOT_ENDED)


class AskedAdaptation(msgspec.Struct, frozen=True):
    """An adaptation that was asked for, and how it ended; times in milliseconds.

    `outcome`: `done`, `rolled back`, `refused`, `not begun`, or `not ended`, with the reason.
    """

    asked: str
    outcome: str
    reason: str = ""
    prepare_ms: float = 0.0
    blackout_ms: float = 0.0
    total_ms: float = 0.0
    may_fail: bool = False

    def __str__(self) -> str:
        why = f": {self.reason}" if self.reason else ""
        return f"{self.asked}: {self.outcome}{why}"


def adaptations(record: RunRecord) -> list[AskedAdaptation]:
    """Those asked for with the run, in their order, then those asked for while it ran."""
    by_place = {one.scheduled: one for one in record.adaptations}
    with_run = [
        _told(by_place[place]) if place in by_place else _without_end(record, one)
        for place, one in enumerate(record.options.adaptations, 1)
    ]
    return with_run + [_told(one) for one in record.adaptations if not one.scheduled]


def _told(one: Outcome) -> AskedAdaptation:
    times_ms = (one.prepare_ms, one.blackout_ms, one.total_ms)
    return AskedAdaptation(one.asked, one.outcome, one.reason, *times_ms, may_fail=one.may_fail)


def _without_end(record: RunRecord, scheduled: Scheduled) -> AskedAdaptation:
    """What is known of one that has left no outcome."""
    seconds = record.end.seconds if record.end is not None else None
    last = max(_sent(record), default=0)
    outcome = NOT_BEGUN
    if last < scheduled.at_request:
        reason = f"request {scheduled.at_request} was never sent, {last} was the last"
    elif seconds is not None and seconds * 1e3 < scheduled.after_ms:
        reason = f"the run ended after {seconds:g} s"
    else:
        outcome, reason = NOT_ENDED, "the run ended before it"
    return AskedAdaptation(str(scheduled), outcome, reason, may_fail=scheduled.goal.may_fail)


def _sent(record: RunRecord) -> set[int]:
    return {entry.request_id for entry in record.history.dialogue if entry.kind is EntryKind.SENT}


# -- what did not happen --------------------------------------------------------------------------


def _faults(record: RunRecord) -> list[str]:
    return [
        f"{f.receipt.value}: {f.fault}: {f.detail}" if f.detail else f"never fired: {f.fault}"
        for f in record.faults
        if not f.fired
    ]


def _adaptations(record: RunRecord) -> list[str] | None:
    asked = adaptations(record)
    return [str(one) for one in asked if one.outcome != DONE and not one.may_fail] if asked else None


def _ended_by_itself(record: RunRecord) -> bool:
    """Whether nothing ended the run before all was done.

    One that its user ended is judged by what it did; of one that was cut off, `clean_exit` tells.
    """
    excused = record.simulated and record.lost  # a fault had struck each replica: see `Excuses`
    return record.end is not None and not record.end.reason and not excused


def _requests(record: RunRecord) -> list[str] | None:
    work = record.options.work
    if not isinstance(work, LoadRun) or not _ended_by_itself(record):
        return None
    sent = len(_sent(record))
    return [f"{sent} requests were sent, {work.count} were asked for"] if sent != work.count else []


def _no_reply(record: RunRecord) -> list[str] | None:
    """The expected replies that never came."""
    work = record.options.work
    if not isinstance(work, LoadRun) or not work.expect:
        return None
    if record.expected is None:
        return ["the expected replies are not in the record"]
    expected = min(len(record.expected.replies), work.count)
    answered = {entry.request_id for entry in _answers(record)}
    left = [number for number in range(1, expected + 1) if number not in answered]
    return [f"no reply to {len(left)} of {expected} requests, the first is request {left[0]}"] if left else []


def _other_reply(record: RunRecord) -> list[str]:
    """The first reply that is not the expected one."""
    expected = record.expected
    if expected is None:
        return []
    replies: dict[int, bytes] = {}
    for entry in _answers(record):
        replies.setdefault(entry.request_id, entry.payload)
    numbers = sorted(number for number in replies if 1 <= number <= len(expected.replies))
    found = (expected.difference(number, replies[number]) for number in numbers)
    return list(itertools.islice(filter(None, found), 1))


def _answers(record: RunRecord) -> Iterator[Entry]:
    return (entry for entry in record.history.dialogue if entry.kind is EntryKind.ANSWERED)


def _replay(record: RunRecord) -> list[str] | None:
    if not isinstance(record.options.work, ReplayRun) or not _ended_by_itself(record):
        return None
    result = record.end.result if record.end is not None else None
    played = (result or {}).get("played")
    whole = isinstance(played, dict) and played.get("complete") is True
    return [] if whole else ["the log was not replayed to its end"]


def _drive(record: RunRecord) -> list[str] | None:
    """A drive ends at a standstill, in a collision, as slow or as late as its scenario says."""
    work, drive = record.options.work, record.drive
    if not isinstance(work, CarRun) or not _ended_by_itself(record) or drive is None:
        return None  # without a drive the car did not report: `vehicle` tells
    lasted_s, scenario = drive.t_us / 1e6, load_scenario(work.scenario)
    match drive.end:
        case "stopped" | None:
            return [f"the drive was stopped after {lasted_s:g} s, which was not asked for"]
        case "slow" if scenario.slow_end is None:
            return [f"the drive ended after {lasted_s:g} s because the car was slow, which was not asked for"]
        case "duration":
            lasts_s = (work.duration_ms or scenario.duration_ms) / 1e3
            return [f"the drive ended after {lasted_s:g} of {lasts_s:g} s"] if lasted_s < lasts_s else []
    return []


def _policy(record: RunRecord) -> list[str] | None:
    """A policy was followed if each of its rules was evaluated, and all that it proposed came about.

    A condition that never held is no failure: the verdict has it. What was rolled back or refused is proposed
    again while the condition holds; if that is done, it has come about.
    """
    asked, found = record.options.policy, record.policy
    if asked is None:
        return None
    if found is None:
        return ["the closed loop did not live to report"]
    missing = [found.trouble] if found.trouble else []
    missing += [f"never evaluated: {rule.when}" for rule in found.rules if not rule.observations]
    if asked.may_fail:
        return missing
    done_last = {one.target: number for number, one in enumerate(record.proposals) if one.outcome == DONE}
    return missing + [
        f"{one.running} to {one.target} ({one.reason}): {one.outcome}{f': {one.why}' if one.why else ''}"
        for number, one in enumerate(record.proposals)
        if one.outcome not in SETTLED and done_last.get(one.target, -1) < number
    ]


# -- the list -------------------------------------------------------------------------------------


class Asked(NamedTuple):
    """Something that options ask for, and the check in whose name it is reported.

    `missing` finds in a record what of it did not happen: nothing if all of it did. None where nothing of the
    kind was asked for, or where the run did not come to its end by itself. `wrong` finds what came about, and
    not as it was asked for.
    """

    what: str
    check: str
    missing: Callable[[RunRecord], list[str] | None]
    wrong: Callable[[RunRecord], list[str]] = lambda record: []


ASKED_FOR: Final = (
    Asked("fault", "faults_applied", _faults),
    Asked("adaptation", "adaptations_done", _adaptations),
    Asked("number of requests", "complete", _requests),
    Asked("drive to its end", "complete", _drive),
    Asked("replay to its end", "complete", _replay),
    Asked("policy", "policy_followed", _policy),
    Asked("expected replies", "expected_replies", _no_reply, _other_reply),
)
CHECKS: Final = tuple(dict.fromkeys(row.check for row in ASKED_FOR))


def not_happened(record: RunRecord) -> list[str]:
    """All that was asked for and did not happen, in the words of a verdict."""
    return [f"{row.check}: {reason}" for row in ASKED_FOR for reason in row.missing(record) or ()]


def check_asked(name: str) -> Callable[[Evidence], Check | None]:
    """The check that is called `name`: unknown, with the reasons, if something asked for did not happen; fail
    if it happened otherwise.
    """
    rows = [row for row in ASKED_FOR if row.check == name]

    def check(evidence: Evidence) -> Check | None:
        found = [missing for row in rows if (missing := row.missing(evidence.record)) is not None]
        if not found:
            return None
        wrong = [reason for row in rows for reason in row.wrong(evidence.record)]
        missing = [reason for missing in found for reason in missing]
        finding: Finding = "fail" if wrong else "unknown" if missing else "pass"
        return Check(finding, (*wrong, *missing)[:REASONS_MAX])

    return check
