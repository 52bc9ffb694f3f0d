"""The pool of processes: zygotes, the spares that they fork, and what the spares became.

Each is identified by its own pidfd and its own control line; no process is ever killed by name.
"""

import contextlib
import os
import signal
import socket
import sys
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import HarnessError, StepFailed, function_failed
from aftbed.ftm.registry import installed_mechanisms
from aftbed.runtime import control, interface
from aftbed.runtime.interface import LIGHT, ProcessKind
from aftbed.runtime.tasks import Key, Wait
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.liveness import Liveness
from aftbed.runtime.unix.transport import FDS_MAX, Line, decode_report

REAP_SECONDS: Final = 0.01  # a failover does not wait for the reaping of a dead process
SPARE_SECONDS_MAX: Final = 5.0  # a zygote imports first
DEMAND: Final = 3  # spares that are forked where one is waited for: the next ones are wanted soon
ANEW_SECONDS: Final = 0.05  # from the end of a spare before its first message to the order of another one
EARLY_ENDS_MAX: Final = 100  # spares in a row that end so
WATCHING_KINDS: Final = ("watchdog", "recovery")
SERVER: Final = "server"  # the kind of brick that hosts the function
CRASHES: Final = (signal.SIGSEGV, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)

Started = tuple[int, socket.socket]  # a zygote's pid, and our end of its control line


