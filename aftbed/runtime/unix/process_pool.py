"""The supervisor's processes: zygotes, the spares that they parked, and what spares became.

Everything is found by its own pidfd and its own control line; nothing is ever killed by name.
"""

import contextlib
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.runtime import control, interface
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.tasks import Key, Wait
from aftbed.runtime.unix import linux, run_directory
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.journal_files import Header
from aftbed.runtime.unix.spawn import Started, start_zygote
from aftbed.runtime.unix.transport import Line, decode_report

REAP_SECONDS: Final = 0.01
SPARE_SECONDS_MAX: Final = 5.0  # a zygote imports first
DEMAND: Final = 3  # spares that are forked where one is waited for: whoever takes one takes more
PARK_BATCH: Final = 8  # spares per order: the first of them start while the next are forked
WATCHING_KINDS: Final = ("watchdog", "recovery")


class UnixProcess:
    """A child of the supervisor."""

    def __init__(
        self, name: str, kind: ProcessKind, line: Line[control.FromNode], ledger: UndoLedger
    ) -> None:
        self.name, self.kind, self.line, self._ledger = name, kind, line, ledger
        self.pid, self.pidfd = 0, -1
        self.journal = ""
        self.header: Header | None = None
        self.alive = True
        self.incarnation = 0
        self.bricks: tuple[tuple[str, str], ...] = ()
        self.starvation: linux.Starvation | None = None

    def born(self, pid: int) -> None:
        """The process exists; it cannot be reaped by another, so the pid is its own."""
        self.pid, self.pidfd = pid, os.pidfd_open(pid)
        self.starvation = linux.Starvation(pid)

    def hangs(self, now_ns: int, deadline_ns: int) -> bool:
        """Whether its pulse is older than `deadline_ns`, though the machine lets it run."""
        if self.header is None or self.starvation is None:
            return False
        pulse_ns = self.header.pulse_ns()
        if pulse_ns == 0 or now_ns - pulse_ns < deadline_ns // 2:
            self.starvation.forget()
            return False
        return not self.starvation.starves(now_ns) and now_ns - pulse_ns > deadline_ns

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
        """SIGCONT; False if it is gone. One that is not seen to go on is left to the warden."""
        sent = self._signal(signal.SIGCONT)
        if sent and run_directory.state_of(self.pid) != "T":
            self._ledger.undone(self.pid)
        return sent

    def _signal(self, sig: signal.Signals) -> bool:
        return self.pidfd >= 0 and linux.kill(self.pidfd, sig)

    def silent(self, now_ns: int, deadline_ns: int) -> bool:
        """Whether it lives, as far as is known, and its pulse is older than `deadline_ns`."""
        pulse_ns = self.header.pulse_ns() if self.alive and self.header is not None else 0
        return 0 < pulse_ns < now_ns - deadline_ns

    def stopped(self) -> bool:
        """Whether the kernel has it in state `T` (proc(5)), or as a dead one."""
        try:
            stat = Path(f"/proc/{self.pid}/stat").read_text()
        except OSError:
            return True
        return stat.rpartition(")")[2].split()[0] in "TZX"

    def assigned(self) -> None:
        """The Ack of an Assign is here: its journal exists."""
        if self.header is None and self.journal and Path(self.journal).exists():
            self.header = Header(Path(self.journal))

    def watches(self) -> bool:
        """Whether it would act on the death of another."""
        return any(kind in WATCHING_KINDS for _, kind in self.bricks)

    def announce(self) -> None:
        """Raise the flag: an order waits."""
        if self.header is not None:
            self.header.announce()

    def announced(self) -> bool:
        """Whether it has yet to see the flag."""
        return self.header is not None and self.header.announced()

    def close(self) -> None:
        """Let go of all descriptors."""
        self.alive = False
        self.line.close()
        if self.pidfd >= 0:
            os.close(self.pidfd)
            self.pidfd = -1
        if self.header is not None:
            self.header.close()
            self.header = None


