"""The zygote: imports everything once, then forks processes in about a millisecond.

It forks *spares*, which wait at their control line for what they are to be: a node of the graph (`Assign`)
or a service beside it (`Serve`: the hub, the vehicle, the player). A spare is forked by an intermediate
process that ends at once, so that the supervisor, a subreaper, adopts it: the death of a zygote then kills
no spare (`PR_SET_PDEATHSIG` follows the parent), and the supervisor reaps what it started.

There are two zygotes, because the fork and the death of a process take time in proportion to its memory: a
light one for the mechanism, and one that has imported what needs the bus (`preload`).
"""

import contextlib
import gc
import importlib
import os
import socket
import sys
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import msgspec

from aftbed.core.errors import ConfigError, FunctionFailedError
from aftbed.ftm.client import Client
from aftbed.functions.load import Code, load_module
from aftbed.functions.source import FunctionSource
from aftbed.runtime import control
from aftbed.runtime.assembly import Assembler
from aftbed.runtime.devices import Device, Sensor
from aftbed.runtime.node import Node
from aftbed.runtime.unix import linux, prefault
from aftbed.runtime.unix.death_notice import Lifeline
from aftbed.runtime.unix.devices import ProcessSenses, make_source
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.linux import INHERITED_FD, Area
from aftbed.runtime.unix.node_io import EXIT_ASSERT, UnixIO, UnixNode
from aftbed.runtime.unix.options import SourceOptions
from aftbed.runtime.unix.transport import PULSE_SECONDS, Line, decode_order
from aftbed.vehicle.aeb.function import default_application


def run(
    supervisor: int, cpus: list[int], preload: tuple[str, ...], areas: tuple[Area, ...] | None = None
) -> NoReturn:
    """Serve the control line at `INHERITED_FD` until it ends.

    `areas`: where a node writes to, if the parent of this process has found that out (`launch.warm_up`).
    """
    os.set_inheritable(INHERITED_FD, False)
    os.sched_setaffinity(0, cpus)
    linux.die_with(supervisor)
    linux.set_name("aftbed-zygote")
    linux.reuse_blocks()
    for module in preload:
        importlib.import_module(module)
    if areas is None:
        areas = prefault.warm_up()
    gc.freeze()
    gc.disable()  # structs on the path are untracked; the rest is freed by its reference count
    line = Line(socket.socket(fileno=INHERITED_FD), decode_order)
    line.send(control.Hello(os.getpid()))
    while (got := line.recv()) is not None:
        order, fds = got
        assert isinstance(order, control.Park), order
        try:
            _fork_spares(fds, supervisor, areas)
        except OSError as error:
            with contextlib.suppress(BrokenPipeError):  # the run has ended
                line.send(control.Report("trouble", f"no process can be forked: {error.strerror}".encode()))
            break
    os._exit(0)


def _fork_spares(fds: list[int], supervisor: int, areas: tuple[Area, ...]) -> None:
    """Fork one spare per descriptor, through an intermediate process that leaves them to the supervisor.

    Raises OSError if one cannot be forked.
    """
    alive, life = os.pipe()
    intermediate = os.fork()
    if intermediate == 0:
        os.close(INHERITED_FD)
        for descriptor in fds:
            try:
                spare = os.fork()
            except OSError as error:
                os._exit(error.errno or 1)
            if spare == 0:
                os.close(life)
                os.read(alive, 1)  # ends when the intermediate does, so that no spare spins meanwhile
                os.dup2(descriptor, INHERITED_FD, inheritable=False)
                os.closerange(INHERITED_FD + 1, 1 << 16)
                try:
                    _be_spare(supervisor, areas)
                except (BrokenPipeError, ConnectionResetError):  # the run has ended
                    os._exit(0)
        os._exit(0)
    refused = os.waitstatus_to_exitcode(os.waitpid(intermediate, 0)[1])
    for descriptor in (*fds, alive, life):
        os.close(descriptor)
    if refused > 0:  # negative: it was killed
        raise OSError(refused, os.strerror(refused))


