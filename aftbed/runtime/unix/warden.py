"""The warden: what removes a run's directory and its last processes when nobody else is left to.

The supervisor cleans up after the command, and the command after the supervisor. If both die, or if
one dies while the other is stopped, the warden does it: a small process forked first, which does
nothing but wait for the ends of two pipes.
"""

import os
import select
import signal
from pathlib import Path
from typing import Final, NoReturn

from aftbed.runtime.unix import linux, rundir

GRACE_SECONDS: Final = 0.6  # G7 allows a second in all


def watch(private: Path, command_end: int, supervisor_end: int, supervisor_pidfd: int) -> NoReturn:
    """Wait until command and supervisor are gone; kill a supervisor that outlives its command."""
    linux.set_name("aftbed-warden")
    poll = select.poll()
    poll.register(command_end, 0)  # only POLLHUP: nothing is ever written
    poll.poll()
    rest = select.poll()
    rest.register(supervisor_end, 0)
    if not rest.poll(GRACE_SECONDS * 1e3):
        linux.kill(supervisor_pidfd, signal.SIGKILL)
        rest.poll(GRACE_SECONDS * 1e3)
    rundir.remove(private)
    os._exit(0)
