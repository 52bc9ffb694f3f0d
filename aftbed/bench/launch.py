"""The time from the start of the command to the first reply, and that of the graph alone.

The command is started as a user would start it, in an interpreter of its own. `graph_ms` is the time from a
warm zygote with parked spares to the answer of the last node. `imports_ms` is the limit: an interpreter that
only imports the libraries that a run needs, started in turn with the command.
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
IMPORTS: Final = "import can, cantools, msgspec, typer"


def bench_launch(ftm: str, placement: str, runs: int) -> dict[str, object]:
    """`launch_ms{p50,max}`, `graph_ms{...}` and `imports_ms{...}` of `runs` starts of `aftbed run`."""
    found: dict[str, list[float]] = {"launch_ms": [], "graph_ms": [], "imports_ms": []}
    for _ in range(runs):
        for name, value in zip(found, (*_once(ftm, placement), _imports_ms()), strict=True):
            found[name].append(value)
    about: dict[str, object] = {"ftm": ftm, "placement": placement, "runs": runs}
    return about | {name: _p50_max(values) for name, values in found.items()}


def _imports_ms() -> float:
    began_ns = time.monotonic_ns()
    subprocess.run([sys.executable, "-c", IMPORTS], timeout=RUN_SECONDS_MAX, check=True)
    return (time.monotonic_ns() - began_ns) / 1e6


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
