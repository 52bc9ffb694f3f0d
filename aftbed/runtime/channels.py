"""The channels of a run: the executive owns both ends of every one, and hands them out.

So channels outlive nodes: what is queued while a node is suspended, killed or replaced stays queued.
"""

from collections.abc import Callable

from aftbed.core.graph import Link
from aftbed.runtime.interface import Channel


class Channels:
    """All channels between nodes, found by their ends."""

    def __init__(self, make: Callable[[Link], Channel]) -> None:
        self.make = make
        self.fresh: dict[tuple[str, str, str], Channel] = {}  # of the graph to be: some read them already
        self._all: dict[tuple[str, str, str], Channel] = {}

    def renew(self, link: Link) -> Channel:
        """A fresh channel for `link`; the old one is let go."""
        key = (link.source, link.source_port, link.sink)
        old = self._all.pop(key, None)
        if old is not None:
            old.close()
        channel = self._all[key] = self.make(link)
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
