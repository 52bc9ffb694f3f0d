"""The verdict over one run: every promise checked, and honest about what it does not know (G8).

Trouble of the harness, a history that is not whole, a fault that never fired: none of them is a pass.
"""

import itertools
from collections.abc import Callable
from typing import Final, Literal

import msgspec

from aftbed.core.application import Application
from aftbed.core.events import Event
from aftbed.core.fault import FIRED
from aftbed.core.history import History
from aftbed.core.script import ScriptKind
from aftbed.core.valuefault import Flip
from aftbed.ftm.compose import replication_of
from aftbed.judge import checks as judge_checks
from aftbed.judge.checks import Check, Failover, Requests, corruptions, half_a_graph, value
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import bare_server
from aftbed.runtime.hosting import Hosted
from aftbed.runtime.rewiring import replica_of
from aftbed.runtime.sim.world import Run
from aftbed.runtime.unix.closedloop import Proposed, read_proposals
from aftbed.runtime.unix.options import COMMAND_GONE, CarRun, ReplayRun
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations

Word = Literal["pass", "fail", "inconclusive"]
EXIT_CODES: Final[dict[Word, int]] = {"pass": 0, "fail": 1, "inconclusive": 3}
EXIT_INTERRUPTED: Final = 130
STOPPED: Final = ("", "interrupted", "stopped")  # ends that somebody wanted


class Verdict(msgspec.Struct, frozen=True):
    """The one document of `aftbed run --json`."""

    run: str
    seed: int
    ftm: str
    placement: str
    scenario: str
    verdict: Word
    requests: Requests
    vehicle: VehicleResult | None
    failovers: list[Failover]
    checks: dict[str, str]
    reasons: list[str]
    faults: list[dict[str, str]]
    replay: dict[str, object] | None
    seconds: float | None
    launch_ms: float | None
    proposals: list[Proposed] | msgspec.UnsetType = msgspec.UNSET  # where there is a policy


def judge(record: RunRecord) -> Verdict:
    """Check everything that the record allows to check."""
    options, history, bare = record.options, record.history, bare_server(record)
    found = {
        "at_most_once": judge_checks.at_most_once(history),
        "exactly_one_answer": judge_checks.exactly_one_answer(history, cut_off=_cut_off(record)),
        "one_history": judge_checks.one_history(history, bare()),
        "one_master": judge_checks.one_master(history),
        "whole_graph": _whole_graph(record),
        "clean_exit": _clean_exit(record),
        "faults_applied": _faults_applied(record),
        "whole_history": _whole(record),
    }
    values = value(history, bare(), _faults(record))
    if values is not None:
        found["value"] = values
    vehicle = _vehicle(record)
    scenario = "load"
    if isinstance(options.work, CarRun):
        scenario = options.work.scenario
        found["vehicle"] = _vehicle_check(record, vehicle)
    replay = None
    if isinstance(options.work, ReplayRun):
        scenario, replay = f"replay {options.work.log}", _result(record)
    proposals = read_proposals(record.path)
    sent = [e.t_ns for e in history.dialogue]
    return Verdict(
        run=options.run,
        seed=options.seed,
        ftm=options.ftm,
        placement=options.placement,
        scenario=scenario,
        verdict=_word(found),
        requests=judge_checks.requests(history, bare()),
        vehicle=vehicle,
        failovers=judge_checks.failovers(history),
        checks={name: c.finding for name, c in found.items()},
        reasons=[f"{name}: {reason}" for name, c in found.items() for reason in c.reasons],
        faults=_faults(record),
        replay=replay,
        seconds=_number(record, "seconds"),
        launch_ms=round((min(sent) - record.started_ns) / 1e6, 3) if sent else None,
        proposals=msgspec.UNSET if proposals is None else proposals,
    )


def _word(checks: dict[str, Check]) -> Word:
    findings = {c.finding for c in checks.values()}
    if "fail" in findings:
        return "fail"
    return "inconclusive" if "unknown" in findings else "pass"


