"""What a time means on the road: how far the car travels in it, and what is left of its speed at contact.

The paper tells the first (Section IV: at 50 km/h). The second is what matters: a car that would have come
to a stop just short of the obstacle begins to brake by that time later, so the distance v0 tau is missing
at the end of its way. With a constant deceleration a, what it has left at contact is

    v = sqrt(2 a v0 tau),    at most v0

This is the worst instant there is: a delay that is over before the last moment to brake costs nothing, and
one that comes later meets a car that is slower already.

Limits: the deceleration is there at once and to the full (no dead time, lag or jerk of the actuators,
which cost the same with and without the delay), and the brakes do not work during the delay.
"""

from typing import Final

import msgspec

from aftbed.search.road_table import speed_left_ms
from aftbed.vehicle.plant import GRAVITY_MS2, KMH_PER_MS

SPEED_KMH: Final = 50.0
FRICTION: Final = 0.9  # nominal peak braking coefficient of UN R152
DECELERATION_MS2: Final = FRICTION * GRAVITY_MS2


class OnRoad(msgspec.Struct, frozen=True):
    """A time, in metres travelled and in km/h left at contact where it comes at the worst instant."""

    ms: float
    metres: float
    worst_kmh: float


def metres(speed_kmh: float, delay_ms: float) -> float:
    """How far the car travels in that time."""
    return speed_kmh / KMH_PER_MS * delay_ms / 1e3


def residual_kmh(speed_kmh: float, delay_ms: float, deceleration_ms2: float = DECELERATION_MS2) -> float:
    """The speed at contact of a car that brakes so much too late, and in time would just have stopped."""
    assert speed_kmh >= 0 and delay_ms >= 0 and deceleration_ms2 > 0
    taken_m = metres(speed_kmh, delay_ms)
    left_kmh = speed_left_ms(speed_kmh / KMH_PER_MS, taken_m, deceleration_ms2) * KMH_PER_MS
    return min(speed_kmh, left_kmh)  # to the last bit: 3.6 there and back may be more


def on_road(delay_ms: float, speed_kmh: float = SPEED_KMH) -> OnRoad:
    """Both, rounded to a tenth of a millimetre and a hundredth of a km/h."""
    return OnRoad(
        delay_ms, round(metres(speed_kmh, delay_ms), 4), round(residual_kmh(speed_kmh, delay_ms), 2)
    )
