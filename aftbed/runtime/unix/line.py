"""The line between the supervisor and a process: one SEQPACKET pair, and how descriptors travel on it.

What is said on it: `runtime.control`. A packet over the limit travels as a memfd.
"""

import array
import contextlib
import os
import socket
from collections.abc import Callable
from typing import Final, Generic, TypeVar

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.messages import PACKET_BYTES_MAX, UNREADABLE
from aftbed.runtime.control import FromNode, ToNode
from aftbed.runtime.unix import packets

FDS_MAX: Final = 64
_RIGHTS_BYTES: Final = socket.CMSG_SPACE(FDS_MAX * 4)

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
            packets.send_in_file(self.sock, data)
        else:
            self._sendmsg(data, fds)

    def _sendmsg(self, data: bytes, fds: tuple[int, ...]) -> None:
        rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", fds))] if fds else []
        self.sock.sendmsg([data], rights)

    def recv(self) -> tuple[Incoming, list[int]] | None:
        """The next message with its descriptors; None at the end.

        Raises BlockingIOError where there is none, PeerError on what is not a message (its
        descriptors are closed).
        """
        data, ancillary, flags, _ = self.sock.recvmsg(
            PACKET_BYTES_MAX, _RIGHTS_BYTES, socket.MSG_CMSG_CLOEXEC
        )
        fds = packets.descriptors_in(ancillary)
        if not data:
            for fd in fds:
                os.close(fd)
            return None
        try:
            if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
                raise PeerError(f"truncated control message of {len(data)} bytes, {len(fds)} descriptors")
            if data == packets.ANNOUNCED and len(fds) == 1:
                data = packets.read_file(fds.pop())
            return self._decode(data), fds
        except (*UNREADABLE, PeerError, OSError) as error:
            for fd in fds:
                os.close(fd)
            raise PeerError(f"not a control message ({len(data)} bytes): {error}") from error

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(OSError):
            self.sock.close()
