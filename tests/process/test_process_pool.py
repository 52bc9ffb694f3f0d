"""The supervisor's pool of processes, with real zygotes."""

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

SECONDS_MAX: Final = 60.0
OWED: Final = 5
# In a process of its own: it adopts what a dead zygote leaves, and all its children die with it.
SUPERVISOR: Final = f"""
import os, signal, sys
from pathlib import Path

from aftbed.runtime.interface import LIGHT, ProcessKind
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.process_pool import UnixProcessPool

def restart(process):
    if process.kind is ProcessKind.ZYGOTE:
        pool.restart_zygote(process.name)

def end(failure):
    print(failure or "all parked")
    loop.end()

class Full:
    def send(self, order, fds):
        raise BlockingIOError

linux.become_subreaper()
loop = EventLoop()
ledger = UndoLedger(Path(sys.argv[1]), os.eventfd(0))
pool = UnixProcessPool(loop, lambda process, report: None, restart, ledger)
pool.start_zygote(LIGHT)
{{what}}
loop.tasks.start("spares", pool.parked_at_least(LIGHT, {OWED}), end)
loop.run()
"""
DEAD: Final = f"""
os.kill(pool.zygotes[LIGHT].pid, signal.SIGSTOP)  # it reads none of its orders
pool.park(LIGHT, {OWED})
os.kill(pool.zygotes[LIGHT].pid, signal.SIGKILL)
"""
UNREAD: Final = f"""
sound, pool.zygotes[LIGHT].line = pool.zygotes[LIGHT].line, Full()
pool.park(LIGHT, {OWED})
pool.zygotes[LIGHT].line = sound
"""


@pytest.mark.process
@pytest.mark.parametrize("what", [DEAD, UNREAD], ids=["of a dead zygote", "of an order that was not sent"])
def test_all_spares_that_were_ordered_are_parked_in_the_end(tmp_path: Path, what: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SUPERVISOR.format(what=what), tmp_path],
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        check=False,
    )
    assert done.stdout == "all parked\n", done.stderr
