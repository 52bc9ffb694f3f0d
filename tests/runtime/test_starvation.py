"""A machine that stalls is not a node that hangs: the table of `linux.Starvation` on real processes."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from aftbed.runtime.unix.linux import EXCUSED_NS_MAX, Starvation

ASLEEP = "print(flush=True); import time; time.sleep(60)"
# A brick that is blocked for good while the timer of the pulse goes on: the sleep is resumed each time.
BLOCKED = """
import signal, time
signal.signal(signal.SIGALRM, lambda *_: print(flush=True))
signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
time.sleep(60)
"""
LOOPS = """
import os
os.sched_setaffinity(0, {%d})
%s
print(flush=True)
while True: pass
"""
DOZES = """
import os, time
os.sched_setaffinity(0, {%d})
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
print(flush=True)
while True: time.sleep(0.001)
"""
WEAK = "os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))"
PERIOD_NS = 100_000_000


@contextmanager
def process(program: str) -> Iterator["subprocess.Popen[bytes]"]:
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    try:
        assert child.stdout is not None
        child.stdout.readline()  # it is where it should be
        yield child
    finally:
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()


def test_a_stopped_process_hangs() -> None:
    with process(ASLEEP) as child:
        child.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, child.pid, os.WSTOPPED)
        assert not Starvation(child.pid).starves(1)


def test_a_process_that_is_gone_is_not_excused() -> None:
    with process(ASLEEP) as child:
        pass
    assert not Starvation(child.pid).starves(1)


def test_asleep_without_a_timer_is_a_core_that_stalls_and_no_excuse_lasts_for_ever() -> None:
    with process(ASLEEP) as child:
        starvation = Starvation(child.pid)
        _until_asleep(child.pid)
        assert starvation.starves(2)
        assert starvation.starves(2 + EXCUSED_NS_MAX)
        assert not starvation.starves(3 + EXCUSED_NS_MAX)
        starvation.forget()
        assert starvation.starves(4 + EXCUSED_NS_MAX)


def test_blocked_while_its_timer_comes_is_a_hang() -> None:
    with process(BLOCKED) as child:
        assert child.stdout is not None
        limit = time.monotonic() + 5.0
        while True:  # it may be in its handler just now, and another has the core
            starvation = Starvation(child.pid)
            starvation.starves(time.monotonic_ns())
            child.stdout.readline()
            child.stdout.readline()  # its handler has run since
            if not starvation.starves(time.monotonic_ns()):
                return
            assert time.monotonic() < limit, "it is excused"


def test_one_that_waits_for_its_core_starves_even_where_it_sleeps_just_now() -> None:
    """It runs now and then, after a long wait; on a loaded machine a wait may be short, then once more."""
    cpu = min(os.sched_getaffinity(0))
    with process(DOZES % cpu) as dozing, process(LOOPS % (cpu, "")):
        limit = time.monotonic() + 20.0
        while True:  # this process may be kept waiting itself, and look too late
            starvation, began_ns = Starvation(dozing.pid), time.monotonic_ns()
            starvation.starves(began_ns)
            before_ns = _cpu_ns(dozing.pid)
            while time.monotonic_ns() - began_ns < PERIOD_NS or _cpu_ns(dozing.pid) == before_ns:
                assert time.monotonic() < limit, "it never runs, or never starves"
                os.sched_yield()
            _until_asleep(dozing.pid)
            now_ns = time.monotonic_ns()
            if _state(dozing.pid) == "S" and starvation.starves(now_ns):
                return


@pytest.mark.parametrize(("word", "excused"), [("", False), (WEAK, True)])
def test_runnable_without_a_cpu_starves_and_with_one_it_loops(word: str, excused: bool) -> None:
    """The weak one shares its core with a strong one, which gets nearly all of it."""
    cpu = min(os.sched_getaffinity(0))
    with process(LOOPS % (cpu, word)) as looping, process(LOOPS % (cpu, "")) as strong:
        watched = looping if excused else strong
        other = strong if excused else looping
        if not excused:
            os.sched_setscheduler(other.pid, os.SCHED_IDLE, os.sched_param(0))
        starvation = Starvation(watched.pid)
        starvation.starves(1)
        before = _cpu_ns(strong.pid)
        while _cpu_ns(strong.pid) - before < PERIOD_NS:
            os.sched_yield()
        assert starvation.starves(1 + PERIOD_NS) is excused


def _until_asleep(pid: int) -> None:
    limit = time.monotonic() + 5.0
    while _state(pid) != "S":
        assert time.monotonic() < limit, "it does not fall asleep"
        os.sched_yield()


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def _cpu_ns(pid: int) -> int:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
