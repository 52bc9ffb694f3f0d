"""The keys of a scenario file, with units in their names and ranges in their types, and the `Scenario`.

The same keys describe a user's file, a shipped scenario, and the rows of a published table (`tables`).
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import FileKeyError
from aftbed.core.requirements import check_requirements
from aftbed.vehicle.plant import (
    DEAD_TIME_MS,
    KMH_PER_MS,
    LAG_MS,
    Brakes,
    CutIn,
    Driver,
    LeadBraking,
    LeadCar,
    LeadSpeed,
    PlantSetup,
    VehicleResult,
)

Outcome = Literal["stop", "no_collision", "no_braking", "impact"]

Speed = Annotated[float, Meta(ge=0, le=200)]
Distance = Annotated[float, Meta(ge=0, le=1000)]
Duration = Annotated[float, Meta(ge=0, le=3600)]
Deceleration = Annotated[float, Meta(ge=0, le=12)]
Lag = Annotated[float, Meta(ge=0, le=2)]


class Expectation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the drive must come to. The two limits apply whatever the outcome."""

    outcome: Outcome  # stop, no_collision, no_braking, or impact
    impact_speed_kmh_max: Speed = 0.0  # for impact
    stop_gap_m_min: Distance = 0.0  # if it stops, how far from the car ahead at least


class SlowEnd(msgspec.Struct, frozen=True):
    """A drive is over `after_ms` after the ego has become slower than one of the two, m/s."""

    after_ms: int
    below_ms: float | None = None
    below_lead_ms: float | None = None  # this much less than the car ahead


class Scenario(msgspec.Struct, frozen=True):
    """A drive, ready for `Plant(scenario.plant)`; it ends at `duration_ms` at the latest."""

    name: str
    description: str
    duration_ms: int
    plant: PlantSetup
    expect: Expectation
    verifies: tuple[str, ...] = ()  # requirements
    slow_end: SlowEnd | None = None


class EgoKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    speed_kmh: Speed  # at the start


class BrakingKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Euro NCAP gives the car ahead one second to reach its deceleration."""

    after_s: Duration  # when it begins to brake
    deceleration_ms2: Deceleration  # how hard
    ramp_s: Duration = 1.0  # the time in which it gets there
    to_kmh: Speed = 0.0  # the speed at which it brakes no more


class LeadSpeedKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    after_s: Duration  # when it begins
    to_kmh: Speed  # the speed to which it goes, up or down
    rate_ms2: Annotated[float, Meta(gt=0, le=12)]  # how fast


class CutInKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    after_s: Duration  # when it begins to come to the middle of our lane
    over_s: Annotated[float, Meta(gt=0, le=60)]  # how long that takes


class LeadKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Either `gap_m`, or the time in which the ego would close it: `ttc_s`."""

    speed_kmh: Speed  # at the start
    gap_m: Distance | None = None  # at the start; this or ttc_s
    ttc_s: Annotated[float, Meta(gt=0, le=60)] | None = None  # the gap as time to contact
    braking: BrakingKeys | None = None  # how it brakes
    speeds: tuple[LeadSpeedKeys, ...] = ()  # changes of its speed, in their order, instead of braking
    lateral_m: Annotated[float, Meta(ge=-10, le=10)] = 0.0  # to the left of the middle of our lane
    cut_in: CutInKeys | None = None  # how it comes into our lane; needs lateral_m


class RoadKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    friction: Annotated[float, Meta(gt=0, le=1.2)] = 0.9  # of the tyres: 0.9 dry, 0.6 wet, 0.3 snow


class BrakesKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    dead_time_s: Lag = DEAD_TIME_MS / 1000  # how long the brakes do nothing
    lag_s: Lag = LAG_MS / 1000  # the lag with which they follow then
    jerk_max_ms3: Annotated[float, Meta(gt=0, le=1000)] | None = None  # how fast they build up
    deceleration_max_ms2: Annotated[float, Meta(gt=0, le=12)] | None = None  # what they can give


class DriverKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    reaction_s: Annotated[float, Meta(ge=0, le=10)]  # how long after the warning the driver brakes
    deceleration_ms2: Deceleration  # how hard


class EndsKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """As in Euro NCAP's tests, which are over when the car has become slower than the one ahead."""

    below_kmh: Speed | None = None  # the car is slower than this
    below_lead_kmh: Speed | None = None  # the car is this much slower than the one ahead
    after_s: Duration = 1.0  # so long after that


class ScenarioKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    description: str  # for people
    duration_s: Annotated[float, Meta(gt=0, le=3600)]  # the longest that the drive may take
    ego: EgoKeys  # the car with the function
    expect: Expectation  # what the drive must come to
    lead: LeadKeys | None = None  # the car ahead; none: the road is empty
    road: RoadKeys = RoadKeys()  # what the tyres stand on
    brakes: BrakesKeys = BrakesKeys()  # how they follow what is asked of them
    driver: DriverKeys | None = None  # who brakes at the warning; none: never
    ends: EndsKeys | None = None  # when the drive is over, before duration_s
    verifies: tuple[str, ...] = ()  # requirements that a drive of it verifies, as [SG-1]


