"""From SIGKILL of the primary to the next good reply, in a closed loop: one request always waits.

Each kill takes the whole replica (all nodes of its chain), as the crash of an ECU would. The next kill
waits until redundancy is back, and until the spares that it took are forked anew, beside which a recovery
takes up to ten times as long. Times are from the journals, whose clock is common to all processes.

`death_ms` is the limit of any detection: from SIGKILL of a process to the moment at which another one that
polls its pidfd sees that it is dead. The victim runs as a node of the leader's chain does, the other one as
a Watchdog does. Kills and deaths alternate: the load sends in every third turn of `TURN_NS`. When all is
back, a death is measured in the turn before such a one, and the kill comes within it.
"""

import os
import select
import signal
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from aftbed.bench.rounds import ROUNDS, InRounds, become_node, beside_limit, cores, shares, together
from aftbed.bench.runs import (
    POLL_SECONDS,
    Percentiles,
    endless_run,
    percentiles,
    wait_for,
    wait_until_at_rest,
)
from aftbed.core.errors import HarnessError
from aftbed.core.progress import Show, unshown
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.judge.checks import failovers
from aftbed.runtime.unix import control_client, interrupts, linux
from aftbed.runtime.unix.options import Turns

REDUNDANCY_SECONDS_MAX: Final = 5.0
PAUSE_SECONDS: Final = 0.01  # of undisturbed service before a kill
DEATH_SECONDS_MAX: Final = 5.0
TURN_NS: Final = 40_000_000  # a death takes half of it, with its forks, and a client that waits is not hung
OF_LOAD, OF_DEATHS = Turns(TURN_NS, 0, 3), Turns(TURN_NS, 2, 3)  # between them the backup catches up
DEATH: Final = "SIGKILL to a pidfd readable elsewhere"
PARTS: Final = ("detection", "fencing", "promotion", "first_reply")


class RecoveryResult(InRounds, frozen=True):
    """The document of `aftbed bench recovery`; `after_detection_ms`: from the alarm on."""

    ftm: str
    placement: str
    kills: int
    recovery_ms: Percentiles
    after_detection_ms: Percentiles
    parts_ms: dict[str, Percentiles]
    death_ms: Percentiles


class _Recovery(NamedTuple):
    """One of them (ms): the whole, and its parts in the order of PARTS."""

    whole_ms: float
    parts_ms: tuple[float, float, float, float]


