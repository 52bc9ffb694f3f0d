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
import struct
import sys
from collections.abc import Callable
from typing import Final, NoReturn

from aftbed.core import wire
from aftbed.core.brick import CONTROL, Send
from aftbed.core.message import Message, Rebound, Submit
from aftbed.ftm.catalog import Setting, make
from aftbed.ftm.mechanism import CHAIN_PARTS, build
from aftbed.runtime.unix import control, linux
from aftbed.vehicle.function import default_application, sample_requests

WARM_UP_ROUNDS: Final = 64
_CONTROL_FD: Final = 3

Become = Callable[[control.Line[control.ToNode], control.Assign | control.Serve, list[int]], NoReturn]


def run(descriptor: int, supervisor: int, preload: tuple[str, ...], become: Become) -> NoReturn:
    """Be a zygote, serving `descriptor`, until it ends. Forked from the supervisor; never returns."""
    os.dup2(descriptor, _CONTROL_FD, inheritable=False)
    os.closerange(_CONTROL_FD + 1, 1 << 16)
    linux.die_with(supervisor)
    linux.set_name("aftbed-zygote")
    for module in preload:
        importlib.import_module(module)
    warm_up()
    gc.collect()
    gc.freeze()
    gc.disable()  # structs on the path are untracked; what is left dies by reference count
    line = control.Line(socket.socket(fileno=_CONTROL_FD), control.decode_order)
    line.send(control.Hello(os.getpid()))
    while True:
        got = line.recv()
        if got is None:
            os._exit(0)
        order, fds = got
        assert isinstance(order, control.Park), order
        _park(fds, supervisor, become)


def _park(fds: list[int], supervisor: int, become: Become) -> None:
    """Fork one spare per descriptor, through an intermediate that leaves them to the supervisor."""
    alive, life = os.pipe()
    intermediate = os.fork()
    if intermediate == 0:
        os.close(_CONTROL_FD)
        for descriptor in fds:
            if os.fork() == 0:
                os.close(life)
                os.read(alive, 1)  # ends when the intermediate does, so that no spare spins meanwhile
                os.dup2(descriptor, _CONTROL_FD, inheritable=False)
                os.closerange(_CONTROL_FD + 1, 1 << 16)
                _wait_for_a_part(supervisor, become)
        os._exit(0)
    os.waitpid(intermediate, 0)
    for descriptor in (*fds, alive, life):
        os.close(descriptor)


def _wait_for_a_part(supervisor: int, become: Become) -> NoReturn:
    """A spare: adopted, parked, then what it is told to be."""
    linux.die_with(supervisor)
    linux.set_name("aftbed-spare")
    line = control.Line(socket.socket(fileno=_CONTROL_FD), control.decode_order)
    line.send(control.Hello(os.getpid()))
    got = line.recv()
    if got is None:
        os._exit(0)
    order, fds = got
    if isinstance(order, control.Assign | control.Serve):
        become(line, order, fds)
    os._exit(0)


def set_timeouts(sock: socket.socket, receive_seconds: float, send_seconds: float) -> None:
    """Kernel timeouts, which hold for plain reads and writes of the descriptor too."""
    for option, seconds in ((socket.SO_RCVTIMEO, receive_seconds), (socket.SO_SNDTIMEO, send_seconds)):
        value = struct.pack("ll", int(seconds), int(seconds % 1 * 1e6))
        sock.setsockopt(socket.SOL_SOCKET, option, value)


def warm_up() -> None:
    """Let requests run through a chain, so that children inherit warmed-up code.

    The links are the graph's own; the backup's side is not linked.
    """
    graph = build("pbr", "replica")
    setting = Setting(1, 1, True, default_application)
    names = ("client", "proxy", *(f"a/{part}" for part in CHAIN_PARTS))
    bricks = {name: make(graph.brick(name).kind, setting) for name in names}
    ways = {(k.source, k.source_port): (k.sink, k.sink_port) for k in graph.links if not k.standby}
    bricks["proxy"].step(CONTROL, Rebound("pxy2pro", True, 1), 0)
    bricks["a/after"].step(CONTROL, Rebound("aft2aft", True, 1), 0)
    for payload in sample_requests(0, WARM_UP_ROUNDS):
        mail: list[tuple[str, str, Message]] = [("client", "submit", Submit(payload))]
        while mail:
            name, port, message = mail.pop()
            for effect in bricks[name].step(port, message, 0):  # type: ignore[arg-type]
                if isinstance(effect, Send) and (name, effect.port) in ways:
                    sink, sink_port = ways[name, effect.port]
                    if sink in bricks:
                        mail.append((sink, sink_port, wire.decode(wire.encode(effect.message))))


def log_to(descriptor: int) -> None:
    """Let what this process prints go to the run's log."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
