"""An experiment of a campaign, and what came of it: two values, and the order of what can come of it.

The classes are those of the design (section 2), the worst one wins. A run that breaks nothing is `masked`
if the fault had no visible effect, `tolerated` if the mechanism had to act in sight: a failover, a third
execution, a refused adaptation. `inconclusive` and `harness_error` are not about the mechanism, and never
a pass (G8).

A worker that carries out experiments on real processes imports no simulator: all nodes are forks of it, and
copy what it has.
"""

import shlex
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
from msgspec import Meta

from aftbed.adapt.commands import read, scheduled
from aftbed.campaign.states import RunState, states_of
from aftbed.core.errors import HarnessError
from aftbed.core.graph import Graph
from aftbed.core.messages import Scheduled
from aftbed.core.script import RECIPES
from aftbed.core.units import duration
from aftbed.ftm.compose import build, detects
from aftbed.functions.load import NO_CODE, OWN_CODE, Code, preload_for
from aftbed.functions.request_file import GivenRequests, names_function, requests_from
from aftbed.inject.model import Fault, FaultReport, parse
from aftbed.judge.asked import WITHOUT_END
from aftbed.judge.checks import Evidence, Requests
from aftbed.judge.handling_bound import STALL_NS
from aftbed.judge.intervals import FTTI, HandlingIntervals, false_alarm, starved, struck_alone
from aftbed.judge.outcome import FAILED, OUTCOMES, UNKNOWN, outcome_of, worst
from aftbed.judge.record import RunEnd, RunRecord, read_record
from aftbed.judge.verdict import Verdict, evidence_of, judge
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import CarRun, LoadRun, Work, with_names_resolved
from aftbed.runtime.unix.seal import copy_sealed
from aftbed.runtime.unix.supervisor_process import warm_up
from aftbed.runtime.unix.trust import OWN_RUN, Trust, remember, vetted
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import Scenario, broken_expectations

if TYPE_CHECKING:
    from aftbed.runtime.sim.world import Setup

REQUESTS_MAX: Final = 1_000_000  # of one experiment
RATE_HZ_MAX: Final = 100_000


class Experiment(msgspec.Struct, frozen=True):
    """One run to be. `id` depends on what is run, by which code; `index` is its place in the plan."""

    id: str
    index: int
    number: int  # within the stratum
    stratum: str
    seed: int
    ftm: str
    placement: str
    runtime: str
    scenario: str
    requests: Annotated[int, Meta(ge=0, le=REQUESTS_MAX)]
    rate_hz: Annotated[float, Meta(ge=0, le=RATE_HZ_MAX)]
    faults: tuple[str, ...] = ()
    adaptations: tuple[str, ...] = ()
    recipe: str = ""
    expected: tuple[str, ...] = ()
    budget_ms: float | None = None  # for a recovery
    app: str = ""  # the protected function, the built-in one if left out
    request_file: str = ""  # where the requests come from: see `spec.System`
    ftti_ms: float = 0.0  # 0: none

    def command(self) -> str:
        """The command that repeats it by hand, and shows it in full."""
        simulated, rate = self.runtime == "sim", f"{self.rate_hz:g}" if self.rate_hz else ""
        words = ["aftbed", "sim" if simulated else "run", "--ftm", self.ftm]
        words += ["--placement", self.placement, "--seed", str(self.seed)]
        words += ["--app", shlex.quote(self.app)] if self.app else []
        if self.scenario:
            words += ["--scenario", self.scenario, *([] if simulated else ["--pace", "max"])]
        elif simulated or self.request_file:
            words += ["--requests", shlex.quote(self.request_file)] if self.request_file else []
            words += ["--count", str(self.requests), *(["--rate", rate] if rate else [])]
        else:
            words += ["--load", f"{self.requests}@{rate}" if rate else str(self.requests)]
        for text in self.faults:
            words += ["--inject", shlex.quote(text)]
        for text in self.adaptations:
            words += ["--adapt", shlex.quote(text)]
        words += ["--recipe", self.recipe] if self.recipe == "paper" else []
        return " ".join([*words, *(["--ftti", duration(self.ftti_ms)] if self.ftti_ms else [])])


