"""What a run costs: its start, and at work its CPU, memory and processes.

CPU and memory are those of the graph with the supervisor, and those of all other processes apart.

Placements are compared side by side, because the paper's complaint is processes that do almost nothing. In
`process` each brick is a process, as in the paper; in `replica` a replica is one; in `single` both replicas
are one process, so that no replica survives its crash. CPU and memory are measured at the rate of the radar,
and at one request a second, which is as good as idle (a load that pauses for longer is taken for dead).

CPU is the time that the scheduler has given to each process over a window, in nanoseconds
(/proc/PID/schedstat): the ticks of /proc/PID/stat are 10 ms long, which is more than most nodes use in a
second. Memory is PSS (proc(5), smaps_rollup), which shares a page among the processes that map it, so that a
sum over processes is honest.

A start is measured as a user would make it, in an interpreter of its own: `launch_ms` to the first reply, and
`graph_ms` of it from a warm zygote with parked spares to the answer of the last node. `imports_ms` is the
limit: an interpreter that only imports the libraries that a run needs. The help page is measured with it,
beside an interpreter that only imports typer. Each round starts all four once.
"""

import json
import os
import time
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from aftbed.bench.cycle import ring_p50_us
from aftbed.bench.rounds import ROUNDS, BesideLimit, InRounds, MachineWatch, Meanwhile, beside_limit, in_turn
from aftbed.bench.runs import (
    STOPPED,
    Percentiles,
    cpu_ns,
    endless_run,
    finished,
    latencies_us,
    percentiles,
    run_python,
    wait_for,
    wait_until_at_rest,
    wait_until_ready,
)
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.core.progress import Show, unshown
from aftbed.judge.record import RunRecord, read_record
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.control_client import ProcessRow, measured
from aftbed.runtime.unix.interrupts import scratch_directory
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import CarRun

RADAR_HZ: Final = 50.0
IDLE_HZ: Final = 1.0
WINDOW_PERIODS_MIN: Final = 1.2
START_SECONDS_MAX: Final = 10.0
IDLE_SECONDS: Final = 3.0  # of a run that has nothing to do
SETTLE_SECONDS: Final = 1.5  # of driving before the look, so that the pages that work touches are counted
ASLEEP_PERCENT: Final = 0.5  # of one core: a node below it does almost nothing
NO_CRASH: Final = "single"  # the placement in which both replicas die at once
RUN_SECONDS_MAX: Final = 30.0
DRIVE: Final = ("--pace", "max", "--scenario", "free-drive", "--duration", "500ms")  # to the first reply
START_RUNS: Final = 4 * ROUNDS  # the times of two imports differ by a third
# Without asammdf, which a run does not import either, wherever it is installed.
IMPORTS: Final = "from aftbed.vehicle.can import python_can; import cantools, msgspec, typer"
HELP_IMPORTS: Final = "import typer"


class Usage(msgspec.Struct, frozen=True):
    """`cpu_percent` is of one core, over `seconds`.

    `processes` are those of the graph and the supervisor: the paper's count. `asleep` is how many of them
    used less than ASLEEP_PERCENT. `others_*` are the zygotes and spares.
    """

    seconds: float
    processes: int
    asleep: int
    cpu_percent: float
    pss_mb: float
    others: int
    others_cpu_percent: float
    others_pss_mb: float


class LoadResult(msgspec.Struct, frozen=True):
    """A window of a run at a fixed rate. Latency is of the requests sent in it, as the client saw them."""

    ftm: str
    placement: str
    rate_hz: float
    requests: int
    sent_hz: float
    latency_ms: Percentiles
    ring_us: float  # p50 of a ring of as many hops, in a closed loop
    usage: Usage


class MemoryOfOthers(msgspec.Struct):
    """Of all processes of one name."""

    processes: int = 0
    pss_mb: float = 0.0


class MemoryResult(msgspec.Struct, frozen=True):
    """The document of `aftbed bench memory`; `others`: zygotes, spares, hub, vehicle and command.

    `idle_cpu_percent` is of one core, of the graph's processes at one request a second.
    """

    ftm: str
    placement: str
    processes: int
    pss_mb: float
    rss_mb: float
    idle_cpu_percent: float
    others: dict[str, MemoryOfOthers]
    machine: Meanwhile


