"""The CAN bus between processes: a hub on 127.0.0.1 that speaks the socketcand text protocol.

Every node is a TCP client; python-can's own `socketcand` interface and other tools attach as they
are. The dialogue of a client (`<` to the hub, `>` from it):

    > < hi >
    < < open can0 >            > < ok >
    < < rawmode >              > < ok >          from here on the client hears the bus
    < < send 130 8 1 2 3 4 5 6 7 8 >
    > < frame 110 12.345678 0102030405060708 >
    < < echo >                 > < echo >
    < < aftbed time 20000 >    > < ok >          ours: the virtual time, in lockstep

A frame goes to all who hear the bus but its sender. What is malformed or out of place is answered
with `< error 20000000 SECONDS.MICROS reason >`, which clients of socketcand read as an error frame,
and changes nothing; an element over its size limit also ends the connection.

*Arbitration.* The bus carries one frame at a time. Each node queues its own frames in order; among
the first frames of the nodes the lowest identifier wins, as on the wire. With a `bitrate_bps` a
frame takes its time on the wire (worst-case bit stuffing, so an upper bound) and is delivered when
its transmission ends; without one it takes none.

*Time.* Stamps are microseconds since the start of the run times the pace. In lockstep they are the
virtual time that one client, the first that asks for it, sets by `aftbed time`; it never runs
backwards.

*Order of work.* One thread that blocks only to wait for events: relay first, because latency is what
the bus is measured by, then one `write` to the log before the next frame is taken. So a `kill -9`
costs the log no more than the frame under way.

*Beside the bus* nodes of ours say more, and faults of the bus strike here: see `hub_client`.

Limit, said openly: python-can demands that a read gives `< ok >` and nothing behind it, while the
first frame may follow at once. So the hub sends one byte of TCP urgent data between the two: a reader
stops in front of the urgent mark, whatever is queued behind it, and the receiving kernel takes the
byte itself out of the stream. RFC 6093 advises against urgent data because middleboxes spoil it; the
loopback has none. Through a proxy the mark is lost, and the byte is a newline.
"""

import re
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from os import read, write
from typing import Final, Protocol

import msgspec

from aftbed.core.busfault import BusFault, Condition, Struck
from aftbed.core.errors import ConfigError, HarnessError, PeerError
from aftbed.core.words import number
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.disturbance import Disturber, Sent

CLIENTS_MAX: Final = 64
OUTPUT_BYTES_MAX: Final = 256 * 1024
FRAMES_QUEUED_MAX: Final = 256  # of one client
_SEND: Final = re.compile(rb"< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-9]) ((?:[0-9A-Fa-f]{1,2} ){0,8}) ?")


class HubOptions(msgspec.Struct, frozen=True):
    """How the bus behaves. `origin_ns` is the start of the run by the monotonic clock."""

    channel: str = "can0"
    lockstep: bool = False
    pace: float = 1.0  # seconds of bus time in a second
    bitrate_bps: int | None = None  # None: a frame takes no time on the wire
    origin_ns: int | None = None  # None: when `serve` is called

    def __post_init__(self) -> None:
        """Refuse a bus on which no time would pass."""
        if not self.pace > 0:
            raise ConfigError(f"bus pace {self.pace}, allowed is more than 0")
        if self.bitrate_bps is not None and not 1_000 <= self.bitrate_bps <= 1_000_000:
            raise ConfigError(f"bus bitrate {self.bitrate_bps} bit/s, allowed is 1000 to 1000000")


class HubCounts(msgspec.Struct):
    """What happened on the bus: frames carried, elements refused, clients put out by reason."""

    frames: int = 0
    refused: int = 0
    slow_readers: int = 0
    oversized: int = 0
    turned_away: int = 0


class Client:
    """How far its handshake is, what waits in either direction, and who it says that it is."""

    __slots__ = (
        "carried",
        "frames",
        "inbox",
        "interest",
        "name",
        "opened",
        "outbox",
        "raw",
        "sock",
        "uses",
    )

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.name = f"client {sock.fileno()}"  # no node has a blank in its name
        self.uses: frozenset[int] = frozenset()  # the identifiers that it makes something of, if it said so
        self.opened = False
        self.raw = False
        self.inbox = b""
        self.outbox = bytearray()
        self.frames: deque[Frame] = deque()  # `t_us` is when the node asked for the bus
        self.carried = 0  # of them, over the wire
        self.interest = select.EPOLLIN


