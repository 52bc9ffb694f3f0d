"""How packets travel between processes of a run: on control lines and on channels.

Both are `AF_UNIX SOCK_SEQPACKET` pairs (unix(7)): order kept, packets whole, a bounded queue in the kernel.
A packet over the limit travels as a memfd (memfd_create(2)).

A channel is read with read(2), which is fast and drops descriptors. So the writer of a large packet
*announces* it with a packet of one byte, and the next packet is read with recvmsg(2). The kernel may put a
nudge between the two, and a writer that found no room announces again: neither does any harm.

The queue of a channel is bounded in bytes, and a memfd is not counted. So the packet that comes with it is
padded to the largest size: that bounds how many large packets wait in a channel, and blocks a writer that
is faster than its reader.
"""

import array
import contextlib
import mmap
import os
import socket
import stat
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

import msgspec

from aftbed.core.application import STATE_BYTES_MAX
from aftbed.core.errors import PeerError
from aftbed.core.graph import Link
from aftbed.core.messages import PACKET_BYTES_MAX, UNREADABLE
from aftbed.inject.shared_state import SHARED_BYTES
from aftbed.runtime.control import FromNode, ToNode
from aftbed.runtime.unix.linux import readable, set_timeouts

ANNOUNCED: Final = b"\xc1"  # a byte that MessagePack never uses
READ_BYTES_MAX: Final = PACKET_BYTES_MAX + 1  # one byte more than is allowed, so that it is noticed
_WEIGHT: Final = ANNOUNCED * PACKET_BYTES_MAX
_RIGHTS_BYTES: Final = socket.CMSG_SPACE(4)
NUDGE: Final = b"\0"
ORDER_SECONDS: Final = 0.02  # a node that is suspended waits so long for an order, and looks around
STATE_NAME: Final = "aftbed-state"  # as /proc/PID/fd shows it
WRITE_SECONDS_MAX: Final = 2.0  # a node that cannot write for so long takes itself for fenced


def put(descriptor: int, data: bytes | memoryview) -> None:
    """Send `data`, however large. Raises OSError as write(2) does; then all of it has to be sent again."""
    if len(data) <= PACKET_BYTES_MAX:
        os.write(descriptor, data)
        return
    os.write(descriptor, ANNOUNCED)
    with _borrowed(descriptor) as sock:
        send_in_file(sock, data, _WEIGHT)


def take(descriptor: int) -> bytes:
    """The next packet, behind an announcement; one without a memfd is given as it is. Raises PeerError."""
    with _borrowed(descriptor) as sock:
        data, ancillary, _, _ = sock.recvmsg(READ_BYTES_MAX, _RIGHTS_BYTES, socket.MSG_CMSG_CLOEXEC)
    fds = descriptors_in(ancillary)
    return read_file(fds[0]) if fds else data


def send_in_file(sock: socket.socket, data: bytes | memoryview, beside: bytes = ANNOUNCED) -> None:
    """`data` as a memfd, in a packet of `beside`. Raises OSError as sendmsg(2) does."""
    assert len(data) <= STATE_BYTES_MAX, f"{len(data)} bytes"
    with open(os.memfd_create(STATE_NAME), "wb", buffering=0) as file:
        _write_whole(file.fileno(), data)
        sock.sendmsg([beside], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [file.fileno()]))])


