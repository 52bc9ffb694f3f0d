"""The supervisor's pool of processes, with real zygotes."""

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from liveruns import ended, state_of, until

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
    def __init__(self, line):
        self.line = line

    def __getattr__(self, name):
        return getattr(self.line, name)

    def send(self, order, fds):
        raise BlockingIOError

linux.become_subreaper()
loop = EventLoop()
ledger = UndoLedger(Path(sys.argv[1]), os.eventfd(0))
pool = UnixProcessPool(loop, lambda process, report: None, restart, ledger, sys.argv[2])
pool.start_zygote(LIGHT)
{{what}}
loop.tasks.start("spares", pool.parked_at_least(LIGHT, {OWED}), end)
loop.run()
spares = [process.pid for process in pool.processes if process.kind is ProcessKind.SPARE]
print(sum("/numpy/" in Path("/proc/%d/maps" % pid).read_text() for pid in spares), "with numpy")
"""
PARK: Final = f"""
pool.park(LIGHT, {OWED})
"""
DEAD: Final = f"""
os.kill(pool.zygotes[LIGHT].pid, signal.SIGSTOP)  # it reads none of its orders
pool.park(LIGHT, {OWED})
os.kill(pool.zygotes[LIGHT].pid, signal.SIGKILL)
"""
UNREAD: Final = f"""
sound = pool.zygotes[LIGHT].line
pool.zygotes[LIGHT].line = Full(sound)
pool.park(LIGHT, {OWED})
pool.zygotes[LIGHT].line = sound
"""


NEVER: Final = f"""
pool.zygotes[LIGHT].line = Full(pool.zygotes[LIGHT].line)
pool.park(LIGHT, {OWED})
"""

# Of the two forks the second is that of the intermediate, which stops there.
STOPPED: Final = """
import os, signal

from aftbed.runtime.unix import zygote

def stop_and_fork():
    print(os.getpid(), flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
    return fork()

def fork_and_stop():
    os.fork = stop_and_fork
    return fork()

fork, os.fork = os.fork, fork_and_stop
os.dup2(0, zygote.INHERITED_FD)
zygote._fork_spares([os.dup(0)], os.getpid())
"""


def supervise(what: str, folder: Path, application: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", SUPERVISOR.format(what=what), folder, application],
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        check=False,
    )


@pytest.mark.process
@pytest.mark.parametrize("what", [DEAD, UNREAD], ids=["of a dead zygote", "of an order that was not sent"])
def test_all_spares_that_were_ordered_are_parked_in_the_end(tmp_path: Path, what: str) -> None:
    done = supervise(what, tmp_path)
    assert done.stdout == "all parked\n0 with numpy\n", done.stderr


@pytest.mark.process
def test_the_spares_of_a_run_with_an_fmu_have_what_it_needs(tmp_path: Path) -> None:
    """To import it takes a new backup 0.2 s, in which there is no redundancy."""
    done = supervise(PARK, tmp_path, "model.fmu")
    assert done.stdout == f"all parked\n{OWED} with numpy\n", done.stderr


@pytest.mark.process
def test_a_run_in_which_no_spare_comes_to_its_first_message_ends_with_the_reason(tmp_path: Path) -> None:
    done = supervise(NEVER, tmp_path)
    assert done.returncode == 1 and not done.stdout
    assert "no process starts: 100 in a row ended before their first message" in done.stderr


@pytest.mark.process
def test_what_forks_the_spares_ends_with_its_zygote_also_where_it_is_stopped() -> None:
    command = [sys.executable, "-c", STOPPED]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as zygote:
        try:
            assert zygote.stdout is not None
            intermediate = int(zygote.stdout.readline())
            until(lambda: state_of(intermediate) == "T", "the intermediate to stop")
        finally:
            zygote.kill()
    assert ended(intermediate)
