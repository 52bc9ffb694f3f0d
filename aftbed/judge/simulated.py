"""The record of a simulated run, and what it breaks. Only this module of the judge imports the simulator."""

import itertools
from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.adapt.engine import DONE
from aftbed.core.application import Application, close
from aftbed.core.errors import FUNCTION_FAILED
from aftbed.core.events import Event
from aftbed.core.graph import STAGED
from aftbed.core.script import ScriptKind
from aftbed.ftm.compose import detects, replication_of
from aftbed.functions.load import NO_CODE, Code
from aftbed.inject.crash import Crash
from aftbed.inject.hang import Hang
from aftbed.inject.slow import Slow
from aftbed.judge.asked import not_happened
from aftbed.judge.checks import Evidence
from aftbed.judge.intervals import FTTI, check_ftti
from aftbed.judge.record import DriveEnd, Excuses, RunEnd, RunRecord
from aftbed.judge.reference import reference_run, succession
from aftbed.judge.verdict import Breach, Verdict, Word, broken, judge
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.world import FUNCTION, Run, StruckNode
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work

# Events of faults that no mechanism outvotes: bits of a checkpoint, or of a reply that is kept.
UNPROMISED_VALUES: Final = frozenset(
    event.label
    for event in (Event.STATE_CAPTURED, Event.STATE_RESTORED, Event.CHECKPOINT_SENT)
    + (Event.CHECKPOINT_APPLIED, Event.REPLY_STORED, Event.DEDUPE_HIT)
)
HARMLESS: Final = (Crash, Hang, Slow)  # kinds of faults that alter no message and no state
SHORT_HANG_MS: Final = 200  # each step of a script waits longer
SINGLE: Final = "single"  # the node of that placement hosts both replicas


def record_of(run: Run) -> RunRecord:
    """The record of a simulated run."""
    setup, rest = run.setup, run.rest
    given = setup.given
    named = (given.source, given.expect) if given is not None else ()
    load = LoadRun(setup.count, setup.rate_hz, *named)
    work: Work = CarRun(setup.scenario, None, "") if setup.scenario else load
    what = (setup.ftm, setup.placement, setup.seed, work, setup.faults, setup.adaptations)
    options = RunOptions("", "", "", *what, application=setup.application, ftti_ms=setup.ftti_ms)
    end = RunEnd(
        unfinished=rest.why_not,
        lost=rest.lost,
        leader=rest.leader,
        hosted=rest.hosted,
        states=rest.states,
        faults=run.faults,
        seconds=round((rest.ended_ns - START_NS) / 1e9, 3),
    )
    flips = [f for f in setup.faults if f.action.alters_value]
    # A switch of the mechanism brings the Servers in line, so with adaptations the values are promised again.
    values = not setup.adaptations and any(f.event in UNPROMISED_VALUES for f in flips)
    return RunRecord(
        options,
        run.history,
        end,
        run.faults,
        run.adaptations,
        DriveEnd(run.drive_end, run.drive_us, run.vehicle) if run.vehicle is not None else None,
        failures=run.failures,
        function_failures=tuple(
            text.replace(f"detected stop: {FUNCTION_FAILED}", "")
            for _, event, text in run.logged
            if event == FUNCTION
        ),
        excuses=Excuses(service_struck_down(run), values, tuple(one.node for one in run.struck)),
        given=given.requests if given is not None else None,
        expected=given.expected if given is not None else None,
    )


def service_struck_down(run: Run) -> bool:
    """Whether faults struck each replica, the second before redundancy was back from the first.

    Of two short hangs both replicas recover.
    """
    renewed = [
        (s.began_ns, s.ended_ns)
        for s in run.scripts
        if s.kind is ScriptKind.NEW_BACKUP and s.ended_ns and not s.failure
    ]
    # What is staged, and what was exchanged and may have to come back, is a part of its replica.
    named = [(replica_of(one.node.removesuffix(STAGED)), one) for one in sorted(run.struck)]
    strikes = [(replica, one) for replica, one in named if replica]
    # Supervision stops what a fault has made late. Where there is another replica, that one has to serve.
    late = supervised(run) and bool(run.setup.faults)
    stopped = run.history.events(Event.DETECTED_STOP) if late else []
    if SINGLE in (*(one.node for one in run.struck if not _is_short(one)), *(one.node for one in stopped)):
        return True
    if any(_alone(run, one.t_ns) for one in stopped):
        return True
    if any(_alone(run, one.t_ns) and not _is_short(one) for _, one in strikes):
        return True
    return any(
        other != replica
        and not (_is_short(first) and _is_short(second))
        and not any(first.t_ns < began and done < second.t_ns for began, done in renewed)
        for (replica, first), (other, second) in itertools.combinations(strikes, 2)
    )