def _whole(record: RunRecord) -> Check:
    """A journal that was full has not seen everything."""
    lost = record.history.dropped
    return Check("unknown", (f"{lost} records found no room in the journals",)) if lost else Check("pass")


def _cut_off(record: RunRecord) -> bool:
    """Whether it ended with no regard to who waits for an answer."""
    return record.end is None or record.end.get("reason") == COMMAND_GONE


def _clean_exit(record: RunRecord) -> Check:
    """G7, as far as the supervisor saw it; a run without its end is trouble of the harness."""
    if record.end is None:
        return Check("unknown", ("the supervisor did not live to end the run",))
    left, reason = record.end.get("left"), str(record.end.get("reason"))
    if left:
        return Check("fail", (f"left behind: {left}",))
    if reason not in STOPPED:
        return Check("unknown", (reason,))
    return Check("pass")


def _whole_graph(record: RunRecord) -> Check:
    """G5, of a run that ended with somebody who leads and nothing under way."""
    if record.end is None or "hosted" not in record.end:
        return Check("unknown", ("the supervisor did not live to say what lived",))
    living = msgspec.convert(record.end["hosted"], Hosted)
    if not living.leader or record.end.get("lost"):
        return Check("pass")  # there is no service left; what that means, the other checks say
    under_way = record.end.get("unfinished")
    if under_way:
        return Check("unknown", (f"the run ended while this was under way: {under_way}",))
    done = [str(a["ftm"]) for a in record.adaptations if a["outcome"] == "done"]
    reasons = half_a_graph(living, done[-1] if done else record.options.ftm)
    return Check("fail" if reasons else "pass", tuple(reasons[: judge_checks.REASONS_MAX]))


def _faults(record: RunRecord) -> list[dict[str, str]]:
    if record.end is not None:
        return msgspec.convert(record.end.get("faults", []), list[dict[str, str]])
    return [{"fault": str(f), "receipt": "unknown"} for f in record.options.faults]


def _faults_applied(record: RunRecord) -> Check:
    """G8: a fault that did not fire proves nothing."""
    missing = [f for f in _faults(record) if f["receipt"] not in FIRED]
    return Check("unknown" if missing else "pass", tuple(map(_missed, missing)))


def _missed(fault: dict[str, str]) -> str:
    detail = fault.get("detail")
    return f"{fault['receipt']}: {fault['fault']}: {detail}" if detail else f"never fired: {fault['fault']}"


def _result(record: RunRecord) -> dict[str, object] | None:
    found = record.end.get("result") if record.end is not None else None
    return found if isinstance(found, dict) else None


def _vehicle(record: RunRecord) -> VehicleResult | None:
    found = _result(record)
    if found is None or not isinstance(record.options.work, CarRun):
        return None
    return msgspec.convert(found["result"], VehicleResult)


def _vehicle_check(record: RunRecord, vehicle: VehicleResult | None) -> Check:
    """What the scenario expects of the car; a drive that was broken off is judged by what it did."""
    assert isinstance(record.options.work, CarRun)
    found = _result(record)
    if vehicle is None or found is None:
        return Check("unknown", ("the car did not report",))
    if found.get("end") == "stopped" and not vehicle.collision:
        return Check("pass")
    broken = broken_expectations(load_scenario(record.options.work.scenario), vehicle)
    return Check("fail" if broken else "pass", tuple(broken))


def _number(record: RunRecord, key: str) -> float | None:
    found = record.end.get(key) if record.end is not None else None
    return float(found) if isinstance(found, int | float) else None


# -- The judgement over a simulated run: which promise it breaks, if any.
#
# The checkers are those of real runs. Beside them: an assert that failed in a brick is a fault of ours
# whatever came of it; the graph must be whole at the end (G5); and when the faults are over, the run must
# come
# to rest.
# No mechanism outvotes a bit that is flipped in a checkpoint, so nothing is promised of the values then,
# but
# that a switch brings the Servers in line. A service that is gone because a fault struck each replica is no
# breach: nobody promised anything else.


