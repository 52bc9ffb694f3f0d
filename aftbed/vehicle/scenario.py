"""Scenarios: a drive and what is to be expected of it, as YAML with units in the keys.

The shipped ones follow Euro NCAP's car-to-car rear tests (CCR: s the car ahead stands, m it moves, b it
brakes). `expect` says what an undisturbed run must come to; the verdict of a run checks it.

    stop          the ego brakes to standstill, without contact
    no_collision  no contact; the ego need not stop
    no_braking    nothing ever asks for braking, and nothing is hit
    impact        contact is allowed, up to `impact_speed_kmh_max`
"""

from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.plant import KMH_PER_MS, Lead, LeadBraking, PlantSetup
from aftbed.vehicle.report import VehicleResult
from aftbed.vehicle.yamlfile import read_yaml

Outcome = Literal["stop", "no_collision", "no_braking", "impact"]

_FOLDER: Final = Path(__file__).resolve().parent / "scenarios"

Speed = Annotated[float, Meta(ge=0, le=200)]
Distance = Annotated[float, Meta(ge=0, le=1000)]
Duration = Annotated[float, Meta(ge=0, le=3600)]
Deceleration = Annotated[float, Meta(ge=0, le=12)]


class Expectation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the drive must come to. The two limits apply whatever the outcome."""

    outcome: Outcome
    impact_speed_kmh_max: Speed = 0.0
    stop_gap_m_min: Distance = 0.0


class Scenario(msgspec.Struct, frozen=True):
    """A drive, ready for `Plant(scenario.plant)`; it ends at `duration_ms` at the latest."""

    name: str
    description: str
    duration_ms: int
    plant: PlantSetup
    expect: Expectation


class _Ego(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    speed_kmh: Speed


class _Braking(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    after_s: Duration
    deceleration_ms2: Deceleration
    ramp_s: Duration = 0.0


class _Lead(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Either `gap_m`, or the time in which the ego would close it: `ttc_s`."""

    speed_kmh: Speed
    gap_m: Distance | None = None
    ttc_s: Annotated[float, Meta(gt=0, le=60)] | None = None
    braking: _Braking | None = None


class _Road(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    friction: Annotated[float, Meta(gt=0, le=1.2)] = 0.9


class _Brakes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    jerk_max_ms3: Annotated[float, Meta(gt=0, le=1000)] | None = None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A scenario file, key by key."""

    description: str
    duration_s: Annotated[float, Meta(gt=0, le=3600)]
    ego: _Ego
    expect: Expectation
    lead: _Lead | None = None
    road: _Road = _Road()
    brakes: _Brakes = _Brakes()


def scenario_names() -> list[str]:
    """The scenarios that are shipped."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_scenario(name_or_path: str) -> Scenario:
    """A shipped scenario by name, or a file by path: whatever has a slash or ends in .yaml or .yml."""
    if "/" in name_or_path or name_or_path.endswith((".yaml", ".yml")):
        path = Path(name_or_path)
    elif name_or_path in scenario_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    else:
        raise unknown("scenario", name_or_path, scenario_names())
    file = read_yaml(path, _File)
    setup = PlantSetup(
        speed_ms=file.ego.speed_kmh / KMH_PER_MS,
        lead=_lead(path, file.lead, file.ego.speed_kmh) if file.lead else None,
        friction=file.road.friction,
        jerk_max_ms3=file.brakes.jerk_max_ms3,
    )
    return Scenario(path.stem, file.description, round(file.duration_s * 1000), setup, file.expect)


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


def _lead(path: Path, lead: _Lead, ego_kmh: float) -> Lead:
    braking = _braking(lead.braking) if lead.braking else None
    return Lead(_gap_m(path, lead, ego_kmh), lead.speed_kmh / KMH_PER_MS, braking)


def _braking(braking: _Braking) -> LeadBraking:
    return LeadBraking(round(braking.after_s * 1000), braking.deceleration_ms2, round(braking.ramp_s * 1000))


def _gap_m(path: Path, lead: _Lead, ego_kmh: float) -> float:
    """The gap as given, or as it follows from `ttc_s`. Zero would be a collision before the start."""
    if (lead.gap_m is None) == (lead.ttc_s is None):
        given = "none of them" if lead.gap_m is None else "both"
        raise ConfigError(f"{path}: lead: found {given}, allowed is one of gap_m, ttc_s")
    if lead.ttc_s is not None:
        closing_kmh = ego_kmh - lead.speed_kmh
        if closing_kmh <= 0.0:
            reason = f"found {lead.ttc_s}, allowed is gap_m, because the gap does not close"
            raise ConfigError(f"{path}: lead.ttc_s: {reason}")
        return lead.ttc_s * closing_kmh / KMH_PER_MS
    assert lead.gap_m is not None
    if lead.gap_m == 0.0:
        raise ConfigError(f"{path}: lead.gap_m: found 0, allowed is more than 0")
    return lead.gap_m
