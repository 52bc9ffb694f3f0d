"""Faults of the bus in the hub: who hears a disturbed frame, and what is said about it beside the bus.

A client that says its name (`< aftbed node radar 100 >`, with the identifiers that it makes something of) can
be cut off, and is believed when it says what it has noticed. One that does not is a tool: it hears and is
heard by all.

In lockstep, time stands still until the protected function has answered what it was asked. A fault makes that
a matter of the bus: a RADAR_TRACK that did not come is not answered, one that comes twice may be answered
twice. So the time master is told, before anybody hears the frame, how many more or fewer get it of those who
use it:

    < change 130 -1 >        nobody got it
    < change 100 +1 >        it comes now, held back before, or a second time

A gateway that makes no request of a frame of which one is expected says so (`< aftbed unasked 130 >`), and
that is passed on in the same way.
"""

from collections.abc import Callable, Sequence

import msgspec

from aftbed.core.busfault import BusFault, Struck
from aftbed.vehicle.disturbance import Disturber, Sent
from aftbed.vehicle.frame import Frame
from aftbed.vehicle.hubclient import Client
from aftbed.vehicle.hubdesk import watch_line


class Delivery(msgspec.Struct, frozen=True):
    """A frame, and who hears it."""

    frame: Frame
    hearers: list[Client]


class HubFaults:
    """All faults of a hub. `tell_master` and `tell_plant` say a line to who sets the time, and to the car."""

    def __init__(self, tell_master: Callable[[bytes], None], tell_plant: Callable[[bytes], None]) -> None:
        self._tell_master, self._tell_plant = tell_master, tell_plant
        self._disturber = Disturber()
        self._said: dict[int, str] = {}  # the receipts that were reported

    def arm(self, fault_number: int, fault: BusFault, draw: int, now_us: int) -> None:
        """From now on."""
        self._disturber.arm(fault_number, fault, draw, now_us)
        for waiting, condition in self._disturber.conditions():
            if waiting == fault_number:
                self._tell_plant(watch_line(waiting, condition))

    def forget(self, fault_number: int, now_us: int) -> None:
        """No longer; what it holds back is due."""
        self._disturber.forget(fault_number, now_us)

    def watches(self) -> bytes:
        """What a car that has just come has to look at."""
        return b"".join(watch_line(waiting, condition) for waiting, condition in self._disturber.conditions())

    def met(self, fault_number: int, now_us: int) -> None:
        """The car says that the condition holds."""
        self._disturber.met(fault_number, now_us)

    def noticed(self, node: str, can_id: int, word: str) -> None:
        """A node says that something is wrong with these frames."""
        self._disturber.noticed(node, can_id, word)

    def unasked(self, can_id: int) -> None:
        """The gateway makes no request of a frame."""
        self._tell_master(_change(can_id, -1))

    @property
    def idle(self) -> bool:
        """Whether the bus is as if there had never been a fault."""
        return self._disturber.idle

    def due_us(self) -> int | None:
        """When to call `release` next."""
        return self._disturber.due_us()

    def struck(self) -> list[Struck]:
        """What has become of each."""
        return self._disturber.struck()

    def news(self) -> list[Struck]:
        """Those whose receipt is another one than when this was last asked."""
        found = [s for s in self._disturber.struck() if self._said.get(s.number, "armed") != s.receipt]
        self._said |= {s.number: s.receipt for s in found}
        return found

    # -- frames -------------------------------------------------------------------------------

    def carry(self, frame: Frame, sender: Client, hearers: Sequence[Client]) -> list[Delivery]:
        """What comes of a frame that `sender` has sent, and who hears it."""
        sent = self._disturber.carry(frame, sender.name)
        expected = sum(c is not sender and frame.can_id in c.uses for c in hearers)
        return self._deliveries(sent, frame.t_us, hearers, {frame.can_id: -expected})

    def release(self, now_us: int, hearers: Sequence[Client]) -> list[Delivery]:
        """What comes by itself now."""
        return self._deliveries(self._disturber.release(now_us), now_us, hearers, {})

    def _deliveries(
        self, sent: list[Sent], now_us: int, hearers: Sequence[Client], changes: dict[int, int]
    ) -> list[Delivery]:
        found = []
        for one in sent:
            heard = [c for c in hearers if c.name != one.sender and not self._deaf(one.sender, c, now_us)]
            users = [c for c in heard if one.frame.can_id in c.uses]
            for user in users:
                self._disturber.reached(one.by, user.name)
            changes[one.frame.can_id] = changes.get(one.frame.can_id, 0) + len(users)
            found.append(Delivery(one.frame, heard))
        for can_id, change in changes.items():
            if change:
                self._tell_master(_change(can_id, change))
        return found

    def _deaf(self, sender: str, hearer: Client, now_us: int) -> bool:
        return self._disturber.deaf(sender, hearer.name, now_us)


def _change(can_id: int, change: int) -> bytes:
    return f"< change {can_id:03X} {change:+d} >".encode("ascii")