def frame_bits(data_bytes: int) -> int:
    """Bits of a data frame with an 11-bit identifier on the wire, stuffing at its worst.

    34 bits and the data are open to stuffing, at most one bit in four (Davis et al. 2007); the
    13 bits of delimiters, acknowledgement, end of frame and intermission are not.
    """
    stuffable = 34 + 8 * data_bytes
    return stuffable + (stuffable - 1) // 4 + 13


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


class Clients:
    """All connections."""

    def __init__(self, listener: socket.socket, epoll: select.epoll, counts: HubCounts) -> None:
        self._listener, self._epoll, self._counts = listener, epoll, counts
        self._by_fd: dict[int, Client] = {}
        self.hearers: list[Client] = []  # replaced, never changed: it is walked while clients drop

    def get(self, fd: int) -> Client | None:
        """Whose descriptor this is."""
        return self._by_fd.get(fd)

    def all(self) -> list[Client]:
        """Who is connected."""
        return list(self._by_fd.values())

    def accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # gone before it was accepted
            return
        if len(self._by_fd) >= CLIENTS_MAX:
            self._counts.turned_away += 1
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = self._by_fd[sock.fileno()] = Client(sock)
        self._epoll.register(sock.fileno(), client.interest)
        self.send(client, b"< hi >")

    def drop(self, client: Client) -> None:
        """Hang up. What the node had handed over before still gets its turn on the wire."""
        if self._by_fd.pop(client.sock.fileno(), None) is None:
            return
        self.hearers = [other for other in self.hearers if other is not client]
        self._epoll.unregister(client.sock.fileno())
        client.sock.close()

    def watch(self, client: Client) -> None:
        """Ask only for the events that can be served: a full queue is not read into."""
        interest = select.EPOLLOUT if client.outbox else 0
        if len(client.frames) < FRAMES_QUEUED_MAX:
            interest |= select.EPOLLIN
        if interest != client.interest and client.sock.fileno() in self._by_fd:
            client.interest = interest
            self._epoll.modify(client.sock.fileno(), interest)

    def send(self, client: Client, data: bytes, flags: int = 0) -> None:
        """Send, or queue what the socket does not take; a client with too much queued is dropped."""
        sent = 0
        if not client.outbox:
            try:
                sent = client.sock.send(data, flags | socket.MSG_NOSIGNAL)
            except BlockingIOError:
                pass
            except OSError:
                self.drop(client)
                return
        if sent < len(data):
            client.outbox += data[sent:]
            if len(client.outbox) > OUTPUT_BYTES_MAX:
                self._counts.slow_readers += 1
                self.drop(client)
            self.watch(client)

    def flush(self, client: Client) -> None:
        try:
            del client.outbox[: client.sock.send(client.outbox, socket.MSG_NOSIGNAL)]
        except BlockingIOError:
            return
        except OSError:
            self.drop(client)
            return
        self.watch(client)


class Desk(Protocol):
    """The line to it is the life descriptor."""

    def attend(self, hub: "Hub") -> bool:
        """Carry out what is ordered on the line; False at its end."""
        ...

    def report(self, news: list[Struck]) -> None:
        """Something has become of these faults."""
        ...

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """The condition of that fault holds; `since_ns` is 0 where the car waits for `Watches.go_on`."""
        ...


class Watches:
    """Conditions of faults that are none of the bus. `tell_plant` says a line to the car, `answer` its ok."""

    def __init__(
        self,
        tell_plant: Callable[[bytes], None],
        answer: Callable[[Client], None],
        desk: Desk | None,
        *,
        lockstep: bool,
    ) -> None:
        self._tell_plant, self._answer, self._desk, self._lockstep = tell_plant, answer, desk, lockstep
        self._open: dict[int, Condition] = {}
        self._held: dict[int, Client] = {}  # the car, by the fault for which it waits

    def watch(self, fault_number: int, condition: Condition) -> None:
        """From now on."""
        self._open[fault_number] = condition
        self._tell_plant(watch_line(fault_number, condition))

    def lines(self) -> bytes:
        """What a car that has just come has to look at."""
        return b"".join(watch_line(*watched) for watched in self._open.items())

    def met(self, fault_number: int, t_us: int, since_ns: int, car: Client) -> None:
        """The car says that the condition of a fault, ours or one of the bus, holds."""
        if self._open.pop(fault_number, None) is None or self._desk is None:
            self._answer(car)
            return
        if self._lockstep:
            self._held[fault_number] = car
        else:
            self._answer(car)
        self._desk.met(fault_number, t_us, 0 if self._lockstep else since_ns)

    def go_on(self, fault_number: int) -> None:
        """What was to be done is done: answer the car that waits for it."""
        car = self._held.pop(fault_number, None)
        if car is not None:
            self._answer(car)


