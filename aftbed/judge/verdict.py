"""The verdict over one run, real or simulated: every promise checked, and what is not known (G8).

Trouble of the harness, a history that is not whole, a fault that never fired: none of them is a pass.
"""

from collections.abc import Callable
from typing import Final, Literal

import msgspec

from aftbed.core.application import Application
from aftbed.inject.model import FaultReport
from aftbed.judge import checks
from aftbed.judge.asked import CHECKS as ASKED_CHECKS
from aftbed.judge.asked import AskedAdaptation, adaptations, check_asked
from aftbed.judge.checks import Check, Checker, Evidence, Failover, Requests
from aftbed.judge.intervals import FTTI, HandlingIntervals, check_ftti, intervals
from aftbed.judge.isolated import reference_of
from aftbed.judge.record import RunRecord
from aftbed.judge.sources import function_failures
from aftbed.runtime.unix.closed_loop import PolicyReport, Proposed
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun
from aftbed.runtime.unix.trust import NOBODY, Trust
from aftbed.vehicle.can.bus_load import BusLoad
from aftbed.vehicle.can.hub import Stranger
from aftbed.vehicle.plant import VehicleResult

Word = Literal["pass", "fail", "inconclusive"]
EXIT_CODES: Final[dict[Word, int]] = {"pass": 0, "fail": 1, "inconclusive": 3}


CHECKERS: Final = (  # a new check is one line here; its name is its key in every verdict
    Checker("at_most_once", "G1", lambda e: checks.at_most_once(e.record.history)),
    Checker("exactly_one_answer", "G2", checks.check_exactly_one_answer),
    Checker("one_history", "G3", checks.check_one_history),
    Checker("one_master", "G6", lambda e: checks.one_master(e.record.history)),
    Checker("whole_graph", "G5", checks.check_whole_graph),
    Checker("clean_exit", "G7", checks.check_clean_exit),
    *(Checker(name, "G8", check_asked(name)) for name in ASKED_CHECKS),
    Checker("no_forged_frames", "G8", checks.check_no_forged_frames),
    Checker("sources_agree", "G8", checks.check_sources),
    Checker("whole_history", "G8", checks.check_whole_history),
    Checker("value", "G4", checks.check_value),
    Checker("at_rest", "", checks.check_at_rest),
    Checker("assertions", "", checks.check_assertions),
    Checker(checks.VEHICLE, "", checks.check_vehicle),
    Checker(FTTI, "", check_ftti),
)


def findings(evidence: Evidence) -> dict[Checker, Check]:
    """The answer of every check that has one, in the order of `CHECKERS`."""
    answers = ((checker, checker.check(evidence)) for checker in CHECKERS)
    return {checker: found for checker, found in answers if found is not None}


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
    intervals: list[HandlingIntervals]
    adaptations: list[AskedAdaptation]
    ftm_at_end: str  # "" where the supervisor did not live to report it
    checks: dict[str, str]
    reasons: list[str]
    strangers: list[Stranger]
    bus_load: BusLoad | None  # None without a bus between processes
    app: str  # the function that the run began with, "" for the built-in one
    tolerance: float  # by which its replies may differ from those of the bare server
    function_failures: list[str]  # why nodes stopped whose function ended, or broke its contract
    faults: list[FaultReport]
    replay: dict[str, object] | None
    seconds: float | None
    launch_ms: float | None
    verifies: tuple[str, ...]  # requirements
    ftti_ms: float | None
    command: str  # of the run, "" if another program launched it
    code: str  # the version that ran, "" where it is not known
    policy: PolicyReport | msgspec.UnsetType | None = msgspec.UNSET  # only under a policy, as `proposals`
    proposals: list[Proposed] | msgspec.UnsetType = msgspec.UNSET


class Breach(msgspec.Struct, frozen=True):
    """A check that failed, and why. `promise`: what it is about, "" where it is none of G1 to G8."""

    check: str
    reason: str
    promise: str = ""

    def __str__(self) -> str:
        promise = f" ({self.promise})" if self.promise else ""
        return f"{self.check}{promise}: {self.reason}"


def evidence_of(
    record: RunRecord, function: Callable[[], Application] | None = None, trust: Trust = NOBODY
) -> Evidence:
    """With the bare server's run over the same requests; of `function`, where the record does not name it.

    A function that the record names is executed only if `trust` allows it; else its replies are unknown.
    """
    return Evidence(record, reference_of(record, function, trust))


def judge(record: RunRecord, evidence: Evidence | None = None) -> Verdict:
    """Check everything that the record allows to check."""
    options, history = record.options, record.history
    evidence = evidence or evidence_of(record)
    found = {checker.name: check for checker, check in findings(evidence).items()}
    words = {check.finding for check in found.values()}
    replay = None
    match options.work:
        case CarRun() as car:
            scenario = car.scenario
        case ReplayRun() as log:
            scenario, replay = f"replay {log.log}", record.end.result if record.end is not None else None
        case LoadRun() as load:
            scenario = f"requests {load.requests}" if load.requests else "load"
    followed = options.policy is not None
    began_ns = min((e.t_ns for e in history.dialogue), default=None)
    return Verdict(
        run=options.run,
        seed=options.seed,
        ftm=options.ftm,
        placement=options.placement,
        scenario=scenario,
        verdict="fail" if "fail" in words else "inconclusive" if "unknown" in words else "pass",
        requests=checks.requests(history, evidence.reference, checks.late_after_ns(options.work)),
        vehicle=record.vehicle,
        failovers=checks.failovers(history, record.faults),
        intervals=intervals(evidence),
        adaptations=adaptations(record),
        ftm_at_end=record.end.hosted.ftm if record.end is not None and record.end.hosted is not None else "",
        checks={name: check.finding for name, check in found.items()},
        reasons=[f"{name}: {reason}" for name, check in found.items() for reason in check.reasons],
        strangers=checks.strangers(record),
        bus_load=record.bus_load,
        app=options.application,
        tolerance=evidence.reference.tolerance,
        function_failures=function_failures(record),
        faults=list(record.faults),
        replay=replay,
        seconds=record.end.seconds if record.end is not None else None,
        launch_ms=(
            None if record.simulated or began_ns is None else round((began_ns - record.started_ns) / 1e6, 3)
        ),
        verifies=options.verifies,
        ftti_ms=options.ftti_ms or None,
        command=options.command,
        code=options.code,
        policy=record.policy if followed else msgspec.UNSET,
        proposals=list(record.proposals) if followed else msgspec.UNSET,
    )


def broken(evidence: Evidence) -> tuple[Breach, ...]:
    """The checks that failed, each with its first reason."""
    return tuple(
        Breach(checker.name, check.reasons[0], checker.promise)
        for checker, check in findings(evidence).items()
        if check.finding == "fail"
    )
