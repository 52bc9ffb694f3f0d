"""Memory of a run at work: the processes of the graph and the supervisor, and all others apart.

PSS shares a page among those that map it (proc(5), smaps_rollup); the sum over processes is honest.
"""

import os
import time
from pathlib import Path
from typing import Final

from aftbed.bench.runs import finish
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import CarRun
from aftbed.runtime.unix.resources import Row, measured

START_SECONDS_MAX: Final = 10.0
SETTLE_SECONDS: Final = 1.5  # of driving before the look, so that pages that work touches are counted


def bench_memory(ftm: str, placement: str) -> dict[str, object]:
    """`processes, pss_mb, rss_mb` of the graph and the supervisor, `others{}` by name."""
    options, listener = options_for(ftm=ftm, placement=placement, work=CarRun("free-drive", 1.0, "latch"))
    launched = launch(options, listener)
    try:
        rows = _look(launched.private)
    finally:
        launched.stop()
        finish(launched, ends=("interrupted",))
    nodes = [row for row in rows if row.node]
    others: dict[str, dict[str, float]] = {}
    for row in rows:
        if not row.node:
            found = others.setdefault(row.name, {"processes": 0, "pss_mb": 0.0})
            found["processes"] += 1
            found["pss_mb"] = round(found["pss_mb"] + row.pss_mb, 1)
    return {
        "ftm": ftm,
        "placement": placement,
        "processes": len(nodes),
        "pss_mb": round(sum(row.pss_mb for row in nodes), 1),
        "rss_mb": round(sum(row.rss_mb for row in nodes), 1),
        "others": others,
    }


def _look(private: Path) -> list[Row]:
    limit = time.monotonic() + START_SECONDS_MAX
    while time.monotonic() < limit:
        try:
            status = control_client.ask(private, control_client.Status())
        except ConfigError:
            status = {}
        if status.get("vehicle"):
            time.sleep(SETTLE_SECONDS)
            rows = control_client.processes(private)
            rows.append(Row("command", "command", os.getpid(), False))
            return measured(rows)
        time.sleep(0.02)
    raise HarnessError(f"the car does not drive after {START_SECONDS_MAX} s")
