"""The NodeIO of a node that is a process: sockets, the journal, the kernel's clock. This is the hot path.

Blocking, never spinning. A node whose bricks have one open port, which is the rule on the request path,
blocks in a plain read of that port: a poll before each read costs 1.4 us a hop (measured, 20 % of a hop). So
the control socket is not polled there; the supervisor raises a flag in the header of the node's journal and
puts a *nudge*, a packet of one byte, into the node's inputs. A node checks the flag after each wake-up,
before it handles the mail: control is served before data. It is also served while the node cannot continue:
while it is suspended, while a channel has no room, while a fault is being applied.

Two loops. `Node.turn` is the general one. `serve_fast` is the same for a node whose bricks have no deadlines
and that has nothing to poll, with all look-ups in front of the loop. It is left whenever something else is to
be done than mail between the bricks, and mail on the one open inlet: an order, the end of a channel, a large
packet, a suspend, or a fault (`FaultAgent.active`). tests/runtime/test_node_loops.py drives both with the
same mail and compares.

Around each wait, for mail, orders, room or time, the host changes the activity in the journal's header: a
byte that is even while it waits, odd while it executes bricks, and another one each time. Watchers look at it
(`liveness`), so a node that has nothing to do sleeps. The two bytes cost 0.17 us a hop; the timer that
they replaced, whose signal wrote the time, cost 17 idle processes a tenth of a core. A large packet that is
read or written counts as a wait: ten megabytes take longer than a step, and no brick is executed meanwhile.

What is read from a channel is handled before anything else is read, so mail is either in the kernel, where it
outlives this process, or inside a request that the client will ask again.

A slow node waits in the host and not in a brick: it is not taken for a hung one. With a
share of a CPU, it waits between a step and its effects for as long as the CPU time that it used would have
taken longer: with 25 %, three times that. What it sleeps too long is waited less the next time, so the share
is exact in the long run, and nothing outside of the node has to be undone.
"""

import contextlib
import io
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Final, NoReturn

from aftbed.core import messages
from aftbed.core.brick import Note, Send
from aftbed.core.errors import FunctionFailedError, PeerError, function_failed
from aftbed.core.events import Event
from aftbed.core.journal import ACTIVITY_OFFSET, FLAG_OFFSET, RECORD
from aftbed.core.messages import ChannelEnded, Message
from aftbed.inject.slow import SLOW_MS_MAX
from aftbed.runtime import control
from aftbed.runtime.node import HostedBrick, Node, NodeIO, Recorder
from aftbed.runtime.unix import transport
from aftbed.runtime.unix.death_notice import Lifeline
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.transport import NUDGE, READ_BYTES_MAX, WRITE_SECONDS_MAX, Line

APPLY_NS_MAX: Final = 5_000_000_000  # the executive has so long to apply a fault
PAUSE_NS_MAX: Final = round(SLOW_MS_MAX * 1e6)  # of one step; the rest is waited behind the next one
CREDIT_NS_MAX: Final = 1_000_000  # of a sleep that was too long: more is the machine's doing
EXIT_FENCED: Final = 3
EXIT_ASSERT: Final = 70
EXIT_DETECTED: Final = 71  # a detected stop

_now, _read, _write = time.monotonic_ns, os.read, os.write
_encode, _decode = messages.encode_unchecked, messages.decode_unchecked
_put, _LARGE = transport.put, messages.PACKET_BYTES_MAX
_pack = RECORD.pack_into
RECORD_BYTES: Final = RECORD.size


# The fast loop reads into one buffer: a new object of READ_BYTES_MAX for each packet costs 1.3 % of a cycle,
# and a view that is made for each takes as long. What is in it is valid until the next read.
_BUFFER: Final = memoryview(bytearray(READ_BYTES_MAX))
_SHORT: Final = 512
_VIEWS: Final = tuple([_BUFFER[:size] for size in range(_SHORT)])  # of short packets, by their size


class Inlet:
    """The reading end of a channel."""

    __slots__ = ("fd", "hosted", "port")

    def __init__(self, hosted: "UnixBrick", port: str, fd: int) -> None:
        self.hosted, self.port, self.fd = hosted, port, fd


