"""Which nodes are seen alive, by the tables of `aftbed.runtime.unix.liveness`, on real processes.

A node that waits, is stopped, loops or is blocked in a brick; and a machine that does not let a process run,
which is no hang.
"""

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.brick import Brick, Effect
from aftbed.core.messages import AnyMessage, Rebound, Request, encode
from aftbed.runtime import control
from aftbed.runtime.devices import LOOK_NS
from aftbed.runtime.node import Node
from aftbed.runtime.unix.devices import ProcessSenses
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.linux import set_timeouts, state_of
from aftbed.runtime.unix.liveness import EXCUSED_NS_MAX, STILL_NS, Liveness, Starvation
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import ANNOUNCED, ORDER_SECONDS, Line, decode_order

SECONDS_MAX: Final = 20.0
LOOKS: Final = 4
LOOP, BLOCK, PASS = b"loop", b"block", b"pass"


class Obedient(Brick):
    """Does what a request says: loops for ever, blocks for ever, or nothing."""

    def __init__(self, reached: int) -> None:
        self._reached = reached  # a pipe: a byte for each request that has come

    def open_ports(self) -> tuple[str, ...]:
        return ("in",)

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if isinstance(msg, Rebound):
            return []
        assert isinstance(msg, Request)
        os.write(self._reached, b".")
        while msg.payload == LOOP:
            pass
        while msg.payload == BLOCK:
            time.sleep(60)
        return []


