"""What the zygotes import, and so every node: each module is memory of all processes of a run."""

import subprocess
import sys

import pytest

NOT_IN_A_NODE = {
    *("typer", "pydantic", "rich", "yaml", "jinja2", "numpy", "scipy", "matplotlib", "psutil", "asammdf"),
    *("multiprocessing", "aftbed.runtime.unix.launch", "aftbed.runtime.unix.supervisor"),
}


@pytest.mark.parametrize(
    ("zygote", "too"),
    [
        ("zygote", {"can", "cantools", "email", "threading", "logging", "argparse", "subprocess"}),
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
