"""How the size of the protected function's state changes its cycle, and the blackout of an update.

A function with ballast (`ballast`) replaces the built-in one by an update, and then two versions of it
replace each other. This moves the whole state on both replicas while the client waits: that is the
blackout. The cycle is measured in a closed loop after the last update. Under `pbr` the state goes into each
checkpoint; under `lfr` it never leaves its replica, except for an update.

If a mechanism does not carry a size, that is a result and no failure of the bench: the row has the reason,
and larger sizes are not tried under that mechanism. (A message over PACKET_BYTES_MAX travels as a memfd; in a
closed loop a backup may be so many of them behind that it cannot be brought to rest in time.)
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.planner import APPLICATION
from aftbed.bench import ballast
from aftbed.bench.adaptation import adapted
from aftbed.bench.cycle import ring_p50_us
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
from aftbed.core.messages import PACKET_BYTES_MAX, Goal

PLACEMENT: Final = "process"
REPLIES_MIN: Final = 5
ROUNDS: Final = 11  # of two sizes in turn
UPDATES: Final = 2  # in a round
WINDOW_SECONDS: Final = 0.5  # of a closed loop in a round
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


class StateRatio(msgspec.Struct, frozen=True):
    """The document of `aftbed bench state`: one size beside another, in turn; ratios of the medians."""

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
    ftm: str, size_bytes: int, beside_bytes: int, *, tracked: bool = False, rounds: int = ROUNDS
) -> StateRatio:
    """A function of each size in turn: its cycle in a closed loop, and the blackout of updates to it.

    One page changes with each request. `tracked`: the function tells its changes. Raises HarnessError.
    """
    cycles: dict[int, list[float]] = {size_bytes: [], beside_bytes: []}
    blackouts: dict[int, list[float]] = {size_bytes: [], beside_bytes: []}
    ratios = []
    for _ in range(rounds):
        medians = []
        for size in (beside_bytes, size_bytes):
            measured = _window(ftm, size, UPDATES, WINDOW_SECONDS, tracked=tracked)
            cycles[size] += measured.cycles_us
            blackouts[size] += measured.blackouts_ms
            medians.append(quantile(measured.cycles_us, 0.5))
        ratios.append(medians[1] / medians[0])
    blackout, beside = percentiles(blackouts[size_bytes]), percentiles(blackouts[beside_bytes])
    return StateRatio(
        ftm,
        size_bytes,
        beside_bytes,
        tracked,
        percentiles(cycles[size_bytes], 1),
        percentiles(cycles[beside_bytes], 1),
        round(quantile(ratios, 0.5), 3),
        tuple(round(ratio, 3) for ratio in ratios),
        blackout,
        beside,
        round(blackout.p50 / beside.p50, 3),
    )


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


def _window(ftm: str, size_bytes: int, updates: int, seconds: float, *, tracked: bool = False) -> _Window:
    with endless_run(ftm, PLACEMENT) as run:
        outcomes = _updates(run.private, size_bytes, updates, tracked=tracked)
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
