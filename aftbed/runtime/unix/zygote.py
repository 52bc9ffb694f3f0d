"""The zygote: imports everything once, then forks processes in about a millisecond.

It forks *spares*, which wait at their control line for what they are to be: a node of the graph (`Assign`)
or a service beside it (`Serve`: the hub, the vehicle, the player). A spare is forked by an intermediate
process that ends at once, so that the supervisor, a subreaper, adopts it: the death of a zygote then kills
no spare (`PR_SET_PDEATHSIG` follows the parent), and the supervisor reaps what it started.

There are two zygotes, because the fork and the death of a process take time in proportion to its memory: a
light one for the mechanism, and one that has imported what needs the bus (`preload`).

A zygote is a fork of the supervisor where that has imported the same and little else; otherwise it is an
interpreter of its own.
"""

import contextlib
import gc
import os
import socket
import sys
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import msgspec

from aftbed.core.errors import ConfigError, FunctionFailedError
from aftbed.ftm.client import Client
from aftbed.ftm.registry import find
from aftbed.functions.load import Code, load_module, preload_for
from aftbed.functions.source import FunctionSource
from aftbed.runtime import control
from aftbed.runtime.assembly import Assembler
from aftbed.runtime.devices import Device, Sensor
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.node import Node
from aftbed.runtime.unix import linux, rehearsal, run_directory
from aftbed.runtime.unix.death_notice import Lifeline
from aftbed.runtime.unix.devices import ProcessSenses, make_source
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.linux import INHERITED_FD
from aftbed.runtime.unix.node_io import EXIT_ASSERT, UnixIO, UnixNode
from aftbed.runtime.unix.options import SourceOptions
from aftbed.runtime.unix.transport import ORDER_SECONDS, WRITE_SECONDS_MAX, Line, decode_order
from aftbed.vehicle.aeb.function import default_application