class UnixProcessPool:
    """Two zygotes, and what they park. `on_report` and `on_death` are the supervisor's."""

    def __init__(
        self,
        loop: EventLoop,
        on_report: Callable[[UnixProcess, msgspec.Struct], None],
        on_death: Callable[[UnixProcess], None],
        ledger: UndoLedger,
    ) -> None:
        self._loop, self._ledger = loop, ledger
        self._cpus = sorted(os.sched_getaffinity(0))
        self._on_report, self._on_death = on_report, on_death
        self.processes: list[UnixProcess] = []
        self.zygotes: dict[str, UnixProcess] = {}
        self.parked: dict[str, deque[UnixProcess]] = {}
        self._unborn: dict[str, list[UnixProcess]] = {}
        self._levels: dict[str, int] = {}

    # -- zygotes ------------------------------------------------------------------------------

    def start_zygote(self, name: str, started: Started | None = None) -> None:
        """Take over a zygote that has been started, or start one."""
        self.parked.setdefault(name, deque())
        self._unborn[name] = []
        pid, ours = started or start_zygote(name, self._cpus)
        process = self._adopt(name, ProcessKind.ZYGOTE, ours)
        process.born(pid)
        self.zygotes[name] = process
        self._watch(process)

    def restart_zygote(self, name: str) -> None:
        """After its death: a new one, and the spares that the old one did not get to fork."""
        wanted = len(self._unborn[name])
        for process in self._unborn[name]:
            self._forget(process)
        self.start_zygote(name)
        self.park(name, wanted)

    # -- spares -------------------------------------------------------------------------------

    def park(self, zygote: str, count: int) -> None:
        """Have `count` more spares forked."""
        while count > 0:
            batch = min(count, PARK_BATCH)
            pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(batch)]
            for ours, _ in pairs:
                self._unborn[zygote].append(self._adopt("spare", ProcessKind.SPARE, ours))
            with contextlib.suppress(OSError):  # a dead zygote: its restart asks again
                fds = tuple(end.fileno() for _, end in pairs)
                self.zygotes[zygote].line.send(control.Park(0), fds)
            for _, theirs in pairs:
                theirs.close()
            count -= batch

    def spare(self, zygote: str) -> Generator[Wait, dict[Key, bytes], UnixProcess]:
        """A parked spare; waits for one to be forked if there is none."""
        while True:
            while not self.parked[zygote]:
                if not self._unborn[zygote]:
                    self.park(zygote, DEMAND)
                yield Wait(frozenset({("spare", zygote, 0)}), seconds=SPARE_SECONDS_MAX)
            process = self.parked[zygote].popleft()
            if process.alive:
                return process

    def parked_at_least(self, zygote: str, count: int) -> Generator[Wait, dict[Key, bytes], None]:
        """Wait until `count` spares are parked."""
        while len(self.parked[zygote]) < count:
            yield Wait(frozenset({("spare", zygote, 0)}), seconds=SPARE_SECONDS_MAX)

    def wait_for_forks(self, zygote: str) -> Generator[Wait, dict[Key, bytes], None]:
        """Wait until no spare is being forked: what comes next shall have the CPUs."""
        while self._unborn[zygote]:
            yield Wait(frozenset({("spare", zygote, 0)}), seconds=SPARE_SECONDS_MAX)

    def refill(self, zygote: str, count: int) -> None:
        """Have `count` spares parked, in the end: one after the other, since others need the CPUs, too."""
        self._levels[zygote] = count
        self._fill(zygote)

    def _fill(self, zygote: str) -> None:
        """Fork the next one to the level asked for. Once that is reached, what is taken is not replaced."""
        if len(self.parked[zygote]) >= self._levels.get(zygote, 0):
            self._levels.pop(zygote, None)
        elif not self._unborn[zygote]:
            self.park(zygote, 1)

    def _adopt(self, name: str, kind: ProcessKind, sock: socket.socket) -> UnixProcess:
        sock.setblocking(False)
        process = UnixProcess(name, kind, Line(sock, decode_report), self._ledger)
        self.processes.append(process)
        self._loop.read(sock.fileno(), lambda: self._heard(process))
        return process

    def _watch(self, process: UnixProcess) -> None:
        self._loop.read(process.pidfd, lambda: self._died(process), patient=True)

    def _heard(self, process: UnixProcess) -> None:
        """Read what the process says; its death is the pidfd's business, not the line's."""
        while process.alive:
            try:
                got = process.line.recv()
            except BlockingIOError:
                return
            except OSError:
                got = None
            if got is None:
                self._loop.forget(process.line.fileno())
                return
            message, fds = got
            assert not fds, f"{process.name} sent descriptors"
            if isinstance(message, control.Hello) and process.kind is ProcessKind.SPARE and not process.pid:
                self._hello(process, message.pid)
            elif not isinstance(message, control.Hello):
                self._on_report(process, message)

    def _hello(self, process: UnixProcess, pid: int) -> None:
        process.born(pid)
        self._watch(process)
        for name, unborn in self._unborn.items():
            if process in unborn:
                unborn.remove(process)
                self.parked[name].append(process)
                self._fill(name)
                self._loop.tasks.settle(("spare", name, 0))

    # -- death --------------------------------------------------------------------------------

    def _died(self, process: UnixProcess) -> None:
        """It can be reaped at leisure: others wait for a failover just now."""
        self._heard(process)  # its last words are still in the line
        self._loop.forget(process.pidfd)
        process.alive = False
        self._on_death(process)
        self._loop.after(REAP_SECONDS, lambda: self._reap(process))

    def _reap(self, process: UnixProcess) -> None:
        if process in self.processes:
            linux.reap(process.pid)
            self._forget(process)

    def _forget(self, process: UnixProcess) -> None:
        if process.pidfd >= 0:
            self._loop.forget(process.pidfd)
        self._loop.forget(process.line.fileno())
        process.close()
        self.processes.remove(process)
        for pool in (*self.parked.values(), *self._unborn.values()):
            if process in pool:
                pool.remove(process)

    def order(self, process: interface.Process, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send `order`. Raises StepFailed if the process is gone or does not read its line."""
        assert isinstance(process, UnixProcess)
        try:
            process.line.send(order, fds)
        except OSError as error:
            raise StepFailed(f"{process.name} cannot be reached: {error.strerror}") from None
