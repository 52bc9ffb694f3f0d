"""Starting zygotes: the first thing that a supervisor does, before it imports what it needs itself."""

import os
import site
import socket
import sys
from pathlib import Path
from typing import Final

from aftbed.runtime.interface import BUS, LIGHT

ZYGOTE: Final = "aftbed.runtime.unix.zygote"
CONTROL_FD: Final = 3
PRELOADS: Final[dict[str, tuple[str, ...]]] = {
    LIGHT: (),
    BUS: (
        "aftbed.runtime.unix.gateway",
        "aftbed.vehicle.drive_real",
        "aftbed.vehicle.replay.player",
        "cantools",
    ),
}

Started = tuple[int, socket.socket]  # the zygote's pid, and our end of its control line


def start_zygote(name: str, cpus: list[int]) -> Started:
    """Start the zygote called `name` as a child of this process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = start(theirs.fileno(), os.getpid(), cpus, PRELOADS[name])
    theirs.close()
    return pid, ours


def start(descriptor: int, supervisor: int, cpus: list[int], preload: tuple[str, ...]) -> int:
    """Start a zygote in a fresh interpreter that serves `descriptor`; its pid.

    A fresh one, since all that its parent has ever imported would weigh on every fork and every death.
    """
    arguments = [sys.executable, "-P", "-m", ZYGOTE, str(supervisor), ",".join(map(str, cpus)), *preload]
    descriptors = [(os.POSIX_SPAWN_DUP2, descriptor, CONTROL_FD)]
    return os.posix_spawn(sys.executable, arguments, environment(), file_actions=descriptors)


def environment() -> dict[str, str]:
    """Where this very package is found; the working directory is not searched (`-P`)."""
    home = str(Path(__file__).resolve().parents[3])
    if home in site.getsitepackages():
        return dict(os.environ)
    path = os.environ.get("PYTHONPATH")
    return os.environ | {"PYTHONPATH": home if path is None else os.pathsep.join((home, path))}
