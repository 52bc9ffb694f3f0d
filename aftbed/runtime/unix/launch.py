"""Starts a run from a command, and passes on the reports of its supervisor.

The command forks the supervisor, if that has not begun before (`head_start`), tells it what to run, and
forks the warden, before there is anything to remove: only then does it make the private directory, and send
*go*. So whenever the command is killed, there is a warden, or nothing is left. The supervisor has a session
of its own, so a terminal's Ctrl-C reaches the command alone.

When the descriptors of a `Launched` are closed, its run knows that the command is gone. So no child of the
command keeps them, of this run or of a later one: else one run would end only after the other.
"""

import contextlib
import os
import resource
import shutil
import signal
import socket
import time
import weakref
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

import msgspec

from aftbed import __version__
from aftbed.core.errors import ConfigError
from aftbed.core.messages import Scheduled
from aftbed.ftm.compose import parse
from aftbed.ftm.registry import packages_of
from aftbed.inject.model import Fault
from aftbed.runtime import control
from aftbed.runtime.unix import head_start, interrupts, linux, run_directory, seal
from aftbed.runtime.unix.cleanup import watch
from aftbed.runtime.unix.code_version import code_version
from aftbed.runtime.unix.journal_files import CHUNK_BYTES, trim
from aftbed.runtime.unix.options import CarRun, LoadRun, PolicyOptions, RunOptions, Work, with_names_resolved
from aftbed.runtime.unix.process_pool import killed_by
from aftbed.runtime.unix.request_store import write_given
from aftbed.runtime.unix.supervisor_process import GO, RUN, be_supervisor
from aftbed.runtime.unix.transport import Line, decode_report
from aftbed.vehicle.can.bus_model import HOST

if TYPE_CHECKING:
    from aftbed.functions.request_file import GivenRequests
    from aftbed.vehicle.scenarios.scenario import Scenario

END_SECONDS_MAX: Final = 8.0
KILL_SECONDS_MAX: Final = 1.0
FILES_MIN: Final = 256
BACKLOG: Final = 128  # connections that wait for the hub
_encode: Final = msgspec.msgpack.Encoder().encode


def ensure_limits() -> None:
    """Raise the soft limit on open files if a run could need more.

    Raises ConfigError where a limit, or the umask, does not allow a run.
    """
    files = linux.allow_files()
    if files < FILES_MIN:
        raise ConfigError(
            f"{files} open files are allowed, and a run needs {FILES_MIN}: ulimit -n {linux.FILES_GOOD}"
        )
    mask = os.umask(0o077)
    os.umask(mask)
    if mask & 0o700:
        raise ConfigError(f"umask {mask:04o}: a run could not use its own files: umask 0022")
    size, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if size != resource.RLIM_INFINITY and size < CHUNK_BYTES:
        raise ConfigError(
            f"a file may have {size} bytes, and a journal takes at least {CHUNK_BYTES}: ulimit -f unlimited"
        )


