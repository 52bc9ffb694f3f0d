"""The intervals of ISO 26262-1:2018 for each fault of a run: FDTI (3.55), FRTI (3.59), FHTI (3.56).

    fault applied ---- FDTI ----> detected ---- FRTI ----> next good reply, or the detected stop
         +------------------------- FHTI --------------------------+

| interval | begins | ends |
|---|---|---|
| FDTI | `fault.applied` | a Watchdog suspects, the supervisor sees a death, a vote differs, a brick refuses |
| FRTI | there | the next good reply, of the next master where there is one; else the detected stop |
| FHTI | `fault.applied` | the end of the FRTI |

A fault that nothing has detected has no FDTI and no FRTI; its FHTI ends with the first good reply to a
request that was sent after it, or that came when it was over. A vote differs when a third execution begins.

The *reaction* is `operational` if the service went on, `safe` if it ended in a detected stop, and `none` if
neither is known: replies are wrong or missing, or a state is wrong behind right replies (`latent`).

An adaptation is no fault, but the car cannot tell: for the length of its blackout the function does not
answer. So it is listed too, as a reaction that needs no detection, and the FTTI holds for it as well.

Times are by the clock. In lockstep the bus waits for the function meanwhile. In a run of many faults a
detection is the first behind the fault.

Those of a fault of the bus are in bus time. It is detected when a receiver refuses a frame, or misses one;
handled when all that objected use these frames again. If they never do, the fallback of the brakes is safe.
A frame that is late, and right, is handled when it is taken in; a wrong one that is believed never is.

A fault of the radar has none: its frames are well-formed, and nothing refuses them.
"""

import itertools
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from enum import Enum
from functools import cached_property
from typing import Final, NamedTuple

import msgspec

from aftbed.core.events import LATE, RERUN, Event
from aftbed.core.journal import EntryKind, Record
from aftbed.ftm.compose import REPLICAS, build
from aftbed.inject.bus import BusFault
from aftbed.inject.crash import Crash
from aftbed.inject.model import Fault, FaultReport, parse
from aftbed.inject.receipts import BusTimes
from aftbed.inject.targets import BACKUP, PRIMARY, SUPERVISOR
from aftbed.judge.checks import (
    HANG_NOTICED_NS,
    REASONS_MAX,
    Check,
    Evidence,
    master_changes,
    number_of,
    served_by,
    wrong_replies,
)
from aftbed.judge.handling_bound import bound_ms
from aftbed.judge.outcome import LATENT, outcome_of
from aftbed.judge.record import RunRecord
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, cycle_ms_of

FTTI: Final = "ftti"  # the name of its check
AGREED: Final = 2  # detail of `vote.compared`: two trials, and they were equal
STARVED_MS_MIN: Final = 20.0  # of a node without a CPU, in a run,
STARVED_PART: Final = 0.05  # and more than so much of it
BY_MECHANISM: Final = (  # events by which a mechanism shows that it has noticed something
    Event.WATCHDOG_SUSPECT,
    Event.FOLLOWER_DIVERGED,
    Event.DETECTED_STOP,
    Event.PEER_REFUSED,
    Event.REPLY_REFUSED,
)


class Reaction(Enum):
    """What the system did about a fault."""

    OPERATIONAL = "operational"  # the service goes on
    SAFE = "safe"  # it has ended in a detected stop
    NONE = "none"


class Occasion(Enum):
    """What an interval is about."""

    FAULT = "fault"
    ADAPTATION = "adaptation"


