"""CPU and memory of the processes of a run, by psutil."""

import time
from typing import Final

import msgspec

CPU_SAMPLE_SECONDS: Final = 0.2


class ProcessRow(msgspec.Struct, frozen=True):
    """A process of a run; `node`: one of the graph, or the supervisor."""

    name: str
    role: str
    pid: int
    node: bool
    cpu_percent: float = 0.0
    pss_mb: float = 0.0
    rss_mb: float = 0.0


def measured(rows: list[ProcessRow]) -> list[ProcessRow]:
    """`rows` with CPU over a short while, PSS and RSS; those that have gone meanwhile are left out."""
    import psutil  # noqa: PLC0415 - 15 ms that nobody else needs

    alive = []
    for row in rows:
        try:
            process = psutil.Process(row.pid)
            process.cpu_percent()
            alive.append((row, process))
        except psutil.Error:
            continue
    time.sleep(CPU_SAMPLE_SECONDS)  # what is sampled, not what is waited for
    found = []
    for row, process in alive:
        try:
            memory, cpu = process.memory_full_info(), process.cpu_percent()
        except psutil.Error:
            continue
        found.append(
            msgspec.structs.replace(
                row,
                cpu_percent=cpu,
                pss_mb=round(memory.pss / 1e6, 2),
                rss_mb=round(memory.rss / 1e6, 2),
            )
        )
    return found