def watch_line(fault_number: int, condition: Condition) -> bytes:
    """What the car is told to look at."""
    than = "below" if condition.below else "above"
    return f"< watch {fault_number} {condition.quantity} {than} {number(condition.value)} >".encode("ascii")


class Delivery(msgspec.Struct, frozen=True):
    """A frame, and who hears it."""

    frame: Frame
    hearers: list[Client]


class HubFaults:
    """All faults of a hub. `tell_master` and `tell_plant` say a line to who sets the time, and to the car."""

    def __init__(self, tell_master: Callable[[bytes], None], tell_plant: Callable[[bytes], None]) -> None:
        self._tell_master, self._tell_plant = tell_master, tell_plant
        self._disturber = Disturber()
        self._said: dict[int, str] = {}  # the receipts that were reported

    def arm(self, fault_number: int, fault: BusFault, draw: int, now_us: int) -> None:
        """From now on."""
        self._disturber.arm(fault_number, fault, draw, now_us)
        for waiting, condition in self._disturber.conditions():
            if waiting == fault_number:
                self._tell_plant(watch_line(waiting, condition))

    def forget(self, fault_number: int, now_us: int) -> None:
        """No longer; what it holds back is due."""
        self._disturber.forget(fault_number, now_us)

    def watches(self) -> bytes:
        """What a car that has just come has to look at."""
        return b"".join(watch_line(waiting, condition) for waiting, condition in self._disturber.conditions())

    def met(self, fault_number: int, now_us: int) -> None:
        """The car says that the condition holds."""
        self._disturber.met(fault_number, now_us)

    def noticed(self, node: str, can_id: int, word: str) -> None:
        """A node says that something is wrong with these frames."""
        self._disturber.noticed(node, can_id, word)

    def unasked(self, can_id: int) -> None:
        """The gateway makes no request of a frame."""
        self._tell_master(_change(can_id, -1))

    @property
    def idle(self) -> bool:
        """Whether the bus is as if there had never been a fault."""
        return self._disturber.idle

    def due_us(self) -> int | None:
        """When to call `release` next."""
        return self._disturber.due_us()

    def struck(self) -> list[Struck]:
        """What has become of each."""
        return self._disturber.struck()

    def news(self) -> list[Struck]:
        """Those whose receipt is another one than when this was last asked."""
        found = [s for s in self._disturber.struck() if self._said.get(s.number, "armed") != s.receipt]
        self._said |= {s.number: s.receipt for s in found}
        return found

    # -- frames -------------------------------------------------------------------------------

    def carry(self, frame: Frame, sender: Client, hearers: Sequence[Client]) -> list[Delivery]:
        """What comes of a frame that `sender` has sent, and who hears it."""
        sent = self._disturber.carry(frame, sender.name)
        expected = sum(c is not sender and frame.can_id in c.uses for c in hearers)
        return self._deliveries(sent, frame.t_us, hearers, {frame.can_id: -expected})

    def release(self, now_us: int, hearers: Sequence[Client]) -> list[Delivery]:
        """What comes by itself now."""
        return self._deliveries(self._disturber.release(now_us), now_us, hearers, {})

    def _deliveries(
        self, sent: list[Sent], now_us: int, hearers: Sequence[Client], changes: dict[int, int]
    ) -> list[Delivery]:
        found = []
        for one in sent:
            heard = [c for c in hearers if c.name != one.sender and not self._deaf(one.sender, c, now_us)]
            users = [c for c in heard if one.frame.can_id in c.uses]
            for user in users:
                self._disturber.reached(one.by, user.name)
            changes[one.frame.can_id] = changes.get(one.frame.can_id, 0) + len(users)
            found.append(Delivery(one.frame, heard))
        for can_id, change in changes.items():
            if change:
                self._tell_master(_change(can_id, change))
        return found

    def _deaf(self, sender: str, hearer: Client, now_us: int) -> bool:
        return self._disturber.deaf(sender, hearer.name, now_us)


def _change(can_id: int, change: int) -> bytes:
    return f"< change {can_id:03X} {change:+d} >".encode("ascii")


