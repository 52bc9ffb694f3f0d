"""From SIGKILL of the primary to the next good reply, in a closed loop: one request always waits.

Each kill takes the whole replica (all nodes of its chain), as the crash of an ECU would. The next kill
waits until redundancy is back. Times are from the journals, whose clock is common to all processes.

`death_ms` is the limit of any detection: from SIGKILL of a process to the moment at which another one that
polls its pidfd sees that it is dead. It is measured in the same command, before and after the kills.
"""

import os
import select
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.bench.runs import POLL_SECONDS, Percentiles, endless_run, percentiles, wait_for
from aftbed.core.errors import HarnessError
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.judge.checks import failovers
from aftbed.runtime.unix import control_client, linux

REDUNDANCY_SECONDS_MAX: Final = 5.0
PAUSE_SECONDS: Final = 0.02  # of undisturbed service between two kills
DEATH_SECONDS_MAX: Final = 5.0
DEATHS: Final = 25  # before the kills, and as many after them


class RecoveryResult(msgspec.Struct, frozen=True):
    """The document of `aftbed bench recovery`; `after_detection_ms`: from the alarm on."""

    ftm: str
    placement: str
    kills: int
    recovery_ms: Percentiles
    after_detection_ms: Percentiles
    parts_ms: dict[str, Percentiles]
    death_ms: Percentiles


def bench_recovery(ftm: str, placement: str, kills: int, *, pin: bool = True) -> RecoveryResult:
    """Kill the primary `kills` times. Raises HarnessError."""
    deaths = [death_ms() for _ in range(DEATHS)]
    with endless_run(ftm, placement, pin=pin) as run:
        epoch = 0
        for number in range(kills + 1):
            epoch = _redundant_epoch(run.private, epoch)
            time.sleep(PAUSE_SECONDS)
            if number < kills:
                control_client.ask(
                    run.private, control_client.InjectCommand(Fault(Crash(), "primary", Trigger()))
                )
    deaths += [death_ms() for _ in range(DEATHS)]
    parts: dict[str, list[float]] = {"detection": [], "fencing": [], "promotion": [], "first_reply": []}
    recovered = []
    for f in failovers(run.record.history, run.record.faults):
        if f.detected_ms is None or f.fenced_ms is None or f.promoted_ms is None or f.recovered_ms is None:
            continue
        recovered.append(f.recovered_ms)
        parts["detection"].append(f.detected_ms)
        parts["fencing"].append(f.fenced_ms - f.detected_ms)
        parts["promotion"].append(f.promoted_ms - f.fenced_ms)
        parts["first_reply"].append(f.recovered_ms - f.promoted_ms)
    if len(recovered) < kills:
        raise HarnessError(f"{kills} kills, but only {len(recovered)} recoveries in the journals")
    return RecoveryResult(
        ftm,
        placement,
        kills,
        percentiles(recovered),
        percentiles([r - d for r, d in zip(recovered, parts["detection"], strict=True)]),
        {name: percentiles(values) for name, values in parts.items()},
        percentiles(deaths),
    )


def _redundant_epoch(private: Path, after: int) -> int:
    """The epoch in which two replicas serve, a later one than `after`.

    An earlier kill may have hit a leader that had no backup yet.
    """

    def reached(status: dict[str, object]) -> bool:
        return int(str(status["epoch"])) > after and bool(status["backup"]) and not status["busy"]

    return int(str(wait_for(private, reached, REDUNDANCY_SECONDS_MAX, "redundancy")["epoch"]))


def death_ms() -> float:
    """From SIGKILL of a process to its pidfd being readable in another process. Raises HarnessError."""
    parent = os.getpid()
    reader, writer = os.pipe()
    children = []
    try:
        victim = _child(parent, signal.pause)
        children.append(victim)
        children.append(_child(parent, lambda: _watch_death(victim, writer)))
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
    pid = os.fork()
    if pid == 0:
        try:
            linux.die_with(parent)
            work()
        finally:
            os._exit(0)
    return pid


def _watch_death(victim: int, writer: int) -> None:
    """Write the time when the watch begins, and the time of the death (monotonic ns, 8 bytes each)."""
    poll = select.poll()
    poll.register(os.pidfd_open(victim), select.POLLIN)
    os.write(writer, time.monotonic_ns().to_bytes(8, "little"))
    if poll.poll(DEATH_SECONDS_MAX * 1e3):
        os.write(writer, time.monotonic_ns().to_bytes(8, "little"))


def _read_time(reader: int) -> int:
    if not select.select([reader], [], [], DEATH_SECONDS_MAX)[0]:
        raise HarnessError(f"no process reported a death within {DEATH_SECONDS_MAX:g} s")
    return int.from_bytes(os.read(reader, 8), "little")
