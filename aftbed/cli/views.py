"""What several commands print: a run while it lives, a verdict, adaptations that ended.

rich is imported only where the output is a terminal. `aftbed run` imports this module before it forks the
supervisor, so nothing else that is large is imported here.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.cli.colour import Style, painted
from aftbed.cli.options import print_json
from aftbed.core.errors import shown
from aftbed.runtime import control
from aftbed.runtime.control import Report, ServiceState
from aftbed.runtime.unix.options import RunOptions
from aftbed.vehicle.can.bus_model import CHANNEL, HOST
from aftbed.vehicle.plant import Telemetry

if TYPE_CHECKING:
    from aftbed.judge.verdict import Verdict
    from aftbed.vehicle.aeb.messages import Sight

STAGES: Final = ("-", "WARN", "PARTIAL", "FULL")
PLAIN_PERIOD_MS: Final = 500
KMH_PER_MS: Final = 3.6
STYLES_OF_VERDICTS: Final = {"pass": Style.GOOD, "fail": Style.SERIOUS, "inconclusive": Style.WARN}
STYLES_OF_CHECKS: Final = {"pass": Style.PLAIN, "fail": Style.SERIOUS, "unknown": Style.WARN}


# -- a run while it lives -------------------------------------------------------------------------


class RunView:
    """Shows a live run. This one shows nothing.

    `descriptors`: when one is readable, or `wait_s` seconds have passed, `attend` is worth calling.
    `decide` is called with the answer to a question, if the view `takes_keys`.
    """

    def __init__(self) -> None:
        self.decide: Callable[[str], None] = lambda answer: None

    @property
    def descriptors(self) -> tuple[int, ...]:
        return ()

    @property
    def wait_s(self) -> float | None:
        return None

    @property
    def takes_keys(self) -> bool:
        return False

    def telemetry(self, car: Telemetry) -> None:
        """What the car of a drive does."""

    def sight(self, seen: "Sight") -> None:
        """What the function sees in a replay."""

    def state(self, state: ServiceState) -> None:
        """What serves now."""

    def event(self, event: dict[str, object]) -> None:
        """An event of the run: `t_ms`, `event`, `text`."""

    def attend(self) -> None:
        """Look after the terminal: keys, its size, what is to be drawn."""

    def report(self, report: Report) -> None:
        """Show what the run reports, except for its events."""
        match report.kind:
            case control.TELEMETRY:
                self.telemetry(msgspec.msgpack.decode(report.data, type=Telemetry))
            case control.SIGHT:
                from aftbed.vehicle.aeb.messages import Sight  # noqa: PLC0415 - only of a replay

                self.sight(msgspec.msgpack.decode(report.data, type=Sight))
            case control.STATE:
                self.state(msgspec.msgpack.decode(report.data, type=ServiceState))


class PlainView(RunView):
    """A line per event, and one for the car every PLAIN_PERIOD_MS."""

    def __init__(self, options: RunOptions) -> None:
        super().__init__()
        print(f"run {options.run}: {options.ftm}, {options.placement}, seed {options.seed}", flush=True)
        if options.port:
            print(bus_line(options), flush=True)
        self._next_ms = 0

    def telemetry(self, car: Telemetry) -> None:
        if car.t_ms >= self._next_ms:
            self._next_ms = car.t_ms + PLAIN_PERIOD_MS
            print(car_line(car), flush=True)

    def sight(self, seen: "Sight") -> None:
        if seen.t_ms >= self._next_ms:
            self._next_ms = seen.t_ms + PLAIN_PERIOD_MS
            print(sight_line(seen), flush=True)

    def event(self, event: dict[str, object]) -> None:
        print(shown(event_line(event)), flush=True)


def bus_line(options: RunOptions) -> str:
    return f"bus: {CHANNEL} at {HOST}:{options.port}, for clients of socketcand"


def car_line(t: Telemetry) -> str:
    gap = "no target" if t.gap_m is None else f"gap {t.gap_m:6.2f} m"
    ttc = "" if t.ttc_s is None else f"  TTC {t.ttc_s:5.2f} s"
    return (
        f"{t.t_ms / 1e3:6.2f} s  {t.speed_ms * KMH_PER_MS:5.1f} km/h  {gap}{ttc}"
        f"  {STAGES[t.stage]:7}  {t.deceleration_ms2:4.1f} m/s2"
    )


def event_line(event: dict[str, object]) -> str:
    return f"[{event['t_ms']:>10} ms] {event['event']}: {event['text']}"


def requests_line(state: ServiceState) -> str:
    """What the client has counted, "" if it has not."""
    if state.requests is None:
        return ""
    cycle = "" if state.cycle_us is None else f", cycle {state.cycle_us:.0f} us"
    return f"{state.requests.sent} sent, {state.requests.answered} answered{cycle}"


def sight_line(seen: "Sight") -> str:
    speed = "speed unknown" if seen.speed_ms is None else f"{seen.speed_ms * KMH_PER_MS:5.1f} km/h"
    gap = "no target" if seen.range_m is None else f"gap {seen.range_m:6.2f} m"
    ttc = "" if seen.ttc_s is None else f"  TTC {seen.ttc_s:5.2f} s"
    return (
        f"{seen.t_ms / 1e3:6.2f} s  {speed}  {'radar unknown' if seen.targets is None else gap}{ttc}"
        f"  {STAGES[seen.stage]:7}  asks for {seen.deceleration_ms2:.1f} m/s2"
    )


# -- a verdict ------------------------------------------------------------------------------------


def show_verdict(verdict: "Verdict", *, as_json: bool, quiet: bool = False) -> None:
    """Print it to standard output; `quiet`: without what was done, sent and counted."""
    if as_json:
        print_json(verdict)
        return
    if not quiet:
        _show_run(verdict)
    for reason in verdict.reasons:
        print(shown(f"  because    {reason}"))
    print(painted(f"verdict: {verdict.verdict}", STYLES_OF_VERDICTS[verdict.verdict]))


def _show_run(verdict: "Verdict") -> None:
    requests = verdict.requests
    print(shown(f"{verdict.scenario} under {verdict.ftm} ({verdict.placement}), seed {verdict.seed}"))
    print(
        f"  requests   {requests.sent} sent, {requests.answered} answered, {requests.lost} lost,"
        f" {requests.duplicated} duplicated, {requests.late} late, {requests.wrong} wrong"
    )
    compared = "one_history" in verdict.checks
    if verdict.app or not compared:
        within = f", replies within {verdict.tolerance:g}" if verdict.tolerance else ""
        how = within if compared else ", its replies are not compared"
        print(shown(f"  function   {verdict.app or 'the built-in one'}{how}"))
    for failure in verdict.function_failures:
        print(shown(f"  failed     {failure}"))
    _show_vehicle(verdict)
    for f in verdict.failovers:
        print(
            f"  failover   to epoch {f.epoch}: detected {_ms(f.detected_ms)}, fenced {_ms(f.fenced_ms)},"
            f" promoted {_ms(f.promoted_ms)}, next good reply {_ms(f.recovered_ms)},"
            f" blackout {_ms(f.blackout_ms)}"
        )
    for handled in verdict.intervals:
        if handled.of_fault:
            print(shown(f"  handled    {handled}"))
    for one in verdict.adaptations:
        took = f", blackout {_ms(one.blackout_ms)}, total {_ms(one.total_ms)}" if one.total_ms else ""
        print(shown(f"  adaptation {one}{took}"))
    if verdict.adaptations:
        print(shown(f"  at the end {verdict.ftm_at_end or 'unknown'}"))
    if verdict.policy is not msgspec.UNSET:
        _show_policy(verdict)
    if (load := verdict.bus_load) is not None:
        print(f"  bus load   {load.p50_percent:.1f} % (p50), {load.max_percent:.1f} % at most")
    if verdict.strangers:
        from aftbed.judge.checks import stranger_line  # noqa: PLC0415 - after the run

        print("\n".join(f"  bus        {stranger_line(stranger)}" for stranger in verdict.strangers))
    for fault in verdict.faults:
        print(shown(f"  fault      {fault.fault}: {fault.receipt.value}"))
    if verdict.verifies:
        print(f"  verifies   {', '.join(verdict.verifies)}")
    checks = (painted(f"{name} {found}", STYLES_OF_CHECKS[found]) for name, found in verdict.checks.items())
    print("  checks     " + ", ".join(checks))


def _show_policy(verdict: "Verdict") -> None:
    from aftbed.runtime.unix.closed_loop import proposed_line, rule_line  # noqa: PLC0415 - only with a policy

    for rule in verdict.policy.rules if verdict.policy else ():
        print(shown(f"  policy     {rule_line(rule)}"))
    for proposal in verdict.proposals or ():
        print(shown(f"  proposal   {proposed_line(proposal)}"))


def _show_vehicle(verdict: "Verdict") -> None:
    car = verdict.vehicle
    if car is None:
        if verdict.replay is not None:
            print(f"  replay     {msgspec.json.encode(verdict.replay).decode()}")
    elif car.collision:
        print(f"  car        {painted(f'COLLISION at {car.impact_speed_kmh:.1f} km/h', Style.ALARM)}")
    elif car.stop_gap_m is not None:
        most = f"{car.max_deceleration_ms2:.1f} m/s2 at most"
        print(f"  car        stopped {car.stop_gap_m:.2f} m short, {most}")
    else:
        gap = "" if car.min_gap_m is None else f", gap {car.min_gap_m:.2f} m at least"
        print(f"  car        {'braked' if car.braked else 'never braked'}{gap}")
    if car is not None and car.fallback_s is not None:
        print(f"  brakes     first without a fresh request after {car.fallback_s:.2f} s")


def _ms(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} ms"


# -- adaptations that ended -----------------------------------------------------------------------


class EndedAdaptation(msgspec.Struct, frozen=True):
    """One adaptation of a run, as the run reports it; times in milliseconds."""

    number: int
    purpose: str
    recipe: str
    ftm: str
    outcome: str
    reason: str
    asked_ms: float
    prepare_ms: float
    blackout_ms: float
    total_ms: float
    bricks_changed: int
    bricks_total: int

    def __str__(self) -> str:
        why = f": {self.reason}" if self.reason else ""
        return f"{self.purpose}: {self.outcome}{why}"


def history_lines(ended: list[EndedAdaptation]) -> Iterator[str]:
    """A table with a line for each adaptation."""
    yield "  #     ASKED    PREPARE   BLACKOUT      TOTAL  BRICKS RECIPE  WHAT"
    for one in ended:
        took = " ".join(f"{ms:>7.2f} ms" for ms in (one.prepare_ms, one.blackout_ms, one.total_ms))
        bricks = f"{one.bricks_changed}/{one.bricks_total}"
        yield f"{one.number:>3} {one.asked_ms / 1e3:>7.2f} s {took} {bricks:>7} {one.recipe:7} {one}"
    yield f"{len(ended)} adaptation{'s' if len(ended) != 1 else ''}"
