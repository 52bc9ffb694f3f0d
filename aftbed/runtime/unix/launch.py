"""Starts a run from a command, and passes on the reports of its supervisor.

The command forks the supervisor and the warden before it does anything else that takes memory, and before
there is anything to remove: only then does it make the private directory, and send *go*. So whenever the
command is killed, there is a warden, or nothing is left. The supervisor has a session of its own, so a
terminal's Ctrl-C reaches the command alone.

When the descriptors of a `Launched` are closed, its run knows that the command is gone. So no child of the
command keeps them, of this run or of a later one: else one run would end only after the other.
"""

import contextlib
import errno
import importlib
import os
import resource
import select
import shutil
import signal
import socket
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

import msgspec

from aftbed import __version__
from aftbed.core.errors import AftbedError, ConfigError, HarnessError
from aftbed.core.messages import Scheduled
from aftbed.inject.model import Fault
from aftbed.runtime import control
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.unix import linux, run_directory, seal
from aftbed.runtime.unix.cleanup import UndoLedger, watch
from aftbed.runtime.unix.journal_files import CHUNK_BYTES, trim
from aftbed.runtime.unix.linux import Area
from aftbed.runtime.unix.options import LoadRun, PolicyOptions, RunOptions, Work, with_names_resolved
from aftbed.runtime.unix.process_pool import PRELOADS, Started, killed_by, start_zygote
from aftbed.runtime.unix.request_store import write_given
from aftbed.runtime.unix.transport import Line, decode_order, decode_report

if TYPE_CHECKING:
    from aftbed.functions.request_file import GivenRequests

END_SECONDS_MAX: Final = 8.0
KILL_SECONDS_MAX: Final = 1.0
FILES_MIN, FILES_GOOD = 256, 1024  # a supervisor of 37 processes holds 180, more while it adapts
BACKLOG: Final = 128  # connections that wait for the hub
GO: Final = b"go"