UnixBrick = HostedBrick[Inlet, int]
UnixNode = Node[Inlet, int]
OpenPorts = tuple[str, ...] | tuple[tuple[str, ...], ...]  # of the one brick with inlets, or of each
ReadInto = Callable[[memoryview], int]  # the next packet, into a buffer; how many bytes it has


class PollSet:
    """What to wait for while the same ports are open: a single inlet, or a poll."""

    __slots__ = ("by_fd", "poll", "single")

    def __init__(self, inlets: list[Inlet], others: tuple[int, ...], may_block: bool) -> None:
        self.single = inlets[0] if may_block and len(inlets) == 1 else None
        self.by_fd = {inlet.fd: inlet for inlet in inlets}
        self.poll = select.poll()
        for fd in (*self.by_fd, *others):
            self.poll.register(fd, select.POLLIN)


def _open_ports(bricks: list[UnixBrick]) -> tuple[tuple[str, ...], ...]:
    return tuple([hosted.brick.open_ports() for hosted in bricks])


class UnixIO(NodeIO[Inlet, int]):
    """Of one process of the graph. `serve` never returns."""

    output = int

    def __init__(
        self,
        line: Line[control.ToNode],
        journal: JournalFile,
        rehearse: Callable[[tuple[str, ...]], None] = lambda kinds: None,
    ) -> None:
        self.line, self.journal = line, journal
        self._rehearse = rehearse
        self.lifeline: Lifeline | None = None  # kept, not used: the kernel reads it when this process dies
        self._announced: Inlet | None = None  # the next packet there is a large one
        self._used_ns = self._owed_ns = 0  # CPU time at the last throttle; what is left to wait
        self._fast = False  # served by the fast loop
        self._fronts: list[UnixBrick] = []  # bricks with inlets
        self._polls: dict[tuple[object, ...], PollSet] = {}  # by the arguments of `_poll_set`, and open ports
        self._inlets: dict[OpenPorts, tuple[Inlet, ReadInto]] = {}  # by open ports, where one inlet is open

    def join(self, node: UnixNode) -> None:
        self._node = node

    @property
    def now_ns(self) -> Callable[[], int]:
        return time.monotonic_ns

    @property
    def record(self) -> Recorder:
        return self.journal.write

    def report(self, report: control.FromNode) -> None:
        self.line.send(report)

    def rehearse(self, kinds: tuple[str, ...]) -> None:
        """Do once in private what bricks of these kinds do in a failover."""
        self._rehearse(kinds)

    def memory(self, number: int) -> memoryview:
        """The memory behind that descriptor, which is closed."""
        return transport.map_memory(number)

    def put_state(self, number: int, state: bytes) -> bytes:
        """Into a memfd, which is closed."""
        return transport.put_state(number, state)

    def state_in(self, number: int) -> bytes:
        """The content of a memfd, which is closed."""
        return transport.read_file(number)

    # -- activity -----------------------------------------------------------------------------

    def _begin_wait(self) -> None:
        """The host waits from here on, and no brick is executed."""
        mapping = self.journal.mapping
        mapping[ACTIVITY_OFFSET] = (mapping[ACTIVITY_OFFSET] + 1) & 254

    def _end_wait(self) -> None:
        self.journal.mapping[ACTIVITY_OFFSET] |= 1

    # -- the loop -----------------------------------------------------------------------------

    def serve(self) -> NoReturn:
        """Serve until the supervisor ends it; a failed assert ends the process (fail-silence)."""
        try:
            self.loop()
        except ConnectionError:
            os._exit(EXIT_FENCED)
        except FunctionFailedError as error:
            self.stop_detected(self._node.name, function_failed(error))
        except BaseException as error:  # noqa: BLE001 - the last frame of this process: nothing may leak out
            print(f"{self._node.name} (pid {os.getpid()}):", file=sys.stderr)
            sys.excepthook(type(error), error, error.__traceback__)
            sys.stderr.flush()
            os._exit(EXIT_ASSERT)

    def loop(self) -> NoReturn:
        """Handle events one by one, and mail on the fast loop where it can serve this node."""
        turn = self._node.turn
        while True:
            if self._announced is not None:
                self._take_announced(self._announced)
                continue
            turn()
            if self._fast and self._announced is None:
                self.serve_fast()

    def turn(self) -> None:
        """Handle one event, or wait for one, on the general path."""
        if self._announced is not None:
            self._take_announced(self._announced)
        else:
            self._node.turn()

    def serve_fast(self) -> None:
        """The same as `turn`, with all at hand, for a node that polls nothing.

        Returns for whatever is neither mail on the one open inlet nor mail between its bricks: `turn` handles
        it. What suspends the node, arms a fault or binds a port is an order, so that is asked for only at the
        start, and behind orders that were served.
        """
        node, device, mail = self._node, self._node.device, self._node.mail
        if node.suspend_token or node.suspended or node.agent.active:
            return
        inlets, fronts, journal = self._inlets, self._fronts, self.journal
        open_ports = fronts[0].brick.open_ports if len(fronts) == 1 else partial(_open_ports, fronts)
        mapping = journal.mapping
        buffer, views = _BUFFER, _VIEWS
        obeyed = False
        while not obeyed:
            at = journal.at
            try:
                if mail:
                    hosted, port, message = mail[0]
                    if at > journal.end or port not in hosted.brick.open_ports():
                        return
                    mail.popleft()
                    read = None
                else:
                    found = inlets.get(open_ports())
                    if found is None or (device is not None and node.step_device(device)):
                        return
                    inlet, read_into = found
                    mapping[ACTIVITY_OFFSET] = activity = (mapping[ACTIVITY_OFFSET] + 1) & 254
                    size = read_into(buffer)
                    mapping[ACTIVITY_OFFSET] = activity + 1
                    if not 2 <= size < READ_BYTES_MAX or mapping[FLAG_OFFSET] or at > journal.end:
                        self._handle_packet(inlet, bytes(buffer[:size]))
                        return
                    raw = views[size] if size < _SHORT else buffer[:size]
                    hosted, port, message = inlet.hosted, inlet.port, _decode(raw)
                    read = message
                now_ns = _now()
                effects = hosted.brick.step(port, message, now_ns)  # type: ignore[arg-type]
            except PeerError:
                self._refuse(getattr(message, "request_id", 0))
                continue
            except messages.UNREADABLE:
                self._refuse()
                continue
            outputs = hosted.outputs
            for effect in effects:
                if type(effect) is Send:
                    out = outputs[effect.port]
                    if type(out) is not int:
                        out(effect.message)  # type: ignore[operator]
                        continue
                    data = raw if effect.message is read else _encode(effect.message)
                    try:
                        (_write if len(data) <= _LARGE else self._put_large)(out, data)
                    except OSError:
                        journal.at = at  # orders that are served meanwhile may write records
                        self._write_hard(hosted, effect.port, out, data)
                        at, obeyed = journal.at, True
                elif type(effect) is Note:
                    _pack(
                        mapping, at, now_ns, effect.request_id, effect.detail, hosted.index, effect.event.code
                    )
                    at += RECORD_BYTES
                else:
                    journal.at = at
                    node.order_or_halt(hosted, effect)
            journal.at = at

    # -- reading ------------------------------------------------------------------------------

    def open_input(self, hosted: UnixBrick, port: str, number: int) -> Inlet:
        return Inlet(hosted, port, number)

    def close_input(self, end: Inlet) -> None:
        os.close(end.fd)

    def rewired(self) -> None:
        """Make poll sets anew, and see whether the fast loop may serve this node."""
        node, device = self._node, self._node.device
        self._fronts = [hosted for hosted in node.bricks.values() if hosted.inputs]
        self._polls.clear()
        self._inlets.clear()
        polled = node.timed or (device is not None and device.polled)
        self._fast = not polled

    def _poll_set(self, others: tuple[int, ...], *, may_block: bool) -> PollSet:
        """What to wait for now; `others` are descriptors beside the inlets.

        `may_block`: these are the same every time, and nothing is due at a time.
        """
        ports = _open_ports(self._fronts)
        key = (ports, others, may_block)
        found = self._polls.get(key)
        if found is not None:
            return found
        inlets = [
            hosted.inputs[port]
            for hosted, names in zip(self._fronts, ports, strict=True)
            for port in names
            if port in hosted.inputs
        ]
        self._polls[key] = found = PollSet(inlets, others, may_block)
        if found.single is not None:
            read_into = io.FileIO(found.single.fd, closefd=False).readinto
            self._inlets[ports[0] if len(ports) == 1 else ports] = found.single, read_into
        return found

    def mail_waits(self) -> bool:
        """Whether there is mail at an open port."""
        return bool(self._poll_set((), may_block=False).poll.poll(0))

    def receive(self) -> bool:
        """Handle one packet of an open port, or what the device has to read, or what is due; wait for it."""
        node, device = self._node, self._node.device
        fds = device.fds() if device is not None else ()
        may_block = not (node.timed or fds or node.agent.filters) and (
            device is None or device.deadline_ns() is None
        )
        found = self._poll_set((self.line.fileno(), *fds), may_block=may_block)
        if found.single is not None:
            self._begin_wait()
            raw = _read(found.single.fd, READ_BYTES_MAX)
            self._end_wait()
            self._handle_packet(found.single, raw)
        else:
            self._poll(found)
        return True

    def _poll(self, found: PollSet) -> None:
        """Wait for several descriptors; orders go first."""
        node = self._node
        self._begin_wait()
        ready = found.poll.poll(self._patience_ms())
        self._end_wait()
        now_ns = _now()
        if node.agent.filters:
            node.release_due(now_ns)
        fds = [fd for fd, _ in ready]
        if self.journal.mapping[FLAG_OFFSET] or self.line.fileno() in fds:
            self.serve_orders()
            return  # what is open may be another set now
        for fd in fds:
            inlet = found.by_fd.get(fd)
            if inlet is not None:
                self._handle_packet(inlet, _read(inlet.fd, READ_BYTES_MAX))
                return  # one step may close the other ports
            if node.device is not None:
                node.device.ready(fd, now_ns)
        node.wake_due(now_ns)

    def _patience_ms(self) -> float | None:
        """The longest wait, in ms, which poll rounds up; None: until something comes."""
        due = self._node.deadline_ns()
        return None if due is None else max(0.0, (due - _now()) / 1e6)

    def _handle_packet(self, inlet: Inlet, raw: bytes) -> None:
        """Handle one packet, after the orders that wait."""
        if self.journal.mapping[FLAG_OFFSET]:
            self.serve_orders()
        if raw == b"":
            self._handle_end(inlet)
        elif raw == transport.ANNOUNCED:
            self._announced = inlet
        elif raw != NUDGE:
            try:
                message = _decode(raw)
            except messages.UNREADABLE:
                self._refuse()
                return
            self._node.step(inlet.hosted, inlet.port, message, raw)

    def _take_announced(self, inlet: Inlet) -> None:
        """Read the large packet that is next, or what has come in between. Its writer may take its time."""
        self._begin_wait()
        try:
            raw = transport.take(inlet.fd)
        except PeerError:
            self._announced = None
            self._refuse()
            return
        finally:
            self._end_wait()
        if raw != NUDGE:
            self._announced = None
        self._handle_packet(inlet, raw)
        if self._announced is not None and inlet.hosted.inputs.get(inlet.port) is not inlet:
            self._announced = None  # the order that has just been served has taken the channel away

    def _handle_end(self, inlet: Inlet) -> None:
        """Close the input: the channel is drained to its end."""
        if inlet.hosted.inputs.get(inlet.port) is inlet:
            self._node.bind_input(inlet.hosted.name, inlet.port, None)
            self._node.step(inlet.hosted, inlet.port, ChannelEnded())

    def _refuse(self, request_id: int = 0) -> None:
        """Record a message that the brick does not take, or a packet that is no message."""
        self.record(_now(), Event.PEER_REFUSED, request_id, 0)

    # -- writing ------------------------------------------------------------------------------

    def open_output(self, number: int) -> int:
        return number

    def close_output(self, end: int) -> None:
        os.close(end)

    def write(self, hosted: UnixBrick, port: str, end: int, message: Message, raw: bytes | None) -> bool:
        """Send `message`, and wait for room. Raises BrokenPipeError: see `_write_hard`."""
        data = _encode(message) if raw is None else raw
        try:
            (_write if len(data) <= _LARGE else self._put_large)(end, data)
        except OSError:
            self._write_hard(hosted, port, end, data)
        return True

    def _put_large(self, end: int, data: bytes | memoryview) -> None:
        """Raises OSError as `transport.put` does."""
        self._begin_wait()
        try:
            _put(end, data)
        finally:
            self._end_wait()

    def write_or_drop(self, end: int, message: Message) -> None:
        """Send `message` if there is room and a reader: the brick asks again for what it wants."""
        with contextlib.suppress(OSError):
            _put(end, _encode(message))

    def _write_hard(self, hosted: UnixBrick, port: str, end: int, data: bytes | memoryview) -> None:
        """The channel is full or shut: serve orders meanwhile, since one may be about this channel.

        If the port is bound elsewhere meanwhile, the data is not sent: the brick was notified, and has asked
        again for what it wants. A fault that is armed at the channel meanwhile strikes what is sent later.
        Raises BrokenPipeError where this node is fenced, or nothing reads the channel for
        `WRITE_SECONDS_MAX`.
        """
        limit = _now() + int(WRITE_SECONDS_MAX * 1e9)
        while _now() < limit:
            if hosted.outputs[port] is not end:
                return
            self._begin_wait()
            try:
                _put(end, data)
            except BlockingIOError:
                self._end_wait()
                self.serve_orders()
            except ConnectionError:
                self._end_wait()
                self.serve_orders(wait=True)
            else:
                self._end_wait()
                return
        raise BrokenPipeError(f"{hosted.name}: {port} is shut or has no reader")

    # -- orders -------------------------------------------------------------------------------

    def wait_for_order(self) -> bool:
        """Suspended: wait for an order, for ORDER_SECONDS at most."""
        self.serve_orders(wait=True)
        self._node.release_due(_now())
        return True

    def serve_orders(self, wait: bool = False, until: int = 0) -> bool:
        """Carry out the orders that have come; with `wait`, wait for one, for ORDER_SECONDS at most. True if
        there was any.

        With `until`: True if the Ack of that fault was among them.
        """
        self.journal.mapping[FLAG_OFFSET] = 0
        served = False
        while True:
            try:
                got = self._next_order(wait and not served)
            except BlockingIOError:
                return served
            if got is None:
                os._exit(0)  # the supervisor is gone, and this run with it
            order, fds = got
            if isinstance(order, control.Ack):
                served = served or order.token == until
                continue
            self._node.obey(order, fds)
            served = served or not until

    def _next_order(self, wait: bool) -> tuple[control.ToNode, list[int]] | None:
        line = self.line
        if wait:
            self._begin_wait()
            try:
                return line.recv()
            finally:
                self._end_wait()
        line.sock.setblocking(False)
        try:
            return line.recv()
        finally:
            line.sock.setblocking(True)

    # -- faults and ends ----------------------------------------------------------------------

    def kill(self) -> None:
        """Die of SIGKILL."""
        os.kill(os.getpid(), signal.SIGKILL)

    def stop_detected(self, brick: str, reason: str) -> NoReturn:
        """Exit, with the reason on stderr."""
        print(f"{brick} (pid {os.getpid()}): detected stop: {reason}", file=sys.stderr, flush=True)
        os._exit(EXIT_DETECTED)

    def wait_until_applied(self, fault: int) -> None:
        """Serve orders until the supervisor has acknowledged `fault`."""
        limit_ns = _now() + APPLY_NS_MAX
        while _now() < limit_ns:
            if self.serve_orders(wait=True, until=fault):
                return
        raise AssertionError(f"fault {fault} was not applied within {APPLY_NS_MAX / 1e9} s")

    def delay(self, by_ns: int) -> None:
        """Sleep."""
        self._sleep(by_ns)

    def _sleep(self, for_ns: int) -> None:
        self._begin_wait()
        time.sleep(for_ns / 1e9)
        self._end_wait()

    def begin_throttle(self) -> None:
        """CPU time counts from now on."""
        self._used_ns, self._owed_ns = time.thread_time_ns(), 0

    def throttle(self, stretch_ns: Callable[[int], int]) -> None:
        """Sleep for `stretch_ns` of the CPU time that was used since the last call."""
        before_ns, self._used_ns = self._used_ns, time.thread_time_ns()
        self._owed_ns += stretch_ns(self._used_ns - before_ns)
        if self._owed_ns > 0:
            began_ns = _now()
            self._sleep(min(self._owed_ns, PAUSE_NS_MAX))
            self._owed_ns = max(self._owed_ns - (_now() - began_ns), -CREDIT_NS_MAX)
