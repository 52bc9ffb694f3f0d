"""The CAN bus between processes: a hub on 127.0.0.1 that speaks the socketcand text protocol.

Every node is a TCP client; python-can's own `socketcand` interface and other tools attach unchanged.
The dialogue of a client (`<` to the hub, `>` from it):

    > < hi >
    < < open can0 >            > < ok >
    < < rawmode >              > < ok >          from here on the client receives frames
    < < send 130 8 1 2 3 4 5 6 7 8 >
    > < frame 110 12.345678 0102030405060708 >
    < < echo >                 > < echo >

An element that is malformed or out of place is answered with `< error 20000000 SECONDS.MICROS reason >`,
which clients of socketcand read as an error frame, and changes nothing; an element over its size limit also
ends the connection. Frames follow the rules of `bus_model`.

*Time.* Stamps are microseconds since the start of the run times the pace. In lockstep they are the
virtual time that one client, the first that asks for it, sets by `aftbed time`; it never runs backwards.

*Beside the bus* aftbed's nodes send elements of their own. A client that gives its name can be cut off by
a fault, and its reports count; one that does not is a tool: it receives all frames, and all receive
its frames.

    < < aftbed node radar 100 >        the client's name, and the identifiers that it uses
    < < aftbed noticed 100 sequence >  what is wrong with these frames
    < < aftbed unasked 130 >           the gateway makes no request of a frame of which one is expected
    < < aftbed time 20000 >            > < ok >  the virtual time; with faults, when one is due: < ok 31000 >
    < < aftbed await radar 12 >        > < ok >  when twelve frames of the radar have been carried
    < < aftbed plant >                 > < ok >  this client is the car, the only one that knows conditions
                                       > < watch 7 ttc below 1.2 >
    < < aftbed met 7 3240 5678 >       > < ok >  it holds: at 3240 us of the drive, 5678 ns by the clock

In lockstep time stands still until the protected function has answered what it was asked. A fault makes
that a matter of the bus: a RADAR_TRACK that was lost is not answered, one that comes twice may be answered
twice. So the hub sends the time master, before any node receives the frame, by how many the number of
receivers that use it differs from the number without faults:

    > < change 130 -1 >        lost, or no request was made of it
    > < change 100 +1 >        one more: held back before, or a second time

Other faults can wait for a condition of the car, too (`SupervisorLink`). In lockstep it gets its `< ok >`
only after all actions at the condition are done, so it does not take its next step before.

*Order of work.* One thread that blocks only to wait for events: relay first, because latency is what
the bus is measured by, then one `write` to the log before the next frame is taken. So a `kill -9` costs the
log at most the frame under way. Nothing that a client does may stop the bus: a client that does not read
is disconnected when 256 KiB wait for it; one that sends more than the wire carries is not read until its
queue is short.

Limit: python-can demands that a read gives `< ok >` and nothing behind it, while the first frame may follow
at once. So the hub sends one byte of TCP urgent data between the two: a reader stops in front of the urgent
mark, whatever is queued behind it, and the receiving kernel takes the byte itself out of the stream. RFC 6093
advises against urgent data because middleboxes spoil it; the loopback has none. Through a proxy the mark is
lost, and the byte is a newline.
"""

import re
import select
import socket
import time
from collections.abc import Sequence
from os import read, write
from typing import Final, Protocol

import msgspec

from aftbed.core.errors import ConfigError, HarnessError, PeerError
from aftbed.core.units import number
from aftbed.vehicle.can.bus_model import BusModel, BusNode
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.condition import Condition

EVENTS_MAX: Final = 32  # in one round; the rest comes in the next
READ_BYTES_MAX: Final = 4096
ELEMENT_BYTES_MAX: Final = 128  # the longest legal one has 46
LAST_FRAMES_S_MAX: Final = 0.1
LOG_BYTES_MAX: Final = 1024 * 1024 * 1024
CLIENTS_MAX: Final = 64
OUTPUT_BYTES_MAX: Final = 256 * 1024
FRAMES_QUEUED_MAX: Final = 256  # of one client