def start_zygote(name: str, cpus: list[int]) -> Started:
    """Start the zygote called `name` as a child of this process.

    In a fresh interpreter, because whatever its parent has imported would weigh on every fork and every
    death.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        arguments = (str(os.getpid()), ",".join(map(str, cpus)), name)
        return linux.start_interpreter("aftbed.runtime.unix.zygote", theirs.fileno(), *arguments), ours


def killed_by(sig: int, record: Path) -> str:
    """What ended a process with a journal in `record`."""
    if sig == signal.SIGBUS:
        return f"was killed by SIGBUS, as where a journal finds no room: is the disk of {record} full?"
    return f"was killed by {signal.Signals(sig).name}"


class UnixProcess:
    """A child of the supervisor: see `runtime.interface.Process`."""

    def __init__(
        self, name: str, kind: ProcessKind, line: Line[control.FromNode], ledger: UndoLedger
    ) -> None:
        self.name, self.kind, self.line, self._ledger = name, kind, line, ledger
        self.pid, self.pidfd = 0, -1
        self.journal = ""
        self._liveness: Liveness | None = None  # of a node that has a journal
        self.alive = True
        self.incarnation = 0
        self.bricks: tuple[tuple[str, str], ...] = ()

    def born(self, pid: int) -> None:
        """The process exists; only this one can reap it, so the pid cannot have been given away."""
        self.pid, self.pidfd = pid, os.pidfd_open(pid)

    def kill(self) -> bool:
        """SIGKILL; False if it is gone."""
        return self._signal(signal.SIGKILL)

    def freeze(self, for_ms: int = 0) -> bool:
        """SIGSTOP, once its undo is written (`runtime.unix.cleanup`); False if it is gone.

        Raises StepFailed, having stopped nothing, if it cannot be written.
        """
        if self.pidfd < 0:
            return False
        self._ledger.ahead(self.name, self.pid, for_ms)
        return self._signal(signal.SIGSTOP)

    def thaw(self) -> bool:
        """SIGCONT; False if it is gone. If it is not seen to run again, the warden retries."""
        sent = self._signal(signal.SIGCONT)
        if sent and linux.state_of(self.pid) != "T":
            self._ledger.undone(self.pid)
        return sent

    def _signal(self, sig: signal.Signals) -> bool:
        return self.pidfd >= 0 and linux.kill(self.pidfd, sig)

    def stopped(self) -> bool:
        """Whether the kernel has it in state `T` (proc(5)), or as a dead one."""
        return linux.state_of(self.pid) in ("T", "X", "Z", "")

    def dying(self) -> bool:
        """Whether it is dead, or the kernel has begun to end it, which its pidfd does not show yet."""
        return not self.alive or (self._liveness is not None and self._liveness.dying())

    def hangs(self, now_ns: int, deadline_ns: int) -> bool:
        """Whether it was not seen alive for `deadline_ns`, though the machine lets it run. This is a look."""
        return self._liveness is not None and now_ns - self._liveness.seen_ns(now_ns) > deadline_ns

    def assigned(self) -> None:
        """It has acknowledged an Assign, so its journal exists."""
        if self._liveness is None and self.journal:
            with contextlib.suppress(FileNotFoundError):  # one that refuses its Assign may have made none
                self._liveness = Liveness(self.pid, self.journal)

    def announce(self) -> None:
        """Raise the flag: an order waits."""
        if self._liveness is not None:
            self._liveness.header.announce()

    def announced(self) -> bool:
        """Whether it has yet to see the flag."""
        return self._liveness is not None and self._liveness.header.announced()

    def killed_in_turn(self) -> int:
        """Its place when all are killed: those that act on the death of others first, and the hub last.

        A client of the hub that outlives it ends in an error, and reports that.
        """
        if any(kind in WATCHING_KINDS for _, kind in self.bricks):
            return 0
        return 2 if self.name == control.HUB else 1

    def close(self) -> None:
        """Close all descriptors."""
        self.alive = False
        self.line.close()
        if self.pidfd >= 0:
            os.close(self.pidfd)
            self.pidfd = -1
        if self._liveness is not None:
            self._liveness.close()
            self._liveness = None


class UnixProcessPool:
    """See `runtime.interface.ProcessPool`. `on_report` and `on_death` are the supervisor's; `application`:
    the protected function.
    """

    def __init__(
        self,
        loop: EventLoop,
        on_report: Callable[[UnixProcess, msgspec.Struct], None],
        on_death: Callable[[UnixProcess], None],
        ledger: UndoLedger,
        application: str,
    ) -> None:
        self._loop, self._ledger, self._application = loop, ledger, application
        self._cpus = sorted(os.sched_getaffinity(0))
        self._on_report, self._on_death = on_report, on_death
        self.processes: list[UnixProcess] = []
        self.zygotes: dict[str, UnixProcess] = {}
        self._parked: dict[str, deque[UnixProcess]] = {}  # by zygote
        self._unborn: dict[str, list[UnixProcess]] = {}  # ordered from their zygote, not seen yet
        self._levels: dict[str, int] = {}  # to which spares are refilled
        self._early_ends = 0  # spares in a row that ended before their first message

    def start_zygote(self, name: str, started: Started | None = None) -> None:
        """Take over a zygote that was started already, or start one."""
        self._parked.setdefault(name, deque())
        self._unborn[name] = []
        pid, ours = started or start_zygote(name, self._cpus)
        self.zygotes[name] = self._add(name, ProcessKind.ZYGOTE, ours)
        self._born(self.zygotes[name], pid)

    def restart_zygote(self, name: str) -> None:
        """Replace a dead zygote, and order the spares from it that the old one did not fork any more."""
        unborn = list(self._unborn[name])
        for process in unborn:
            self._forget(process)
        self.start_zygote(name)
        self.park(name, len(unborn))

    # -- spares -------------------------------------------------------------------------------

    def park(self, zygote: str, count: int) -> None:
        """Have `count` more spares forked."""
        for first in range(0, count, FDS_MAX):
            pairs = [
                socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                for _ in range(min(FDS_MAX, count - first))
            ]
            self._unborn[zygote] += [self._add("spare", ProcessKind.SPARE, ours) for ours, _ in pairs]
            with contextlib.suppress(OSError):  # a dead zygote: its restart orders them again
                imports = (installed_mechanisms(), self._application) if zygote == LIGHT else ()
                order = control.Park(0, *imports)
                self.zygotes[zygote].line.send(order, tuple(end.fileno() for _, end in pairs))
            for _, theirs in pairs:
                theirs.close()

    def spare(self, zygote: str) -> Generator[Wait, dict[Key, bytes], UnixProcess]:
        """A parked spare; waits for one to be forked if there is none."""
        while True:
            while not self._parked[zygote]:
                if not self._unborn[zygote]:
                    self.park(zygote, DEMAND)
                yield _next_spare(zygote)
            process = self._parked[zygote].popleft()
            if process.alive:
                return process

    def parked_at_least(self, zygote: str, count: int) -> Generator[Wait, dict[Key, bytes], None]:
        """Wait until `count` spares are parked."""
        while len(self._parked[zygote]) < count:
            yield _next_spare(zygote)

    def wait_for_forks(self, zygote: str) -> Generator[Wait, dict[Key, bytes], None]:
        """Wait until no spare is being forked, so that the next thing to do has the CPUs."""
        while self._unborn[zygote]:
            yield _next_spare(zygote)

    def refill(self, zygote: str, count: int) -> None:
        """Have `count` spares parked in the end, forked one after the other: others need the CPUs, too.

        When the level is reached, spares that are taken are not replaced any more.
        """
        self._levels[zygote] = count
        self._refill_next(zygote)

    def _refill_next(self, zygote: str) -> None:
        if len(self._parked[zygote]) >= self._levels.get(zygote, 0):
            self._levels.pop(zygote, None)
        elif not self._unborn[zygote]:
            self.park(zygote, 1)

    # -- control lines ------------------------------------------------------------------------

    def order(self, process: interface.Process, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send `order`. Raises StepFailed if the process is gone or does not read its line."""
        assert isinstance(process, UnixProcess)
        try:
            process.line.send(order, fds)
        except OSError as error:
            raise StepFailed(f"{process.name} cannot be reached: {error.strerror}") from None

    def _add(self, name: str, kind: ProcessKind, sock: socket.socket) -> UnixProcess:
        sock.setblocking(False)
        process = UnixProcess(name, kind, Line(sock, decode_report), self._ledger)
        self.processes.append(process)
        self._loop.read(sock.fileno(), lambda: self._read_line(process))
        return process

    def _born(self, process: UnixProcess, pid: int) -> None:
        process.born(pid)
        self._loop.read(process.pidfd, lambda: self._died(process), patient=True)

    def _read_line(self, process: UnixProcess) -> bool:
        """Handle one message; False if there is none. The end of a line is no death: the pidfd shows that."""
        try:
            got = process.line.recv()
        except BlockingIOError:
            return False
        except OSError:
            got = None
        if got is None:
            self._loop.forget(process.line.fileno())
            if not process.pid:
                self._loop.after(ANEW_SECONDS, lambda: self._order_anew(process))
            return False
        message, fds = got
        assert not fds, f"{process.name} sent descriptors"
        if not isinstance(message, control.Hello):
            self._on_report(process, message)
        elif process.kind is ProcessKind.SPARE and not process.pid:
            self._early_ends = 0
            self._born(process, message.pid)
            zygote = next(name for name, unborn in self._unborn.items() if process in unborn)
            self._unborn[zygote].remove(process)
            self._parked[zygote].append(process)
            self._refill_next(zygote)
            self._loop.tasks.settle(("spare", zygote, 0))
        return process.alive

    def _order_anew(self, process: UnixProcess) -> None:
        """Have another spare forked for one that ended before its first message, or was never forked.

        No pidfd shows its end, and all that need a spare would wait for it. Raises HarnessError where spare
        after spare ends so.
        """
        for zygote, unborn in self._unborn.items():
            if process in unborn and self.zygotes[zygote].alive:  # a restart orders those of a dead one
                self._early_ends += 1
                if self._early_ends > EARLY_ENDS_MAX:
                    raise HarnessError(
                        f"no process starts: {EARLY_ENDS_MAX} in a row ended before their first message; "
                        "dmesg shows whether the kernel killed them"
                    )
                self._forget(process)
                self.park(zygote, 1)
                return

    # -- death --------------------------------------------------------------------------------

    def _died(self, process: UnixProcess) -> None:
        while self._read_line(process):  # its last messages
            pass
        self._loop.forget(process.pidfd)
        process.alive = False
        self._on_death(process)
        self._loop.after(REAP_SECONDS, lambda: self._reap(process))

    def _reap(self, process: UnixProcess) -> None:
        if process in self.processes:
            reap(process)
            self._forget(process)

    def _forget(self, process: UnixProcess) -> None:
        if process.pidfd >= 0:
            self._loop.forget(process.pidfd)
        self._loop.forget(process.line.fileno())
        process.close()
        self.processes.remove(process)
        for spares in (*self._parked.values(), *self._unborn.values()):
            if process in spares:
                spares.remove(process)


def reap(process: UnixProcess) -> bool:
    """Reap a child if it is dead; False if it is not, or not ours.

    Raises HarnessError if its journal found no room: that is a file mapped into memory, so the kernel sends
    SIGBUS. The log has the crash of a process that hosts the function, which may be a library.
    """
    code = linux.reap(process.pid)
    if code is not None and -code in CRASHES and any(kind == SERVER for _, kind in process.bricks):
        why = f"its process {killed_by(-code, Path(process.journal).parent)}"
        print(f"{process.name} (pid {process.pid}): {function_failed(why)}", file=sys.stderr, flush=True)
    if code == -signal.SIGBUS and process.journal:
        raise HarnessError(f"{process.name} {killed_by(-code, Path(process.journal).parent)}")
    return code is not None


def _next_spare(zygote: str) -> Wait:
    """Until `zygote` has forked one more spare."""
    return Wait(frozenset({("spare", zygote, 0)}), seconds=SPARE_SECONDS_MAX)
