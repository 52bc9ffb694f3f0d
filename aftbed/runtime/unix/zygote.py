"""The zygote: imports everything once, then forks processes in about a millisecond.

It forks *spares*: processes that are parked at their control line until they are told what to be. A
spare is forked twice removed, so that the supervisor, a subreaper, adopts it: a zygote's death then
kills nobody (`PR_SET_PDEATHSIG` follows the parent), and the supervisor reaps what it started.
There are two: one for the mechanism, light, since the fork and the death of a process take time in
proportion to its memory; one for what needs the bus (`preload`).
"""

import gc
import importlib
import os
import socket
import sys
from typing import NoReturn

from aftbed.runtime import control
from aftbed.runtime.unix import linux, prefault, rehearsal
from aftbed.runtime.unix.part import become
from aftbed.runtime.unix.prefault import Area
from aftbed.runtime.unix.spawn import CONTROL_FD
from aftbed.runtime.unix.transport import Line, decode_order


def run(
    supervisor: int, cpus: list[int], preload: tuple[str, ...], areas: tuple[Area, ...] | None = None
) -> NoReturn:
    """Be a zygote, serving `CONTROL_FD`, until it ends.

    `areas`: where a node writes to, if the parent of this process has found it out (`launch.warm_up`).
    """
    os.set_inheritable(CONTROL_FD, False)
    os.sched_setaffinity(0, cpus)
    linux.die_with(supervisor)
    linux.set_name("aftbed-zygote")
    for module in preload:
        importlib.import_module(module)
    if areas is None:
        areas = rehearsal.warm_up()
    gc.freeze()
    gc.disable()  # structs on the path are untracked; what is left dies by reference count
    line = Line(socket.socket(fileno=CONTROL_FD), decode_order)
    line.send(control.Hello(os.getpid()))
    while True:
        got = line.recv()
        if got is None:
            os._exit(0)
        order, fds = got
        assert isinstance(order, control.Park), order
        _park(fds, supervisor, areas)


def _park(fds: list[int], supervisor: int, areas: tuple[Area, ...]) -> None:
    """Fork one spare per descriptor, through an intermediate that leaves them to the supervisor."""
    alive, life = os.pipe()
    intermediate = os.fork()
    if intermediate == 0:
        os.close(CONTROL_FD)
        for descriptor in fds:
            if os.fork() == 0:
                os.close(life)
                os.read(alive, 1)  # ends when the intermediate does, so that no spare spins meanwhile
                os.dup2(descriptor, CONTROL_FD, inheritable=False)
                os.closerange(CONTROL_FD + 1, 1 << 16)
                _wait_for_a_part(supervisor, areas)
        os._exit(0)
    os.waitpid(intermediate, 0)
    for descriptor in (*fds, alive, life):
        os.close(descriptor)


def _wait_for_a_part(supervisor: int, areas: tuple[Area, ...]) -> NoReturn:
    """A spare: adopted, parked, then what it is told to be."""
    linux.die_with(supervisor)
    linux.set_name("aftbed-spare")
    prefault.own(areas)
    line = Line(socket.socket(fileno=CONTROL_FD), decode_order)
    line.send(control.Hello(os.getpid()))
    got = line.recv()
    if got is None:
        os._exit(0)
    order, fds = got
    if isinstance(order, control.Assign | control.Serve):
        become(line, order, fds)
    os._exit(0)


if __name__ == "__main__":
    run(int(sys.argv[1]), [int(cpu) for cpu in sys.argv[2].split(",")], tuple(sys.argv[3:]))