class HandlingIntervals(msgspec.Struct, frozen=True):
    """Of one fault, in ms by the clock, or `in_bus_time`; None where it is not known, or did not happen.

    `bound_ms`: what the FHTI may be at most (`handling_bound`). `latent`: undetected, and a state is wrong.
    `asked`: a request waited for it, or came behind the detection; without one no reply can end it. Of a
    fault of the bus: a receiver has noticed it, or believed it.
    """

    fault: str
    fdti_ms: float | None
    frti_ms: float | None
    fhti_ms: float | None
    reaction: Reaction
    bound_ms: float | None = None
    latent: bool = False
    asked: bool = True
    occasion: Occasion = Occasion.FAULT
    in_bus_time: bool = False

    @property
    def of_fault(self) -> bool:
        return self.occasion is Occasion.FAULT

    @property
    def why_unknown(self) -> str:
        """Why nothing can end it, where it is not `asked`."""
        return "no receiver noticed it" if self.in_bus_time else "no request came after it"

    @property
    def done(self) -> str:
        """The words before its time."""
        return "handled after" if self.of_fault else "without service for"

    def __str__(self) -> str:
        """For people."""
        if self.latent:
            return f"{self.fault}: latent: not detected, and a state is wrong"
        if self.fhti_ms is None:
            why = "not handled" if self.asked else self.why_unknown
            return f"{self.fault}: {self.reaction.value}: {why}"
        known = "not detected" if self.frti_ms is None else f"FDTI {self.fdti_ms:g}, FRTI {self.frti_ms:g}"
        bound = "" if self.bound_ms is None else f", at most {self.bound_ms:g}"
        unit = "ms of bus time" if self.in_bus_time else "ms"
        return f"{self.fault}: {self.reaction.value}, FHTI {self.fhti_ms:g} {unit}{bound} ({known})"


def starved(starved_ms: float, seconds: float) -> bool:
    """Whether a node had to wait for a CPU for so long that the times of a run of `seconds` mean nothing."""
    return starved_ms > max(STARVED_MS_MIN, STARVED_PART * seconds * 1e3)


def false_alarm(evidence: Evidence) -> bool:
    """Whether a replica was given up as too slow before a fault had struck: by a Watchdog, which may be
    right where the run was adapted, or by the deadline of Supervision.
    """
    history = evidence.record.history
    suspicions = [] if evidence.record.adaptations else history.events(Event.WATCHDOG_SUSPECT)
    stops = [one for one in history.events(Event.DETECTED_STOP) if one.detail == LATE]
    first_ns = min((record.t_ns for record in (*suspicions, *stops)), default=None)
    strikes = (record.t_ns for record in history.events(Event.FAULT_APPLIED))
    return first_ns is not None and first_ns < min(strikes, default=first_ns + 1)


def struck_alone(evidence: Evidence) -> bool:
    """Whether a fault struck while a new backup was awaited, behind the loss of a replica."""
    history = evidence.record.history
    turns = history.events(Event.RECOVERY_ENTER, Event.BACKUP_READY)
    for strike in history.events(Event.FAULT_APPLIED):
        before = [turn for turn in turns if turn.t_ns < strike.t_ns]
        if before and max(before, key=lambda turn: turn.t_ns).event is Event.RECOVERY_ENTER:
            return True
    return False


def intervals(evidence: Evidence) -> list[HandlingIntervals]:
    """Of each fault that struck, in the order of their numbers, then of each adaptation."""
    record = evidence.record
    adapted = [
        HandlingIntervals(
            f"adapt {one.asked}",
            0.0,
            one.blackout_ms,
            one.blackout_ms,
            Reaction.OPERATIONAL,
            occasion=Occasion.ADAPTATION,
        )
        for one in record.adaptations
        if one.blackout_ms
    ]
    if not any(report.fired for report in record.faults):
        return adapted
    return [*_Faults(evidence).intervals(), *adapted]


class _Found(NamedTuple):
    """A fault that struck: first at `began_ns`, about `request_id` (0: about none)."""

    number: int
    words: str
    fault: Fault
    began_ns: int
    request_id: int

    @property
    def over_ns(self) -> int:
        """When it ended by itself; of a fault that does not, when it began."""
        return self.began_ns + self.fault.action.lasts_ms * 1_000_000


class _Reply(NamedTuple):
    t_ns: int
    request_id: int


