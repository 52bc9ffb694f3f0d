"""On what a campaign was run: what a reader asks when the numbers of two of them differ."""

import os
import platform
import shlex
import sys
from pathlib import Path

import msgspec

CPUINFO = Path("/proc/cpuinfo")


class Environment(msgspec.Struct, frozen=True):
    """Of this process: versions, machine, and the command that it was started with."""

    python: str
    kernel: str
    cpus: str
    command: str


def here() -> Environment:
    """That of this process."""
    usable = len(os.sched_getaffinity(0))
    return Environment(
        f"{platform.python_implementation()} {platform.python_version()}",
        f"{platform.system()} {platform.release()}",
        f"{usable} of {os.cpu_count()}, {_cpu_model()}",
        shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    )


def _cpu_model() -> str:
    try:
        lines = CPUINFO.read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
