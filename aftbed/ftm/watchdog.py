"""Watchdog: tells Recovery that a node of its replica is dead or hangs. One per replica.

A death comes as a message (the host holds the pidfds). A hang is a node whose pulse is older than a
deadline. The deadline only counts while this Watchdog itself runs on time: if the pulses, which the
host hands in every `PERIOD_NS`, come late, the machine was stalled, and every node gets the whole
deadline again. That is what keeps a busy machine from a false failover.
"""

from typing import Final

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, NodeDied, Pulses, Rebound, Suspect, Watch

PERIOD_NS: Final = 10_000_000
HANG_DEADLINE_NS: Final = 60_000_000
LATE_NS_MAX: Final = 10_000_000
_OPEN: Final = ("sense",)


class Watchdog(Brick):
    """`nodes` are watched from `since_ns` on; one suspicion per generation is enough."""

    def __init__(self) -> None:
        self.replica, self.generation = "", 0
        self.nodes: tuple[str, ...] = ()
        self.suspect: Suspect | None = None
        self._last_ns = 0
        self._grace_until_ns = 0

    def open_ports(self) -> tuple[str, ...]:
        """What the host senses."""
        return _OPEN

    def quiescent(self) -> bool:
        """It holds no request."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Be told whom to watch, that a node died, or how the pulses are."""
        if isinstance(msg, Watch):
            self.replica, self.generation, self.nodes = msg.replica, msg.generation, msg.nodes
            self.suspect, self._last_ns = None, now_ns
            self._grace_until_ns = now_ns + HANG_DEADLINE_NS
            return []
        if isinstance(msg, NodeDied):
            return self._suspect(msg.node, "crash", now_ns) if msg.node in self.nodes else []
        if isinstance(msg, Pulses):
            return self._judge(msg, now_ns)
        if isinstance(msg, Rebound):  # Recovery is a new one: it knows nothing yet
            return [Send("wdg2rec", self.suspect)] if self.suspect and msg.bound else []
        raise PeerError(f"{type(msg).__name__} on {port}")

    def _judge(self, pulses: Pulses, now_ns: int) -> list[Effect]:
        if now_ns - self._last_ns > PERIOD_NS + LATE_NS_MAX:
            self._grace_until_ns = now_ns + HANG_DEADLINE_NS
        self._last_ns = now_ns
        if now_ns < self._grace_until_ns:
            return []
        for node in self.nodes:
            if now_ns - pulses.seen_ns.get(node, now_ns) > HANG_DEADLINE_NS:
                return self._suspect(node, "hang", now_ns)
        return []

    def _suspect(self, node: str, cause: str, now_ns: int) -> list[Effect]:
        if self.suspect is not None:
            return []
        self.suspect = Suspect(self.replica, self.generation, node, cause, now_ns)
        return [
            Send("wdg2rec", self.suspect),
            Note(Event.WATCHDOG_SUSPECT, detail=self.generation),
        ]