SINGLE: Final = "single"  # the node of that placement: one host, one fate
UNPROMISED: Final = frozenset(  # a bit of a checkpoint, or of a reply that is kept
    event.label
    for event in (Event.STATE_CAPTURED, Event.STATE_RESTORED, Event.CHECKPOINT_SENT)
    + (Event.CHECKPOINT_APPLIED, Event.REPLY_STORED, Event.DEDUPE_HIT)
)
REST: Final = "rest"
ASSERT: Final = "assert"


class Breach(msgspec.Struct, frozen=True):
    """`promise`: G1 to G6 (design 3), `rest` or `assert`."""

    promise: str
    reason: str

    def __str__(self) -> str:
        return f"{self.promise}: {self.reason}"


def breaches(run: Run, function: Callable[[], Application] = default_application) -> tuple[Breach, ...]:
    """All that `run` breaks; `function` makes the bare server."""
    history, down = run.history, struck_down(run)
    flips = [f for f in run.setup.faults if isinstance(f.action, Flip)]
    judged = {
        "G1": judge_checks.at_most_once(history),
        "G2": judge_checks.exactly_one_answer(history, cut_off=down),
        "G6": judge_checks.one_master(history),
    }
    if run.setup.adaptations or not any(f.event in UNPROMISED for f in flips):
        judged["G4" if flips else "G3"] = judge_checks.one_history(history, function())
    found = [Breach(name, c.reasons[0]) for name, c in judged.items() if c.finding == "fail"]
    found += [Breach(ASSERT, failure) for failure in run.failures[:1]]
    if run.rest.lost and not down:
        names = ", ".join(name for _, name in run.struck) or "nobody"
        found.append(Breach("G2", f"the service is lost, though only {names} was struck"))
    if not run.rest.lost and not down:
        found += [Breach("G5", reason) for reason in half_a_graph(run.rest.hosted, expected_of(run))[:1]]
        found += [Breach(REST, "; ".join(run.rest.why_not))] if run.rest.why_not else []
    return tuple(found)


def struck_down(run: Run) -> bool:
    """Whether faults struck each replica, the second before redundancy was back from the first.

    Or any, where for a time there may have been one only.
    """
    replicas = {b.replica for b in run.rest.graph.bricks if b.replica and b.part == "server"}
    renewed = [
        (s.began_ns, s.ended_ns)
        for s in run.scripts
        if s.kind is ScriptKind.NEW_BACKUP and s.ended_ns and not s.failure
    ]
    strikes = sorted((t_ns, replica_of(name)) for t_ns, name in run.struck if replica_of(name))
    if any(name == SINGLE for _, name in run.struck):
        return True
    simplex = any(a.goal.expression and not replication_of(a.goal.expression) for a in run.setup.adaptations)
    if len(replicas) < 2 or simplex:
        return bool(strikes)
    return any(
        other != replica and not any(first_ns < began and done < second_ns for began, done in renewed)
        for (first_ns, replica), (second_ns, other) in itertools.combinations(strikes, 2)
    )


def expected_of(run: Run) -> str:
    """The FTM that the adaptations, as they ended, have come to."""
    done = [a.ftm for a in run.adaptations if a.outcome == "done"]
    return done[-1] if done else run.setup.ftm


def outcome(run: Run, function: Callable[[], Application] = default_application) -> str:
    """The class of what the faults did."""
    return class_of(run.history, function, lost=run.rest.lost)


def class_of(history: History, function: Callable[[], Application], *, lost: bool) -> str:
    """`masked`, `tolerated`, `unavailable` or `sdc` (design 2), by what the client saw; the worst wins."""
    if corruptions(history, function()):
        return "sdc"
    if lost:
        return "unavailable"
    late = judge_checks.requests(history, function()).late
    return "tolerated" if late or judge_checks.failovers(history) else "masked"