def fork(
    name: str, cpus: list[int], application: str = "", *, warm: bool = False
) -> tuple[int, socket.socket]:
    """Fork the zygote `name` from this process: its pid, and our end of its control line.

    That of the mechanism is forked from a process that has rehearsed. `application`: what to import for, if
    known. `warm`: this process has imported what the zygote needs, and its memory is settled. Raises OSError.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    supervisor = os.getpid()
    with theirs:
        pid = os.fork()
        if pid == 0:
            try:
                os.dup2(theirs.fileno(), INHERITED_FD)
                os.closerange(INHERITED_FD + 1, 1 << 16)
                # The parent's may write to descriptors that are closed now, and will be those of journals.
                sys.stdout, sys.stderr = (open(fd, "w", buffering=1, closefd=False) for fd in (1, 2))  # noqa: SIM115
                _begin(supervisor, cpus)
                if not warm:
                    preload(name)
                    preload_for(application)
                    if name == LIGHT:
                        rehearsal.settle()
                _serve(supervisor, rehearsed=warm or name == LIGHT)
            except ConnectionError:  # there is no run
                os._exit(0)
            except BaseException:  # noqa: BLE001 - the last frame of this process
                sys.excepthook(*sys.exc_info())
            finally:
                os._exit(1)
    return pid, ours


def preload(name: str) -> None:
    """Import what the processes of the zygote `name` need beside this module."""
    if name == BUS:
        from aftbed.runtime.unix import bus_services  # noqa: PLC0415 - costs 150 ms

        bus_services.preload()


def _begin(supervisor: int, cpus: list[int]) -> None:
    os.set_inheritable(INHERITED_FD, False)
    os.sched_setaffinity(0, cpus)
    linux.die_with(supervisor)
    linux.set_name("aftbed-zygote")
    linux.reuse_blocks()


def _serve(supervisor: int, *, rehearsed: bool) -> NoReturn:
    """Carry out what comes on the control line at `INHERITED_FD`, until it ends.

    A drive waits for its first spares, so a zygote that has not rehearsed does it when they are forked.
    """
    first = True
    gc.freeze()
    gc.disable()  # structs on the path are untracked; the rest is freed by its reference count
    line = Line(socket.socket(fileno=INHERITED_FD), decode_order)
    line.send(control.Hello(os.getpid()))
    while (got := line.recv()) is not None:
        order, fds = got
        if isinstance(order, control.JoinRun):
            _join(Path(order.private), fds)
            continue
        assert isinstance(order, control.Park), order
        if not rehearsed and not first:
            rehearsal.warm_up()
            rehearsed = True
        first = False
        for name in order.mechanisms:
            with contextlib.suppress(ConfigError):  # a node that needs it will say so
                find(name)
        preload_for(order.application)
        try:
            _fork_spares(fds, supervisor)
        except OSError as error:
            with contextlib.suppress(ConnectionError):  # the run has ended
                line.send(control.Report("trouble", f"no process can be forked: {error.strerror}".encode()))
            break
    os._exit(0)


def _join(private: Path, fds: list[int]) -> None:
    """Belong to the run, with all that is forked or executed from here on, and print to its file."""
    run_directory.mark(private)
    os.environ[run_directory.VARIABLE] = str(private)
    (log,) = fds
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)


def _fork_spares(fds: list[int], supervisor: int) -> None:
    """Fork one spare per descriptor, through an intermediate process that leaves them to the supervisor.

    Raises OSError if one cannot be forked.
    """
    alive, life = os.pipe()
    zygote = os.getpid()
    intermediate = os.fork()
    if intermediate == 0:
        linux.die_with(zygote)  # also where it is stopped: its spares wait for its end
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
                    _be_spare(supervisor)
                except ConnectionError:  # the run has ended
                    os._exit(0)
        os._exit(0)
    refused = os.waitstatus_to_exitcode(os.waitpid(intermediate, 0)[1])
    for descriptor in (*fds, alive, life):
        os.close(descriptor)
    if refused > 0:  # negative: it was killed
        raise OSError(refused, os.strerror(refused))


def _be_spare(supervisor: int) -> NoReturn:
    """Wait for an order; then be the node or the service that it describes."""
    linux.die_with(supervisor)
    linux.set_name("aftbed-spare")
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
    if order.rehearse:
        rehearsal.rehearse_node((brick.kind for brick in order.bricks), commits=order.staged)
    if order.cpu is not None:
        os.sched_setaffinity(0, {order.cpu})
    if kind in ("watchdog", "recovery"):
        linux.use_short_slices()
    else:
        linux.use_batch_scheduling()
    linux.set_timeouts(line.sock, ORDER_SECONDS, WRITE_SECONDS_MAX)
    io = UnixIO(line, JournalFile(order.journal, order.node), rehearsal.rehearse_node)
    node = Node(order.node, io)
    io.lifeline = Lifeline(order.journal)
    if kind == "engine":
        gc.enable()  # a plan leaves cycles behind, and the Engine is not on the request path
    code = _NotedCode(order.journal)
    Assembler(default_application, code).build(node, order, fds, lambda: _make_device(order, node, line))
    return io


class _NotedCode(Code):
    """Notes in the record of the run what is not of this package, and loads by one name always the same."""

    def __init__(self, journal: str) -> None:
        self._journal = journal  # of a node, in a folder of the record

    @property
    def _record(self) -> Path:
        return Path(self._journal).parent.parent

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


def _make_device(order: control.Assign, node: UnixNode, line: Line[control.ToNode]) -> Device:
    if order.device == "sensor":
        return Sensor(ProcessSenses())
    client = node.brick(order.bricks[0].name)
    assert isinstance(client, Client)
    options = msgspec.msgpack.decode(order.options, type=SourceOptions)
    return make_source(client, options, lambda: line.send(control.Report(control.LOAD_ENDED, b"")))


if __name__ == "__main__":
    _begin(int(sys.argv[1]), [int(cpu) for cpu in sys.argv[2].split(",")])
    preload(sys.argv[3])
    if sys.argv[3] == LIGHT:
        rehearsal.warm_up()
    _serve(int(sys.argv[1]), rehearsed=sys.argv[3] == LIGHT)
