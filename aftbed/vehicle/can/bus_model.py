"""The rules of the CAN bus: which frame is next, which nodes receive it, what faults make of it.

Two buses follow them: the hub between processes (`hub`) and the bus of the virtual car (`drive_virtual`).
They differ in where time comes from and in how a frame reaches a node.

*Arbitration.* The bus carries one frame at a time. Each node queues its own frames in order; among the first
frames of the nodes the lowest identifier wins, as on the wire. With a `bitrate_bps` a frame takes its time
on the wire (worst-case bit stuffing, so an upper bound) and is delivered when its transmission ends; without
one it takes none.

*Delivery.* A frame goes to all receivers but its sender.

*Faults* act on a frame in the moment in which it has the bus to itself (`BusDisturber`). A node that a fault
cuts off from the sender does not receive the frame. The bus notes for each fault which node has evaluated a
frame that it changed. In lockstep the time master has to know how many replies to wait for, so a bus counts,
by identifier, how many more or fewer nodes receive a frame than would without faults (`receipts_changed`).

*Conditions.* A fault, of the bus or another one (`watch`), can wait for a condition of the car. Only the car
knows whether it holds: it is asked for `conditions`, and reports the first moment in which one does (`met`).
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.condition import Condition

HOST: Final = "127.0.0.1"
CHANNEL: Final = "can0"
NODES: Final = ("radar", "brake", "gateway")  # of a car's bus
FALLBACK: Final = "fallback"  # reported by the brake ECU when its requests are missing
GOOD_AGAIN: Final = "good_again"  # reported by a node that uses these frames again


class Notice(NamedTuple):
    """What a node has found wrong with the frames of `can_id`, or that they are `GOOD_AGAIN`; in bus time."""

    can_id: int
    word: str
    t_us: int


class CarriedFrame(msgspec.Struct, frozen=True):
    """A frame that the bus carries for the node named `sender`; `by` are the faults that changed it."""

    frame: Frame
    sender: str
    by: tuple[int, ...] = ()


class BusDisturber(Protocol):
    """The faults of one bus, each with its number. All times are bus time."""

    def carry(self, frame: Frame, sender: str) -> Sequence[CarriedFrame]:
        """What the bus carries now, because `sender` has sent `frame`."""
        ...

    def release(self, now_us: int) -> Sequence[CarriedFrame]:
        """What the bus carries now without a frame being sent now: held back before, or a flood."""
        ...

    def due_us(self) -> int | None:
        """When to call `release` next."""
        ...

    def cut_off(self, sender: str, node: str, now_us: int) -> bool:
        """Whether `node` receives nothing from `sender` now."""
        ...

    def reached(self, by: tuple[int, ...], node: str, t_us: int) -> None:
        """A frame that these faults have changed has come to `node`, which evaluates it."""
        ...

    def noticed(self, node: str, notice: Notice) -> None:
        """`node` reports what is wrong with frames, or that it uses them again."""
        ...

    def conditions(self) -> Sequence[tuple[int, Condition]]:
        """Those that faults still wait for, by the number of the fault."""
        ...

    def met(self, number: int, now_us: int) -> None:
        """The condition of that fault holds."""
        ...

    @property
    def idle(self) -> bool:
        """Whether no fault can act any more."""
        ...


class BusNode:
    """A node of the bus. `uses` are the identifiers of the frames that it evaluates."""

    __slots__ = ("carried", "frames", "name", "uses")

    def __init__(self, name: str, uses: frozenset[int] = frozenset()) -> None:
        self.name = name
        self.uses = uses
        self.frames: deque[Frame] = deque()  # not sent yet; `t_us` is when the node asked for the bus
        self.carried = 0  # frames of this node that have been over the wire


def frame_bits(data_bytes: int) -> int:
    """Bits of a data frame with an 11-bit identifier on the wire, stuffing at its worst.

    34 bits and the data are open to stuffing, at most one bit in four (Davis et al. 2007); the
    13 bits of delimiters, acknowledgement, end of frame and intermission are not.
    """
    return unstuffed_bits(data_bytes) + (34 + 8 * data_bytes - 1) // 4


def unstuffed_bits(data_bytes: int) -> int:
    """The same without stuff bits (ISO 11898-1)."""
    return 34 + 8 * data_bytes + 13


Node = TypeVar("Node", bound=BusNode)


class BusModel(ABC, Generic[Node]):
    """One bus. A subclass says how a frame reaches a node, and acts on what the rules report."""

    def __init__(self, bitrate_bps: int | None = None) -> None:
        self._receivers: tuple[Node, ...] = ()
        self._others: dict[Node, tuple[Node, ...]] = {}  # the receivers but one, by that one
        self.disturber: BusDisturber | None = None  # from the first fault on
        self.disturbed = False  # a fault can still act; if not, a frame costs no more than without faults
        self.watched: dict[int, Condition] = {}
        self._announced: set[int] = set()
        self._bitrate_bps = bitrate_bps
        self._senders: list[Node] = []  # nodes with frames waiting; outlives their connection
        self._wire: tuple[Node, Frame] | None = None  # in transmission, until its `t_us`
        self._wire_free_us = 0

    # -- what a subclass supplies ---------------------------------------------------------------

    @abstractmethod
    def deliver(self, frame: Frame, sender: str, receivers: Sequence[Node]) -> None:
        """Hand `frame` to these nodes, and record it."""

    def dequeued(self, node: Node) -> None:
        """A frame of `node` has left its queue."""

    def receipts_changed(self, can_id: int, change: int) -> None:
        """That many more or fewer nodes are about to receive a frame that they use, because of a fault."""

    def condition_added(self, number: int, condition: Condition) -> None:
        """From now on the car has to check this condition."""

    def faults_acted(self) -> None:
        """What became of the faults may have changed."""

    # -- receivers ------------------------------------------------------------------------------

    def add_receiver(self, node: Node) -> None:
        self._receivers, self._others = (*self._receivers, node), {}

    def remove_receiver(self, node: Node) -> None:
        self._receivers, self._others = tuple(one for one in self._receivers if one is not node), {}

    # -- the wire -------------------------------------------------------------------------------

    def send(self, node: Node, frame: Frame) -> None:
        """Queue a frame of `node`; it is carried by `carry`."""
        node.frames.append(frame)
        if len(node.frames) == 1:
            self._senders.append(node)

    def carry(self, until_us: int | None = None) -> None:
        """Let frames over the wire in arbitration order: those that are over by then, or all."""
        while True:
            if self._wire is not None:
                sender, frame = self._wire
                if until_us is not None and frame.t_us > until_us:
                    return
                self._wire = None
                sender.carried += 1
                self.transmit(sender, frame)
            if not self._senders:
                return
            winner = min(self._senders, key=lambda node: node.frames[0].can_id)
            self._wire = (winner, self._timed(winner.frames.popleft()))
            if not winner.frames:
                self._senders.remove(winner)
            self.dequeued(winner)

    def wire_due_us(self) -> int | None:
        """When the transmission on the wire ends."""
        return self._wire[1].t_us if self._wire is not None else None

    def _timed(self, frame: Frame) -> Frame:
        """`frame` with the time at which its transmission ends, beginning when the wire is free."""
        self._wire_free_us = max(self._wire_free_us, frame.t_us)
        if self._bitrate_bps is not None:
            self._wire_free_us += -(-frame_bits(len(frame.data)) * 1_000_000 // self._bitrate_bps)
        if self._wire_free_us == frame.t_us:
            return frame
        return Frame(self._wire_free_us, frame.can_id, frame.data)

    # -- delivery -------------------------------------------------------------------------------

    def transmit(self, sender: Node, frame: Frame) -> None:
        """The transmission of `frame` has ended: deliver it, or what faults make of it."""
        if not self.disturbed:
            others = self._others.get(sender)
            if others is None:
                others = self._others[sender] = tuple(n for n in self._receivers if n is not sender)
            self.deliver(frame, sender.name, others)
            return
        assert self.disturber is not None
        expected = sum(node is not sender and frame.can_id in node.uses for node in self._receivers)
        carried = self.disturber.carry(frame, sender.name)
        self._deliver_all(self.disturber, carried, {frame.can_id: -expected})

    def release(self, now_us: int) -> None:
        """Deliver what faults have held back until now, or send by themselves."""
        if self.disturbed:
            assert self.disturber is not None
            self._deliver_all(self.disturber, self.disturber.release(now_us), {})

    def _deliver_all(
        self, disturber: BusDisturber, carried: Sequence[CarriedFrame], changes: dict[int, int]
    ) -> None:
        """Deliver these frames. `changes`: by how many the receipts of an identifier have changed so far."""
        deliveries = []
        for one in carried:
            frame, sender = one.frame, one.sender
            receivers = [
                node
                for node in self._receivers
                if node.name != sender and not disturber.cut_off(sender, node.name, frame.t_us)
            ]
            users = [node for node in receivers if frame.can_id in node.uses]
            for user in users:
                disturber.reached(one.by, user.name, frame.t_us)
            changes[frame.can_id] = changes.get(frame.can_id, 0) + len(users)
            deliveries.append((frame, sender, receivers))
        for can_id, change in changes.items():
            if change:
                self.receipts_changed(can_id, change)
        for delivery in deliveries:
            self.deliver(*delivery)
        self._update_faults(disturber)

    def advance(self, now_us: int) -> None:
        """Bring a bus that runs by the clock to now: carry what was sent, then what faults release.

        A frame is struck by the time at which it was sent, so no fault may end before it is carried.
        """
        self.carry(now_us)
        self.release(now_us)

    # -- faults and conditions ------------------------------------------------------------------

    def disturb(self, disturber: BusDisturber) -> None:
        """A fault was armed or ended in `disturber`, which is the same for the whole run."""
        self.disturber, self.disturbed = disturber, True
        for number, condition in disturber.conditions():
            if number not in self._announced:
                self._announced.add(number)
                self.condition_added(number, condition)

    def noticed(self, node: str, notice: Notice) -> None:
        """`node` reports what is wrong with frames, or that it uses them again."""
        if self.disturber is not None:
            self.disturber.noticed(node, notice)
            self._update_faults(self.disturber)

    def _update_faults(self, disturber: BusDisturber) -> None:
        self.faults_acted()
        self.disturbed = not disturber.idle

    def watch(self, number: int, condition: Condition) -> None:
        """Have the car check the condition of a fault that is not of the bus."""
        self.watched[number] = condition
        self.condition_added(number, condition)

    def conditions(self) -> list[tuple[int, Condition]]:
        """All conditions that the car has to check, by the number of the fault."""
        own = self.disturber.conditions() if self.disturbed and self.disturber is not None else ()
        return [*own, *self.watched.items()]

    def met(self, number: int, now_us: int) -> bool:
        """The car reports that a condition holds. True if `watch` had asked for it."""
        if self.disturbed and self.disturber is not None:
            self.disturber.met(number, now_us)
            self.release(now_us)
        return self.watched.pop(number, None) is not None
