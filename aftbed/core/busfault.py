"""Conditions of the car, and the names of a car's bus."""

from typing import Final, Literal

import msgspec

from aftbed.core.units import number

NODES: Final = ("radar", "brake", "gateway")  # that a car's bus has
FALLBACK: Final = "fallback"  # what a brake ECU that misses its requests says that it has noticed
QUANTITIES: Final = ("ttc", "gap", "speed")

Quantity = Literal["ttc", "gap", "speed"]  # s, m, m/s: of the plant itself, not of what a sensor says


class Condition(msgspec.Struct, frozen=True):
    """A quantity of the car is below, or else above, a value. What is not known is neither."""

    quantity: Quantity
    below: bool
    value: float

    def holds(self, ttc_s: float | None, gap_m: float | None, speed_ms: float) -> bool:
        """Whether it is so, in a car with these."""
        found = {"ttc": ttc_s, "gap": gap_m, "speed": speed_ms}[self.quantity]
        if found is None:
            return False
        return found < self.value if self.below else found > self.value

    def __str__(self) -> str:
        return f"{self.quantity} {'<' if self.below else '>'} {number(self.value)}"