def listen_on_loopback(port: int, option: str) -> socket.socket:
    """A listening socket on 127.0.0.1; `port`, the value of `option`, may be 0 for any free one.

    Raises ConfigError if it is in use.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((HOST, port))
        sock.listen(BACKLOG)
    except OSError as error:
        sock.close()
        raise ConfigError(
            f"{option} {port}: {error.strerror}; choose another, or 0 for any free one"
        ) from None
    return sock


def _fork_supervisor(listener: socket.socket | None) -> head_start.Start:
    """A supervisor that begins now. Raises OSError."""

    def supervise(line: socket.socket) -> NoReturn:
        linux.continue_at_parents_death()
        os.setsid()
        if listener is not None:
            listener.close()  # it comes with the options
        be_supervisor(line, {})

    return head_start.fork(supervise)


class Launched:
    """A run in progress, seen from its command. `end` is set when it has ended in order.

    `trouble`: why its supervisor could not go on, "" if it could.
    """

    def __init__(
        self,
        options: RunOptions,
        listener: socket.socket | None,
        given: "GivenRequests | None" = None,
        log: bytes | None = None,
    ) -> None:
        self.options = options
        self.private, self.record = Path(options.private), Path(options.record)
        self._kept = self.record.parent != self.private  # after the run
        self.started_ns = time.monotonic_ns()
        self.end: dict[str, object] | None = None
        self.trouble = ""
        self._waited = False
        self.supervisor = 0
        start = head_start.taken() or _fork_supervisor(listener)
        self.supervisor, self.line = start.pid, Line(start.line, decode_report)
        try:
            self._fork_warden(listener, log)
        except OSError:
            start.end()
            raise
        self._make_directories(given)

    # -- start --------------------------------------------------------------------------------

    def _fork_warden(self, listener: socket.socket | None, log: bytes | None) -> None:
        """Tell the supervisor what to run, and fork the warden. Each has its ends of two pipes."""
        command_end, command_life = os.pipe()
        supervisor_end, supervisor_life = os.pipe()
        waker = os.eventfd(0)
        self._pidfd = os.pidfd_open(self.supervisor)
        self._hand_over((supervisor_life, waker), listener, log)
        os.close(supervisor_life)
        self.warden = interrupts.fork()
        if self.warden == 0:
            try:
                linux.continue_at_parents_death()
                os.setsid()
                os.close(command_life)
                self.line.close()
                if listener is not None:
                    listener.close()
                watch(
                    private=self.private,
                    record=self.record,
                    started_ns=self.started_ns,
                    command_end=command_end,
                    supervisor_end=supervisor_end,
                    supervisor_pidfd=self._pidfd,
                    waker=waker,
                )
            finally:
                os._exit(1)  # never into what the command does next
        self._warden_pidfd = os.pidfd_open(self.warden)
        for fd in (command_end, supervisor_end, waker):
            os.close(fd)
        self._life: list[int] = [command_life]
        self._reference = weakref.ref(self, _LAUNCHED.discard)
        _LAUNCHED.add(self._reference)

    def _hand_over(self, fds: tuple[int, int], listener: socket.socket | None, log: bytes | None) -> None:
        """Send the options to the supervisor, as a file, and descriptors. Raises OSError."""
        with contextlib.ExitStack() as files:
            of_options = files.enter_context(_memfd("options", _encode(self.options)))
            found = [of_options.fileno(), *fds]
            if listener is not None:
                found.append(listener.fileno())
            if log is not None:
                assert listener is not None, "a log without a bus"
                found.append(files.enter_context(_memfd("log", log)).fileno())
            socket.send_fds(self.line.sock, [RUN], found)

    def _make_directories(self, given: "GivenRequests | None") -> None:
        """Make the private directory and the record, with what was asked for in it, and send *go*."""
        about = {"version": __version__, "started_ns": self.started_ns, **msgspec.to_builtins(self.options)}
        for key in ("listener", "log", "private", "drive"):
            about.pop(key)
        about["load"] = isinstance(self.options.work, LoadRun)
        about["kept"] = self._kept
        try:
            run_directory.make(self.private)
            if self.record.parent == self.private:
                run_directory.record_directory(self.record)
            if given is not None:
                write_given(self.record, given)
            (self.record / "run.json").write_bytes(msgspec.json.format(msgspec.json.encode(about)))
            self.line.sock.send(GO)
        except BaseException as error:
            if not run_directory.owned_here(self.private):  # another run has made it: its warden keeps it
                linux.kill(self._warden_pidfd, signal.SIGKILL)
            self.wait()
            self.remove()
            if isinstance(error, OSError):
                raise ConfigError(f"{self.record}: cannot be written: {error.strerror}") from None
            raise

    # -- while it runs, and its end -----------------------------------------------------------

    def reports(self) -> Iterator[control.Report]:
        """The reports of the supervisor, until the run has ended."""
        while self.end is None:
            try:
                got = self.line.recv()
            except OSError:
                return
            if got is None:
                return
            report, _ = got
            if isinstance(report, control.Report):
                match report.kind:
                    case control.FINISHED:
                        self.end = msgspec.json.decode(report.data)
                    case "trouble":
                        self.trouble = report.data.decode()
                    case _:
                        yield report

    def stop(self) -> None:
        """Request the end of the run; reports continue until then."""
        with contextlib.suppress(OSError):
            self.line.send(control.Stop(control.UNANSWERED))

    def wait(self) -> None:
        """Wait for the supervisor's end; kill it at the deadline. The record stays; a kept one is sealed."""
        if self._waited:
            return
        self._waited = True
        self.line.close()
        if not linux.ends(self._pidfd, END_SECONDS_MAX):
            linux.kill(self._pidfd, signal.SIGKILL)
            linux.ends(self._pidfd, KILL_SECONDS_MAX)
        code = os.waitstatus_to_exitcode(os.waitpid(self.supervisor, 0)[1])
        if code < 0 and not self.trouble:
            self.trouble = f"the supervisor {killed_by(-code, self.record)}"
        if self._kept and self.end is not None:
            with contextlib.suppress(OSError):  # then it has none, which the judge tells
                trim(self.record / "journal")
                seal.write(self.record)

    def remove(self) -> None:
        """Remove the private directory, after the record was read, and let the warden end.

        A supervisor that was not waited for is ended first.
        """
        self.wait()
        if run_directory.owned_here(self.private):
            run_directory.remove(self.private)
        life, self._life = self._life, []
        for fd in life:
            os.close(fd)
        if not linux.ends(self._warden_pidfd, KILL_SECONDS_MAX):
            linux.kill(self._warden_pidfd, signal.SIGKILL)  # a stopped warden would never end
        os.waitpid(self.warden, 0)
        _LAUNCHED.discard(self._reference)
        os.close(self._pidfd)
        os.close(self._warden_pidfd)

    def disown(self) -> None:
        """Forget the run in a child of the command, which must not end it."""
        self.line.close()
        for fd in (*self._life, self._pidfd, self._warden_pidfd):
            os.close(fd)


