"""Conditions of the car at which a fault begins: of the plant itself, not of what a sensor measures."""

from typing import Final, Literal

import msgspec

from aftbed.core.units import number

QUANTITIES: Final = ("ttc", "gap", "speed")

Quantity = Literal["ttc", "gap", "speed"]  # s, m, m/s


class Condition(msgspec.Struct, frozen=True):
    """A quantity of the car is below, or else above, a value. An unknown quantity is neither."""

    quantity: Quantity
    below: bool
    value: float

    def holds(self, ttc_s: float | None, gap_m: float | None, speed_ms: float) -> bool:
        found = {"ttc": ttc_s, "gap": gap_m, "speed": speed_ms}[self.quantity]
        if found is None:
            return False
        return found < self.value if self.below else found > self.value

    def __str__(self) -> str:
        return f"{self.quantity} {'<' if self.below else '>'} {number(self.value)}"
