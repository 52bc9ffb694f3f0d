"""What several commands print: a run while it lives, a verdict, adaptations that ended.

rich is imported only where the output is a terminal. `aftbed run` imports this module before it forks the
supervisor, so nothing else that is large is imported here.
"""

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.cli.options import print_json
from aftbed.core.errors import shown
from aftbed.runtime.unix.options import RunOptions
from aftbed.vehicle.can.bus_model import CHANNEL, HOST
from aftbed.vehicle.plant import Telemetry

if TYPE_CHECKING:
    from rich.console import RenderableType

    from aftbed.judge.verdict import Verdict

EVENTS_SHOWN: Final = 10
STAGES: Final = ("-", "WARN", "PARTIAL", "FULL")
PLAIN_PERIOD_MS: Final = 500
KMH_PER_MS: Final = 3.6
ROAD_M: Final = 60  # drawn, one character a metre


# -- a run while it lives -------------------------------------------------------------------------


class RunView:
    """Shows a live run. This one shows nothing."""

    def telemetry(self, data: bytes) -> None:
        """A `Telemetry`, encoded."""

    def cycle(self, cycle_us: float | None) -> None:
        """The latest cycle time at the client, from request to reply."""

    def event(self, event: dict[str, object]) -> None:
        """An event of the run: `t_ms`, `event`, `text`."""


@contextmanager
def open_view(options: RunOptions, *, quiet: bool) -> Iterator[RunView]:
    """The view that suits standard output; `quiet` shows nothing."""
    if quiet:
        yield RunView()
    elif not sys.stdout.isatty():
        yield PlainView(options)
    else:
        from rich.live import Live  # noqa: PLC0415 - only on a terminal

        view = LiveView(options)
        with Live(get_renderable=view.render, refresh_per_second=20):
            yield view


class PlainView(RunView):
    """A line per event, and one for the car every PLAIN_PERIOD_MS."""

    def __init__(self, options: RunOptions) -> None:
        print(f"run {options.run}: {options.ftm}, {options.placement}, seed {options.seed}", flush=True)
        if options.port:
            print(_bus(options), flush=True)
        self._next_ms = 0

    def telemetry(self, data: bytes) -> None:
        telemetry = msgspec.msgpack.decode(data, type=Telemetry)
        if telemetry.t_ms >= self._next_ms:
            self._next_ms = telemetry.t_ms + PLAIN_PERIOD_MS
            print(_car(telemetry), flush=True)

    def event(self, event: dict[str, object]) -> None:
        print(f"[{event['t_ms']:>10} ms] {event['event']}: {event['text']}", flush=True)


class LiveView(RunView):
    """Speed, gap, TTC, stage, the roles of the replicas, and the last events; redrawn 20 times a second."""

    def __init__(self, options: RunOptions) -> None:
        self._title = f"aftbed run {options.run}: {options.ftm}, {options.placement}"
        self._bus = [_bus(options)] if options.port else []
        self._events: deque[str] = deque(maxlen=EVENTS_SHOWN)
        self._telemetry: Telemetry | None = None
        self._roles = "a leads, b backs up" if options.ftm != "none" else "a alone"
        self._cycle = ""

    def telemetry(self, data: bytes) -> None:
        self._telemetry = msgspec.msgpack.decode(data, type=Telemetry)

    def cycle(self, cycle_us: float | None) -> None:
        self._cycle = "" if cycle_us is None else f"    cycle {cycle_us:.0f} us"

    def event(self, event: dict[str, object]) -> None:
        self._events.append(f"{event['t_ms']:>10} ms  {event['event']:<13} {event['text']}")
        if event["event"] == "roles":
            self._roles = str(event["text"])

    def render(self) -> "RenderableType":
        """The panel as it is now."""
        from rich.panel import Panel  # noqa: PLC0415 - only on a terminal
        from rich.text import Text  # noqa: PLC0415 - only on a terminal

        car = _car(self._telemetry) if self._telemetry else "waiting for the car"
        road = _road(self._telemetry.gap_m if self._telemetry else None)
        lines = [car, road, f"replicas: {self._roles}{self._cycle}", *self._bus, "", *self._events]
        text = Text("\n".join(lines), no_wrap=True, overflow="ellipsis")
        return Panel(text, title=self._title, height=EVENTS_SHOWN + 6 + len(self._bus))


def _bus(options: RunOptions) -> str:
    return f"bus: {CHANNEL} at {HOST}:{options.port}, for clients of socketcand"


def _car(t: Telemetry) -> str:
    gap = "no target" if t.gap_m is None else f"gap {t.gap_m:6.2f} m"
    ttc = "" if t.ttc_s is None else f"  TTC {t.ttc_s:5.2f} s"
    return (
        f"{t.t_ms / 1e3:6.2f} s  {t.speed_ms * KMH_PER_MS:5.1f} km/h  {gap}{ttc}"
        f"  {STAGES[t.stage]:7}  {t.deceleration_ms2:4.1f} m/s2"
    )


def _road(gap_m: float | None) -> str:
    """The car, the gap and the obstacle."""
    if gap_m is None:
        return ">" + "." * ROAD_M
    return ">" + "." * min(ROAD_M, max(0, round(gap_m))) + "#"


# -- a verdict ------------------------------------------------------------------------------------


def show_verdict(verdict: "Verdict", *, as_json: bool) -> None:
    """Print it to standard output."""
    if as_json:
        print_json(verdict)
        return
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
    print("  checks     " + ", ".join(f"{name} {found}" for name, found in verdict.checks.items()))
    for reason in verdict.reasons:
        print(shown(f"  because    {reason}"))
    print(f"verdict: {verdict.verdict}")


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
        print(f"  car        COLLISION at {car.impact_speed_kmh:.1f} km/h")
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
