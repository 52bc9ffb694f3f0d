"""Channels in virtual time, with the semantics of those of sockets (see `runtime.unix.transport`).

Order is kept; what is queued survives both nodes; a fence lets what was sent through and then ends; a node
that writes behind a fence, or where no node will ever read, dies (EPIPE); a full channel holds its writer up.
The executive has a hold on both ends until it closes them, the nodes at the ends have theirs.
"""

from collections import deque
from heapq import heappush
from typing import Final, Protocol

from aftbed.core.graph import Link
from aftbed.core.messages import Message
from aftbed.runtime.sim.clock import Clock

IDLE_BEFORE_COLD_NS: Final = 20_000_000  # a reader that was idle for so long has lost its caches
COLD_PENALTY_NS: Final = (10_000, 50_000)  # added to its next read: from, to
QUEUE_MAX: Final = 128  # messages; a socket pair holds about as many small ones


class ChannelUser(Protocol):
    """A node at an end of a channel."""

    name: str
    ran_ns: int  # when it last did anything

    def run(self) -> None:
        """Handle all that can be handled now."""
        ...


class SimEnd:
    """One end, by its number."""

    __slots__ = ("channel", "number")

    def __init__(self, channel: "SimChannel", number: int) -> None:
        self.channel, self.number = channel, number

    def fileno(self) -> int:
        """The number."""
        return self.number


class SimChannel:
    """`mail`: times of arrival and messages; `readers` and `writers`: the nodes that have an end."""

    def __init__(self, link: Link, clock: Clock, first_number: int) -> None:
        self.link, self._clock = link, clock
        self.write, self.read = SimEnd(self, first_number), SimEnd(self, first_number + 1)
        self.mail: deque[tuple[int, Message]] = deque()
        self.readers: list[ChannelUser] = []
        self.writers: list[ChannelUser] = []
        self.ended = self.refused = self.closed = False
        self._last_ns = 0  # of an arrival

    @property
    def number(self) -> int:
        """Of its writing end."""
        return self.write.number

    def heard_by(self) -> frozenset[str]:
        """Who reads it."""
        return frozenset([node.name for node in self.readers])

    def has_room(self) -> bool:
        """Whether `put` would succeed now."""
        return not (self.ended or self.refused or len(self.mail) >= QUEUE_MAX)

    def put(self, message: Message) -> bool:
        """Send. False if there is no room now, or no node will ever read it: the writer waits for orders."""
        mail = self.mail
        if self.ended or self.refused or len(mail) >= QUEUE_MAX:
            return False
        clock = self._clock
        t_ns = clock.ns + clock.hop_ns()
        if self.readers and t_ns - self.readers[0].ran_ns > IDLE_BEFORE_COLD_NS:
            t_ns += clock.between_ns(*COLD_PENALTY_NS)
        if t_ns <= self._last_ns:
            t_ns = self._last_ns + 1
        self._last_ns = t_ns
        mail.append((t_ns, message))
        clock.count += 1
        heappush(clock.heap, (t_ns, clock.count, self.arrive))
        return True

    def arrive(self) -> None:
        """Something has come, or may be read now."""
        readers = self.readers
        if len(readers) == 1:
            readers[0].run()
            return
        for node in list(readers):
            node.run()

    def take(self) -> Message:
        """The oldest message, which has arrived."""
        if len(self.mail) == QUEUE_MAX:
            for node in list(self.writers):
                self._clock.at(self._clock.ns, node.run)  # there is room again
        return self.mail.popleft()[1]

    def fence(self) -> None:
        """No more mail. The reader hears of the end behind what was sent."""
        if self.ended:
            return
        self.ended = True
        self._last_ns = max(self._last_ns + 1, self._clock.ns + self._clock.hop_ns())
        self._clock.message(self._last_ns, self, self._end_comes)
        for node in list(self.writers):
            self._clock.at(self._clock.ns, node.run)

    def _end_comes(self) -> None:
        self._last_ns = self._clock.ns
        self.arrive()

    def over(self) -> bool:
        """Whether the reader has come to the end."""
        return self.ended and not self.mail and self._clock.ns >= self._last_ns

    def refuse(self) -> None:
        """Who waits for room dies."""
        self.refused = True
        for node in list(self.writers):
            self._clock.at(self._clock.ns, node.run)

    def nudge(self) -> None:
        """Orders arrive by themselves here."""

    def close(self) -> None:
        """The executive's hold on both ends."""
        self.closed = True
        self._look()

    def leave(self, node: ChannelUser) -> None:
        """`node` has no end of it any more."""
        if node in self.readers:
            self.readers.remove(node)
        if node in self.writers:
            self.writers.remove(node)
        self._look()

    def _look(self) -> None:
        if self.closed and not self.writers:
            self.fence()
        if self.closed and not self.readers:
            self.refuse()
