"""Published tables of what an emergency brake must do, row by row, as data: `cases/*.yaml`.

A table has groups (one target, one state of the car), a group has rows: a speed, and the greatest speed
at impact with which the row is passed. Each group names the source of its numbers, and marks those
that are not from the text of a regulation or a protocol. A row is a scenario like any other:
`load_scenario("r152:m1-60")`, and so every `--scenario`.

    r152      UN Regulation No. 152: the speed is the relative one
    ncap      Euro NCAP, car-to-car rear: the speed is the ego's
    negative  nothing is due, and nothing may be asked of the brakes

What a table asks for beside the impact is in the case: how long the warning has to come before emergency
braking, and how much or how little may be asked of the brakes.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.scenario import (
    BrakesKeys,
    Deceleration,
    DriverKeys,
    Duration,
    EgoKeys,
    Expectation,
    LeadKeys,
    RoadKeys,
    Scenario,
    ScenarioKeys,
    Speed,
    scenario_of,
)

SEPARATOR: Final = ":"  # between table and row, in the name of a case
COLOURS: Final = ((5.0, "green"), (15.0, "yellow"), (30.0, "orange"), (40.0, "brown"))  # below, in km/h
WORST_COLOUR: Final = "red"
NEAR_NAMES: Final = 8

_FOLDER: Final = Path(__file__).resolve().parent / "cases"


class Case(msgspec.Struct, frozen=True):
    """One row of a table. What is None is not asked for."""

    name: str  # the scenario's too
    table: str
    group: str
    speed_kmh: float  # of the row: the relative speed in r152, else the ego's
    limit_kmh: float  # greatest relative speed at contact with which the row is passed; 0 is no contact
    warning_s_min: float | None  # the warning comes at least so long before emergency braking
    demand_ms2_min: float | None  # what emergency braking asks for at least
    source: str
    demand_ms2_max: float | None = None  # no more than this may be asked of the brakes


class _Group(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Rows of one kind. The rows are pairs: speed, limit. `speed`: which speed the first one is."""

    description: str
    source: str
    duration_s: Annotated[float, Meta(gt=0, le=3600)]
    rows: Annotated[tuple[tuple[Speed, Speed], ...], Meta(min_length=1)]
    speed: Literal["ego", "relative"] = "ego"
    lead: LeadKeys | None = None
    road: RoadKeys = RoadKeys()
    brakes: BrakesKeys = BrakesKeys()
    driver: DriverKeys | None = None
    warning_s_min: Duration | None = None
    demand_ms2_min: Deceleration | None = None
    demand_ms2_max: Deceleration | None = None


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    title: str
    groups: dict[str, _Group]


def table_names() -> list[str]:
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def group_names(table: str) -> list[str]:
    """The groups of a table, in its order. Raises ConfigError if there is no such table."""
    return list(_table(table).groups)


def title(table: str) -> str:
    """What a table is, in a line. Raises ConfigError if there is no such table."""
    return _table(table).title


def cases(table: str, group: str | None = None) -> tuple[Case, ...]:
    """The rows of a table, or of one group of it. Raises ConfigError on a name that does not exist."""
    groups = _table(table).groups
    if group is not None and group not in groups:
        raise unknown(f"group of table {table}", group, groups)
    return tuple(
        Case(
            name=f"{table}{SEPARATOR}{name}-{speed_kmh:g}",
            table=table,
            group=name,
            speed_kmh=speed_kmh,
            limit_kmh=limit_kmh,
            warning_s_min=held.warning_s_min,
            demand_ms2_min=held.demand_ms2_min,
            source=held.source,
            demand_ms2_max=held.demand_ms2_max,
        )
        for name, held in groups.items()
        if group in (None, name)
        for speed_kmh, limit_kmh in held.rows
    )


def case_scenario(name: str) -> Scenario:
    """The drive of the case of this name. Raises ConfigError, with names that are near, if there is none."""
    table = name.partition(SEPARATOR)[0]
    for case in cases(table):
        if case.name == name:
            return _scenario(case, _table(table).groups[case.group])
    import difflib  # noqa: PLC0415 - for a mistake only

    names = [case.name for case in cases(table)]
    near = difflib.get_close_matches(name, names, n=NEAR_NAMES, cutoff=0.0)
    raise ConfigError(
        f"unknown case {name!r} (of {len(names)} in table {table}, the nearest: {', '.join(near)})"
    )


def broken(case: Case, result: VehicleResult) -> list[str]:
    """Every way in which a drive fails its row, or []."""
    found = []
    impact_kmh = (result.impact_speed_kmh or 0.0) if result.collision else 0.0
    if result.collision and (impact_kmh > case.limit_kmh or case.limit_kmh == 0.0):
        allowed = f"at most {case.limit_kmh:g}" if case.limit_kmh else "none"
        found.append(f"impact at {impact_kmh:.1f} km/h, allowed is {allowed}")
    demand_ms2 = result.demand_max_ms2
    if case.demand_ms2_min is not None and demand_ms2 < case.demand_ms2_min:
        found.append(f"asked for {demand_ms2:.1f} m/s2, at least {case.demand_ms2_min:g} are due")
    if case.demand_ms2_max is not None and demand_ms2 > case.demand_ms2_max:
        found.append(f"asked for {demand_ms2:.1f} m/s2, allowed is at most {case.demand_ms2_max:g}")
    warning_s = result.warning_s
    if case.warning_s_min is not None and warning_s is not None and warning_s < case.warning_s_min:
        found.append(f"warned {warning_s:.2f} s before braking, at least {case.warning_s_min:g} s are due")
    return found


def colour(impact_kmh: float) -> str:
    """The colour in which Euro NCAP prints a speed at impact."""
    return next((name for below_kmh, name in COLOURS if impact_kmh < below_kmh), WORST_COLOUR)


@lru_cache(maxsize=8)
def _table(name: str) -> _Table:
    if name not in table_names():
        raise unknown("table", name, table_names())
    from aftbed.core.yaml_file import read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    return read_yaml(_FOLDER / f"{name}.yaml", _Table)


def _scenario(case: Case, group: _Group) -> Scenario:
    lead_kmh = group.lead.speed_kmh if group.lead is not None else 0.0
    if case.demand_ms2_max == 0.0:
        expect = Expectation("no_braking")
    elif case.limit_kmh == 0.0:
        expect = Expectation("no_collision")
    else:
        expect = Expectation("impact", impact_speed_kmh_max=case.limit_kmh)
    keys = ScenarioKeys(
        description=f"{group.description}, {case.speed_kmh:g} km/h",
        duration_s=group.duration_s,
        ego=EgoKeys(case.speed_kmh + (lead_kmh if group.speed == "relative" else 0.0)),
        expect=expect,
        lead=group.lead,
        road=group.road,
        brakes=group.brakes,
        driver=group.driver,
    )
    return scenario_of(case.name, keys)
