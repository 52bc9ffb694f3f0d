"""What an outage can cost at most, in closed form: the speed at which the car still hits what is ahead.

The paper (Section IV) tells an outage of t in metres: v0 t at the speed v0. An outage that delays the whole
of a braking by t brings the car to every place with the speed that it would have had v0 t metres before.
Where the braking left a gap of d0, and ends with a constant deceleration a, that is an impact at

    v = sqrt(2 a (v0 t - d0))     none where v0 t <= d0, and never more than v0

and, from a drive that ends in an impact at u anyway, v = sqrt(u u + 2 a v0 t). With d0 = 0, the car that
would have just stopped, it is sqrt(2 a v0 t). Here v0 is the speed at which the gap closes before anybody
brakes, and a the greatest deceleration of the drive without the outage.

Where the function goes from nothing to full braking at once, that is what happens. Where it asks for a
part of it before, an outage delays less than the whole, and what is lost is made up for in part: the form
is a bound then. Beside it an outage costs up to `SLACK_MS` more: a reply counts from the next step of the
brakes on.

Limits: a car ahead that brakes has no such v0.
"""

from math import sqrt
from typing import Final

from aftbed.vehicle.plant import KMH_PER_MS, VehicleResult
from aftbed.vehicle.scenarios.scenario import Scenario

SLACK_MS: Final = 2.0


def impact_kmh(result: VehicleResult) -> float:
    """The relative speed at contact; 0 without one."""
    return (result.impact_speed_kmh or 0.0) if result.collision else 0.0


def closing_speed_ms(scenario: Scenario) -> float | None:
    """How fast the gap closes before anybody brakes; None where it does not, or the car ahead brakes."""
    lead = scenario.plant.lead
    if lead is None or lead.braking is not None:
        return None
    closing_ms = scenario.plant.speed_ms - lead.speed_ms
    return closing_ms if closing_ms > 0.0 else None


def residual_kmh(free: VehicleResult, closing_ms: float, outage_ms: float) -> float:
    """The impact to which an outage of the drive `free` can lead at most; 0 is none."""
    already_ms = impact_kmh(free) / KMH_PER_MS
    taken_m = closing_ms * outage_ms / 1000 - left_m(free)
    return speed_left_ms(closing_ms, taken_m, free.max_deceleration_ms2, already_ms) * KMH_PER_MS


def speed_left_ms(speed_ms: float, taken_m: float, deceleration_ms2: float, already_ms: float = 0.0) -> float:
    """What is left of `speed_ms` where `taken_m` of the way to brake on are missing; see above."""
    square = already_ms**2 + 2.0 * deceleration_ms2 * taken_m
    return min(sqrt(square), speed_ms) if square > 0.0 else 0.0


def left_m(free: VehicleResult) -> float:
    """The gap that the braking leaves; 0 where it ends in contact."""
    return 0.0 if free.collision or free.min_gap_m is None else free.min_gap_m
