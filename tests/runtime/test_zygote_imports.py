"""What processes import: zygotes, whose modules are memory of all nodes, and the process of a function."""

import subprocess
import sys

import pytest

NOT_IN_A_NODE = {
    *("typer", "pydantic", "rich", "yaml", "jinja2", "numpy", "scipy", "matplotlib", "psutil", "asammdf"),
    *("multiprocessing", "aftbed.runtime.unix.launch", "aftbed.runtime.unix.supervisor"),
}

OF_THE_BUS = {"can", "cantools", "email", "threading", "logging", "argparse", "subprocess"}


@pytest.mark.parametrize(
    ("zygote", "too"),
    [
        ("zygote", {*OF_THE_BUS, *("hashlib", "secrets", "difflib", "shutil", "tempfile")}),
        ("zygote.bus", set[str]()),
    ],
)
def test_a_zygote_imports_what_its_processes_need(zygote: str, too: set[str]) -> None:
    code = (
        f"import sys; from aftbed.runtime.unix import zygote; zygote.preload({zygote!r}); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    rooms = {name.split(".")[1] for name in modules if name.startswith("aftbed.")}
    assert not modules & (NOT_IN_A_NODE | too)
    assert not rooms & {"cli", "bench", "report", "interop", "campaign", "search", "judge", "api"}
    assert ("cantools" in modules) == (zygote == "zygote.bus")


def test_a_worker_of_real_experiments_imports_what_they_need() -> None:
    """Each process of each run is a fork of it: `threading` alone has each do half a millisecond of work."""
    code = "import sys; from aftbed.campaign import runner; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert not modules & {*NOT_IN_A_NODE, *OF_THE_BUS, "zipfile"} - {"aftbed.runtime.unix.launch"}
    rooms = {name.split(".")[1] for name in modules if name.startswith("aftbed.")}
    assert not rooms & {"cli", "bench", "report", "interop", "search", "api"}
    assert "aftbed.runtime.sim.world" not in modules


def test_the_process_of_a_function_imports_what_executes_it() -> None:
    """Without the reader of records, and the runtime with it, it starts in half the time."""
    code = "import sys, aftbed.judge.execution; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    runtime = {name for name in modules if name.startswith("aftbed.runtime.unix.")}
    assert runtime == {f"aftbed.runtime.unix.{name}" for name in ("confined", "linux", "trust")}
    assert "aftbed.judge.record" not in modules and not any("aftbed.inject" in name for name in modules)