class _Replies:
    """The right replies of a dialogue and the times of all requests, in arrays: there may be millions."""

    def __init__(self, evidence: Evidence) -> None:
        wrong = wrong_replies(evidence.record.history, evidence.reference)
        self._times, self._ids, self._epochs = array("q"), array("Q"), array("q")
        self._sent_ids, self._sent_times = array("Q"), array("q")
        self.wrong_ns: list[int] = []
        for entry in evidence.record.history.dialogue:
            if entry.kind is EntryKind.SENT:
                self._sent_ids.append(entry.request_id)
                self._sent_times.append(entry.t_ns)
            elif wrong.get(entry.request_id) == entry.payload:
                self.wrong_ns.append(entry.t_ns)
            else:
                self._times.append(entry.t_ns)
                self._ids.append(entry.request_id)
                self._epochs.append(entry.epoch)

    def good_from(self, t_ns: int, epoch: int = 0) -> Iterator[_Reply]:
        """Each right reply from `t_ns` and `epoch` on."""
        for at in range(bisect_left(self._times, t_ns), len(self._times)):
            if self._epochs[at] >= epoch:
                yield _Reply(self._times[at], self._ids[at])

    def sent_ns(self, request_id: int) -> int:
        """0: it was never sent."""
        at = bisect_left(self._sent_ids, request_id)
        there = at < len(self._sent_ids) and self._sent_ids[at] == request_id
        return self._sent_times[at] if there else 0

    def asked_since(self, t_ns: int) -> bool:
        """Whether a request came then or later."""
        return bool(self._sent_times) and self._sent_times[-1] >= t_ns


