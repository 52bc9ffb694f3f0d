"""How the size of the protected function's state changes its cycle, and the blackout of an update.

A function with ballast (`ballast`) replaces the built-in one by an update, and then two versions of it
replace each other. This moves the whole state on both replicas while the client waits: that is the
blackout. Under `pbr` the state goes into each checkpoint; under `lfr` it never leaves its replica, except for
an update.

`bench_state` measures a cycle side by side (`cycle`): a run with each of two sizes and the limit live at the
same time, and every third turn is that of one of them. A turn is longer where a cycle takes milliseconds; one
of more than some 10 MB outlasts its turn, and the others are slower then. Updates are measured before, in
runs of their own, one size in turn with the other.

The limit of a cycle under a state is the bare ring (`cycle`), with what the machine allows for the state.
Its process in the leader's place copies as many bytes into a memfd as are captured for a checkpoint, compares
them with the last ones, and sends what changed, a page. The process in the backup's place copies the state
with this page into a memfd, and back out of it. A function that tells its changes is not captured: a page is
all that is copied then. Under `lfr` no checkpoint is made, so its limit is the ring alone.

If a mechanism does not carry a size, that is a result and no failure of the bench: the row has the reason,
and larger sizes are not tried under that mechanism. (A message over PACKET_BYTES_MAX travels as a memfd; in a
closed loop a backup may be so many of them behind that it cannot be brought to rest in time.)
"""

import mmap
import os
import time
from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.planner import APPLICATION
from aftbed.bench import ballast
from aftbed.bench.adaptation import adapted
from aftbed.bench.cycle import (
    RING_BYTES,
    TURN_NS,
    CycleRun,
    RingWork,
    ring_in_turns,
    ring_of,
    ring_p50_us,
    side_by_side,
)
from aftbed.bench.rounds import ROUNDS, InRounds, beside_limit, together
from aftbed.bench.runs import (
    PAUSE_SECONDS,
    Percentiles,
    endless_run,
    latencies_us,
    percentiles,
    wait_until_ready,
)
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.events import Event
from aftbed.core.messages import PACKET_BYTES_MAX, Goal
from aftbed.core.progress import Show, unshown
from aftbed.ftm.compose import build, path
from aftbed.ftm.pages import PAGE_BYTES
from aftbed.ftm.registry import BRICKS

PLACEMENT: Final = "process"
REPLIES_MIN: Final = 5
UPDATES: Final = 4  # in a round
SECONDS: Final = 3.0  # of a round, in which cycles are measured
TURN_BYTES_PER_NS: Final = 0.1  # of a state: a cycle of 1 MB fits twenty times into its turn
TURN_NS_MAX: Final = 40_000_000  # a client that waits for two turns is not taken for hung
_AROUND_BYTES: Final = 1024  # of a message, beside the state in it


class StateResult(msgspec.Struct, frozen=True):
    """One size of the state under one mechanism; `refused`: the reason where it is not carried."""

    ftm: str
    state_bytes: int
    requests: int = 0
    cycle_us: Percentiles | None = None
    ring_us: float = 0.0  # p50, of as many hops
    updates: int = 0
    blackout_ms: Percentiles | None = None
    total_ms: Percentiles | None = None
    refused: str = ""


def sweep_sizes(
    ftm: str, sizes_bytes: Iterable[int], measure: Callable[[int], StateResult]
) -> list[StateResult]:
    """What `measure` gives for each size, in ascending order, up to the first that `ftm` does not carry."""
    found: list[StateResult] = []
    for size_bytes in sorted(sizes_bytes):
        if found and found[-1].refused:
            why = "not tried: a smaller one is not carried"
            found.append(StateResult(ftm, size_bytes, refused=why))
        else:
            found.append(measure(size_bytes))
    return found


