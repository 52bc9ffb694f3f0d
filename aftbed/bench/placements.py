"""Placements side by side, since the paper's complaint is processes that do next to nothing.

In `process` each brick is a process, as in the paper; in `replica` a replica is one; in `single` both
replicas are one process, so that its crash is survived by nobody. CPU and memory are taken at the rate of
the radar, and at one request a second, which is as good as idle (a load that stands still for longer
is taken for a dead one).
"""

import os
from typing import Final

import msgspec

from aftbed.bench.adapt import REQUESTS_ENDLESS, ready
from aftbed.bench.cycle import bench_cycle, hops
from aftbed.bench.ring import ring_us
from aftbed.bench.runs import finish, start
from aftbed.bench.statistics import summary
from aftbed.bench.usage import Usage, usage
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.ftm.compose import build
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.options import LoadRun

RADAR_HZ: Final = 50.0
IDLE_HZ: Final = 1.0
WINDOW_PERIODS_MIN: Final = 1.2
NO_CRASH: Final = "single"  # the placement in which both replicas die at once
PACKET_BYTES: Final = 64
RING_COUNT: Final = 300
ENDS: Final = ("interrupted", "")


class Times(msgspec.Struct, frozen=True):
    """Quantiles of a sample, by nearest rank."""

    p50: float
    p95: float
    p99: float
    max: float


def times(values: list[float], digits: int = 3) -> Times:
    """Of `values`, rounded."""
    return msgspec.convert(summary(values, digits), Times)


class Cycle(msgspec.Struct, frozen=True):
    """Of one mechanism in one placement, beside the bare ring of as many hops."""

    ftm: str
    placement: str
    requests: int
    hops: int
    cycle_us: Times
    ring_us: Times
    ratio_p50: float


class Placed(msgspec.Struct, frozen=True):
    """A placement: what it costs in time, CPU and memory, and whether a replica's crash is survived."""

    placement: str
    survives_crash: bool
    cycle: Cycle
    loaded: Usage
    idle: Usage


class Loaded(msgspec.Struct, frozen=True):
    """A window of a run under a fixed rate. Latency is of the requests sent in it, as the client saw them."""

    ftm: str
    placement: str
    rate_hz: float
    requests: int
    sent_hz: float
    latency_ms: Times
    ring_us: float  # p50, of as many hops, in a closed loop
    usage: Usage


def cycle(ftm: str, placement: str, requests: int, rounds: int) -> Cycle:
    """As `aftbed bench cycle`."""
    return msgspec.convert(bench_cycle(ftm, placement, requests, rounds=rounds), Cycle)


def placed(ftm: str, placement: str, seconds: float, cycle: Cycle) -> Placed:
    """One placement, whose cycle has been measured."""
    return Placed(
        placement,
        placement != NO_CRASH,
        cycle,
        under_load(ftm, placement, RADAR_HZ, seconds).usage,
        under_load(ftm, placement, IDLE_HZ, seconds).usage,
    )


def processes(ftm: str, placement: str) -> int:
    """How many there are while it serves: its nodes and the supervisor, the paper's count."""
    launched = start(ftm, placement, LoadRun(REQUESTS_ENDLESS, RADAR_HZ))
    try:
        ready(launched.private)
        return sum(row.node for row in control_client.processes(launched.private))
    finally:
        launched.stop()
        finish(launched, ends=ENDS)


def under_load(ftm: str, placement: str, rate_hz: float, seconds: float) -> Loaded:
    """Run `ftm` under `rate_hz` requests a second, and look at `seconds` of it."""
    bare_us = ring_p50_us(ftm, placement)
    launched = start(ftm, placement, LoadRun(REQUESTS_ENDLESS, rate_hz))
    try:
        ready(launched.private)
        found, began_ns, ended_ns = usage(launched.private, max(seconds, WINDOW_PERIODS_MIN / rate_hz))
    except BaseException:
        launched.stop()
        finish(launched, ends=ENDS)
        raise
    launched.stop()
    latency_us = latencies_us(finish(launched, ends=ENDS), began_ns, ended_ns)
    if not latency_us:
        raise HarnessError(f"{ftm} ({placement}) answered nothing in {found.seconds} s at {rate_hz:g} Hz")
    return Loaded(
        ftm,
        placement,
        rate_hz,
        len(latency_us),
        round(len(latency_us) / found.seconds, 1),
        times([us / 1e3 for us in latency_us]),
        bare_us,
        found,
    )


def latencies_us(record: RunRecord, began_ns: int, ended_ns: int) -> list[float]:
    """From request.sent to reply.delivered, of the requests that were sent in that time and answered."""
    sent: dict[int, int] = {}
    found = []
    for event in record.history.events(Event.REQUEST_SENT, Event.REPLY_DELIVERED):
        if event.event is Event.REQUEST_SENT:
            if began_ns <= event.t_ns < ended_ns:
                sent[event.request_id] = event.t_ns
        elif event.request_id in sent:
            found.append((event.t_ns - sent[event.request_id]) / 1e3)
    return found


def ring_p50_us(ftm: str, placement: str) -> float:
    """The median round of the bare ring with as many hops as a request takes."""
    cpus = sorted(os.sched_getaffinity(0))
    cpu = cpus[0] if len(cpus) > 1 else None
    return round(quantile(ring_us(hops(build(ftm, placement)), PACKET_BYTES, RING_COUNT, cpu), 0.5), 1)