def _alone(run: Run, t_ns: int) -> bool:
    """Whether one replica alone served at `t_ns`, or an adaptation to that was under way."""
    if len(run.adaptations) < len(run.setup.adaptations):
        return True  # when the last one began is not known
    alone = not replication_of(run.setup.ftm)
    for one in run.adaptations:
        asked_ns = START_NS + round(one.asked_ms * 1e6)
        if t_ns < asked_ns:
            break
        ended_ns = asked_ns + round(one.total_ms * 1e6)
        tries_alone = bool(one.tried_ftm) and not replication_of(one.tried_ftm)
        under_way = tries_alone and t_ns <= ended_ns
        serves = t_ns >= (one.opened_ns or ended_ns) and one.outcome == DONE
        alone = under_way or (not replication_of(one.ftm) if serves else alone)
    return alone


def _is_short(one: StruckNode) -> bool:
    return 0 < one.for_ms <= SHORT_HANG_MS


def evidence_of_run(
    run: Run, code: Code = NO_CODE, function: Callable[[], Application] | None = None
) -> Evidence:
    """With the bare server's run, which is executed here: this process has simulated the function, too.

    `function` makes the bare server of a run whose setup does not name it.
    """
    record = record_of(run)
    bare = succession(record, code) if function is None else function()
    try:
        return Evidence(record, reference_run(record.history, bare))
    finally:
        close(bare)


def breaches(
    run: Run, code: Code = NO_CODE, function: Callable[[], Application] | None = None
) -> tuple[Breach, ...]:
    """All that a simulated run breaks."""
    return (*broken(evidence_of_run(run, code, function)), *needless_stops(run))


def supervised(run: Run) -> bool:
    """Whether a mechanism ran, or was tried, that stops a replica for a late step."""
    hosted = (run.setup.ftm, *(one.tried_ftm or one.ftm for one in run.adaptations))
    return any(detects(ftm, "flow") for ftm in hosted)


def needless_stops(run: Run) -> tuple[Breach, ...]:
    """A brick that stopped itself, though nothing that it was given can have been altered, or was late."""
    if not all(isinstance(fault.action, HARMLESS) for fault in run.setup.faults):
        return ()
    stops = run.history.events(Event.DETECTED_STOP)
    if supervised(run):
        # What was struck or suspected makes late what comes behind it; the death of a Doom alone does not.
        late = [one.t_ns for one in run.struck] if not run.setup.dooms else []
        late += [record.t_ns for record in run.history.events(Event.FAULT_APPLIED, Event.WATCHDOG_SUSPECT)]
        first_ns = min(late, default=None)
        stops = [stop for stop in stops if first_ns is None or stop.t_ns < first_ns]
    return tuple(Breach("needless_stop", f"{r.node} stopped at request {r.request_id}") for r in stops)


def verdict_of(run: Run, evidence: Evidence) -> Verdict:
    """What the run breaks, else what did not happen, or is not known (G8)."""
    found = (*broken(evidence), *needless_stops(run))
    missed = not_happened(evidence.record)
    missed += [evidence.reference.unknown] if evidence.reference.unknown else []
    ftti = check_ftti(evidence)
    missed += [f"{FTTI}: {reason}" for reason in ftti.reasons] if ftti and ftti.finding == "unknown" else []
    word: Word = "fail" if found else "inconclusive" if missed else "pass"
    reasons = [*map(str, found), *missed]
    return msgspec.structs.replace(judge(evidence.record, evidence), verdict=word, reasons=reasons)
