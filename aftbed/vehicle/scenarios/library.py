"""Scenarios: a drive and what is to be expected of it, as YAML with units in the keys.

The shipped ones follow Euro NCAP's car-to-car rear tests (CCR: s the car ahead stands, m it moves, b it
brakes). Each row of a published table (`tables`) is a scenario too, by the name of its case:
`r152:m1-60`. `expect` is the outcome that an undisturbed run must have; the verdict of a run checks it.

    stop          the ego brakes to standstill, without contact
    no_collision  no contact; the ego need not stop
    no_braking    nothing ever asks for braking, and nothing is hit
    impact        contact is allowed, up to `impact_speed_kmh_max`
"""

from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.scenarios.scenario import Scenario, ScenarioKeys, scenario_of
from aftbed.vehicle.scenarios.tables import SEPARATOR, case_scenario

_FOLDER: Final = Path(__file__).resolve().parent


def scenario_names() -> list[str]:
    """The scenarios that are shipped, without the rows of the tables."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def names_file(name_or_path: str) -> bool:
    """Whether it is the path of a file, not a name."""
    return "/" in name_or_path or name_or_path.endswith((".yaml", ".yml"))


def located_scenario(name_or_path: str, folder: Path) -> str:
    """An absolute path, where it is the path of a file; a relative one is looked up in `folder`.

    Raises ConfigError where there is no such file.
    """
    if not names_file(name_or_path):
        return name_or_path
    path = (folder / name_or_path).resolve()
    if not path.is_file():
        raise ConfigError(f"{name_or_path}: {path}: no such file")
    return str(path)


def load_scenario(name_or_path: str) -> Scenario:
    """A shipped scenario or a row of a table by name, or a file by path.

    A path is whatever has a slash or ends in .yaml or .yml; a row is what has a colon, as in `r152:m1-60`.
    """
    if names_file(name_or_path):
        path = Path(name_or_path)
    elif SEPARATOR in name_or_path:
        return case_scenario(name_or_path)
    elif name_or_path in scenario_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    else:
        raise unknown("scenario", name_or_path, scenario_names())
    from aftbed.core.yaml_file import in_file, read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    keys = read_yaml(path, ScenarioKeys)
    with in_file(path):
        return scenario_of(path.stem, keys)