_LAUNCHED: Final[set[weakref.ref[Launched]]] = set()


def _disown_all() -> None:
    if not _LAUNCHED:  # as in each process that a zygote forks: what is not executed there is not copied
        return
    for reference in list(_LAUNCHED):
        if (launched := reference()) is not None:
            launched.disown()
    _LAUNCHED.clear()  # a child of this child has other descriptors by the same numbers


os.register_at_fork(after_in_child=_disown_all)


def _memfd(name: str, content: bytes) -> FileIO:
    """A file in memory, to be read from its beginning. Raises OSError."""
    file = FileIO(os.memfd_create(f"aftbed-{name}"), "r+")
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]
    file.seek(0)
    return file


def launch(
    options: RunOptions,
    listener: socket.socket | None,
    given: "GivenRequests | None" = None,
    log: bytes | None = None,
) -> Launched:
    """Start a run, of the requests `given` or the PlayedLog `log` where its work is one; see `Launched`.

    Raises ConfigError, leaving nothing, where it cannot be started.
    """
    launched = None
    try:
        with interrupts.uninterrupted():  # a run with its directory and its warden, or none
            launched = Launched(options, listener, given, log)
        return launched  # noqa: RET504 - an interrupt that comes before it finds the run
    except BaseException as error:
        if launched is not None:
            launched.remove()
        record = Path(options.record)
        if record.parent != Path(options.private):
            shutil.rmtree(record, ignore_errors=True)
        if isinstance(error, OSError):
            raise ConfigError(f"a run cannot be started: {error.strerror}") from None
        raise
    finally:
        if listener is not None:
            listener.close()


def options_for(
    *,
    ftm: str,
    placement: str,
    work: Work,
    seed: int = 0,
    record: str | None = None,
    faults: tuple[Fault, ...] = (),
    adaptations: tuple[Scheduled, ...] = (),
    policy: PolicyOptions | None = None,
    pin: bool = True,
    bus_port: int = 0,
    bus_open: bool = False,
    application: str = "",
    ftti_ms: float = 0.0,
    verifies: tuple[str, ...] = (),
    command: str = "",
    evidence: bool = False,
) -> tuple[RunOptions, socket.socket | None]:
    """What a run needs; where there is a bus, its socket too. Raises ConfigError, leaving nothing.

    `evidence`: the options say which code this is, also of a run that verifies nothing and is not kept.
    """
    faults = tuple(with_names_resolved(fault, work) for fault in faults)
    goals = tuple(one.goal.expression for one in adaptations if one.goal.expression)
    drive = _scenario(work) if isinstance(work, CarRun) else None
    verifies = tuple(dict.fromkeys((*verifies, *(drive.verifies if drive is not None else ()))))
    ensure_limits()
    listener = None if isinstance(work, LoadRun) else listen_on_loopback(bus_port, "--bus-port")
    try:
        private = run_directory.free()
        directory = private / "record" if record is None else run_directory.record_directory(Path(record))
    except ConfigError:
        if listener is not None:
            listener.close()
        raise
    options = RunOptions(
        run=private.name,
        private=str(private),
        record=str(directory),
        ftm=ftm,
        placement=placement,
        seed=seed,
        work=work,
        faults=faults,
        adaptations=adaptations,
        policy=policy,
        pin=pin,
        listener=listener.fileno() if listener is not None else -1,
        port=listener.getsockname()[1] if listener is not None else 0,
        bus_open=bus_open,
        application=application,
        drive=_encode(drive) if drive is not None else b"",
        ftti_ms=ftti_ms,
        verifies=verifies,
        command=command,
        packages=(packages := packages_of(name for one in (ftm, *goals) for name in parse(one))),
        code=code_version(packages) if evidence or verifies or record is not None else "",
    )
    return options, listener


def _scenario(work: CarRun) -> "Scenario":
    """That of `work`, as it is driven. With another duration it verifies nothing. Raises ConfigError."""
    from aftbed.vehicle.scenarios.library import load_scenario  # noqa: PLC0415 - only for a drive: PyYAML

    scenario = load_scenario(work.scenario)
    if work.duration_ms is None:
        return scenario
    return msgspec.structs.replace(scenario, duration_ms=work.duration_ms, verifies=())
