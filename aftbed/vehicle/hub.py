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

*Limits.* Nothing that a client does may stop the bus. One who does not read is disconnected when
256 KiB wait for it; one who sends more than the wire carries is not read until its queue is short.

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
from os import read, write
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, HarnessError, PeerError
from aftbed.vehicle.candump import log_line
from aftbed.vehicle.frame import Frame

CLIENTS_MAX: Final = 64
EVENTS_MAX: Final = 32  # in one round; the rest comes in the next
READ_BYTES_MAX: Final = 4096
ELEMENT_BYTES_MAX: Final = 128  # the longest legal one has 46
LAST_FRAMES_S_MAX: Final = 0.1
OUTPUT_BYTES_MAX: Final = 256 * 1024
FRAMES_QUEUED_MAX: Final = 256  # of one client
LOG_BYTES_MAX: Final = 1024 * 1024 * 1024

_SEND: Final = re.compile(rb"< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-9]) ((?:[0-9A-Fa-f]{1,2} ){0,8}) ?")
_TIME: Final = re.compile(rb"< aftbed time ([0-9]{1,16}) ")
_HEARD: Final = select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR


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


class _Client:
    """One connection: how far its handshake is, and what waits in either direction."""

    __slots__ = ("frames", "inbox", "interest", "opened", "outbox", "raw", "sock")

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.opened = False
        self.raw = False
        self.inbox = b""
        self.outbox = bytearray()
        self.frames: deque[Frame] = deque()  # `t_us` is when the node asked for the bus
        self.interest = select.EPOLLIN