def bench_recovery(
    ftm: str, placement: str, kills: int, *, pin: bool = True, rounds: int = ROUNDS, show: Show = unshown
) -> RecoveryResult:
    """Kill the primary `kills` times. Raises HarnessError."""
    share = shares(kills, rounds)
    found = together(
        len(share), lambda number: _recoveries_and_deaths(ftm, placement, share[number], pin=pin), show
    )
    recoveries = [one for values in found.figures for one in values]
    parts = {name: [one.parts_ms[n] for one in recoveries] for n, name in enumerate(PARTS)}
    beside = beside_limit(DEATH, [[one.whole_ms for one in values] for values in found.figures], found.limits)
    return RecoveryResult(
        ftm,
        placement,
        kills,
        percentiles([one.whole_ms for one in recoveries]),
        percentiles([one.whole_ms - one.parts_ms[0] for one in recoveries]),
        {name: percentiles(values) for name, values in parts.items()},
        percentiles([ms for values in found.limits for ms in values]),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


def _recoveries_and_deaths(
    ftm: str, placement: str, kills: int, *, pin: bool
) -> tuple[list[_Recovery], list[float]]:
    """Of a run whose primary is killed so often, and as many deaths (ms) in between."""
    deaths_ms = []
    with endless_run(ftm, placement, pin=pin, turns=OF_LOAD) as run:
        epoch = 0
        for _ in range(kills):
            epoch = _redundant_epoch(run.private, epoch)
            deaths_ms.append(death_at_rest_ms(run.private, OF_LOAD, pin=pin))
            time.sleep(PAUSE_SECONDS)
            control_client.ask(
                run.private, control_client.InjectCommand(Fault(Crash(), "primary", Trigger()))
            )
        _redundant_epoch(run.private, epoch)
    found = []
    for f in failovers(run.record.history, run.record.faults):
        if f.detected_ms is None or f.fenced_ms is None or f.promoted_ms is None or f.recovered_ms is None:
            continue
        times = (0.0, f.detected_ms, f.fenced_ms, f.promoted_ms, f.recovered_ms)
        detection, fencing, promotion, first_reply = (after - before for before, after in pairwise(times))
        found.append(_Recovery(f.recovered_ms, (detection, fencing, promotion, first_reply)))
    if len(found) < kills:
        raise HarnessError(f"{kills} kills, but only {len(found)} recoveries in the journals")
    return found, deaths_ms


def death_at_rest_ms(private: Path, of_load: Turns, *, pin: bool) -> float:
    """A death (ms) in one of `OF_DEATHS`, while a run has nothing to do; returns when its load goes on.

    Raises HarnessError.
    """
    wait_until_at_rest(private)
    for turns in (of_load, OF_DEATHS):
        _sleep_until(turns)
    found_ms = death_ms(pin=pin)
    _sleep_until(of_load)
    return found_ms


def _sleep_until(turns: Turns) -> None:
    """Return in one of them."""
    time.sleep(turns.left_ns(time.monotonic_ns()) / 1e9)


def _redundant_epoch(private: Path, after: int) -> int:
    """The epoch in which two replicas serve, a later one than `after`.

    An earlier kill may have hit a leader that had no backup yet.
    """

    def reached(status: dict[str, object]) -> bool:
        return int(str(status["epoch"])) > after and bool(status["backup"]) and not status["busy"]

    return int(str(wait_for(private, reached, REDUNDANCY_SECONDS_MAX, "redundancy")["epoch"]))


def death_ms(*, pin: bool = True) -> float:
    """From SIGKILL of a process to its pidfd being readable in another process. Raises HarnessError."""
    here, there = cores(pin=pin)
    parent = os.getpid()
    reader, writer = os.pipe()
    children = []
    try:
        victim = _child(parent, partial(_be_victim, here))
        children.append(victim)
        children.append(_child(parent, partial(_watch_death, victim, writer, there)))
        _read_time(reader)  # it is about to poll
        time.sleep(POLL_SECONDS)
        killed_ns = time.monotonic_ns()
        os.kill(victim, signal.SIGKILL)
        return (_read_time(reader) - killed_ns) / 1e6
    finally:
        os.close(reader)
        os.close(writer)
        for child in children:  # not reaped yet, so the pid is still its own
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _child(parent: int, work: Callable[[], None]) -> int:
    """Fork a process that does `work` and exits; it dies with `parent`."""
    pid = interrupts.fork()
    if pid == 0:
        try:
            linux.die_with(parent)
            work()
        finally:
            os._exit(0)
    return pid


def _be_victim(cpu: int | None) -> None:
    """As a node of the leader's chain that waits for a message."""
    become_node(cpu)
    signal.pause()


def _watch_death(victim: int, writer: int, cpu: int | None) -> None:
    """Write the time when the watch begins, and the time of the death (monotonic ns, 8 bytes each).

    It runs as a Watchdog does: on another core than the victim, with short slices.
    """
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    linux.use_short_slices()
    poll = select.poll()
    poll.register(os.pidfd_open(victim), select.POLLIN)
    os.write(writer, time.monotonic_ns().to_bytes(8, "little"))
    if poll.poll(DEATH_SECONDS_MAX * 1e3):
        os.write(writer, time.monotonic_ns().to_bytes(8, "little"))


def _read_time(reader: int) -> int:
    if not select.select([reader], [], [], DEATH_SECONDS_MAX)[0]:
        raise HarnessError(f"no process reported a death within {DEATH_SECONDS_MAX:g} s")
    return int.from_bytes(os.read(reader, 8), "little")