_SEND: Final = re.compile(rb"< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-9]) ((?:[0-9A-Fa-f]{1,2} ){0,8}) ?")
_OURS: Final = {  # elements of aftbed's nodes
    word: re.compile(rb"< aftbed %b %b" % (word, arguments))
    for word, arguments in {
        b"time": rb"([0-9]{1,16}) ",
        b"node": rb"([a-z_][a-z0-9_]{0,31})((?: [0-9A-F]{3}){0,16}) ",
        b"await": rb"([a-z_][a-z0-9_]{0,31}) ([0-9]{1,12}) ",
        b"plant": rb"",
        b"met": rb"([0-9]{1,12}) ([0-9]{1,16}) ([0-9]{1,20}) ",
        b"unasked": rb"([0-9A-F]{3}) ",
        b"noticed": rb"([0-9A-F]{3}) ([a-z_]{1,32}) ",
    }.items()
}
_READABLE: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR


class HubOptions(msgspec.Struct, frozen=True):
    """How the bus behaves. `origin_ns` is the start of the run by the monotonic clock."""

    channel: str = "can0"
    lockstep: bool = False
    pace: float = 1.0  # seconds of bus time in a second
    bitrate_bps: int | None = None  # None: a frame takes no time on the wire
    origin_ns: int | None = None  # None: when `serve` is called

    def __post_init__(self) -> None:
        if not self.pace > 0:
            raise ConfigError(f"bus pace {self.pace}, allowed is more than 0")
        if self.bitrate_bps is not None and not 1_000 <= self.bitrate_bps <= 1_000_000:
            raise ConfigError(f"bus bitrate {self.bitrate_bps} bit/s, allowed is 1000 to 1000000")


class HubCounts(msgspec.Struct):
    """What happened on the bus: frames carried, elements refused, clients disconnected by reason."""

    frames: int = 0
    refused: int = 0
    slow_readers: int = 0
    oversized: int = 0
    turned_away: int = 0


class SupervisorLink(Protocol):
    """The hub's link to the supervisor; it reads the hub's life descriptor."""

    def attend(self, hub: "Hub") -> bool:
        """Carry out the next order; False when the link has ended."""
        ...

    def faults_acted(self) -> None:
        """What became of the faults of the bus may have changed."""
        ...

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """The condition of that fault holds.

        `since_ns` is 0 in lockstep, where the car waits for `Hub.go_on`.
        """
        ...


class HubConnection(BusNode):
    """One connection: how far its handshake is, and what waits in either direction."""

    __slots__ = ("inbox", "interest", "opened", "outbox", "raw", "sock")

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(f"client {sock.fileno()}")  # no name that a node gives has a blank in it
        self.sock = sock
        self.opened = False
        self.raw = False
        self.inbox = b""
        self.outbox = bytearray()
        self.interest = select.EPOLLIN


