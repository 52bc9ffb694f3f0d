"""Sweeps: over the size of the protected function's state, and over the rate of its requests.

**State.** A function with ballast (`ballast`) takes the built-in one's place by an update, and then two
versions of it take each other's, which moves the whole state on both replicas while the client waits: that
is the blackout. The cycle is taken in a closed loop after the last update. Under `pbr` the state goes into
each checkpoint; under `lfr` it never leaves its replica, but for an update.

A size that a mechanism does not carry is a finding and no failure of the bench: the row says why, and
larger ones are not tried under that mechanism. (A message over `wire.PACKET_BYTES_MAX` travels as a memfd;
in a closed loop a backup may be so many of them behind that it cannot be brought to rest in time.)

**Rate.** The load is at a fixed rate, an open loop, so what waits is seen in the latency.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.plan import APPLICATION
from aftbed.bench import ballast
from aftbed.bench.adapt import REQUESTS_ENDLESS, adapted, ready
from aftbed.bench.placements import ENDS, Times, latencies_us, ring_p50_us, times
from aftbed.bench.runs import finish, start
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.messages import PACKET_BYTES_MAX, Goal
from aftbed.runtime.unix.options import LoadRun

PLACEMENT: Final = "process"
PAUSE_SECONDS: Final = 0.05  # of undisturbed service between two updates
REPLIES_MIN: Final = 5
_AROUND_BYTES: Final = 1024  # of a message, beside the state in it


class Sized(msgspec.Struct, frozen=True):
    """One size of the state under one mechanism; `refused` says why where it is not carried."""

    ftm: str
    state_bytes: int
    requests: int = 0
    cycle_us: Times | None = None
    ring_us: float = 0.0  # p50, of as many hops
    updates: int = 0
    blackout_ms: Times | None = None
    total_ms: Times | None = None
    refused: str = ""


def sweep_sizes(ftm: str, sizes_bytes: Iterable[int], measure: Callable[[int], Sized]) -> list[Sized]:
    """What `measure` gives for each size, in ascending order, up to the first that `ftm` does not carry."""
    found: list[Sized] = []
    for size_bytes in sorted(sizes_bytes):
        if found and found[-1].refused:
            why = "not tried: a smaller one is not carried"
            found.append(Sized(ftm, size_bytes, refused=why))
        else:
            found.append(measure(size_bytes))
    return found


def sized(ftm: str, size_bytes: int, updates: int, seconds: float) -> Sized:
    """One size: `updates` updates, then a closed loop of `seconds`.

    Raises HarnessError if a size fails that fits into a packet.
    """
    try:
        return _sized(ftm, size_bytes, updates, seconds)
    except (ConfigError, HarnessError) as error:
        if size_bytes + _AROUND_BYTES <= PACKET_BYTES_MAX:
            raise HarnessError(f"state of {size_bytes} bytes under {ftm}: {error}") from error
        return Sized(ftm, size_bytes, refused=f"in a closed loop: {error}")


def _sized(ftm: str, size_bytes: int, updates: int, seconds: float) -> Sized:
    bare_us = ring_p50_us(ftm, PLACEMENT)
    launched = start(ftm, PLACEMENT, LoadRun(REQUESTS_ENDLESS, 0.0))
    try:
        outcomes = _update(launched.private, size_bytes, updates)
        began_ns = time.monotonic_ns()
        time.sleep(seconds)  # what is measured
        ended_ns = time.monotonic_ns()
    except BaseException:
        launched.stop()
        finish(launched, ends=ENDS)
        raise
    launched.stop()
    cycles = latencies_us(finish(launched, ends=ENDS), began_ns, ended_ns)
    if len(cycles) < REPLIES_MIN:
        raise HarnessError(f"only {len(cycles)} replies in {seconds} s after the update")
    return Sized(
        ftm,
        size_bytes,
        len(cycles),
        times(cycles, 1),
        bare_us,
        len(outcomes),
        times([_number(o, "blackout_ms") for o in outcomes]),
        times([_number(o, "total_ms") for o in outcomes]),
    )


def _update(private: Path, size_bytes: int, updates: int) -> list[dict[str, object]]:
    """Put the ballast in; then have its versions take each other's place, `updates` times: how each ended."""
    ready(private)
    outcomes = []
    for number in range(updates + 1):
        source = ballast.source_of(size_bytes, ballast.VERSIONS[number % len(ballast.VERSIONS)])
        outcomes.append(adapted(private, Goal(part=APPLICATION, source=source)))
        time.sleep(PAUSE_SECONDS)
    return outcomes[1:]


def _number(outcome: dict[str, object], key: str) -> float:
    return float(str(outcome[key]))
