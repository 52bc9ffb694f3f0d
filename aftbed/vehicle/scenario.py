"""Scenarios: a drive and what is to be expected of it, as YAML with units in the keys.

The shipped ones follow Euro NCAP's car-to-car rear tests (CCR: s the car ahead stands, m it moves, b it
brakes). Each row of a published table (`tables`) is a scenario too, by the name of its case:
`r152:m1-60`. `expect` says what an undisturbed run must come to; the verdict of a run checks it.

    stop          the ego brakes to standstill, without contact
    no_collision  no contact; the ego need not stop
    no_braking    nothing ever asks for braking, and nothing is hit
    impact        contact is allowed, up to `impact_speed_kmh_max`
"""

from pathlib import Path
from typing import Final

from aftbed.core.errors import unknown
from aftbed.vehicle.report import VehicleResult
from aftbed.vehicle.scenariofile import Expectation, Outcome, Scenario, ScenarioKeys, scenario_of
from aftbed.vehicle.tables import SEPARATOR, case_scenario
from aftbed.vehicle.yamlfile import read_yaml

__all__ = ["Expectation", "Outcome", "Scenario", "broken_expectations", "load_scenario", "scenario_names"]

_FOLDER: Final = Path(__file__).resolve().parent / "scenarios"


def scenario_names() -> list[str]:
    """The scenarios that are shipped, without the rows of the tables."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_scenario(name_or_path: str) -> Scenario:
    """A shipped scenario or a row of a table by name, or a file by path.

    A path is whatever has a slash or ends in .yaml or .yml; a row is what has a colon, as in `r152:m1-60`.
    """
    if "/" in name_or_path or name_or_path.endswith((".yaml", ".yml")):
        path = Path(name_or_path)
    elif SEPARATOR in name_or_path:
        return case_scenario(name_or_path)
    elif name_or_path in scenario_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    else:
        raise unknown("scenario", name_or_path, scenario_names())
    return scenario_of(path.stem, str(path), read_yaml(path, ScenarioKeys))


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
