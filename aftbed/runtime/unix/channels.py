"""Channels outlive nodes: the supervisor owns both ends of every one, and hands them out.

A channel is an `AF_UNIX SOCK_SEQPACKET` pair (unix(7)): order kept, packets whole, a bounded queue in
the kernel. `fence` shuts the writing end behind all of its descriptors: what was sent stays readable
and then ends; who writes later gets EPIPE.
"""

import contextlib
import socket
from typing import Final

from aftbed.core.graph import Link
from aftbed.runtime.unix.linux import set_timeouts
from aftbed.runtime.unix.node_io import NUDGE, PULSE_SECONDS, WRITE_SECONDS_MAX

WRITE_PATIENCE_SECONDS: Final = PULSE_SECONDS
assert WRITE_PATIENCE_SECONDS < WRITE_SECONDS_MAX


class Channel:
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
        """Nobody will read: a writer that waits for room gets EPIPE."""
        with contextlib.suppress(OSError):
            self.read.shutdown(socket.SHUT_RD)

    def nudge(self) -> None:
        """Wake the reader, so that it looks for control mail. A full queue wakes it just as well."""
        with contextlib.suppress(OSError):
            self.write.send(NUDGE, socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Let go of both ends; nodes keep theirs."""
        self.write.close()
        self.read.close()