def bench_memory(ftm: str, placement: str, show: Show = unshown) -> MemoryResult:
    """Memory of a car's drive, when it has settled; CPU of a run that is idle. Raises HarnessError."""
    watch = MachineWatch()
    options, listener = options_for(ftm=ftm, placement=placement, work=CarRun("free-drive", 1.0, "latch"))
    launched = launch(options, listener)
    try:
        wait_for(launched.private, lambda status: status.get("vehicle"), START_SECONDS_MAX, "drive")
        time.sleep(SETTLE_SECONDS)
        rows = control_client.processes(launched.private)
        rows = measured([*rows, ProcessRow("command", "command", os.getpid(), False)])
    finally:
        launched.stop()
        finished(launched, STOPPED[:1])
    show(1, 2)
    nodes = [row for row in rows if row.node]
    others: dict[str, MemoryOfOthers] = {}
    for row in rows:
        if not row.node:
            found = others.setdefault(row.name, MemoryOfOthers())
            found.processes += 1
            found.pss_mb = round(found.pss_mb + row.pss_mb, 1)
    pss_mb, rss_mb = sum(row.pss_mb for row in nodes), sum(row.rss_mb for row in nodes)
    sizes = round(pss_mb, 1), round(rss_mb, 1)
    with endless_run(ftm, placement, IDLE_HZ) as run:
        wait_until_ready(run.private)
        wait_until_at_rest(run.private)
        idle, _, _ = _usage(run.private, IDLE_SECONDS)
    return MemoryResult(ftm, placement, len(nodes), *sizes, idle.cpu_percent, others, watch.found())


def process_count(ftm: str, placement: str) -> int:
    """The nodes and the supervisor of a run that serves: the paper's count."""
    with endless_run(ftm, placement, RADAR_HZ) as run:
        wait_until_ready(run.private)
        return sum(row.node for row in control_client.processes(run.private))


def under_load(ftm: str, placement: str, rate_hz: float, seconds: float) -> LoadResult:
    """Run `ftm` at `rate_hz` requests a second, and measure `seconds` of it."""
    bare_us = ring_p50_us(ftm, placement)
    with endless_run(ftm, placement, rate_hz) as run:
        wait_until_ready(run.private)
        found, began_ns, ended_ns = _usage(run.private, max(seconds, WINDOW_PERIODS_MIN / rate_hz))
    latency_us = latencies_us(run.record, began_ns=began_ns, ended_ns=ended_ns)
    if not latency_us:
        raise HarnessError(
            f"{ftm} ({placement}) at {rate_hz:g} Hz: {_silence(run.record, began_ns, ended_ns)}"
        )
    return LoadResult(
        ftm,
        placement,
        rate_hz,
        len(latency_us),
        round(len(latency_us) / found.seconds, 1),
        percentiles([us / 1e3 for us in latency_us]),
        bare_us,
        found,
    )


def _silence(record: RunRecord, began_ns: int, ended_ns: int) -> str:
    """Why a load has no latency to show: what it sent, and how long a node had no CPU."""
    sent_ns = [event.t_ns for event in record.history.events(Event.REQUEST_SENT)]
    within = sum(began_ns <= t_ns < ended_ns for t_ns in sent_ns)
    waited = f", and a node waited {record.end.starved_ms:g} ms for a CPU" if record.end is not None else ""
    seconds = (ended_ns - began_ns) / 1e9
    return (
        f"in {seconds:.3f} s {within} of its {len(sent_ns)} requests were sent, and none of these was"
        f" answered{'; the service was lost' if record.lost else ''}{waited}; measure again, with less"
        " beside it"
    )