def _be_spare(supervisor: int, areas: tuple[Area, ...]) -> NoReturn:
    """Wait for an order; then be the node or the service that it describes."""
    linux.die_with(supervisor)
    linux.set_name("aftbed-spare")
    linux.populate(areas)
    line = Line(socket.socket(fileno=INHERITED_FD), decode_order)
    line.send(control.Hello(os.getpid()))
    got = line.recv()
    if got is None:
        os._exit(0)
    order, fds = got
    assert isinstance(order, control.Assign | control.Serve), order
    try:
        if isinstance(order, control.Serve):
            from aftbed.runtime.unix.bus_services import serve  # noqa: PLC0415 - costs 150 ms

            linux.set_name(f"aftbed-{order.service}")
            serve(line, order, fds)
            os._exit(0)
        io = _make_node(line, order, fds)
    except BaseException as error:  # noqa: BLE001 - the last frame of this process
        known = isinstance(error, ConfigError | FunctionFailedError | OSError)
        reason = str(error) if known else f"{type(error).__name__}: {error}"
        line.send(control.Ack(order.token, error=reason))
        if known:
            os._exit(0)
        sys.excepthook(type(error), error, error.__traceback__)
        os._exit(EXIT_ASSERT)
    io.serve()


def _make_node(line: Line[control.ToNode], order: control.Assign, fds: list[int]) -> UnixIO:
    linux.set_name(order.node)
    kind = order.bricks[0].kind
    if order.staged and order.aside is not None:
        os.sched_setaffinity(0, {order.aside})  # requests are served on the other one
    if order.cpu is not None:
        os.sched_setaffinity(0, {order.cpu})
    if kind in ("watchdog", "recovery"):
        linux.use_short_slices()
    else:
        linux.use_batch_scheduling()
    linux.set_timeouts(line.sock, PULSE_SECONDS, 2.0)
    io = UnixIO(line, JournalFile(Path(order.journal), order.node))
    node = Node(order.node, io)
    io.start_pulse()
    io.lifeline = Lifeline(Path(order.journal))
    if kind == "engine":
        gc.enable()  # a plan leaves cycles behind, and the Engine is not on the request path
    code = _NotedCode(Path(order.journal).parent.parent)
    Assembler(default_application, code).build(node, order, fds, lambda: _make_device(order, node))
    return io


class _NotedCode(Code):
    """Notes in the record of the run what is not of this package, and loads by one name always the same."""

    def __init__(self, record: Path) -> None:
        self._record = record

    def module(self, place: str) -> ModuleType:
        return self._module(place)

    def function_module(self, source: FunctionSource) -> ModuleType:
        return self._module(source.place, source)

    def _module(self, place: str, source: FunctionSource | None = None) -> ModuleType:
        if not place.endswith(".py") and place.partition(".")[0] == "aftbed":
            return load_module(place)
        from aftbed.runtime.unix import trust  # noqa: PLC0415 - hashlib, in nodes with such code only

        if source is not None and (before := trust.loaded_before(self._record, source)) is not None:
            return trust.load(before)
        module = load_module(place)
        trust.note(self._record, place, module, source.key if source is not None else "")
        return module

    def permit(self, source: FunctionSource) -> FunctionSource:
        from aftbed.runtime.unix import trust  # noqa: PLC0415 - the same

        before = trust.loaded_before(self._record, source)
        if before is not None:
            return source.reading(before.kept)
        trust.note_files(self._record, source)
        return source


def _make_device(order: control.Assign, node: UnixNode) -> Device:
    if order.device == "sensor":
        return Sensor(ProcessSenses())
    client = node.brick(order.bricks[0].name)
    assert isinstance(client, Client)
    return make_source(client, msgspec.msgpack.decode(order.options, type=SourceOptions))


if __name__ == "__main__":
    run(int(sys.argv[1]), [int(cpu) for cpu in sys.argv[2].split(",")], tuple(sys.argv[3:]))