class Result(msgspec.Struct, frozen=True, omit_defaults=True):
    """What came of an experiment: one line of the ledger. Times in ms; `gap_m` and `impact_kmh` of a car.

    `broken`: what was promised whatever the faults are, and was not kept: one master (G6), a whole graph
    (G5), a clean exit (G7).
    """

    experiment: Experiment
    outcome: str
    unexpected: bool = False  # its faults happened, and it came to another class than is expected
    activated: bool = True  # every fault of it happened
    broken: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    faults: tuple[FaultReport, ...] = ()
    requests: Requests | None = None
    failovers: int = 0
    detected_ms: float | None = None
    recovery_ms: float | None = None
    blackout_ms: float | None = None
    adapted: tuple[str, ...] = ()  # how each adaptation ended
    adapt_blackout_ms: float | None = None
    collision: bool | None = None
    impact_kmh: float | None = None
    gap_m: float | None = None
    golden_gap_m: float | None = None  # of the same drive without a fault
    intervals: tuple[HandlingIntervals, ...] = ()
    states: tuple[RunState, ...] = ()  # that it was in
    noisy: bool = False  # the machine was too busy for its times to mean anything
    starved_ms: float = 0.0  # how long the node that waited longest was ready to run and had no CPU
    seconds: float = 0.0

    @property
    def fdti_ms(self) -> float | None:
        """The longest one of its faults, as the next two."""
        return _longest(one.fdti_ms for one in self.intervals if one.of_fault)

    @property
    def frti_ms(self) -> float | None:
        return _longest(one.frti_ms for one in self.intervals if one.of_fault)

    @property
    def fhti_ms(self) -> float | None:
        return _longest(one.fhti_ms for one in self.intervals if one.of_fault)

    @property
    def of_bound(self) -> float | None:
        """The greatest FHTI as a share of its bound; None without a bound."""
        return _longest(
            one.fhti_ms / one.bound_ms
            for one in self.intervals
            if one.fhti_ms is not None and one.bound_ms is not None
        )

    @property
    def detected(self) -> bool:
        """Whether one of its faults was."""
        return any(one.fdti_ms is not None for one in self.intervals if one.of_fault)


def failed(result: Result) -> bool:
    """Whether the client got less than it was promised, as far as it is known."""
    return result.outcome in FAILED


# -- whether times mean anything ------------------------------------------------------------------
#
# Experiments side by side, or the neighbours of a virtual machine, can take the CPU away for longer than any
# mechanism needs to recover. So each worker measures, before and after each experiment, how late it wakes
# from sleeps of a millisecond, as a node does that waits for mail, and the supervisor of the run reports how
# long its unluckiest node was ready to run and had no CPU. If either is far off, the experiment is marked as
# noisy: what depends on time in it is inconclusive, what does not (a wrong reply, a lost one) stands.
# The measurement after an experiment, if it finds the machine quiet, is the one before the next.

SLEEP_SECONDS: Final = 0.001
SLEEPS: Final = 5
FACTOR: Final = 10.0
LATE_MS_MIN: Final = 5.0  # a recovery takes about as long on a bad day: less is no excuse
QUIET_SECONDS: Final = 0.02  # from a measurement; no experiment is as short


