"""Requests per second of one core in the simulator, beside a bare Python loop of as many calls.

A round is one run: a closed loop of requests without faults, bricks, channels, journal and supervisor
included. The limit is what Python itself takes for it: `calls` calls of an empty function for each request,
as many functions as the simulator calls (counted by the interpreter's profile hook). Both take CPU time, not
wall time, since nothing in a simulated run waits.
"""

import gc
import sys
import time
from types import FrameType
from typing import Final

from msgspec.structs import replace

from aftbed.bench.rounds import SHORT_ROUNDS, InRounds, beside_limit, in_turn, shares
from aftbed.bench.runs import Percentiles, percentiles
from aftbed.core.errors import HarnessError
from aftbed.core.journal import EntryKind
from aftbed.core.progress import Show, unshown
from aftbed.runtime.sim.world import Setup, simulate

COUNTED: Final = 100  # requests more in the second of two runs whose calls are counted


class SimulatorResult(InRounds, frozen=True):
    """The document of `aftbed bench simulator`; `request_us` has a value for each round.

    `calls`: of Python functions, per request.
    """

    ftm: str
    placement: str
    requests: int
    calls: float
    request_us: Percentiles
    requests_per_s: int


def bench_simulator(
    ftm: str, placement: str, requests: int, *, rounds: int = SHORT_ROUNDS, show: Show = unshown
) -> SimulatorResult:
    """Simulate `requests` requests, over all rounds. Raises ConfigError."""
    share = shares(requests, rounds)
    setup = Setup(ftm, placement)
    calls = calls_per_request(setup)
    found = in_turn(
        len(share),
        lambda number: _request_us(setup, share[number]),
        lambda number: _calls_us(round(calls * share[number])) / share[number],
        show=show,
    )
    beside = beside_limit(
        f"{calls:g} calls of an empty function", [[us] for us in found.figures], [[us] for us in found.limits]
    )
    figures = percentiles(found.figures)
    return SimulatorResult(
        ftm=ftm,
        placement=placement,
        requests=requests,
        calls=calls,
        request_us=figures,
        requests_per_s=round(1e6 / figures.p50),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


def calls_per_request(setup: Setup) -> float:
    """How many Python functions the simulator calls for a request, without those of its start and end."""
    _simulated(setup, 2 * COUNTED)  # what is cached is called once
    few, more = (_calls(setup, count) for count in (COUNTED, 2 * COUNTED))
    return (more - few) / COUNTED


def _calls(setup: Setup, count: int) -> int:
    calls = 0

    def note(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"

    before, collects = sys.getprofile(), gc.isenabled()
    gc.disable()  # it would call what others have registered with it
    sys.setprofile(note)
    try:
        _simulated(setup, count)
    finally:
        sys.setprofile(before)
        if collects:
            gc.enable()
    return calls


def _request_us(setup: Setup, count: int) -> float:
    began_ns = time.process_time_ns()
    _simulated(setup, count)
    return (time.process_time_ns() - began_ns) / 1e3 / count


def _simulated(setup: Setup, count: int) -> None:
    run = simulate(replace(setup, count=count))
    answered = sum(entry.kind is EntryKind.ANSWERED for entry in run.history.dialogue)
    if answered != count:
        raise HarnessError(f"{answered} of {count} requests were answered: {'; '.join(run.rest.why_not)}")


def _calls_us(calls: int) -> float:
    def empty() -> None:
        pass

    began_ns = time.process_time_ns()
    for _ in range(calls):
        empty()
    return (time.process_time_ns() - began_ns) / 1e3