def scenario_of(name: str, keys: ScenarioKeys) -> Scenario:
    """The scenario that `keys` describe. Raises FileKeyError."""
    brakes, driver = keys.brakes, keys.driver
    setup = PlantSetup(
        speed_ms=keys.ego.speed_kmh / KMH_PER_MS,
        lead=_lead(keys.lead, keys.ego.speed_kmh) if keys.lead else None,
        friction=keys.road.friction,
        brakes=Brakes(
            _ms(brakes.dead_time_s), _ms(brakes.lag_s), brakes.jerk_max_ms3, brakes.deceleration_max_ms2
        ),
        driver=Driver(_ms(driver.reaction_s), driver.deceleration_ms2) if driver else None,
    )
    check_requirements("verifies", keys.verifies)
    ends = _slow_end(keys) if keys.ends else None
    return Scenario(name, keys.description, _ms(keys.duration_s), setup, keys.expect, keys.verifies, ends)


def _ms(duration_s: float) -> int:
    return round(duration_s * 1000)


def _lead(keys: LeadKeys, ego_kmh: float) -> LeadCar:
    if (keys.gap_m is None) == (keys.ttc_s is None):
        given = "none of them" if keys.gap_m is None else "both"
        raise FileKeyError("lead", f"found {given}, allowed is one of gap_m, ttc_s")
    if keys.ttc_s is not None:
        closing_kmh = ego_kmh - keys.speed_kmh
        if closing_kmh <= 0.0:
            reason = f"found {keys.ttc_s}, allowed is gap_m, because the gap does not close"
            raise FileKeyError("lead.ttc_s", reason)
        gap_m = keys.ttc_s * closing_kmh / KMH_PER_MS
    else:
        assert keys.gap_m is not None
        gap_m = keys.gap_m
        if gap_m == 0.0:  # a collision before the start
            raise FileKeyError("lead.gap_m", "found 0, allowed is more than 0")
    braking, cut_in = keys.braking, keys.cut_in
    if braking and keys.speeds:
        raise FileKeyError("lead", "found both, allowed is one of braking, speeds")
    times_s = [change.after_s for change in keys.speeds]
    if times_s != sorted(set(times_s)):
        raise FileKeyError("lead.speeds", f"found {times_s}, allowed is one after the other")
    if cut_in and keys.lateral_m == 0.0:
        raise FileKeyError("lead.cut_in", "found without lateral_m, allowed is a car beside our lane")
    return LeadCar(
        gap_m=gap_m,
        speed_ms=keys.speed_kmh / KMH_PER_MS,
        braking=_braking(braking, keys.speed_kmh) if braking else None,
        lateral_m=keys.lateral_m,
        cut_in=CutIn(_ms(cut_in.after_s), max(1, _ms(cut_in.over_s))) if cut_in else None,
        speeds=tuple(
            LeadSpeed(_ms(one.after_s), one.to_kmh / KMH_PER_MS, one.rate_ms2) for one in keys.speeds
        ),
    )


def _slow_end(keys: ScenarioKeys) -> SlowEnd:
    ends = keys.ends
    assert ends is not None
    if ends.below_kmh is None and ends.below_lead_kmh is None:
        raise FileKeyError("ends", "found none of them, allowed is below_kmh, below_lead_kmh or both")
    if ends.below_kmh is not None and ends.below_kmh > keys.ego.speed_kmh:
        allowed = f"allowed is at most ego.speed_kmh, {keys.ego.speed_kmh:g}"
        raise FileKeyError("ends.below_kmh", f"found {ends.below_kmh:g}, {allowed}")
    if ends.below_lead_kmh is not None and keys.lead is None:
        raise FileKeyError("ends.below_lead_kmh", "found without lead, allowed is below_kmh")
    below_ms, below_lead_ms = (
        None if kmh is None else kmh / KMH_PER_MS for kmh in (ends.below_kmh, ends.below_lead_kmh)
    )
    return SlowEnd(_ms(ends.after_s), below_ms, below_lead_ms)


def _braking(keys: BrakingKeys, lead_kmh: float) -> LeadBraking:
    if keys.to_kmh > 0.0 and keys.to_kmh >= lead_kmh:
        allowed = f"allowed is less than lead.speed_kmh, {lead_kmh:g}"
        raise FileKeyError("lead.braking.to_kmh", f"found {keys.to_kmh:g}, {allowed}")
    ramp_ms, final_ms = _ms(keys.ramp_s), keys.to_kmh / KMH_PER_MS
    return LeadBraking(_ms(keys.after_s), keys.deceleration_ms2, ramp_ms, final_ms)


def broken_expectations(scenario: Scenario, result: VehicleResult) -> list[str]:
    """Every way in which `result` is not what the scenario expects, or []."""
    expect = scenario.expect
    found = []
    if result.collision:
        impact_kmh = result.impact_speed_kmh or 0.0
        if expect.outcome != "impact":
            found.append(f"collision at {impact_kmh:.1f} km/h, expected {expect.outcome}")
        elif impact_kmh > expect.impact_speed_kmh_max:
            found.append(f"impact at {impact_kmh:.1f} km/h, allowed are {expect.impact_speed_kmh_max:.1f}")
    elif expect.outcome == "stop" and result.stop_gap_m is None:
        found.append("the car did not stop, expected stop")
    if expect.outcome == "no_braking" and result.braked:
        found.append("the car braked, expected no_braking")
    if result.stop_gap_m is not None and result.stop_gap_m < expect.stop_gap_m_min:
        found.append(f"stopped at {result.stop_gap_m:.2f} m, at least {expect.stop_gap_m_min:.2f} m expected")
    return found
