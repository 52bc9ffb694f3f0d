"""Runs under a synthetic load, without a car, and the times in their records: what the benches share."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import msgspec

from aftbed.campaign.statistics import quantile
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.events import Event
from aftbed.functions.request_file import GivenRequests
from aftbed.judge.record import RunRecord, read_record
from aftbed.runtime.run_controller import RESTOCK_SECONDS
from aftbed.runtime.unix import control_client, interrupts, linux
from aftbed.runtime.unix.control_client import ProcessRow
from aftbed.runtime.unix.launch import Launched, launch, options_for
from aftbed.runtime.unix.options import LoadRun, Turns

REQUESTS_ENDLESS: Final = 10_000_000
READY_SECONDS_MAX: Final = 10.0
POLL_SECONDS: Final = 0.005
PAUSE_SECONDS: Final = 0.05  # of undisturbed service, between two things that are measured
REST_SECONDS_MAX: Final = 10.0  # until the spares of a run have been forked
LOOK_SECONDS: Final = RESTOCK_SECONDS + 0.01  # between two looks whether they have
STOPPED: Final = ("interrupted", "")  # how an endless run may end
TRIES: Final = 3
CHILD_END_SECONDS_MAX: Final = 0.7  # of a command that is interrupted; then its warden cleans up

Log = Callable[[str], None]
Found = TypeVar("Found")


class Percentiles(msgspec.Struct, frozen=True):
    """Quantiles of a sample, by nearest rank."""

    p50: float
    p95: float
    p99: float
    max: float


def percentiles(values: list[float], digits: int = 3) -> Percentiles:
    """Of `values`, rounded."""
    return Percentiles(*(round(quantile(values, share), digits) for share in (0.5, 0.95, 0.99, 1.0)))


def tried(what: str, measure: Callable[[], Found], log: Log) -> Found:
    """What `measure` gives; a busy machine may fail it. Raises HarnessError after TRIES failures."""
    reason = ""
    for _ in range(TRIES):
        log(f"{what}, again ({reason})" if reason else what)
        try:
            return measure()
        except (HarnessError, ConfigError) as error:  # a run that died refuses like one that never was
            if interrupts.came():
                raise
            reason = str(error)
    raise HarnessError(f"{what}: failed {TRIES} times, the last time: {reason}")


class CommandFailedError(HarnessError):
    """An interpreter that ended with another exit code than 0."""

    def __init__(self, command: str, code: int, last_words: str) -> None:
        super().__init__(f"{command}: exit code {code}: {last_words}")
        self.code, self.last_words = code, last_words


def run_python(
    arguments: list[str],
    seconds_max: float,
    *,
    python: str = sys.executable,
    folder: str | None = None,
    environment: Mapping[str, str] | None = None,
) -> bytes:
    """The output of an interpreter with `arguments`, which dies with this process.

    Raises CommandFailedError on a failure, HarnessError on a timeout.
    """
    command = " ".join(["python", *arguments])
    with contextlib.ExitStack() as standing:
        with interrupts.uninterrupted():
            child = standing.enter_context(
                subprocess.Popen(
                    [python, *arguments],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    cwd=folder,
                    env=environment,
                    preexec_fn=partial(_begin, os.getpid()),  # noqa: PLW1509 - a bench has no threads
                )
            )
            standing.callback(_end, child)
        try:
            out, err = child.communicate(timeout=seconds_max)
        except subprocess.TimeoutExpired:
            raise HarnessError(f"{command}: not ended after {seconds_max:g} s") from None
    if child.returncode != 0:
        raise CommandFailedError(command, child.returncode, err.decode(errors="replace")[-500:].strip())
    return out


def _begin(parent: int) -> None:
    """In the child: die with the bench, and receive its interrupts."""
    linux.die_with(parent)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _end(child: "subprocess.Popen[bytes]") -> None:
    """Let a command that has not ended clean up as behind Ctrl-C; kill it if it takes too long."""
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGINT)
    try:
        child.wait(CHILD_END_SECONDS_MAX)
    except subprocess.TimeoutExpired:
        pass
    finally:
        child.kill()


# -- runs -----------------------------------------------------------------------------------------


def limited_run(
    ftm: str,
    placement: str,
    count: int,
    *,
    pin: bool,
    application: str = "",
    given: GivenRequests | None = None,
    turns: Turns | None = None,
) -> RunRecord:
    """The record of a run of `count` requests in a closed loop; see `RunOptions` and `LoadRun`."""
    load = LoadRun(count, 0.0, given.source if given is not None else "", turns=turns)
    return finished(_start(ftm, placement, load, pin, application, given), ends=("",))


class EndlessRun:
    """A run under an endless load; `record` is there when it has ended."""

    record: RunRecord

    def __init__(self, private: Path) -> None:
        self.private = private


@contextlib.contextmanager
def endless_run(
    ftm: str,
    placement: str,
    rate_hz: float = 0.0,
    *,
    application: str = "",
    pin: bool = True,
    turns: Turns | None = None,
) -> Iterator[EndlessRun]:
    """A run at `rate_hz` requests a second (0: a closed loop), stopped at the end of the block."""
    launched = _start(ftm, placement, LoadRun(REQUESTS_ENDLESS, rate_hz, turns=turns), pin, application)
    run = EndlessRun(launched.private)
    try:
        yield run
    except KeyboardInterrupt:  # its record does not matter, nor why it ended
        launched.stop()
        try:
            _follow(launched)
        finally:
            launched.remove()
        raise
    except BaseException:
        launched.stop()
        finished(launched, STOPPED)
        raise
    launched.stop()
    run.record = finished(launched, STOPPED)


def _start(
    ftm: str,
    placement: str,
    load: LoadRun,
    pin: bool,
    application: str = "",
    given: GivenRequests | None = None,
) -> Launched:
    options, listener = options_for(
        ftm=ftm, placement=placement, work=load, faults=(), pin=pin, application=application
    )
    return launch(options, listener, given)


def _follow(launched: Launched) -> None:
    for _ in launched.reports():
        pass
    launched.wait()


def finished(launched: Launched, ends: tuple[str, ...]) -> RunRecord:
    """Follow the run to its end; its record. Raises HarnessError if it ended for another reason."""
    try:
        _follow(launched)
        record = read_record(launched.record, in_memory=True)
        if record.end is None or record.end.reason not in ends:
            reason = "the supervisor died" if record.end is None else record.end.reason
            raise HarnessError(f"a run of the bench ended early: {reason}")
        return record
    finally:
        launched.remove()


def wait_for(
    private: Path, reached: Callable[[dict[str, object]], object], seconds: float, what: str
) -> dict[str, object]:
    """Poll the status of a run until it is `reached`; returns it. Raises HarnessError."""
    limit = time.monotonic() + seconds
    while time.monotonic() < limit:
        with contextlib.suppress(ConfigError):  # still starting
            status = control_client.ask(private, control_client.StatusQuery())
            if reached(status):
                return status
        time.sleep(POLL_SECONDS)
    raise HarnessError(f"no {what} within {seconds:g} s")


def wait_until_ready(private: Path) -> None:
    """Until the run serves with all its replicas. Raises HarnessError."""
    wait_for(private, lambda status: not status["busy"], READY_SECONDS_MAX, "service")
    time.sleep(PAUSE_SECONDS)


def wait_until_at_rest(private: Path) -> None:
    """Until the zygotes and spares of a load sleep, and have not run since the look before.

    Spares are still forked when the graph serves. Raises HarnessError if they do not come to rest.
    """
    limit_s, before = time.monotonic() + REST_SECONDS_MAX, None
    while time.monotonic() < limit_s:
        rows = [row for row in control_client.processes(private) if not row.node]
        asleep, used_ns = all(linux.state_of(row.pid) == "S" for row in rows), cpu_ns(rows)
        if asleep and used_ns == before:
            return
        before = used_ns
        time.sleep(LOOK_SECONDS)
    raise HarnessError(f"zygotes and spares were not at rest within {REST_SECONDS_MAX:g} s")


def cpu_ns(rows: list[ProcessRow]) -> dict[int, int]:
    """The CPU time of each process that is still there; each has one thread."""
    found = {}
    for row in rows:
        try:
            found[row.pid] = int(Path(f"/proc/{row.pid}/schedstat").read_text().split()[0])
        except (FileNotFoundError, ProcessLookupError):
            continue
    if rows and not found:
        raise HarnessError("no /proc/PID/schedstat: this kernel reports no CPU times (CONFIG_SCHED_INFO)")
    return found


class TimedSample(NamedTuple):
    """A request, or whatever else was measured: when it began (monotonic ns), and how long it took."""

    began_ns: int
    us: float


def answered(
    record: RunRecord, *, skip: int = 0, began_ns: int = 0, ended_ns: int | None = None
) -> list[TimedSample]:
    """From request.sent to reply.delivered at the client, of the requests that were sent in that time.

    Without the first `skip` requests, and without those that were not answered.
    """
    sent: dict[int, int] = {}
    found = []
    for event in record.history.events(Event.REQUEST_SENT, Event.REPLY_DELIVERED):
        if event.event is Event.REQUEST_SENT:
            within = began_ns <= event.t_ns and (ended_ns is None or event.t_ns < ended_ns)
            if within and event.request_id > skip:
                sent[event.request_id] = event.t_ns
        elif event.request_id in sent:
            sent_ns = sent[event.request_id]
            found.append(TimedSample(sent_ns, (event.t_ns - sent_ns) / 1e3))
    return found


def latencies_us(
    record: RunRecord, *, skip: int = 0, began_ns: int = 0, ended_ns: int | None = None
) -> list[float]:
    """The times of the requests that `answered` finds."""
    return [one.us for one in answered(record, skip=skip, began_ns=began_ns, ended_ns=ended_ns)]