class StateRatio(InRounds, frozen=True):
    """The document of `aftbed bench state`: one size beside another, in turn; ratios of the medians.

    `limit` and `ratio` are those of `cycle_us`.
    """

    ftm: str
    state_bytes: int
    beside_bytes: int
    tells_changes: bool
    cycle_us: Percentiles
    beside_cycle_us: Percentiles
    ratio_p50: float
    ratio_rounds: tuple[float, ...]
    blackout_ms: Percentiles
    beside_blackout_ms: Percentiles
    blackout_ratio_p50: float


def bench_state(
    ftm: str,
    size_bytes: int,
    beside_bytes: int,
    *,
    tracked: bool = False,
    rounds: int = ROUNDS,
    show: Show = unshown,
) -> StateRatio:
    """A function of each size: its cycle in a closed loop, and the blackout of updates to it.

    One page changes with each request. `tracked`: the function tells its changes. Raises HarnessError.
    """
    shape = ring_of(build(ftm, PLACEMENT))
    moved_bytes = captured_bytes(ftm, size_bytes, tracked=tracked)
    work = state_work(moved_bytes) if moved_bytes else None

    turn_ns = round(min(max(TURN_NS, moved_bytes / TURN_BYTES_PER_NS), TURN_NS_MAX))
    runs = [
        CycleRun(ftm, PLACEMENT, application=ballast.source_of(size, ballast.VERSIONS[0], tracked=tracked))
        for size in (size_bytes, beside_bytes)
    ]
    sides = [
        *(partial(run.in_turns, skip=0) for run in runs),
        partial(ring_in_turns, shape, RING_BYTES, pin=True, work=work),
    ]

    def measured(number: int) -> tuple[_Round, list[float]]:
        first = number % 2
        sizes = (size_bytes, beside_bytes)
        blackouts = [_blackouts_ms(ftm, size, tracked=tracked) for size in (sizes[first], sizes[1 - first])]
        large, small, ring = side_by_side(sides, turn_ns, SECONDS)
        return _Round(large, small, blackouts[first], blackouts[1 - first]), ring

    found = together(rounds, measured, show)
    large, small, large_ms, small_ms = zip(*found.figures, strict=True)
    name = shape.name + f", memcpy of {moved_bytes} bytes through memfds" * bool(moved_bytes)
    beside, beside_small = beside_limit(name, large, found.limits, 1), beside_limit("", large, small, 1)
    blackout, beside_blackout = (percentiles(list(chain.from_iterable(ms))) for ms in (large_ms, small_ms))
    return StateRatio(
        ftm,
        size_bytes,
        beside_bytes,
        tracked,
        percentiles(list(chain.from_iterable(large)), 1),
        percentiles(list(chain.from_iterable(small)), 1),
        beside_small.ratio.p50.median,
        tuple(
            round(quantile(one, 0.5) / quantile(other, 0.5), 3)
            for one, other in zip(large, small, strict=True)
        ),
        blackout,
        beside_blackout,
        round(blackout.p50 / beside_blackout.p50, 3),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


class _Round(NamedTuple):
    """Of both sizes: the cycles (us), and the blackouts of updates (ms)."""

    cycles_us: list[float]
    beside_cycles_us: list[float]
    blackouts_ms: list[float]
    beside_blackouts_ms: list[float]


def _blackouts_ms(ftm: str, size_bytes: int, *, tracked: bool) -> list[float]:
    with endless_run(ftm, PLACEMENT) as run:
        outcomes = _updates(run.private, size_bytes, UPDATES, tracked=tracked)
    return [float(str(outcome["blackout_ms"])) for outcome in outcomes]


def captured_bytes(ftm: str, size_bytes: int, *, tracked: bool) -> int:
    """How many bytes of a state are copied for a checkpoint of one changed page; 0: none is made."""
    graph = build(ftm, PLACEMENT)
    if not any(Event.CHECKPOINT_SENT in BRICKS[graph.brick(name).kind].visits for name in path(graph)):
        return 0
    return min(size_bytes, PAGE_BYTES) if tracked else size_bytes


def state_work(moved_bytes: int) -> RingWork:
    """What the ring does for a checkpoint of a state of which so many bytes are captured."""
    page_bytes = min(moved_bytes, PAGE_BYTES)

    def of_leader() -> Callable[[], memoryview]:
        state, last, copy = bytearray(moved_bytes), bytearray(moved_bytes), _memfd(moved_bytes)
        view, page, last_page = memoryview(state), copy[-page_bytes:], memoryview(last)[-page_bytes:]

        def checkpoint() -> memoryview:
            state[-1] = (state[-1] + 1) % 256  # in the last page, so that all bytes are compared
            copy[:] = view
            assert last != copy
            last_page[:] = page
            return page

        return checkpoint

    def of_backup() -> Callable[[bytes], None]:
        state, copy = memoryview(bytearray(moved_bytes)), _memfd(moved_bytes)
        page = copy[-page_bytes:]

        def restore(packet: bytes) -> None:
            copy[:] = state
            page[:] = packet
            state[:] = copy

        return restore

    return RingWork(of_leader, of_backup)


def _memfd(size_bytes: int) -> memoryview:
    """Of shared memory without a name, mapped."""
    descriptor = os.memfd_create("aftbed-bench")
    try:
        os.ftruncate(descriptor, size_bytes)
        return memoryview(mmap.mmap(descriptor, size_bytes))
    finally:
        os.close(descriptor)


def sized(ftm: str, size_bytes: int, updates: int, seconds: float) -> StateResult:
    """One size: `updates` updates, then a closed loop of `seconds`.

    Raises HarnessError if a size fails that fits into a packet.
    """
    try:
        return _measured(ftm, size_bytes, updates, seconds)
    except (ConfigError, HarnessError) as error:
        if size_bytes + _AROUND_BYTES <= PACKET_BYTES_MAX:
            raise HarnessError(f"state of {size_bytes} bytes under {ftm}: {error}") from error
        return StateResult(ftm, size_bytes, refused=f"in a closed loop: {error}")


def _measured(ftm: str, size_bytes: int, updates: int, seconds: float) -> StateResult:
    bare_us = ring_p50_us(ftm, PLACEMENT)
    measured = _window(ftm, size_bytes, updates, seconds)
    return StateResult(
        ftm,
        size_bytes,
        len(measured.cycles_us),
        percentiles(measured.cycles_us, 1),
        bare_us,
        len(measured.blackouts_ms),
        percentiles(measured.blackouts_ms),
        percentiles(measured.totals_ms),
    )


class _Window(NamedTuple):
    """What was measured in one run: cycles in the window, and the updates before it."""

    cycles_us: list[float]
    blackouts_ms: list[float]
    totals_ms: list[float]


def _window(ftm: str, size_bytes: int, updates: int, seconds: float) -> _Window:
    with endless_run(ftm, PLACEMENT) as run:
        outcomes = _updates(run.private, size_bytes, updates)
        began_ns = time.monotonic_ns()
        time.sleep(seconds)  # the measured window
        ended_ns = time.monotonic_ns()
    cycles = latencies_us(run.record, began_ns=began_ns, ended_ns=ended_ns)
    if len(cycles) < REPLIES_MIN:
        raise HarnessError(f"only {len(cycles)} replies in {seconds} s after the update")
    blackouts, totals = (
        [float(str(outcome[key])) for outcome in outcomes] for key in ("blackout_ms", "total_ms")
    )
    return _Window(cycles, blackouts, totals)


def _updates(
    private: Path, size_bytes: int, updates: int, *, tracked: bool = False
) -> list[dict[str, object]]:
    """Bring the ballast in, then let its versions replace each other `updates` times: how each ended."""
    wait_until_ready(private)
    outcomes = []
    for number in range(updates + 1):
        version = ballast.VERSIONS[number % len(ballast.VERSIONS)]
        source = ballast.source_of(size_bytes, version, tracked=tracked)
        outcomes.append(adapted(private, Goal(part=APPLICATION, source=source)))
        time.sleep(PAUSE_SECONDS)
    return outcomes[1:]