class Hub(BusModel[HubConnection]):
    """The bus. `serve` makes one and runs it; it owns the connections, not the descriptors given."""

    def __init__(
        self,
        listener: socket.socket,
        log_fd: int,
        options: HubOptions,
        life_fd: int,
        link: SupervisorLink | None,
    ) -> None:
        super().__init__(options.bitrate_bps)
        self.counts = HubCounts()
        self._options = options
        self._listener = listener
        self._log_fd = log_fd
        self._log_bytes = 0
        self._life_fd = life_fd
        self._link = link
        self._origin_ns = time.monotonic_ns() if options.origin_ns is None else options.origin_ns
        self._virtual_us = 0
        self._time_master: HubConnection | None = None
        self._plant: HubConnection | None = None  # the car
        self._awaiting: tuple[HubConnection, str, int] | None = None  # for so many frames of a node
        self._held: dict[int, HubConnection] = {}  # the car, by the number of the fault for which it waits
        self._clients: dict[int, HubConnection] = {}  # by descriptor
        self._epoll = select.epoll()
        listener.setblocking(False)
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._epoll.register(life_fd, select.EPOLLIN)

    def run(self) -> HubCounts:
        """Carry frames until `life_fd` ends, and then those that had been sent by then."""
        alive = True
        while alive:
            alive = self._attend_all(self._wait())
            if self.disturbed and not self._options.lockstep:
                self.release(self.now_us())
            self.carry(None if self._options.lockstep else self.now_us())
            if self._awaiting is not None:
                self._answer_await(*self._awaiting)
        self._epoll.unregister(self._life_fd)
        self._epoll.unregister(self._listener.fileno())
        end_s = time.monotonic() + LAST_FRAMES_S_MAX
        while time.monotonic() < end_s and (events := self._epoll.poll(0, EVENTS_MAX)):
            self._attend_all(events)
            self.carry(None if self._options.lockstep else self.now_us())
        return self.counts

    def close(self) -> None:
        for client in list(self._clients.values()):
            self._drop(client)
        self._epoll.close()

    def go_on(self, fault_number: int) -> None:
        """All actions at the condition of that fault are done: answer the car that waits for it."""
        car = self._held.pop(fault_number, None)
        if car is not None:
            self._send(car, self._ok())

    # -- time and waiting -----------------------------------------------------------------------

    def now_us(self) -> int:
        if self._options.lockstep:
            return self._virtual_us
        elapsed_us = (time.monotonic_ns() - self._origin_ns) // 1000
        return elapsed_us if self._options.pace == 1.0 else int(elapsed_us * self._options.pace)

    def _wait(self) -> list[tuple[int, int]]:
        """The next events; none, and at once, when the transmission on the wire ends or a fault is due."""
        due_us = self.wire_due_us()
        if self.disturbed and self.disturber is not None and not self._options.lockstep:
            fault_us = self.disturber.due_us()
            due_us = min((t_us for t_us in (due_us, fault_us) if t_us is not None), default=None)
        if due_us is None:
            return self._epoll.poll(-1, EVENTS_MAX)
        rest_us = due_us - self.now_us()
        if rest_us > 0:  # epoll counts milliseconds, select microseconds, and an epoll can be selected
            select.select([self._epoll], [], [], rest_us / (1e6 * self._options.pace))
        return self._epoll.poll(0, EVENTS_MAX)

    def _attend_all(self, events: list[tuple[int, int]]) -> bool:
        """Serve these events; False when the life of the hub has ended."""
        alive = True
        for fd, mask in events:
            client = self._clients.get(fd)
            if client is not None:
                if mask & select.EPOLLOUT:
                    self._flush(client)
                if mask & _READABLE:
                    self._receive(client)
            elif fd == self._life_fd:
                alive = bool(read(fd, READ_BYTES_MAX)) if self._link is None else self._link.attend(self)
            elif fd == self._listener.fileno():
                self._accept()
        return alive

    # -- what the rules of the bus ask for ------------------------------------------------------

    def deliver(self, frame: Frame, sender: str, receivers: Sequence[HubConnection]) -> None:
        """The one place through which every frame passes: relay it, then record it."""
        self.counts.frames += 1
        seconds, micros = divmod(frame.t_us, 1_000_000)
        data = frame.data.hex().upper()
        element = f"< frame {frame.can_id:03X} {seconds}.{micros:06d} {data} >".encode("ascii")
        for client in receivers:
            self._send(client, element)
        line = log_line(frame, self._options.channel).encode("ascii")
        self._log_bytes += len(line)
        if self._log_bytes > LOG_BYTES_MAX:
            raise HarnessError(f"the bus log is over its limit of {LOG_BYTES_MAX} bytes")
        if write(self._log_fd, line) != len(line):
            raise HarnessError("the bus log took only a part of a line: is the disk full?")

    def dequeued(self, node: HubConnection) -> None:
        self._update_interest(node)

    def receipts_changed(self, can_id: int, change: int) -> None:
        if self._time_master is not None:
            self._send(self._time_master, f"< change {can_id:03X} {change:+d} >".encode("ascii"))

    def condition_added(self, number: int, condition: Condition) -> None:
        """Send it to the car; one that attaches later gets it then."""
        if self._plant is not None:
            self._send(self._plant, _watch_element(number, condition))

    def faults_acted(self) -> None:
        if self._link is not None:
            self._link.faults_acted()

    # -- elements -------------------------------------------------------------------------------

    def _take(self, client: HubConnection, element: bytes) -> None:
        """Act on one element (without its `>`), or refuse it, having changed nothing."""
        try:
            if client.raw and element.startswith(b"< send "):
                self.send(client, parse_send(element, self.now_us()))
            elif element == b"< echo ":
                self._send(client, b"< echo >")
            elif element.startswith(b"< open ") and not client.opened:
                if element != b"< open %b " % self._options.channel.encode("ascii"):
                    raise PeerError(f"could not open bus: only {self._options.channel} is here")
                client.opened = True
                self._send(client, b"< ok >")
            elif element == b"< rawmode " and client.opened and not client.raw:
                client.raw = True
                self.add_receiver(client)
                self._send(client, b"< ok >\n", socket.MSG_OOB)
            elif element.startswith(b"< aftbed ") and client.opened:
                self._take_ours(client, element)
            else:
                raise PeerError("unknown command, or not now")
        except PeerError as error:
            self._refuse(client, str(error))

    def _take_ours(self, client: HubConnection, element: bytes) -> None:
        word = element.removeprefix(b"< aftbed ").partition(b" ")[0]
        found = _OURS[word].fullmatch(element) if word in _OURS else None
        arguments = [text.decode("ascii") for text in found.groups()] if found is not None else []
        match word, arguments:
            case b"time", [t_us]:
                self._set_time(client, int(t_us))
                self._send(client, self._ok())
            case b"node", [name, uses]:
                client.name = name
                client.uses = frozenset(int(can_id, 16) for can_id in uses.split())
            case b"await", [node, frames]:
                self._awaiting = (client, node, int(frames))
            case b"plant", [] if found is not None:
                self._plant = client
                self._send(client, b"< ok >" + b"".join(_watch_element(*one) for one in self.conditions()))
            case b"met", [number, t_us, since_ns]:
                self._condition_met(client, int(number), int(t_us), int(since_ns))
            case b"unasked", [can_id]:
                if self.disturber is not None:
                    self.receipts_changed(int(can_id, 16), -1)
            case b"noticed", [can_id, reason]:
                self.noticed(client.name, int(can_id, 16), reason)
            case _:
                raise PeerError("unknown command, or not now")

    def _condition_met(self, car: HubConnection, fault_number: int, t_us: int, since_ns: int) -> None:
        met = self.met(fault_number, self.now_us())
        if met and self._link is not None and self._options.lockstep:
            self._held[fault_number] = car
            self._link.met(fault_number, t_us, 0)
            return
        self._send(car, self._ok())
        if met and self._link is not None:
            self._link.met(fault_number, t_us, since_ns)

    def _ok(self) -> bytes:
        """To the time master: once there have been faults, when something is due next."""
        if self.disturber is None:
            return b"< ok >"
        due_us = self.disturber.due_us()
        return f"< ok {'-' if due_us is None else due_us} >".encode("ascii")

    def _answer_await(self, client: HubConnection, node: str, frames: int) -> None:
        if any(c.name == node and c.carried >= frames for c in self._clients.values()):
            self._awaiting = None
            self._send(client, self._ok())

    def _set_time(self, client: HubConnection, t_us: int) -> None:
        if not self._options.lockstep:
            raise PeerError("this bus runs in real time")
        if self._time_master not in (None, client):
            raise PeerError("another client is the time master")
        if t_us < self._virtual_us:
            raise PeerError(f"time runs backwards, from {self._virtual_us} to {t_us}")
        if self.disturbed:
            self.carry()  # what was sent before belongs to the time before
        self._time_master, self._virtual_us = client, t_us
        self.release(t_us)

    def _refuse(self, client: HubConnection, reason: str) -> None:
        self.counts.refused += 1
        seconds, micros = divmod(self.now_us(), 1_000_000)
        self._send(client, f"< error 20000000 {seconds}.{micros:06d} {reason} >".encode("ascii"))

    # -- connections ----------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # gone before it was accepted
            return
        if len(self._clients) >= CLIENTS_MAX:
            self.counts.turned_away += 1
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = self._clients[sock.fileno()] = HubConnection(sock)
        self._epoll.register(sock.fileno(), client.interest)
        self._send(client, b"< hi >")

    def _drop(self, client: HubConnection) -> None:
        """Disconnect. Frames that the node had handed over before still get their turn on the wire."""
        if self._clients.pop(client.sock.fileno(), None) is None:
            return
        self.remove_receiver(client)
        self._epoll.unregister(client.sock.fileno())
        client.sock.close()

    def _receive(self, client: HubConnection) -> None:
        try:
            data = client.sock.recv(READ_BYTES_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        *elements, client.inbox = (client.inbox + data).split(b">")
        for element in elements:
            self._take(client, element.lstrip())
        if len(client.inbox) > ELEMENT_BYTES_MAX:
            self.counts.oversized += 1
            self._refuse(client, f"element over {ELEMENT_BYTES_MAX} bytes")
            self._drop(client)
        self._update_interest(client)

    def _send(self, client: HubConnection, data: bytes, flags: int = 0) -> None:
        """Send, or queue what the socket does not take; a client with too much queued is disconnected."""
        sent = 0
        if not client.outbox:
            try:
                sent = client.sock.send(data, flags | socket.MSG_NOSIGNAL)
            except BlockingIOError:
                pass
            except OSError:
                self._drop(client)
                return
        if sent < len(data):
            client.outbox += data[sent:]
            if len(client.outbox) > OUTPUT_BYTES_MAX:
                self.counts.slow_readers += 1
                self._drop(client)
            self._update_interest(client)

    def _flush(self, client: HubConnection) -> None:
        try:
            del client.outbox[: client.sock.send(client.outbox, socket.MSG_NOSIGNAL)]
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        self._update_interest(client)

    def _update_interest(self, client: HubConnection) -> None:
        """Wait only for events that can be served: a client with a full queue is not read."""
        interest = select.EPOLLOUT if client.outbox else 0
        if len(client.frames) < FRAMES_QUEUED_MAX:
            interest |= select.EPOLLIN
        if interest != client.interest and client.sock.fileno() in self._clients:
            client.interest = interest
            self._epoll.modify(client.sock.fileno(), interest)


def parse_send(element: bytes, t_us: int) -> Frame:
    """The frame in `< send ID LENGTH BYTES` (without its `>`). Raises PeerError."""
    match = _SEND.fullmatch(element)
    if match is None:
        raise PeerError("malformed send")
    identifier, length, text = match.groups()
    if len(identifier) != 3:
        raise PeerError("29-bit identifiers are not carried")
    data = bytes([int(byte, 16) for byte in text.split()])
    if len(data) != int(length):
        raise PeerError(f"length {int(length)} but {len(data)} bytes")
    return Frame(t_us, int(identifier, 16), data)


def _watch_element(fault_number: int, condition: Condition) -> bytes:
    than = "below" if condition.below else "above"
    return f"< watch {fault_number} {condition.quantity} {than} {number(condition.value)} >".encode("ascii")


def serve(
    listener: socket.socket,
    log_fd: int,
    options: HubOptions,
    life_fd: int,
    link: SupervisorLink | None = None,
) -> HubCounts:
    """Run a bus on `listener`, bound and listening, until `life_fd` reads its end; record on `log_fd`.

    A `link` reads `life_fd` itself.

    Raises HarnessError, or OSError, when a frame cannot be recorded.
    """
    hub = Hub(listener, log_fd, options, life_fd, link)
    try:
        return hub.run()
    finally:
        hub.close()