def lateness_ms() -> float:
    """How much longer than asked for the median sleep took."""
    found = []
    for _ in range(SLEEPS):
        began_s = time.perf_counter()
        time.sleep(SLEEP_SECONDS)
        found.append((time.perf_counter() - began_s - SLEEP_SECONDS) * 1e3)
    return sorted(found)[SLEEPS // 2]


class Probe:
    """Calibrated when it is made."""

    def __init__(self) -> None:
        self.quiet_ms = lateness_ms()
        self._quiet_s = -QUIET_SECONDS  # when the machine was found quiet last

    def noisy(self) -> bool:
        """Whether the machine is too busy now. It is not, for `QUIET_SECONDS` after it was found quiet."""
        if time.monotonic() - self._quiet_s < QUIET_SECONDS:
            return False
        noisy = lateness_ms() > max(LATE_MS_MIN, FACTOR * self.quiet_ms)
        if not noisy:
            self._quiet_s = time.monotonic()
        return noisy


# -- one experiment -------------------------------------------------------------------------------
#
# Trouble of the harness (a run that does not start, a supervisor that dies) is `harness_error`, a history
# that is not whole is `inconclusive`: neither is about the mechanism. The result of a real run is kept
# *before* its record is torn down, so that a death in between costs a directory and no verdict.

REASONS_MAX: Final = 3
REASON_MAX: Final = 300  # characters
TIMED: Final = ("degraded", "hang")  # classes that a slow machine alone can bring about
ALONE: Final = ("omission", "unavailable")  # or with a fault that struck the only replica because of it
ON_ACTIVATION: Final = {"faults_applied", "adaptations_done", FTTI}  # the result says these in other ways
# A service that is gone has not sent all of its load, nor made a backup; and that is one way to be degraded.
SAID_BY_OUTCOME: Final = {
    "unavailable": {"complete", "whole_graph"},
    "hang": {"complete", "whole_graph"},
    "degraded": {"whole_graph"},
}
UNEXCUSED: Final = (
    "one_master",
    "whole_graph",
    "clean_exit",
    FTTI,
)  # checks that hold whatever the faults are
STALL_MS: Final = STALL_NS / 1e6
RUN_SECONDS_MAX: Final = 60.0
RECORDS_MAX: Final = 20  # of runs that went wrong, kept of a campaign
REQUESTS_PER_SECOND_MIN: Final = 100.0  # of a closed loop on a busy machine

Keep = Callable[[Result], None]


def carry_out(
    experiment: Experiment, keep: Keep, code: Code = OWN_CODE, records: Path | None = None
) -> Result:
    """Run it, and `keep` the result before anything of the run is taken down.

    `records`: where the record of a real run is kept, by its id, if it was broken or unexpected.
    `code`: how that of the user is found in a simulated run; for a stranger's, see `refuse_untrusted`.
    Whatever goes wrong in the run is an outcome, `harness_error`. What goes wrong in `keep` is raised.
    """
    began_s = time.monotonic()
    with ExitStack() as standing:
        try:
            if experiment.runtime == "sim":
                result = _simulated(experiment, code)
            else:
                result = _real(experiment, standing, records)
        except Exception as error:  # noqa: BLE001 - one experiment must not end a campaign
            reason = f"{type(error).__name__}: {error}"[:REASON_MAX]
            result = Result(experiment, "harness_error", activated=False, reasons=(reason,))
        result = msgspec.structs.replace(result, seconds=round(time.monotonic() - began_s, 3))
        keep(result)
    return result


def faults_of(experiment: Experiment, graph: Graph) -> tuple[Fault, ...]:
    """As values, checked. Raises ConfigError."""
    work: Work = CarRun(experiment.scenario, None, "") if experiment.scenario else LoadRun(1, 0.0)
    found = tuple(parse(text) for text in experiment.faults)
    for fault in found:
        fault.check(graph)
        with_names_resolved(fault, work)
    return found


def refuse_untrusted(experiment: Experiment, trust: Trust) -> None:
    """Raise ConfigError if the experiment, of a ledger, would execute code that is not trusted."""
    wishes = (read(text).wish for text in experiment.adaptations)
    function = experiment.request_file if names_function(experiment.request_file) else ""
    for source in filter(None, (experiment.app, function, *(wish.source for wish in wishes))):
        vetted(source, trust)


def setup_of(experiment: Experiment, code: Code = NO_CODE) -> "Setup":
    """The experiment for the simulator. `code`: of a function that makes its requests. Raises ConfigError."""
    from aftbed.runtime.sim.world import Setup  # noqa: PLC0415 - the simulator, see above

    faults, changes = _asked(experiment)
    return Setup(
        experiment.ftm,
        experiment.placement,
        experiment.seed,
        experiment.requests,
        experiment.rate_hz,
        faults,
        changes,
        scenario=experiment.scenario,
        application=experiment.app,
        given=_given(experiment, code),
        ftti_ms=experiment.ftti_ms,
    )


def _given(experiment: Experiment, code: Code) -> GivenRequests | None:
    """None where the requests are drawn, or a car's. Raises ConfigError."""
    if not experiment.request_file:
        return None
    return requests_from(experiment.request_file, experiment.requests, experiment.seed, code)


def _asked(experiment: Experiment) -> tuple[tuple[Fault, ...], tuple[Scheduled, ...]]:
    graph = build(experiment.ftm, experiment.placement, application=experiment.app)
    recipe = experiment.recipe or RECIPES[0]
    return faults_of(experiment, graph), scheduled(experiment.adaptations, graph, recipe)


def _simulated(experiment: Experiment, code: Code) -> Result:
    from aftbed.judge.simulated import evidence_of_run  # noqa: PLC0415 - the simulator, see above
    from aftbed.runtime.sim.world import simulate  # noqa: PLC0415

    evidence = evidence_of_run(simulate(setup_of(experiment, code), code), code)
    outcome, reasons = outcome_of(evidence)
    reasons += tuple(f"an assertion failed: {failure}" for failure in evidence.record.failures)
    return _result(experiment, evidence, judge(evidence.record, evidence), outcome, reasons)


def _real(experiment: Experiment, standing: ExitStack, records: Path | None) -> Result:
    """On real processes, whose record is there until `standing` ends."""
    noisy = _probe().noisy()
    evidence = evidence_of(_recorded(experiment, standing), trust=OWN_RUN)
    verdict, (outcome, reasons) = judge(evidence.record, evidence), outcome_of(evidence)
    outcome, reasons = known_outcome(outcome, reasons, verdict)
    result = _result(experiment, evidence, verdict, outcome, reasons)
    end = evidence.record.end or RunEnd()
    result = msgspec.structs.replace(result, starved_ms=end.starved_ms)
    noisy = noisy or starved(end.starved_ms, end.seconds or 0.0) or _excused(result)
    alone = by_waits(result, evidence)
    noisy = noisy or alone or _probe().noisy()
    result = without_times(result, alone=alone) if noisy else result
    if records is not None and (result.broken or result.unexpected):
        with suppress(OSError):  # of a full disk: the result stands without it
            if not records.is_dir() or sum(1 for _ in records.iterdir()) < RECORDS_MAX:
                copy_sealed(evidence.record.path, records / experiment.id)
    return result


def known_outcome(outcome: str, reasons: tuple[str, ...], verdict: Verdict) -> tuple[str, tuple[str, ...]]:
    """G8: what the harness does not know is worse than any outcome that it believes to have seen."""
    unknown = {name for name, word in verdict.checks.items() if word == "unknown"}
    unknown -= ON_ACTIVATION | SAID_BY_OUTCOME.get(outcome, set())
    if "clean_exit" in unknown:
        return "harness_error", tuple(verdict.reasons)
    if unknown and outcome != "sdc":
        return "inconclusive", tuple(verdict.reasons)
    return outcome, reasons


def _excused(result: Result) -> bool:
    """Whether a fault was handled later than its bound, which is that of a machine with shorter waits."""
    return result.of_bound is not None and result.of_bound > 1 and result.starved_ms > STALL_MS


def by_waits(result: Result, evidence: Evidence) -> bool:
    """Whether a fault struck the only replica, perhaps, because a node had waited for a CPU: a good replica
    had been taken for hung, or a new backup was not there yet and the outcome is none that was expected.
    """
    alone = false_alarm(evidence) or (result.unexpected and struck_alone(evidence))
    return alone and result.starved_ms > STALL_MS


def _recorded(experiment: Experiment, standing: ExitStack) -> RunRecord:
    faults, changes = _asked(experiment)
    given = _given(experiment, OWN_CODE)
    work: Work = LoadRun(experiment.requests, experiment.rate_hz, experiment.request_file)
    if experiment.scenario:
        work = CarRun(experiment.scenario, None, "latch")
    options, listener = options_for(
        ftm=experiment.ftm,
        placement=experiment.placement,
        work=work,
        seed=experiment.seed,
        faults=faults,
        adaptations=changes,
        application=experiment.app,
        ftti_ms=experiment.ftti_ms,
    )
    preload_for(experiment.app)
    warm_up(BUS if experiment.scenario else LIGHT)
    launched = launch(options, listener, given)
    standing.callback(launched.remove)
    silence_s = RUN_SECONDS_MAX + experiment.requests * (1 / (experiment.rate_hz or REQUESTS_PER_SECOND_MIN))
    linux.set_timeouts(launched.line.sock, silence_s, silence_s)  # a load reports nothing before its end
    for _ in launched.reports():
        pass
    launched.wait()
    if launched.trouble:
        raise HarnessError(launched.trouble)
    remember(launched.record)
    return read_record(launched.record)


@lru_cache(maxsize=1)
def _probe() -> Probe:
    """Of this process."""
    return Probe()


def without_times(result: Result, *, alone: bool = False) -> Result:
    """What is known of a run on a busy machine. `alone`: a fault may have struck the only replica because of
    it, as a good one had been taken for hung, or a new backup was not there yet.
    """
    reasons = ("the machine was too busy for times to mean anything", *result.reasons)
    timed_stop = result.outcome == "detected_stop" and detects(result.experiment.ftm, "flow")
    by_machine = result.unexpected and (result.outcome == "tolerated" or timed_stop)
    by_machine = by_machine or (alone and result.outcome in ALONE)
    outcome = "inconclusive" if result.outcome in TIMED or by_machine else result.outcome
    untimed = {"fdti_ms": None, "frti_ms": None, "fhti_ms": None}
    return msgspec.structs.replace(
        result,
        noisy=True,
        broken=tuple(reason for reason in result.broken if reason.partition(":")[0] != FTTI),
        intervals=tuple(msgspec.structs.replace(one, **untimed) for one in result.intervals),
        outcome=outcome,
        unexpected=result.unexpected and outcome == result.outcome,
        reasons=reasons if outcome != result.outcome else result.reasons,
        detected_ms=None,
        recovery_ms=None,
        blackout_ms=None,
        adapt_blackout_ms=None,
    )


def _result(
    experiment: Experiment, evidence: Evidence, verdict: Verdict, outcome: str, reasons: tuple[str, ...]
) -> Result:
    record = evidence.record
    faults, vehicle, failovers = record.faults, record.vehicle, verdict.failovers
    adapted = tuple(one.outcome for one in record.adaptations)
    recovery_ms = _longest(f.recovered_ms for f in failovers)
    if recovery_ms is not None and recovery_ms > (experiment.budget_ms or recovery_ms):
        outcome = worst([outcome, "degraded"])
        reasons = (f"recovery took {recovery_ms:g} ms, {experiment.budget_ms:g} are allowed", *reasons)
    golden = golden_drive(experiment.scenario, experiment.seed) if vehicle is not None else None
    if vehicle is not None and golden is not None:
        forbidden = forbidden_by(load_scenario(experiment.scenario), vehicle, golden)
        outcome = worst([outcome, "unavailable"]) if forbidden else outcome
        reasons = (*forbidden, *reasons)
    ended = all(one.outcome not in WITHOUT_END for one in verdict.adaptations)
    activated = all(f.fired for f in faults) and ended
    failed = {name for name, word in verdict.checks.items() if word == "fail" and name in UNEXCUSED}
    broken = [reason for reason in verdict.reasons if reason.partition(":")[0] in failed]
    return Result(
        experiment,
        outcome,
        unexpected=activated and outcome not in (*(experiment.expected or OUTCOMES), *UNKNOWN),
        activated=activated,
        broken=tuple(reason[:REASON_MAX] for reason in broken[:REASONS_MAX]),
        reasons=tuple(reason[:REASON_MAX] for reason in reasons[:REASONS_MAX]),
        faults=faults,
        requests=verdict.requests,
        failovers=len(failovers),
        detected_ms=_longest(f.detected_ms for f in failovers),
        recovery_ms=recovery_ms,
        blackout_ms=_longest(f.blackout_ms for f in failovers),
        adapted=adapted,
        adapt_blackout_ms=_longest(one.blackout_ms for one in record.adaptations),
        collision=vehicle.collision if vehicle is not None else None,
        impact_kmh=vehicle.impact_speed_kmh if vehicle is not None else None,
        gap_m=vehicle.stop_gap_m if vehicle is not None else None,
        golden_gap_m=golden.stop_gap_m if golden is not None else None,
        intervals=tuple(verdict.intervals),
        states=states_of(record),
    )


def forbidden_by(scenario: Scenario, found: VehicleResult, golden: VehicleResult) -> list[str]:
    """What the car did that its scenario forbids, and that the golden drive did not."""
    newly_hit = found.collision and not golden.collision
    return (
        broken_expectations(scenario, found) if newly_hit or not broken_expectations(scenario, golden) else []
    )


@lru_cache(maxsize=256)
def golden_drive(scenario: str, seed: int) -> VehicleResult | None:
    """The drive of the car with the bare server, and no fault."""
    from aftbed.runtime.sim.world import Setup, simulate  # noqa: PLC0415 - the simulator, see above

    return simulate(Setup("none", seed=seed, scenario=scenario)).vehicle


def _longest(times: Iterable[float | None]) -> float | None:
    return max((t for t in times if t is not None), default=None)
