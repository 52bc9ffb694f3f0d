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
from aftbed.runtime.unix.node import NUDGE, PULSE_SECONDS, WRITE_SECONDS_MAX

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


class Channels:
    """All channels between nodes, found by their ends."""

    def __init__(self) -> None:
        self._all: dict[tuple[str, str, str], Channel] = {}

    def renew(self, link: Link) -> Channel:
        """A fresh channel for `link`; the old one is let go."""
        key = (link.source, link.source_port, link.sink)
        old = self._all.pop(key, None)
        if old is not None:
            old.close()
        channel = self._all[key] = Channel(link)
        return channel

    def touching(self, bricks: frozenset[str]) -> list[Channel]:
        """Those with an end at one of `bricks`."""
        return [c for c in self._all.values() if c.link.source in bricks or c.link.sink in bricks]

    def into(self, brick: str) -> list[Channel]:
        """Those that lead to `brick`."""
        return [c for c in self._all.values() if c.link.sink == brick]

    def get(self, source: str, port: str, sink: str) -> Channel | None:
        """The channel from `port` of `source` to `sink`."""
        return self._all.get((source, port, sink))

    def items(self) -> list[tuple[tuple[str, str, str], Channel]]:
        """All of them, each with its source, port and sink."""
        return list(self._all.items())

    def take(self, key: tuple[str, str, str]) -> Channel:
        """Take a channel out, open as it is."""
        return self._all.pop(key)

    def put(self, channel: Channel) -> None:
        """Put a channel in."""
        link = channel.link
        self._all[link.source, link.source_port, link.sink] = channel

    def drop(self, channel: Channel) -> None:
        """Let go of `channel`."""
        link = channel.link
        self._all.pop((link.source, link.source_port, link.sink), None)
        channel.close()

    def __len__(self) -> int:
        return len(self._all)