def ensure_limits() -> None:
    """Raise the soft limit on open files if a run could need more.

    Raises ConfigError where a limit, or the umask, does not allow a run.
    """
    files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and files < FILES_GOOD:
        files = FILES_GOOD if most == resource.RLIM_INFINITY else min(most, FILES_GOOD)
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, most))
        if files < FILES_MIN:
            raise ConfigError(
                f"{files} open files are allowed, and a run needs {FILES_MIN}: ulimit -n {FILES_GOOD}"
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


def bind_hub(port: int) -> socket.socket:
    """The hub's listening socket on the loopback; `port` 0 is any. Raises ConfigError if it is in use."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(("127.0.0.1", port))
        sock.listen(BACKLOG)
    except OSError as error:
        sock.close()
        raise ConfigError(
            f"--bus-port {port}: {error.strerror}; choose another, or 0 for any free one"
        ) from None
    return sock


_WARM: Final[dict[str, tuple[Area, ...]]] = {}  # by zygote: where its nodes will write to


def warm_up(name: str) -> None:
    """Import and rehearse what the zygote `name` hands on, for all runs of this process and of its forks.

    Their zygotes are forks from then on. That is for a process that starts many runs.
    """
    from aftbed.runtime.unix import prefault, supervisor, zygote  # noqa: PLC0415 - for many runs

    assert supervisor and zygote
    if name not in _WARM:
        for module in PRELOADS[name]:
            importlib.import_module(module)
        _WARM[name] = prefault.warm_up()


def _fork_zygote(cpus: list[int], areas: tuple[Area, ...]) -> Started:
    """A zygote that is a fork of this process, which is warm: it saves 0.2 s of imports."""
    from aftbed.runtime.unix import zygote  # noqa: PLC0415 - imported by `warm_up`

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    supervisor = os.getpid()
    pid = os.fork()
    if pid == 0:
        try:
            os.dup2(theirs.fileno(), linux.INHERITED_FD)
            os.closerange(linux.INHERITED_FD + 1, 1 << 16)
            # The parent's may write to descriptors that are closed now, and will be those of journals.
            sys.stdout, sys.stderr = (open(fd, "w", buffering=1, closefd=False) for fd in (1, 2))  # noqa: SIM115
            zygote.run(supervisor, cpus, (), areas)
        finally:
            os._exit(1)
    theirs.close()
    return pid, ours


class Launched:
    """A run in progress, seen from its command. `end` is set when it has ended in order.

    `trouble`: why its supervisor could not go on, "" if it could.
    """

    def __init__(
        self, options: RunOptions, listener: socket.socket | None, given: "GivenRequests | None" = None
    ) -> None:
        self.options = options
        self.private, self.record = Path(options.private), Path(options.record)
        self._kept = self.record.parent != self.private  # after the run
        self.started_ns = time.monotonic_ns()
        self.end: dict[str, object] | None = None
        self.trouble = ""
        self._waited = False
        self.supervisor = 0
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line = Line(ours, decode_report)
        try:
            self._fork(listener, theirs)
        except OSError:
            self.line.close()  # what was forked ends without a *go*
            if self.supervisor:
                os.waitpid(self.supervisor, 0)
            raise
        self._make_directories(given)

    # -- start --------------------------------------------------------------------------------

    def _fork(self, listener: socket.socket | None, theirs: socket.socket) -> None:
        """Fork the supervisor and the warden, each with its ends of a line and of two pipes."""
        command_end, command_life = os.pipe()
        supervisor_end, supervisor_life = os.pipe()
        waker = os.eventfd(0)
        self.supervisor = os.fork()
        if self.supervisor == 0:
            linux.continue_at_parents_death()
            os.setsid()
            for fd in (command_end, command_life, supervisor_end):
                os.close(fd)
            self.line.close()
            self._be_supervisor(theirs, waker)
        self._pidfd = os.pidfd_open(self.supervisor)
        theirs.close()
        os.close(supervisor_life)
        self.warden = os.fork()
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
        _LAUNCHED.add(self)

    def _be_supervisor(self, owner: socket.socket, waker: int) -> NoReturn:
        code = 1
        try:
            if owner.recv(len(GO)) != GO:
                os._exit(code)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            run_directory.mark(self.private)
            os.environ[run_directory.VARIABLE] = str(self.private)  # of all that is executed from here on
            log = os.open(self.record / "processes.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            os.dup2(log, 1)
            os.dup2(log, 2)
            linux.set_name("aftbed-supervis")
            cpus = sorted(os.sched_getaffinity(0))
            load = isinstance(self.options.work, LoadRun)
            largest = LIGHT if load else BUS
            if (areas := _WARM.get(largest)) is not None:
                names = (LIGHT,) if load else (LIGHT, BUS)
                zygotes = {name: _fork_zygote(cpus, areas) for name in names}
            else:  # it imports while this process does; the smaller one is started by the supervisor
                zygotes = {largest: start_zygote(largest, cpus)}
            from aftbed.runtime.unix.supervisor import supervise  # noqa: PLC0415 - behind the first zygote

            supervise(self.options, owner, zygotes, UndoLedger(self.private, waker))
            code = 0
        except (AftbedError, OSError) as error:  # of the machine: a full disk, a limit
            if isinstance(error, OSError):
                error = HarnessError(
                    f"the supervisor cannot go on: {error.strerror}{_hint(error, self.record)}"
                )
            with contextlib.suppress(OSError):
                Line(owner, decode_order).send(control.Report("trouble", str(error).encode()))
        except BaseException:  # noqa: BLE001 - the last frame of this process
            import traceback  # noqa: PLC0415 - rarely needed

            traceback.print_exc()
        finally:
            os._exit(code)

    def _make_directories(self, given: "GivenRequests | None") -> None:
        """Make the private directory and the record, with what was asked for in it, and send *go*."""
        about = {"version": __version__, "started_ns": self.started_ns, **msgspec.to_builtins(self.options)}
        for key in ("listener", "private"):
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
                    case "finished":
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
        if not _ends(self._pidfd, END_SECONDS_MAX):
            linux.kill(self._pidfd, signal.SIGKILL)
            _ends(self._pidfd, KILL_SECONDS_MAX)
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
        if not _ends(self._warden_pidfd, KILL_SECONDS_MAX):
            linux.kill(self._warden_pidfd, signal.SIGKILL)  # a stopped warden would never end
        os.waitpid(self.warden, 0)
        _LAUNCHED.discard(self)
        os.close(self._pidfd)
        os.close(self._warden_pidfd)

    def disown(self) -> None:
        """Forget the run in a child of the command, which must not end it."""
        self.line.close()
        for fd in (*self._life, self._pidfd, self._warden_pidfd):
            os.close(fd)


def _hint(error: OSError, record: Path) -> str:
    """What to look at, where that can be told from the error."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f": is the disk of {record} full?"
    return f": {error.filename}" if error.filename else ""


_LAUNCHED: Final[weakref.WeakSet[Launched]] = weakref.WeakSet()


def _disown_all() -> None:
    for launched in list(_LAUNCHED):
        launched.disown()
    _LAUNCHED.clear()  # a child of this child has other descriptors by the same numbers


os.register_at_fork(after_in_child=_disown_all)


def _ends(pidfd: int, seconds: float) -> bool:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(seconds * 1e3))


def launch(
    options: RunOptions, listener: socket.socket | None, given: "GivenRequests | None" = None
) -> Launched:
    """Start a run, of the requests `given` where its work names some; see `Launched`.

    Raises ConfigError, leaving nothing, where it cannot be started.
    """
    try:
        return Launched(options, listener, given)
    except BaseException as error:
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
) -> tuple[RunOptions, socket.socket | None]:
    """What a run needs; where there is a bus, its socket too. Raises ConfigError, leaving nothing."""
    faults = tuple(with_names_resolved(fault, work) for fault in faults)
    ensure_limits()
    listener = None if isinstance(work, LoadRun) else bind_hub(bus_port)
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
    )
    return options, listener
