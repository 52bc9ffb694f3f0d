"""What does not fit into a packet travels as a memfd (memfd_create(2), unix(7)): on lines, and on channels.

A channel is read with read(2), which is quick and lets a descriptor fall. So who writes a large packet
*announces* it first, with a packet of one byte, and the next one is read with recvmsg(2). Between the two the
kernel may put a nudge, and a writer that found no room announces again: neither does any harm.

A channel holds so many bytes, and a memfd is none of them: so the packet that it comes with is as large as
one may be. That bounds how many large packets wait in a channel, and holds back who writes more than the
other end can take, as with any other.
"""

import array
import os
import socket
import stat
from typing import Final

from aftbed.core.errors import PeerError
from aftbed.core.messages import PACKET_BYTES_MAX

STATE_BYTES_MAX: Final = 64 << 20
ANNOUNCED: Final = b"\xc1"  # a byte that MessagePack never uses
READ_BYTES_MAX: Final = PACKET_BYTES_MAX + 1  # one byte more than is allowed, so that it is noticed
_WEIGHT: Final = ANNOUNCED * PACKET_BYTES_MAX
_RIGHTS_BYTES: Final = socket.CMSG_SPACE(4)


def put(descriptor: int, data: bytes) -> None:
    """Send `data`, however large. Raises OSError as write(2) does; then all of it has to be sent again."""
    if len(data) <= PACKET_BYTES_MAX:
        os.write(descriptor, data)
        return
    os.write(descriptor, ANNOUNCED)
    with _borrowed(descriptor) as sock:
        send_in_file(sock.socket, data, _WEIGHT)


def take(descriptor: int) -> bytes:
    """The next packet, behind an announcement; one without a memfd is given as it is. Raises PeerError."""
    with _borrowed(descriptor) as sock:
        data, ancillary, _, _ = sock.socket.recvmsg(READ_BYTES_MAX, _RIGHTS_BYTES, socket.MSG_CMSG_CLOEXEC)
    fds = descriptors_in(ancillary)
    return read_file(fds[0]) if fds else data


def send_in_file(sock: socket.socket, data: bytes, beside: bytes = ANNOUNCED) -> None:
    """`data` as a memfd, in a packet of `beside`. Raises OSError as sendmsg(2) does."""
    assert len(data) <= STATE_BYTES_MAX, f"{len(data)} bytes"
    with open(os.memfd_create("aftbed-state"), "wb", buffering=0) as file:
        left = memoryview(data)
        while left:
            left = left[file.write(left) :]
        sock.sendmsg([beside], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [file.fileno()]))])


def read_file(descriptor: int) -> bytes:
    """The packet in a memfd, which is closed. Raises PeerError if it is no file or too large."""
    try:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode):
            raise PeerError("the descriptor of a large packet is not a memfd")
        if state.st_size > STATE_BYTES_MAX:
            raise PeerError(f"a packet of {state.st_size} bytes, at most {STATE_BYTES_MAX} are allowed")
        return os.pread(descriptor, state.st_size, 0)
    finally:
        os.close(descriptor)


def descriptors_in(ancillary: list[tuple[int, int, bytes]]) -> list[int]:
    """What came with a packet; ours to close."""
    fds = array.array("i")
    for level, kind, payload in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            fds.frombytes(payload[: len(payload) - len(payload) % fds.itemsize])
    return list(fds)


class _borrowed:  # noqa: N801 - a context
    """A socket out of a descriptor, which is not closed with it."""

    __slots__ = ("socket",)

    def __init__(self, descriptor: int) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, fileno=descriptor)

    def __enter__(self) -> "_borrowed":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.detach()