class NodeProcess:
    """A node in a process of its own, with the other ends of its input and its control line."""

    def __init__(self, journal: Path, *, suspended: bool = False) -> None:
        self.line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        reading, self._input = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._reached, reached = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            self.line.close()
            set_timeouts(theirs, ORDER_SECONDS, 2.0)
            io = UnixIO(Line(theirs, decode_order), JournalFile(journal, "node"))
            node = Node("node", io)
            node.add("brick", Obedient(reached))
            node.bind_input("brick", "in", os.dup(reading.fileno()))
            node.suspended = suspended
            io.serve()
        for end in (theirs, reading):
            end.close()
        os.close(reached)
        wait_for(lambda: journal.exists() and journal.stat().st_size > 0)
        self.liveness = Liveness(self.pid, journal)

    def ask(self, what: bytes) -> None:
        """Send a request, and wait until the brick has it."""
        self._input.send(encode(Request(1, 1, what)))
        assert os.read(self._reached, 1) == b"."

    def announce(self) -> None:
        """Begin to send a large packet, and wait until the node waits for the rest of it."""
        self._input.send(ANNOUNCED)  # wakes it
        self.asleep()

    def asleep(self) -> None:
        wait_for(lambda: state_of(self.pid) == "S")

    def close(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        self.liveness.close()
        for end in (self.line, self._input):
            end.close()
        os.close(self._reached)


@contextmanager
def node_process(tmp_path: Path, *, suspended: bool = False) -> Iterator[NodeProcess]:
    node = NodeProcess(tmp_path / "node.journal", suspended=suspended)
    try:
        yield node
    finally:
        node.close()


def wait_for(condition: Callable[[], bool]) -> None:
    limit = time.monotonic() + SECONDS_MAX
    while not condition():
        assert time.monotonic() < limit, "it does not come to that"
        os.sched_yield()


def switches(pid: int) -> list[str]:
    """How often the process has left its core so far."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return [line for line in lines if "ctxt_switches" in line]


def looks(node: NodeProcess) -> list[bool]:
    """Whether some looks, as far apart as those of a Watchdog, see the node alive."""
    seen = []
    for _ in range(LOOKS):
        now_ns = time.monotonic_ns()
        seen.append(node.liveness.seen_ns(now_ns) == now_ns)
        wait_for(lambda now_ns=now_ns: time.monotonic_ns() - now_ns > LOOK_NS)  # type: ignore[misc]
    return seen


def test_a_node_that_waits_for_mail_is_seen_alive_while_it_sleeps(tmp_path: Path) -> None:
    with node_process(tmp_path) as node:
        node.ask(PASS)
        node.asleep()
        before = switches(node.pid)
        assert looks(node) == [True] * LOOKS
        assert switches(node.pid) == before, "it was woken up for that"


def test_a_node_that_waits_for_the_rest_of_a_large_packet_is_seen_alive(tmp_path: Path) -> None:
    """Its writer may have been stopped, or not let run, in the midst of sending it."""
    with node_process(tmp_path) as node:
        node.ask(PASS)
        node.asleep()
        node.announce()
        assert looks(node) == [True] * LOOKS


def test_a_suspended_node_is_seen_alive(tmp_path: Path) -> None:
    with node_process(tmp_path, suspended=True) as node:
        node.asleep()
        for _ in range(LOOKS):  # it looks around now and then, and may do so just now
            wait_for(lambda: node.liveness.seen_ns(now_ns := time.monotonic_ns()) == now_ns)


@pytest.mark.parametrize("trouble", [LOOP, BLOCK])
def test_a_node_that_is_stuck_in_a_brick_is_not_seen_alive(tmp_path: Path, trouble: bytes) -> None:
    """The first look sees that it has begun to; what it does is compared from the second one on."""
    with node_process(tmp_path) as node:
        node.ask(trouble)
        if trouble == BLOCK:
            node.asleep()
        wait_for(lambda: not any(looks(node)))  # a busy machine excuses one that loops


def test_a_stopped_node_is_seen_alive_when_it_goes_on(tmp_path: Path) -> None:
    with node_process(tmp_path) as node:
        node.ask(PASS)
        node.asleep()
        assert all(looks(node))
        os.kill(node.pid, signal.SIGSTOP)
        wait_for(lambda: state_of(node.pid) == "T")
        now_ns = time.monotonic_ns()
        assert node.liveness.seen_ns(now_ns) == now_ns - LOOK_NS, "the last look was longer ago"
        assert not any(looks(node))
        os.kill(node.pid, signal.SIGCONT)
        wait_for(lambda: all(looks(node)))


def test_a_node_that_is_stopped_before_the_first_look_is_not_alive_from_there_on(tmp_path: Path) -> None:
    with node_process(tmp_path) as node:
        node.asleep()
        os.kill(node.pid, signal.SIGSTOP)
        wait_for(lambda: state_of(node.pid) == "T")
        now_ns = time.monotonic_ns()
        assert node.liveness.seen_ns(now_ns) == now_ns - LOOK_NS, "it was alive when it was made"
        assert node.liveness.seen_ns(now_ns + LOOK_NS) == now_ns - LOOK_NS


def test_a_stop_is_noticed_by_the_next_look_whatever_the_node_did_before(tmp_path: Path) -> None:
    with node_process(tmp_path) as node:
        node.ask(PASS)
        node.asleep()
        assert all(looks(node))
        node.ask(PASS)
        node.asleep()
        os.kill(node.pid, signal.SIGSTOP)
        wait_for(lambda: state_of(node.pid) == "T")
        now_ns = time.monotonic_ns()
        assert node.liveness.seen_ns(now_ns) < now_ns


def test_a_node_that_works_is_seen_alive_whenever_one_looks(tmp_path: Path) -> None:
    """A look finds it in a brick as often as not: the activity is another one then."""
    with node_process(tmp_path) as node:
        for _ in range(LOOKS):
            node.ask(PASS)
            now_ns = time.monotonic_ns()
            assert node.liveness.seen_ns(now_ns) == now_ns


def test_a_death_is_seen_before_the_process_is_reaped(tmp_path: Path) -> None:
    with node_process(tmp_path) as node:
        assert not node.liveness.dying()
        os.kill(node.pid, signal.SIGKILL)
        wait_for(node.liveness.dying)
        assert not any(looks(node)[1:])


def test_where_the_kernel_has_no_lifelines_a_watchdog_sleeps_until_a_pidfd_reports_a_death(
    tmp_path: Path,
) -> None:
    """The end of the pipe of lifelines is no death, and is not polled again."""
    journal = tmp_path / "node.journal"
    JournalFile(journal, "node")
    with process(ASLEEP) as child:
        senses = ProcessSenses()
        order = control.WatchNodes(1, "a", 1, ("node",), (str(journal),), (child.pid,))
        senses.watch(order, [os.pidfd_open(child.pid)], lambda node: None)
        (deaths,) = senses.fds()
        assert select.select([deaths], [], [], SECONDS_MAX)[0]
        assert senses.died(deaths) == []
        assert not select.select([deaths], [], [], 0)[0]
        child.kill()
        assert select.select([deaths], [], [], SECONDS_MAX)[0]
        assert senses.died(deaths) == ["node"]
        senses.forget()
        assert senses.fds() == ()


# -- a machine that does not let a process run ------------------------------------------------------

ASLEEP = "print(flush=True); import time; time.sleep(60)"
LOOPS = """
import os
os.sched_setaffinity(0, {%d})
%s
print(flush=True)
while True: pass
"""
WAITS = """
import os
os.sched_setaffinity(0, {%d})
parent = os.getpid()
if not os.fork():
    %s
    print(flush=True)
    while os.getppid() == parent: pass
    os._exit(0)
os.wait()
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


def test_one_that_sleeps_and_did_not_have_to_wait_for_its_core_hangs() -> None:
    """It is asked only where it is in a brick; a node that waits for mail is seen alive."""
    with process(ASLEEP) as child:
        starvation = Starvation(child.pid)
        _until_asleep(child.pid)
        assert not starvation.starves(2)
        assert not starvation.starves(2 + PERIOD_NS)


def test_no_excuse_lasts_for_ever() -> None:
    cpu = min(os.sched_getaffinity(0))
    with process(LOOPS % (cpu, WEAK)) as weak, process(LOOPS % (cpu, "")):
        starvation = Starvation(weak.pid)
        assert not starvation.starves(2), "nothing to compare with"
        assert starvation.starves(2 + EXCUSED_NS_MAX)
        assert not starvation.starves(3 + EXCUSED_NS_MAX)
        starvation.forget()
        assert not starvation.starves(4 + EXCUSED_NS_MAX)
        assert starvation.starves(4 + 2 * EXCUSED_NS_MAX)


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


def test_one_that_waits_for_a_child_which_starves_does_so_too() -> None:
    """As a Server whose function is a program: it sleeps in a read until the program answers."""
    cpu = min(os.sched_getaffinity(0))
    with process(WAITS % (cpu, WEAK)) as waiting, process(LOOPS % (cpu, "")) as strong:
        _until_asleep(waiting.pid)
        starvation, before = Starvation(waiting.pid), _cpu_ns(strong.pid)
        assert not starvation.starves(1), "nothing to compare with"
        while _cpu_ns(strong.pid) - before < PERIOD_NS:
            os.sched_yield()
        assert starvation.starves(1 + PERIOD_NS)


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


def test_one_that_ran_and_is_let_run_no_more_starves() -> None:
    """As on a virtual core that stood still, which is then charged to it as CPU time."""
    cpu = min(os.sched_getaffinity(0))
    with process(LOOPS % (cpu, WEAK)) as weak:
        starvation, before_ns = Starvation(weak.pid), _cpu_ns(weak.pid)
        assert not starvation.starves(1)
        while _cpu_ns(weak.pid) - before_ns < PERIOD_NS:
            os.sched_yield()
        assert not starvation.starves(1 + PERIOD_NS)
        with process(LOOPS % (cpu, "")):
            limit = time.monotonic() + SECONDS_MAX
            while True:  # the weak one gets a little now and then
                assert time.monotonic() < limit, "it never starves"
                ran_ns = _cpu_ns(weak.pid)
                starvation.starves(2 + PERIOD_NS)
                if starvation.starves(2 + PERIOD_NS + STILL_NS):
                    return
                assert _cpu_ns(weak.pid) > ran_ns, "it got nothing, and does not starve"


def _until_asleep(pid: int) -> None:
    limit = time.monotonic() + 5.0
    while _state(pid) != "S":
        assert time.monotonic() < limit, "it does not fall asleep"
        os.sched_yield()


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def _cpu_ns(pid: int) -> int:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
