"""Which of the function's slots an object of the radar has, where the radar has more objects than slots.

The function has `SLOTS` of them, and remembers in each what it saw there. A radar with 64 tracks, or with
objects that come under numbers of their own, needs an allotment: of the objects in our path the nearest
ones get a slot each. The others cannot be hit before these are. An object keeps its slot while it is seen,
and until another needs it, so a moment in which it is not seen costs it nothing; the one that was not
seen for longest gives way. In a slot that went to another object the target is marked as new.
"""

from collections.abc import Mapping

import msgspec

from aftbed.vehicle.aeb.messages import SLOTS, AebTarget


class SlotBook:
    """The allotment, from cycle to cycle."""

    def __init__(self) -> None:
        self._slots: dict[int, int] = {}  # by object; those not seen for longest come first

    def assign(self, seen: Mapping[int, AebTarget]) -> tuple[AebTarget, ...]:
        """The targets of one cycle, by object, whatever slots they name; the nearest come out, in theirs."""
        nearest = sorted(seen, key=lambda number: (seen[number].range_m, number))[:SLOTS]
        known = [number for number in nearest if number in self._slots]
        for number in known:
            self._slots[number] = self._slots.pop(number)
        found = {self._slots[number]: seen[number] for number in known}
        for number in nearest:
            if number not in known:
                found[self._take(number)] = msgspec.structs.replace(seen[number], new=True)
        return tuple(msgspec.structs.replace(found[slot], slot=slot) for slot in sorted(found))

    def _take(self, number: int) -> int:
        """A slot for a new object: a free one, else that of the object not seen for longest."""
        taken = set(self._slots.values())
        free = next((slot for slot in range(SLOTS) if slot not in taken), None)
        slot = self._slots.pop(next(iter(self._slots))) if free is None else free
        self._slots[number] = slot
        return slot