def _write_whole(descriptor: int, data: bytes | memoryview) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


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


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """A socket out of a descriptor, which stays open."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, fileno=descriptor)
    try:
        yield sock
    finally:
        sock.detach()


# -- control lines: one pair between the supervisor and each process; the messages are `runtime.control`'s.

FDS_MAX: Final = 64
_LINE_RIGHTS_BYTES: Final = socket.CMSG_SPACE(FDS_MAX * 4)
_CUT: Final = int(socket.MSG_TRUNC | socket.MSG_CTRUNC)  # of ints: `|` of flags is a function of Python

decode_order: Callable[[bytes], ToNode] = msgspec.msgpack.Decoder(ToNode).decode
decode_report: Callable[[bytes], FromNode] = msgspec.msgpack.Decoder(FromNode).decode
_encode = msgspec.msgpack.Encoder().encode
Incoming = TypeVar("Incoming")


class Line(Generic[Incoming]):
    """One end of a control pair. Blocking or not as the socket is."""

    def __init__(self, sock: socket.socket, decode: Callable[[bytes], Incoming]) -> None:
        self.sock, self._decode = sock, decode

    def fileno(self) -> int:
        """For polling."""
        return self.sock.fileno()

    def send(self, message: msgspec.Struct, fds: tuple[int, ...] = ()) -> None:
        """Send one message and descriptors. Raises OSError as sendmsg(2) does."""
        data = _encode(message)
        assert len(fds) <= FDS_MAX, f"{len(fds)} descriptors"
        if len(data) > PACKET_BYTES_MAX:
            assert not fds, f"{len(data)} bytes, and descriptors"
            send_in_file(self.sock, data)
        else:
            rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", fds))] if fds else []
            self.sock.sendmsg([data], rights)

    def recv(self) -> tuple[Incoming, list[int]] | None:
        """The next message with its descriptors; None at the end.

        Raises BlockingIOError where there is none, PeerError on what is not a message (its
        descriptors are closed).
        """
        data, ancillary, flags, _ = self.sock.recvmsg(
            PACKET_BYTES_MAX, _LINE_RIGHTS_BYTES, socket.MSG_CMSG_CLOEXEC
        )
        fds = descriptors_in(ancillary)
        if not data:
            for fd in fds:
                os.close(fd)
            return None
        try:
            if flags & _CUT:
                raise PeerError(f"truncated control message of {len(data)} bytes, {len(fds)} descriptors")
            if data == ANNOUNCED and len(fds) == 1:
                data = read_file(fds.pop())
            return self._decode(data), fds
        except (*UNREADABLE, PeerError, OSError) as error:
            for fd in fds:
                os.close(fd)
            raise PeerError(f"not a control message ({len(data)} bytes): {error}") from error

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(OSError):
            self.sock.close()


# -- states ---------------------------------------------------------------------------------------


class MemfdState:
    """A state that goes from node to node by way of the supervisor, which does not read it.

    See `runtime.interface.StateFile`.
    """

    def __init__(self) -> None:
        self._descriptor = os.memfd_create(STATE_NAME, os.MFD_CLOEXEC)

    def fileno(self) -> int:
        """The descriptor that is passed to both nodes."""
        return self._descriptor

    def used(self) -> bool:
        """Whether something was written."""
        return os.fstat(self._descriptor).st_size > 0

    def close(self) -> None:
        """A node keeps its own descriptor until it has read the state."""
        os.close(self._descriptor)


def put_state(descriptor: int, state: bytes) -> bytes:
    """What an answer holds of `state`: all of a small one, nothing of one that is in the file now, closed."""
    try:
        if len(state) <= PACKET_BYTES_MAX:
            return state
        assert len(state) <= STATE_BYTES_MAX, f"{len(state)} bytes"
        _write_whole(descriptor, state)
        return b""
    finally:
        os.close(descriptor)


# -- channels -------------------------------------------------------------------------------------
#
# They outlive nodes: the supervisor owns both ends of each, and hands them out. `fence` shuts the writing
# end behind all of its descriptors: what was sent stays readable, then the channel ends; a later write gets
# EPIPE. Where the reading end is closed with mail in it, a write gets ECONNRESET: the first one, or the
# second, if the first gets EPIPE while the kernel is about to close the end.

WRITE_PATIENCE_SECONDS: Final = ORDER_SECONDS
assert WRITE_PATIENCE_SECONDS < WRITE_SECONDS_MAX


class UnixChannel:
    """Both ends of `link`."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.write, self.read = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self.write, self.read):
            set_timeouts(end, 0.0, WRITE_PATIENCE_SECONDS)

    def fence(self) -> None:
        """No more mail through this channel."""
        with contextlib.suppress(OSError):
            self.write.shutdown(socket.SHUT_WR)

    def refuse(self) -> None:
        """Close the reading side: a writer that waits for room gets EPIPE."""
        with contextlib.suppress(OSError):
            self.read.shutdown(socket.SHUT_RD)

    def nudge(self) -> None:
        """Wake the reader, so that it looks for orders. A full queue wakes it just as well."""
        with contextlib.suppress(OSError):
            self.write.send(NUDGE, socket.MSG_DONTWAIT)

    def mail_waits(self) -> bool:
        """Whether there is a message, or the end of a fenced channel, that the sink has not taken."""
        return bool(readable((self.read.fileno(),), 0.0))

    def close(self) -> None:
        """Close both ends here; nodes keep theirs."""
        self.write.close()
        self.read.close()


# -- shared memory --------------------------------------------------------------------------------

MEMORY_NAME: Final = "aftbed-cell"  # as /proc/PID/maps shows it


def map_memory(descriptor: int) -> memoryview:
    """The memory behind `descriptor`, which is closed.

    A process that is forked from here does not inherit it.
    """
    try:
        memory = mmap.mmap(descriptor, SHARED_BYTES)
    finally:
        os.close(descriptor)
    memory.madvise(mmap.MADV_DONTFORK)
    return memoryview(memory)


class MemfdMemory:
    """The supervisor's end of memory that it shares with a node: see `runtime.interface.SharedMemory`.

    A memfd has no name in any directory, and goes with its processes.
    """

    def __init__(self) -> None:
        self._descriptor = os.memfd_create(MEMORY_NAME)
        os.ftruncate(self._descriptor, SHARED_BYTES)
        self.memory = map_memory(os.dup(self._descriptor))

    def fileno(self) -> int:
        """The descriptor that is passed to the node."""
        return self._descriptor

    def seal(self) -> None:
        """Close the descriptor: from here on only the two mappings are left."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def close(self) -> None:
        """Unmap it as well."""
        self.seal()
        self.memory.release()
