"""The time from the start of the command to the first reply, and that of the graph alone.

The command is started as a user would start it, in an interpreter of its own. `graph_ms` is the time from a
warm zygote with parked spares to the answer of the last node.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.journal import EntryKind
from aftbed.judge.record import read_record

RUN_SECONDS_MAX: Final = 30.0


def bench_launch(ftm: str, placement: str, runs: int) -> dict[str, object]:
    """`launch_ms{p50,max}` and `graph_ms{p50,max}` of `runs` starts of `aftbed run`."""
    launches: list[float] = []
    graphs: list[float] = []
    for _ in range(runs):
        launch_ms, graph_ms = _once(ftm, placement)
        launches.append(launch_ms)
        graphs.append(graph_ms)
    return {
        "ftm": ftm,
        "placement": placement,
        "runs": runs,
        "launch_ms": _p50_max(launches),
        "graph_ms": _p50_max(graphs),
    }


def _p50_max(values: list[float]) -> dict[str, float]:
    return {"p50": round(quantile(values, 0.5), 1), "max": round(max(values), 1)}


def _once(ftm: str, placement: str) -> tuple[float, float]:
    with tempfile.TemporaryDirectory(prefix="aftbed-bench-") as folder:
        directory = Path(folder) / "record"
        began_ns = time.monotonic_ns()
        arguments = [sys.executable, "-m", "aftbed", "run", "--ftm", ftm, "--placement", placement]
        arguments += ["--pace", "max", "--scenario", "ccrs-20", "--record", str(directory), "--json"]
        done = subprocess.run(arguments, capture_output=True, timeout=RUN_SECONDS_MAX, check=False)
        if done.returncode != 0:
            raise HarnessError(f"aftbed run ended with {done.returncode}: {done.stderr.decode()[-500:]}")
        record = read_record(directory)
        first_ns = next(e.t_ns for e in record.history.dialogue if e.kind is EntryKind.ANSWERED)
        graph_ms = json.loads((directory / "end.json").read_text())["graph_ms"]
    return (first_ns - began_ns) / 1e6, float(graph_ms)
