"""For whom the hub works, and what it looks after for others: faults that wait for a condition of the car.

A fault of a process can wait for a condition as one of the bus can (`when ttc < 1.2`), and the car, which
alone knows the truth about itself, is asked in the same way: see `hubline`. What follows is done by whoever
asked. In lockstep the car is not answered before that has been done, and so does not take its next step.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from aftbed.core.busfault import Condition, Struck
from aftbed.core.words import number
from aftbed.vehicle.hubclient import Client

if TYPE_CHECKING:
    from aftbed.vehicle.hub import Hub


class Desk(Protocol):
    """The line to it is the life descriptor."""

    def attend(self, hub: "Hub") -> bool:
        """Carry out what is ordered on the line; False at its end."""
        ...

    def report(self, news: list[Struck]) -> None:
        """Something has become of these faults."""
        ...

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """The condition of that fault holds; `since_ns` is 0 where the car waits for `Watches.go_on`."""
        ...


class Watches:
    """Conditions of faults that are none of the bus. `tell_plant` says a line to the car, `answer` its ok."""

    def __init__(
        self,
        tell_plant: Callable[[bytes], None],
        answer: Callable[[Client], None],
        desk: Desk | None,
        *,
        lockstep: bool,
    ) -> None:
        self._tell_plant, self._answer, self._desk, self._lockstep = tell_plant, answer, desk, lockstep
        self._open: dict[int, Condition] = {}
        self._held: dict[int, Client] = {}  # the car, by the fault for which it waits

    def watch(self, fault_number: int, condition: Condition) -> None:
        """From now on."""
        self._open[fault_number] = condition
        self._tell_plant(watch_line(fault_number, condition))

    def lines(self) -> bytes:
        """What a car that has just come has to look at."""
        return b"".join(watch_line(*watched) for watched in self._open.items())

    def met(self, fault_number: int, t_us: int, since_ns: int, car: Client) -> None:
        """The car says that the condition of a fault, ours or one of the bus, holds."""
        if self._open.pop(fault_number, None) is None or self._desk is None:
            self._answer(car)
            return
        if self._lockstep:
            self._held[fault_number] = car
        else:
            self._answer(car)
        self._desk.met(fault_number, t_us, 0 if self._lockstep else since_ns)

    def go_on(self, fault_number: int) -> None:
        """What was to be done is done: answer the car that waits for it."""
        car = self._held.pop(fault_number, None)
        if car is not None:
            self._answer(car)


def watch_line(fault_number: int, condition: Condition) -> bytes:
    """What the car is told to look at."""
    than = "below" if condition.below else "above"
    return f"< watch {fault_number} {condition.quantity} {than} {number(condition.value)} >".encode("ascii")
