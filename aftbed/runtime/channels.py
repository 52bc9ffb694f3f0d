"""The channels of a run: the executive owns both ends of every one, and hands them out.

So channels outlive nodes: what is queued while a node is suspended, killed or replaced stays queued.
"""

from collections.abc import Callable, Iterable

from aftbed.core.graph import Link
from aftbed.runtime.interface import Channel

ChannelKey = tuple[str, str, str]  # source, its port, sink


class Channels:
    """All channels between nodes, found by their ends."""

    def __init__(self, make: Callable[[Link], Channel]) -> None:
        self._make = make
        self.beside: dict[ChannelKey, Channel] = {}  # of the graph to be, or of the one before
        self._all: dict[ChannelKey, Channel] = {}

    def renew(self, link: Link) -> Channel:
        """A fresh channel for `link`; the old one is let go."""
        key = (link.source, link.source_port, link.sink)
        old = self._all.pop(key, None)
        if old is not None:
            old.close()
        channel = self._all[key] = self._make(link)
        return channel

    def make_beside(self, link: Link) -> Channel:
        """The channel of `link`, which the graph that runs does not have; a fresh one, if need be."""
        key = (link.source, link.source_port, link.sink)
        if key not in self.beside:
            self.beside[key] = self._make(link)
        return self.beside[key]

    def adopt(self, links: Iterable[Link]) -> None:
        """From now on the graph that runs has these links; what it does not have stays beside, open."""
        kept = {(k.source, k.source_port, k.sink) for k in links}
        known = self._all | self.beside
        self._all = {key: channel for key, channel in known.items() if key in kept}
        self.beside = {key: channel for key, channel in known.items() if key not in kept}

    def close_beside(self) -> None:
        """Let go of all that the graph that runs does not have."""
        for channel in self.beside.values():
            channel.close()
        self.beside = {}

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

    def drop(self, channel: Channel) -> None:
        """Let go of `channel`."""
        link = channel.link
        self._all.pop((link.source, link.source_port, link.sink), None)
        channel.close()

    def __len__(self) -> int:
        return len(self._all)