class _Faults:
    """All faults of one run."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence, self._record = evidence, evidence.record
        self._history = evidence.record.history
        self._replies = _Replies(evidence)
        self._changes = master_changes(self._history, self._record.faults)
        self._epochs = {c.fault_number: c.epoch for c in reversed(self._changes)}
        self._served = served_by(self._history)
        self._deaths = self._times(Event.NODE_DIED)
        self._stops = self._times(Event.DETECTED_STOP)

    def intervals(self) -> Iterator[HandlingIntervals]:
        found = sorted(self._found(), key=lambda one: one.began_ns)
        alone = self._alone
        by_number = {
            report.number: _of_bus(
                report, report.bus, self._bus_bound_ms(report, report.bus) if alone else None
            )
            for report in self._record.faults
            if report.fired and report.bus is not None
        }
        for one, following in itertools.zip_longest(found, found[1:]):
            next_ns = following.began_ns if following is not None else 0
            by_number[one.number] = self._of(one, next_ns, alone=alone)
        yield from (by_number[number] for number in sorted(by_number))

    @property
    def _alone(self) -> bool:
        """Whether one fault, of whatever kind, was all: only then there is a bound."""
        fired = sum(report.fired for report in self._record.faults)
        return fired == 1 and not self._record.adaptations and self._record.options.policy is None

    def _found(self) -> Iterator[_Found]:
        strikes: dict[int, Record] = {}
        for record in self._history.events(Event.FAULT_APPLIED):
            first = strikes.setdefault(number_of(record), record)
            if record.node == SUPERVISOR != first.node:  # before it, a node came to the point, and waited
                strikes[number_of(record)] = record
        for report in self._record.faults:
            if report.fired and report.number in strikes:
                strike = strikes[report.number]
                words = report.fault
                yield _Found(report.number, words, parse(words), strike.t_ns, strike.request_id)

    def _of(self, one: _Found, next_ns: int, *, alone: bool) -> HandlingIntervals:
        """`next_ns`: when the next fault struck, 0 for never."""
        stops = one.fault.action.stops_process
        detected_ns = self._stop_seen_ns(one) if stops else self._noticed_ns(one, next_ns)
        good = self._next_good(one, detected_ns)
        until_ns = good.t_ns if good is not None and stops else next_ns
        wrong_ns = (t_ns for t_ns in self._replies.wrong_ns if t_ns >= one.began_ns)
        wrong = any(not until_ns or t_ns < until_ns for t_ns in wrong_ns)
        latent = not (stops or wrong or detected_ns is not None) and self._ends_latent
        stopped_ns = _first_from(self._stops, one.began_ns if detected_ns is None else detected_ns)
        reaction, ended_ns = Reaction.NONE, None
        if not wrong and not latent:
            if good is not None:
                reaction, ended_ns = Reaction.OPERATIONAL, good.t_ns
            elif stopped_ns is not None:
                reaction, ended_ns = Reaction.SAFE, stopped_ns
        return HandlingIntervals(
            one.words,
            _ms(one.began_ns, detected_ns),
            _ms(detected_ns, ended_ns),
            _ms(one.began_ns, ended_ns),
            reaction,
            self._bound_ms(one) if alone else None,
            latent,
            asked=wrong
            or ended_ns is not None
            or self._waits(one.began_ns if detected_ns is None else detected_ns),
        )

    @cached_property
    def _ends_latent(self) -> bool:
        return outcome_of(self._evidence)[0] == LATENT

    def _waits(self, from_ns: int) -> bool:
        """Whether a request came from then on, or one from before was never answered."""
        return self._replies.asked_since(from_ns) or bool(self._unanswered)

    @cached_property
    def _unanswered(self) -> set[int]:
        sent, answered = set[int](), set[int]()
        for entry in self._history.dialogue:
            (sent if entry.kind is EntryKind.SENT else answered).add(entry.request_id)
        return sent - answered

    # -- detection ----------------------------------------------------------------------------

    def _times(self, *events: Event) -> list[int]:
        return [record.t_ns for record in self._history.events(*events)]

    @cached_property
    def _suspicions(self) -> dict[str, list[int]]:
        """By the replica that is suspected."""
        found: dict[str, list[int]] = {replica: [] for replica in REPLICAS}
        for record in self._history.events(Event.WATCHDOG_SUSPECT):
            found.setdefault(record.node.partition("/")[0], []).append(record.t_ns)
        return found

    def _stop_seen_ns(self, one: _Found) -> int | None:
        """By the Watchdog of its replica, or by the supervisor. A hang that is long over is not seen."""
        replica = self._struck(one)
        crash = isinstance(one.fault.action, Crash)
        seen = [_first_from(self._suspicions[replica], one.began_ns)] if replica else []
        seen += [_first_from(self._deaths, one.began_ns)] if crash or not replica else []
        times_ns = [t_ns for t_ns in seen if t_ns is not None]
        if one.fault.action.lasts_ms:
            times_ns = [t_ns for t_ns in times_ns if t_ns <= one.over_ns + HANG_NOTICED_NS]
        return min(times_ns, default=None)

    def _struck(self, one: _Found) -> str:
        """The replica that was stopped; "" for a node of none."""
        before = [replica for t_ns, replica in self._served if replica and t_ns <= one.began_ns]
        leader = before[-1] if before else REPLICAS[0]
        other = next(r for r in REPLICAS if r != leader)
        return {PRIMARY: leader, BACKUP: other}.get(one.fault.target, replica_of(one.fault.target))

    @cached_property
    def _notices(self) -> list[int]:
        """When a mechanism showed that it had noticed something."""
        votes = [v for v in self._history.events(Event.VOTE_COMPARED) if v.detail != AGREED]
        reruns = self._history.events(Event.SERVER_ENTER) if votes else []
        thirds: dict[int, int] = {}
        for record in reruns:
            if record.detail == RERUN:
                thirds[record.request_id] = record.t_ns  # the last one
        votes_ns = [min(v.t_ns, thirds.get(v.request_id, v.t_ns)) for v in votes]
        return sorted([*self._times(*BY_MECHANISM), *votes_ns])

    def _noticed_ns(self, one: _Found, next_ns: int) -> int | None:
        """What comes behind the next fault may be about that one."""
        found = _first_from(self._notices, one.began_ns)
        return None if found is None or 0 < next_ns < found else found

    # -- reaction -----------------------------------------------------------------------------

    def _next_good(self, one: _Found, detected_ns: int | None) -> _Reply | None:
        """The reply that ends the handling."""
        undetected_stop = detected_ns is None and one.fault.action.stops_process
        from_ns = one.began_ns if detected_ns is None else detected_ns
        for reply in self._replies.good_from(from_ns, self._epochs.get(one.number, 0)):
            on_its_way = self._replies.sent_ns(reply.request_id) < one.began_ns and reply.t_ns < one.over_ns
            if reply.request_id >= one.request_id and not (undetected_stop and on_its_way):
                return reply
        return None

    def _bound_ms(self, one: _Found) -> float | None:
        options, simulated = self._record.options, self._record.simulated
        period_ms = period_ms_of(self._record)
        if options.application or period_ms is None:
            return None
        found = bound_ms(options.ftm, options.placement, one.fault, period_ms=period_ms, simulated=simulated)
        return None if found is None else round(found, 3)

    def _bus_bound_ms(self, report: FaultReport, times: BusTimes) -> float | None:
        options = self._record.options
        action = parse(report.fault).action
        in_lockstep = isinstance(options.work, CarRun) and options.work.pace is None
        if options.application or not in_lockstep or not isinstance(action, BusFault):
            return None
        from aftbed.judge.bus_bound import bus_bound_ms  # noqa: PLC0415 - cantools

        graph = build(options.ftm, options.placement)
        return bus_bound_ms(action, times.struck_us, graph, simulated=self._record.simulated)


def _of_bus(report: FaultReport, times: BusTimes, bound_ms: float | None) -> HandlingIntervals:
    ended_us, reaction = times.good_us, Reaction.OPERATIONAL
    if ended_us is None:
        ended_us = times.fallback_us
        reaction = Reaction.NONE if ended_us is None else Reaction.SAFE
    return HandlingIntervals(
        report.fault,
        _ms(times.struck_us, times.noticed_us, 1e3),
        _ms(times.noticed_us, ended_us, 1e3),
        _ms(times.struck_us, ended_us, 1e3),
        reaction,
        bound_ms,
        asked=times.believed or times.noticed_us is not None,
        in_bus_time=True,
    )


def period_ms_of(record: RunRecord) -> float | None:
    """Between two requests, by the clock; 0: each follows the reply before. None: it is not known."""
    work = record.options.work
    if isinstance(work, LoadRun) or record.simulated:
        return cycle_ms_of(work)
    if isinstance(work, CarRun) and work.pace is not None:
        return cycle_ms_of(work) / work.pace
    return None  # in lockstep, and of a log, the next request comes when it comes


def _first_from(times_ns: list[int], t_ns: int) -> int | None:
    at = bisect_left(times_ns, t_ns)
    return times_ns[at] if at < len(times_ns) else None


def _ms(begin: int | None, end: int | None, units: float = 1e6) -> float | None:
    """Between two times, of which a millisecond has so many `units`."""
    return None if begin is None or end is None else round((end - begin) / units, 3)


# -- the promise ----------------------------------------------------------------------------------


def check_ftti(evidence: Evidence) -> Check | None:
    """Whether each fault was handled within the FTTI of the run, and no adaptation took longer.

    A latent fault is no hazard by itself: what limits it is another interval. Where the machine was too busy,
    a time that is too long proves nothing.
    """
    record = evidence.record
    if not record.options.ftti_ms:
        return None
    work = record.options.work
    pace = work.pace if isinstance(work, CarRun | ReplayRun) else None
    found = intervals(evidence)
    late = []
    for one in found:
        limit_ms = record.options.ftti_ms / (1.0 if one.in_bus_time else pace or 1.0)
        if one.fhti_ms is not None and one.fhti_ms > limit_ms:
            late.append(f"{one.fault}: {one.done} {one.fhti_ms:g} ms, the FTTI is {limit_ms:g}")
    never = [
        f"{one.fault}: never handled" for one in found if one.fhti_ms is None and one.asked and not one.latent
    ]
    end = record.end
    if late and end is not None and starved(end.starved_ms, end.seconds or 0.0):
        return Check("unknown", (f"a node waited {end.starved_ms:g} ms for a CPU, and {late[0]}",))
    if late or never:
        return Check("fail", (*never, *late)[:REASONS_MAX])
    measured = Counter(one.fault for one in found)
    unknown = [f"{one.fault}: {one.why_unknown}" for one in found if not one.asked]
    unknown += [
        f"{report.fault}: no journal has the time at which it struck"
        for report in record.faults
        if report.fired and not measured[report.fault]
    ]
    return Check("unknown", tuple(unknown[:REASONS_MAX])) if unknown else Check("pass")
