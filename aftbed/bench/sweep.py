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
from typing import Final

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
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.messages import PACKET_BYTES_MAX, Goal

PLACEMENT: Final = "process"
REPLIES_MIN: Final = 5
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
    with endless_run(ftm, PLACEMENT) as run:
        outcomes = _updates(run.private, size_bytes, updates)
        began_ns = time.monotonic_ns()
        time.sleep(seconds)  # the measured window
        ended_ns = time.monotonic_ns()
    cycles = latencies_us(run.record, began_ns=began_ns, ended_ns=ended_ns)
    if len(cycles) < REPLIES_MIN:
        raise HarnessError(f"only {len(cycles)} replies in {seconds} s after the update")
    return StateResult(
        ftm,
        size_bytes,
        len(cycles),
        percentiles(cycles, 1),
        bare_us,
        len(outcomes),
        percentiles([float(str(outcome["blackout_ms"])) for outcome in outcomes]),
        percentiles([float(str(outcome["total_ms"])) for outcome in outcomes]),
    )


def _updates(private: Path, size_bytes: int, updates: int) -> list[dict[str, object]]:
    """Bring the ballast in, then let its versions replace each other `updates` times: how each ended."""
    wait_until_ready(private)
    outcomes = []
    for number in range(updates + 1):
        source = ballast.source_of(size_bytes, ballast.VERSIONS[number % len(ballast.VERSIONS)])
        outcomes.append(adapted(private, Goal(part=APPLICATION, source=source)))
        time.sleep(PAUSE_SECONDS)
    return outcomes[1:]
