"""What a run takes of the machine while it works: CPU and memory, of its graph and of all else.

CPU is the time that the scheduler has given to each process over a window, in nanoseconds
(/proc/PID/schedstat): the ticks of /proc/PID/stat are 10 ms long, which is more than most nodes take in a
second. Memory is PSS, which shares a page among those that map it, so that a sum over processes is honest.
"""

import time
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.resources import Row, measured

ASLEEP_PERCENT: Final = 0.5  # of one core: a node that takes less does next to nothing


class Usage(msgspec.Struct, frozen=True):
    """`cpu_percent` is of one core, over `seconds`.

    `processes` are those of the graph and the supervisor: the paper's count. `asleep` of them took less than
    ASLEEP_PERCENT. `others_*` are what stands beside them: zygotes and spares.
    """

    seconds: float
    processes: int
    asleep: int
    cpu_percent: float
    pss_mb: float
    others: int
    others_cpu_percent: float
    others_pss_mb: float


def usage(private: Path, seconds: float) -> tuple[Usage, int, int]:
    """What the run in `private` takes in the next `seconds`; and when that began and ended (monotonic ns)."""
    rows = control_client.processes(private)
    before, began_ns = _cpu_ns(rows), time.monotonic_ns()
    time.sleep(seconds)  # what is measured, not what is waited for
    after, ended_ns = _cpu_ns(rows), time.monotonic_ns()
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


def _sum(values: dict[int, float], rows: list[Row], digits: int) -> float:
    return round(sum(values.get(row.pid, 0.0) for row in rows), digits)


def _cpu_ns(rows: list[Row]) -> dict[int, int]:
    """The CPU time of each process that is still there; each has one thread."""
    found = {}
    for row in rows:
        try:
            found[row.pid] = int(Path(f"/proc/{row.pid}/schedstat").read_text().split()[0])
        except (FileNotFoundError, ProcessLookupError):
            continue
    if rows and not found:
        raise HarnessError("no /proc/PID/schedstat: this kernel does not tell CPU times (CONFIG_SCHED_INFO)")
    return found
