"""The hub's connections: what is kept of one, how it is served, and when it is put out.

Nothing here may block, and nothing that a client does may stop the bus. One who does not read is
disconnected when 256 KiB wait for it; one who sends more than the wire carries is not read until its queue is
short.
"""

import re
import select
import socket
from collections import deque
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.frame import Frame

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