EVENTS_MAX: Final = 32  # in one round; the rest comes in the next
READ_BYTES_MAX: Final = 4096
ELEMENT_BYTES_MAX: Final = 128  # the longest legal one has 46
LAST_FRAMES_S_MAX: Final = 0.1
LOG_BYTES_MAX: Final = 1024 * 1024 * 1024

_TIME: Final = re.compile(rb"< aftbed time ([0-9]{1,16}) ")
_NODE: Final = re.compile(rb"< aftbed node ([a-z_][a-z0-9_]{0,31})((?: [0-9A-F]{3}){0,16}) ")
_AWAIT: Final = re.compile(rb"< aftbed await ([a-z_][a-z0-9_]{0,31}) ([0-9]{1,12}) ")
_MET: Final = re.compile(rb"< aftbed met ([0-9]{1,12}) ([0-9]{1,16}) ([0-9]{1,20}) ")
_UNASKED: Final = re.compile(rb"< aftbed unasked ([0-9A-F]{3}) ")
_NOTICED: Final = re.compile(rb"< aftbed noticed ([0-9A-F]{3}) ([a-z_]{1,32}) ")
_HEARD: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR


class Hub:
    """The bus. `serve` makes one and runs it; it owns the connections, not the descriptors given."""

    def __init__(
        self, listener: socket.socket, log_fd: int, options: HubOptions, life_fd: int, desk: Desk | None
    ) -> None:
        self.counts = HubCounts()
        self._options = options
        self._listener = listener
        self._log_fd = log_fd
        self._life_fd = life_fd
        self._desk = desk
        self._origin_ns = time.monotonic_ns() if options.origin_ns is None else options.origin_ns
        self._senders: list[Client] = []  # who has frames waiting; outlives the connection
        self._time_master: Client | None = None
        self._plant: Client | None = None  # who drives the car
        self._awaited: tuple[Client, str, int] | None = None  # who wants to know when so many are carried
        self._faults: HubFaults | None = None  # None: nothing is to be looked after
        self._past_faults: HubFaults | None = None
        self.watches = Watches(
            lambda line: self._tell(self._plant, line),
            lambda car: self._send(car, self._ok()),
            desk,
            lockstep=options.lockstep,
        )
        self._virtual_us = 0
        self._wire: tuple[Client, Frame] | None = None  # in transmission, until its `t_us`
        self._wire_free_us = 0
        self._log_bytes = 0
        self._epoll = select.epoll()
        self._clients = Clients(listener, self._epoll, self.counts)
        self._send, self._drop = self._clients.send, self._clients.drop
        listener.setblocking(False)
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._epoll.register(life_fd, select.EPOLLIN)

    def run(self) -> HubCounts:
        """Carry frames until `life_fd` ends, and then those that had been sent by then."""
        alive = True
        while alive:
            alive = self._attend_all(self._wait())
            if self._faults is not None and not self._options.lockstep:
                self._release(self._faults)
            self._carry()
            if self._awaited is not None:
                self._answer_awaited(*self._awaited)
        self._epoll.unregister(self._life_fd)
        self._epoll.unregister(self._listener.fileno())
        end_s = time.monotonic() + LAST_FRAMES_S_MAX
        while time.monotonic() < end_s and (events := self._epoll.poll(0, EVENTS_MAX)):
            self._attend_all(events)
            self._carry()
        return self.counts

    def _attend_all(self, events: list[tuple[int, int]]) -> bool:
        """Serve all who have something; False when the life of the hub has ended."""
        alive = True
        for fd, mask in events:
            client = self._clients.get(fd)
            if client is not None:
                self._attend(client, mask)
            elif fd == self._life_fd:
                alive = bool(read(fd, READ_BYTES_MAX)) if self._desk is None else self._desk.attend(self)
            elif fd == self._listener.fileno():
                self._clients.accept()
        return alive

    def close(self) -> None:
        """Hang up on all clients."""
        for client in self._clients.all():
            self._drop(client)
        self._epoll.close()

    # -- time and waiting

    def _now_us(self) -> int:
        if self._options.lockstep:
            return self._virtual_us
        elapsed_us = (time.monotonic_ns() - self._origin_ns) // 1000
        return elapsed_us if self._options.pace == 1.0 else int(elapsed_us * self._options.pace)

    def _wait(self) -> list[tuple[int, int]]:
        """The next events; at once with none when the transmission on the wire ends, or a fault is due."""
        due_us = self._wire[1].t_us if self._wire is not None else None
        if self._faults is not None and not self._options.lockstep:
            fault_us = self._faults.due_us()
            due_us = fault_us if due_us is None else min(due_us, due_us if fault_us is None else fault_us)
        if due_us is None:
            return self._epoll.poll(-1, EVENTS_MAX)
        rest_us = due_us - self._now_us()
        if rest_us > 0:  # epoll counts milliseconds, select microseconds, and an epoll can be selected
            select.select([self._epoll], [], [], rest_us / (1e6 * self._options.pace))
        return self._epoll.poll(0, EVENTS_MAX)

    # -- the wire

    def _carry(self) -> None:
        """Let frames over the wire, in arbitration order, as far as time allows."""
        while True:
            if self._wire is not None:
                sender, frame = self._wire
                if frame.t_us > self._now_us() and not self._options.lockstep:
                    return
                self._wire = None
                sender.carried += 1
                if self._faults is None:
                    self._deliver(frame, sender, self._clients.hearers)
                else:
                    self._disturb(self._faults, frame, sender)
            if not self._senders:
                return
            winner = min(self._senders, key=lambda client: client.frames[0].can_id)
            self._wire = (winner, self._transmitted(winner.frames.popleft()))
            if not winner.frames:
                self._senders.remove(winner)
            self._clients.watch(winner)

    def _transmitted(self, frame: Frame) -> Frame:
        """`frame` with the time at which its transmission ends, beginning when the wire is free."""
        bitrate_bps = self._options.bitrate_bps
        wire_us = 0 if bitrate_bps is None else -(-frame_bits(len(frame.data)) * 1_000_000 // bitrate_bps)
        self._wire_free_us = max(self._wire_free_us, frame.t_us) + wire_us
        if self._wire_free_us == frame.t_us:
            return frame
        return Frame(self._wire_free_us, frame.can_id, frame.data)

    def _deliver(self, frame: Frame, sender: Client | None, hearers: list[Client]) -> None:
        """The one place through which every frame passes: relay it, then record it."""
        self.counts.frames += 1
        seconds, micros = divmod(frame.t_us, 1_000_000)
        text = f"< frame {frame.can_id:03X} {seconds}.{micros:06d} {frame.data.hex().upper()} >".encode(
            "ascii"
        )
        for client in hearers:
            if client is not sender:
                self._send(client, text)
        line = log_line(frame, self._options.channel).encode("ascii")
        self._log_bytes += len(line)
        if self._log_bytes > LOG_BYTES_MAX:
            raise HarnessError(f"the bus log is over its limit of {LOG_BYTES_MAX} bytes")
        if write(self._log_fd, line) != len(line):
            raise HarnessError("the bus log took only a part of a line: is the disk full?")

    # -- faults of the bus

    def disturb(self, number: int, fault: BusFault, draw: int) -> None:
        """Arm `fault`, which is aimed; `draw` seeds its chance."""

        if self._past_faults is None:
            self._past_faults = HubFaults(
                lambda line: self._tell(self._time_master, line), lambda line: self._tell(self._plant, line)
            )
        self._faults = self._past_faults
        self._faults.arm(number, fault, draw, self._now_us())

    def forget(self, number: int) -> None:
        """End that fault."""
        if self._faults is not None:
            self._faults.forget(number, self._now_us())

    @property
    def disturbed(self) -> bool:
        """Whether a fault can still strike; if not, a frame costs no more than it ever did."""
        return self._faults is not None

    def struck(self) -> list[Struck]:
        """What has become of all faults."""
        return [] if self._past_faults is None else self._past_faults.struck()

    def _disturb(self, faults: "HubFaults", frame: Frame, sender: Client) -> None:
        self._deliver_all(faults, faults.carry(frame, sender, self._clients.hearers))

    def _release(self, faults: "HubFaults") -> None:
        self._deliver_all(faults, faults.release(self._now_us(), self._clients.hearers))

    def _deliver_all(self, faults: "HubFaults", deliveries: "list[Delivery]") -> None:
        for one in deliveries:
            self._deliver(one.frame, None, one.hearers)
        self._look_after(faults)

    def _look_after(self, faults: "HubFaults") -> None:
        if self._desk is not None and (news := faults.news()):
            self._desk.report(news)
        if faults.idle:
            self._faults = None

    def _tell(self, client: Client | None, line: bytes) -> None:
        if client is not None:
            self._send(client, line)

    # -- clients

    def _attend(self, client: Client, events: int) -> None:
        if events & select.EPOLLOUT:
            self._clients.flush(client)
        if events & _HEARD:
            self._receive(client)

    def _receive(self, client: Client) -> None:
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
        self._clients.watch(client)

    def _take(self, client: Client, element: bytes) -> None:
        """Act on one element (without its `>`), or refuse it, having changed nothing."""
        try:
            if client.raw and element.startswith(b"< send "):
                client.frames.append(parse_send(element, self._now_us()))
                if len(client.frames) == 1:
                    self._senders.append(client)
            else:
                self._command(client, element)
        except PeerError as error:
            self._refuse(client, str(error))

    def _command(self, client: Client, element: bytes) -> None:
        """Everything but a frame."""
        if element == b"< echo ":
            self._send(client, b"< echo >")
        elif element.startswith(b"< open ") and not client.opened:
            if element != b"< open %b " % self._options.channel.encode("ascii"):
                raise PeerError(f"could not open bus: only {self._options.channel} is here")
            client.opened = True
            self._send(client, b"< ok >")
        elif element == b"< rawmode " and client.opened and not client.raw:
            client.raw = True
            self._clients.hearers = [*self._clients.hearers, client]
            self._send(client, b"< ok >\n", socket.MSG_OOB)
        elif (match := _TIME.fullmatch(element)) is not None and client.opened:
            self._set_time(client, int(match[1]))
            self._send(client, self._ok())
        elif element.startswith(b"< aftbed ") and client.opened:
            self._aside(client, element)
        else:
            raise PeerError("unknown command, or not now")

    def _aside(self, client: Client, element: bytes) -> None:
        """What nodes of ours say beside the bus; only what is asked for is answered."""
        if (match := _NODE.fullmatch(element)) is not None:
            client.name = match[1].decode("ascii")
            client.uses = frozenset(int(word, 16) for word in match[2].split())
        elif (match := _AWAIT.fullmatch(element)) is not None:
            self._awaited = (client, match[1].decode("ascii"), int(match[2]))
        elif element == b"< aftbed plant ":
            self._plant = client
            own = self._faults.watches() if self._faults is not None else b""
            self._send(client, b"< ok >" + own + self.watches.lines())
        elif (match := _MET.fullmatch(element)) is not None:
            number, t_us, since_ns = map(int, match.groups())
            if self._faults is not None:
                self._faults.met(number, self._now_us())
                self._release(self._faults)
            self.watches.met(number, t_us, since_ns, client)
        elif (match := _UNASKED.fullmatch(element)) is not None:
            if self._past_faults is not None:
                self._past_faults.unasked(int(match[1], 16))
        elif (match := _NOTICED.fullmatch(element)) is not None:
            if self._past_faults is not None:
                self._past_faults.noticed(client.name, int(match[1], 16), match[2].decode("ascii"))
                self._look_after(self._past_faults)
        else:
            raise PeerError("unknown command, or not now")

    def _ok(self) -> bytes:
        """To the time master: once there have been faults, when something is due next."""
        if self._past_faults is None:
            return b"< ok >"
        due_us = self._past_faults.due_us()
        return f"< ok {'-' if due_us is None else due_us} >".encode("ascii")

    def _answer_awaited(self, client: Client, node: str, frames: int) -> None:
        if any(c.name == node and c.carried >= frames for c in self._clients.all()):
            self._awaited = None
            self._send(client, self._ok())

    def _set_time(self, client: Client, t_us: int) -> None:
        if not self._options.lockstep:
            raise PeerError("this bus runs in real time")
        if self._time_master not in (None, client):
            raise PeerError("another client is the time master")
        if t_us < self._virtual_us:
            raise PeerError(f"time runs backwards, from {self._virtual_us} to {t_us}")
        if self._faults is not None:
            self._carry()  # what was sent before is of before
        self._time_master, self._virtual_us = client, t_us
        if self._faults is not None:
            self._release(self._faults)

    # -- output

    def _refuse(self, client: Client, reason: str) -> None:
        self.counts.refused += 1
        seconds, micros = divmod(self._now_us(), 1_000_000)
        self._send(client, f"< error 20000000 {seconds}.{micros:06d} {reason} >".encode("ascii"))


def serve(
    listener: socket.socket, log_fd: int, options: HubOptions, life_fd: int, desk: Desk | None = None
) -> HubCounts:
    """Run a bus on `listener`, bound and listening, until `life_fd` reads its end; record on `log_fd`.

    A `desk` reads `life_fd` itself.

    Raises HarnessError, or OSError, when a frame cannot be recorded.
    """
    hub = Hub(listener, log_fd, options, life_fd, desk)
    try:
        return hub.run()
    finally:
        hub.close()
