"""What a run shows while it lives: a live view on a terminal, plain lines elsewhere, nothing for --json."""

import sys
from collections import deque
from types import TracebackType
from typing import TYPE_CHECKING, Final, Protocol, Self

import msgspec

from aftbed.runtime.unix.options import RunOptions
from aftbed.vehicle.plant import Telemetry

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

EVENTS_SHOWN: Final = 10
STAGES: Final = ("-", "WARN", "PARTIAL", "FULL")
PLAIN_PERIOD_MS: Final = 500


class View(Protocol):
    """A context manager that is told what happens."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def telemetry(self, data: bytes) -> None: ...
    def event(self, event: dict[str, object]) -> None: ...
    def cycle(self, cycle_us: float | None) -> None: ...


def open_view(options: RunOptions, *, quiet: bool) -> View:
    """The view that fits where the output goes."""
    if quiet:
        return QuietView()
    return LiveView(options) if sys.stdout.isatty() else PlainView(options)


class QuietView:
    """Shows nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def telemetry(self, data: bytes) -> None:
        """Not shown."""

    def cycle(self, cycle_us: float | None) -> None:
        """Not shown."""

    def event(self, event: dict[str, object]) -> None:
        """Not shown."""


def _car(t: Telemetry) -> str:
    gap = "no target" if t.gap_m is None else f"gap {t.gap_m:6.2f} m"
    ttc = "" if t.ttc_s is None else f"  TTC {t.ttc_s:5.2f} s"
    return (
        f"{t.t_ms / 1e3:6.2f} s  {t.speed_ms * 3.6:5.1f} km/h  {gap}{ttc}"
        f"  {STAGES[t.stage]:7}  {t.deceleration_ms2:4.1f} m/s2"
    )


class PlainView(QuietView):
    """A line per event, and one for the car every half second."""

    def __init__(self, options: RunOptions) -> None:
        print(f"run {options.run}: {options.ftm}, {options.placement}, seed {options.seed}", flush=True)
        self._next_ms = 0

    def telemetry(self, data: bytes) -> None:
        """The car, now and then."""
        telemetry = msgspec.msgpack.decode(data, type=Telemetry)
        if telemetry.t_ms >= self._next_ms:
            self._next_ms = telemetry.t_ms + PLAIN_PERIOD_MS
            print(_car(telemetry), flush=True)

    def event(self, event: dict[str, object]) -> None:
        """As it happens."""
        print(f"[{event['t_ms']:>10} ms] {event['event']}: {event['text']}", flush=True)


class LiveView(QuietView):
    """Speed, gap, TTC, stage, who leads, and the last events."""

    def __init__(self, options: RunOptions) -> None:
        self._options = options
        self._events: deque[str] = deque(maxlen=EVENTS_SHOWN)
        self._telemetry: Telemetry | None = None
        self._leader = "a leads, b backs up" if options.ftm != "none" else "a alone"
        self._cycle = ""
        self._live: Live | None = None

    def __enter__(self) -> Self:
        from rich.live import Live  # noqa: PLC0415 - only where somebody looks

        self._live = Live(get_renderable=self._render, refresh_per_second=20, transient=False)
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.__exit__(kind, error, trace)

    def telemetry(self, data: bytes) -> None:
        """The newest is shown at the next refresh."""
        self._telemetry = msgspec.msgpack.decode(data, type=Telemetry)

    def cycle(self, cycle_us: float | None) -> None:
        """From request to reply, at the client."""
        self._cycle = "" if cycle_us is None else f"    cycle {cycle_us:.0f} us"

    def event(self, event: dict[str, object]) -> None:
        """Keep the last ones."""
        self._events.append(f"{event['t_ms']:>10} ms  {event['event']:<13} {event['text']}")
        if event["event"] == "roles":
            self._leader = str(event["text"])

    def _render(self) -> "RenderableType":
        from rich.panel import Panel  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415

        car = _car(self._telemetry) if self._telemetry else "waiting for the car"
        bar = _bar(self._telemetry.gap_m if self._telemetry else None)
        lines = [car, bar, f"replicas: {self._leader}{self._cycle}", "", *self._events]
        options = self._options
        title = f"aftbed run {options.run}: {options.ftm}, {options.placement}"
        return Panel(
            Text("\n".join(lines), no_wrap=True, overflow="ellipsis"), title=title, height=EVENTS_SHOWN + 6
        )


def _bar(gap_m: float | None) -> str:
    """The road: the car, the gap, the obstacle."""
    if gap_m is None:
        return ">" + "." * 60
    return ">" + "." * min(60, max(0, round(gap_m))) + "#"
