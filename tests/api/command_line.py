"""The commands of reports, as a person repeats them; pytest with the plugin."""

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

import aftbed

SECONDS_MAX: Final = 120.0
INSTALLED: Final = any(one.name == "aftbed" for one in entry_points(group="pytest11"))
PLUGIN: Final = () if INSTALLED else ("-p", "aftbed.pytest_plugin")
NAMES: Final = """
aftbed() { "$PYTHON" -P -m aftbed "$@"; }
python() { "$PYTHON" "$@"; }
"""


def environment() -> dict[str, str]:
    """In which an interpreter finds this very package, whatever is installed."""
    home = str(Path(aftbed.__file__).parents[1])
    path = os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH", ""))))
    return os.environ | {"PYTHON": sys.executable, "PYTHONPATH": path}


def repeated(command: str) -> subprocess.CompletedProcess[str]:
    """Have a shell do it, in another directory."""
    return called("bash", "-c", f"{NAMES}\n{command}", folder="/")


def called(*words: str, folder: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words,
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        check=False,
    )
