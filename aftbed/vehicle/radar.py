"""What the radar measures, before it becomes a frame; and what may come between."""

from collections.abc import Callable
from typing import Final, NamedTuple, Protocol

from aftbed.vehicle.condition import Condition

RANGE_MAX_M: Final = 150.0
SPEED_MAX_MS: Final = 100.0  # of RELATIVE_SPEED
TRACK_ID: Final = 0


class Target(NamedTuple):
    """A target without the radar's noise. `relative_ms` is negative where it closes."""

    range_m: float
    relative_ms: float
    lateral_m: float
    track_id: int = TRACK_ID


class RadarDisturber(Protocol):
    """The faults of one radar. All times are bus time."""

    def step(self, t_us: int, target: Target | None, holds: Callable[[Condition], bool]) -> None:
        """A step of the car begins; `target` is what a faultless radar sees, `holds` asks the car."""
        ...

    def reported(self, t_us: int, target: Target | None) -> Target | None:
        """In each cycle, behind `step`: what the radar reports in place of `target`."""
        ...

    def answered(self) -> None:
        """The brake ECU has accepted a request of the function."""
        ...