def _usage(private: Path, seconds: float) -> tuple[Usage, int, int]:
    """The usage of the run in the next `seconds`; and when that began and ended (monotonic ns)."""
    rows = control_client.processes(private)
    before, began_ns = cpu_ns(rows), time.monotonic_ns()
    time.sleep(seconds)  # the measured window
    after, ended_ns = cpu_ns(rows), time.monotonic_ns()
    shares = {pid: 100 * (after[pid] - before[pid]) / (ended_ns - began_ns) for pid in after if pid in before}
    nodes = [row for row in rows if row.node]
    if missing := [row.name for row in nodes if row.pid not in shares]:
        raise HarnessError(f"died while it was measured: {', '.join(missing)}")
    pss_mb = {row.pid: row.pss_mb for row in measured(rows)}
    others = [row for row in rows if not row.node and row.pid in shares]
    found = Usage(
        seconds=round((ended_ns - began_ns) / 1e9, 3),
        processes=len(nodes),
        asleep=sum(shares[row.pid] < ASLEEP_PERCENT for row in nodes),
        cpu_percent=_sum(shares, nodes, 2),
        pss_mb=_sum(pss_mb, nodes, 1),
        others=len(others),
        others_cpu_percent=_sum(shares, others, 2),
        others_pss_mb=_sum(pss_mb, others, 1),
    )
    return found, began_ns, ended_ns


def _sum(values: dict[int, float], rows: list[ProcessRow], digits: int) -> float:
    return round(sum(values.get(row.pid, 0.0) for row in rows), digits)


# -- start ----------------------------------------------------------------------------------------


class StartTime(msgspec.Struct, frozen=True):
    """ms."""

    p50: float
    max: float


class HelpResult(BesideLimit, frozen=True):
    """Of `aftbed --help`; the limit is `python -c "import typer"`."""

    help_ms: StartTime


class LaunchResult(InRounds, frozen=True):
    """The document of `aftbed bench launch`; `ratio` is that of `launch_ms`."""

    ftm: str
    placement: str
    runs: int
    launch_ms: StartTime
    graph_ms: StartTime
    imports_ms: StartTime
    help: HelpResult


class _Start(NamedTuple):
    """Of the command up to the first reply, of its graph alone, and of the help page (ms)."""

    launch_ms: float
    graph_ms: float
    help_ms: float


def bench_launch(ftm: str, placement: str, runs: int, show: Show = unshown) -> LaunchResult:
    """Start `aftbed run` and its help page so many times, a round each. Raises HarnessError."""

    def start(number: int) -> _Start:
        return _Start(*_launched_ms(ftm, placement), _python_ms("-m", "aftbed", "--help"))

    def limits(number: int) -> tuple[float, float]:
        return _python_ms("-c", IMPORTS), _python_ms("-c", HELP_IMPORTS)

    found = in_turn(runs, start, limits, show=show)
    launches, graphs, helps = ([one[n] for one in found.figures] for n in range(3))
    imports, typers = ([one[n] for one in found.limits] for n in range(2))
    beside = beside_limit("import of its libraries", _alone(launches), _alone(imports))
    beside_help = beside_limit("import of typer", _alone(helps), _alone(typers))
    return LaunchResult(
        ftm,
        placement,
        runs,
        _start_time(launches),
        _start_time(graphs),
        _start_time(imports),
        HelpResult(_start_time(helps), limit=beside_help.limit, ratio=beside_help.ratio),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


def _alone(values: list[float]) -> list[list[float]]:
    """Rounds of one value each."""
    return [[value] for value in values]


def _start_time(values: list[float]) -> StartTime:
    return StartTime(round(quantile(values, 0.5), 1), round(max(values), 1))


def _launched_ms(ftm: str, placement: str) -> tuple[float, float]:
    """To the first reply, and of the graph alone."""
    with scratch_directory("aftbed-bench-") as folder:
        directory = folder / "record"
        began_ns = time.monotonic_ns()
        arguments = ["-m", "aftbed", "run", "--ftm", ftm, "--placement", placement, *DRIVE]
        run_python([*arguments, "--record", str(directory), "--json"], RUN_SECONDS_MAX)
        dialogue = read_record(directory).history.dialogue
        first_ns = next((e.t_ns for e in dialogue if e.kind is EntryKind.ANSWERED), None)
        if first_ns is None:
            raise HarnessError("aftbed run passed without an answered request")
        graph_ms = json.loads((directory / "end.json").read_text())["graph_ms"]
    return (first_ns - began_ns) / 1e6, float(graph_ms)


def _python_ms(*arguments: str) -> float:
    """How long an interpreter with these arguments takes."""
    began_ns = time.monotonic_ns()
    run_python(list(arguments), RUN_SECONDS_MAX)
    return (time.monotonic_ns() - began_ns) / 1e6
