"""`make noisy`: run a command beside bursts of other work on every core. It finds tests that need quiet.

A burst is a process at real-time priority that computes for 5 to 80 ms, as a hypervisor that gives a core to
others takes it away: nothing of ours runs on that core meanwhile. It needs CAP_SYS_NICE.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Final, NoReturn

from aftbed.runtime.unix import linux

PRIORITY: Final = 50  # above all that is not real-time
PAUSE_SECONDS: Final = 0.25  # the mean between two bursts
BURSTS_SECONDS: Final = (0.005, 0.01, 0.02, 0.04, 0.08)  # with that pause 11 % of a core


def bursts_on(cpu: int) -> NoReturn:
    """Take the core for a burst, again and again."""
    os.sched_setaffinity(0, {cpu})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    chance = Random(cpu)
    while True:
        time.sleep(chance.expovariate(1 / PAUSE_SECONDS))
        end_s = time.monotonic() + chance.choice(BURSTS_SECONDS)
        while time.monotonic() < end_s:
            pass


def forked(work: Callable[[], NoReturn]) -> None:
    """Fork a process that dies with this one."""
    parent = os.getpid()
    if os.fork() == 0:
        try:
            linux.die_with(parent)
            work()
        finally:
            os._exit(1)


if __name__ == "__main__":
    try:  # refused here and not in the children, whose errors are not seen
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except PermissionError:
        sys.exit("noise: no real-time priority: run it as root, or with CAP_SYS_NICE")
    for core in sorted(os.sched_getaffinity(0)):
        forked(partial(bursts_on, core))
    sys.exit(subprocess.run(sys.argv[1:], check=False).returncode)