class Hub:
    """The bus. `serve` makes one and runs it; it owns the connections, not the descriptors given."""

    def __init__(self, listener: socket.socket, log_fd: int, options: HubOptions, life_fd: int) -> None:
        self.counts = HubCounts()
        self._options = options
        self._listener = listener
        self._log_fd = log_fd
        self._life_fd = life_fd
        self._origin_ns = time.monotonic_ns() if options.origin_ns is None else options.origin_ns
        self._clients: dict[int, _Client] = {}
        self._hearers: list[_Client] = []  # replaced, never changed: it is walked while clients drop
        self._senders: list[_Client] = []  # who has frames waiting; outlives the connection
        self._time_master: _Client | None = None
        self._virtual_us = 0
        self._wire: tuple[_Client, Frame] | None = None  # in transmission, until its `t_us`
        self._wire_free_us = 0
        self._log_bytes = 0
        self._epoll = select.epoll()
        listener.setblocking(False)
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._epoll.register(life_fd, select.EPOLLIN)

    def run(self) -> HubCounts:
        """Carry frames until `life_fd` ends, and then those that had been sent by then."""
        alive = True
        while alive:
            alive = self._attend_all(self._wait())
            self._carry()
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
                alive = bool(read(fd, READ_BYTES_MAX))
            elif fd == self._listener.fileno():
                self._accept()
        return alive

    def close(self) -> None:
        """Hang up on all clients."""
        for client in list(self._clients.values()):
            self._drop(client)
        self._epoll.close()

    # -- time and waiting

    def _now_us(self) -> int:
        if self._options.lockstep:
            return self._virtual_us
        elapsed_us = (time.monotonic_ns() - self._origin_ns) // 1000
        return elapsed_us if self._options.pace == 1.0 else int(elapsed_us * self._options.pace)

    def _wait(self) -> list[tuple[int, int]]:
        """The next events; at once with none when the transmission on the wire ends."""
        if self._wire is None:
            return self._epoll.poll(-1, EVENTS_MAX)
        rest_us = self._wire[1].t_us - self._now_us()
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
                self._deliver(frame, sender)
            if not self._senders:
                return
            winner = min(self._senders, key=lambda client: client.frames[0].can_id)
            self._wire = (winner, self._transmitted(winner.frames.popleft()))
            if not winner.frames:
                self._senders.remove(winner)
            self._watch(winner)

    def _transmitted(self, frame: Frame) -> Frame:
        """`frame` with the time at which its transmission ends, beginning when the wire is free."""
        bitrate_bps = self._options.bitrate_bps
        wire_us = 0 if bitrate_bps is None else -(-frame_bits(len(frame.data)) * 1_000_000 // bitrate_bps)
        self._wire_free_us = max(self._wire_free_us, frame.t_us) + wire_us
        if self._wire_free_us == frame.t_us:
            return frame
        return Frame(self._wire_free_us, frame.can_id, frame.data)

    def _deliver(self, frame: Frame, sender: _Client) -> None:
        """The one place through which every frame passes: relay it, then record it."""
        self.counts.frames += 1
        seconds, micros = divmod(frame.t_us, 1_000_000)
        text = f"< frame {frame.can_id:03X} {seconds}.{micros:06d} {frame.data.hex().upper()} >".encode(
            "ascii"
        )
        for client in self._hearers:
            if client is not sender:
                self._send(client, text)
        line = log_line(frame, self._options.channel).encode("ascii")
        self._log_bytes += len(line)
        if self._log_bytes > LOG_BYTES_MAX:
            raise HarnessError(f"the bus log is over its limit of {LOG_BYTES_MAX} bytes")
        if write(self._log_fd, line) != len(line):
            raise HarnessError("the bus log took only a part of a line: is the disk full?")

    # -- clients

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
        client = self._clients[sock.fileno()] = _Client(sock)
        self._epoll.register(sock.fileno(), client.interest)
        self._send(client, b"< hi >")

    def _drop(self, client: _Client) -> None:
        """Hang up. What the node had handed over before still gets its turn on the wire."""
        if self._clients.pop(client.sock.fileno(), None) is None:
            return
        self._hearers = [other for other in self._hearers if other is not client]
        self._epoll.unregister(client.sock.fileno())
        client.sock.close()

    def _attend(self, client: _Client, events: int) -> None:
        if events & select.EPOLLOUT:
            self._flush(client)
        if events & _HEARD:
            self._receive(client)

    def _watch(self, client: _Client) -> None:
        """Ask only for the events that can be served: a full queue is not read into."""
        interest = select.EPOLLOUT if client.outbox else 0
        if len(client.frames) < FRAMES_QUEUED_MAX:
            interest |= select.EPOLLIN
        if interest != client.interest and client.sock.fileno() in self._clients:
            client.interest = interest
            self._epoll.modify(client.sock.fileno(), interest)

    def _receive(self, client: _Client) -> None:
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
        self._watch(client)

    def _take(self, client: _Client, element: bytes) -> None:
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

    def _command(self, client: _Client, element: bytes) -> None:
        """Everything but a frame: rare, so legibility before speed."""
        if element == b"< echo ":
            self._send(client, b"< echo >")
        elif element.startswith(b"< open ") and not client.opened:
            if element != b"< open %b " % self._options.channel.encode("ascii"):
                raise PeerError(f"could not open bus: only {self._options.channel} is here")
            client.opened = True
            self._send(client, b"< ok >")
        elif element == b"< rawmode " and client.opened and not client.raw:
            client.raw = True
            self._hearers = [*self._hearers, client]
            self._send(client, b"< ok >\n", socket.MSG_OOB)
        elif (match := _TIME.fullmatch(element)) is not None and client.opened:
            self._set_time(client, int(match[1]))
            self._send(client, b"< ok >")
        else:
            raise PeerError("unknown command, or not now")

    def _set_time(self, client: _Client, t_us: int) -> None:
        if not self._options.lockstep:
            raise PeerError("this bus runs in real time")
        if self._time_master not in (None, client):
            raise PeerError("another client is the time master")
        if t_us < self._virtual_us:
            raise PeerError(f"time runs backwards, from {self._virtual_us} to {t_us}")
        self._time_master, self._virtual_us = client, t_us

    # -- output

    def _refuse(self, client: _Client, reason: str) -> None:
        self.counts.refused += 1
        seconds, micros = divmod(self._now_us(), 1_000_000)
        self._send(client, f"< error 20000000 {seconds}.{micros:06d} {reason} >".encode("ascii"))

    def _send(self, client: _Client, data: bytes, flags: int = 0) -> None:
        """Send, or queue what the socket does not take; a client with too much queued is dropped."""
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
            self._watch(client)

    def _flush(self, client: _Client) -> None:
        try:
            del client.outbox[: client.sock.send(client.outbox, socket.MSG_NOSIGNAL)]
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        self._watch(client)


def serve(listener: socket.socket, log_fd: int, options: HubOptions, life_fd: int) -> HubCounts:
    """Run a bus on `listener`, bound and listening, until `life_fd` reads its end; record on `log_fd`.

    Raises HarnessError, or OSError, when a frame cannot be recorded.
    """
    hub = Hub(listener, log_fd, options, life_fd)
    try:
        return hub.run()
    finally:
        hub.close()
