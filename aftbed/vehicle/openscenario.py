"""OpenSCENARIO XML 1.0 to 1.3 in, scenarios of ours out: one car behind another on a straight road.

The reading is in `xosc`: a tree that knows its lines (`tree`), parameters replaced by their values
(`parameters`, `expression`), places and lengths (`placing`), the road (`road`), triggers (`trigger`), the
storyboard (`storyboard`), a distribution's variations (`variations`), the words that are refused or of no
meaning (`words`). Here the parts meet, in this order:

    1. what is refused for what it is: all of it, with line and reason, in one error
    2. what is read, with its meaning for the drive
    3. what was not read: of no meaning (`ignored`, printed), or refused

Nothing is written before all of it has worked, for every variation, and each scenario has been read
back as `aftbed run` reads it.

What a drive has to come to is not in such a file; the caller says it.

No library does the reading. The one that is well kept, scenariogeneration, is made to write such files:
its objects hold no line numbers, and what they do not know is skipped, the opposite of what is needed
here. A guard against hostile XML (defusedxml) comes down to refusing a DOCTYPE, which expat can do.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.plant import KMH_PER_MS
from aftbed.vehicle.scenarios.scenario import ScenarioKeys, scenario_of
from aftbed.vehicle.xosc.parameters import Values, declared, substituted
from aftbed.vehicle.xosc.placing import read_cars
from aftbed.vehicle.xosc.road import check_road
from aftbed.vehicle.xosc.storyboard import Drive, Reader, Taken
from aftbed.vehicle.xosc.tree import Element, read_tree
from aftbed.vehicle.xosc.variations import check_distribution, variation_name, variations_of
from aftbed.vehicle.xosc.words import CONTROLLERS, Ignored, account, refuse

EXPECTATIONS: Final = ("stop", "no_collision", "no_braking")
VERSIONS: Final = ("1.0", "1.1", "1.2", "1.3")
DESCRIPTION_CHARACTERS_MAX: Final = 200
DURATION_S_MAX: Final = 3600.0
CARS_MAX: Final = 2
_ROOTS: Final = ("OpenSCENARIO", "OpenScenario")


class Wanted(msgspec.Struct, frozen=True):
    """What the file does not say. `ego` None is the car called Ego; `duration_s` None, what the file says."""

    ego: str | None = None
    expect: str = "no_collision"
    duration_s: float | None = None
    replace_controller: bool = False
    seed: int = 0


class Variation(msgspec.Struct, frozen=True):
    """A scenario of ours, as YAML, and the values that were given to the file's parameters for it."""

    name: str
    parameters: Values
    drive: Drive
    text: str


class Imported(msgspec.Struct, frozen=True):
    """What became of a file. `taken` and `ignored` are those of the first variation.

    `sets` counts the sets of values; where a draw gives one of them again, it is the same variation.
    """

    path: str
    version: str
    description: str
    sets: int
    variations: tuple[Variation, ...]
    taken: tuple[Taken, ...]
    ignored: tuple[Ignored, ...]


def import_scenario(path: Path, distribution: Path | None, wanted: Wanted) -> Imported:
    """The scenarios that a file describes. Raises ConfigError naming file, line and element."""
    if wanted.expect not in EXPECTATIONS:
        raise ConfigError(f"--expect: {unknown('outcome', wanted.expect, EXPECTATIONS)}")
    if wanted.duration_s is not None and not 0.0 < wanted.duration_s <= DURATION_S_MAX:
        allowed = f"allowed is more than 0 and at most {DURATION_S_MAX:g}"
        raise ConfigError(f"--duration: found {wanted.duration_s:g}, {allowed}")
    root = read_tree(path)
    version = _check_root(root)
    sets: list[Values] = [{}]
    if distribution is not None:
        sets = _read_distribution(distribution, path, declared(root), wanted.seed)
    found: dict[str, Variation] = {}
    accounts: list[tuple[tuple[Taken, ...], tuple[Ignored, ...]]] = []
    for values in sets:
        name = variation_name(path.stem, values)
        try:
            drive, ignored, description = _read(substituted(root, values), wanted)
            found[name] = _variation(name, values, drive, description, wanted)
        except ConfigError as error:
            raise _of_variation(error, values) from error
        accounts.append((drive.taken, ignored))
    return Imported(str(path), version, description, len(sets), tuple(found.values()), *accounts[0])


def write(imported: Imported, folder: Path, *, force: bool) -> list[Path]:
    """Write every scenario as a file into `folder`. A file that says something else stays, but by force."""
    paths = [folder / f"{variation.name}.yaml" for variation in imported.variations]
    try:
        for path, variation in zip(paths, imported.variations, strict=True):
            if path.exists() and not force and path.read_bytes() != variation.text.encode():
                raise ConfigError(f"{path}: exists, and says something else; --force writes over it")
        folder.mkdir(parents=True, exist_ok=True)
        for path, variation in zip(paths, imported.variations, strict=True):
            path.write_text(variation.text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error
    return paths


def _check_root(root: Element) -> str:
    """The version of OpenSCENARIO."""
    if root.tag not in _ROOTS:
        raise root.error(f"allowed is {_ROOTS[0]}")
    header = root.one("FileHeader")
    version = f"{header.word('revMajor')}.{header.word('revMinor')}"
    if version not in VERSIONS:
        raise header.error(f"OpenSCENARIO {version[:20]}, allowed are {', '.join(VERSIONS)}")
    for child in root.children:
        if child.tag == "ParameterValueDistribution":
            files = [
                one.attributes.get("filepath", "") for one in child.children if one.tag == "ScenarioFile"
            ]
            other = files[0] if files else "FILE.xosc"
            raise child.error(f"a distribution: import {other} with --variations {root.path}")
    return version


def _read_distribution(path: Path, scenario: Path, parameters: list[str], seed: int) -> list[Values]:
    root = read_tree(path)
    check_distribution(root)
    header = root.one("FileHeader")
    for label in ("revMajor", "revMinor"):
        header.word(label)
    found = variations_of(root, scenario.name, parameters, seed)
    account(root)
    return found


def _read(root: Element, wanted: Wanted) -> tuple[Drive, tuple[Ignored, ...], str]:
    header = root.one("FileHeader")
    for label in ("revMajor", "revMinor"):
        header.word(label)
    description = header.word("description", "") or root.path
    ego = _find_ego(root, wanted.ego)
    _set_aside(root, ego, wanted)
    refuse(root)
    cars, entries = read_cars(root)
    if len(cars) > CARS_MAX:
        raise root.one("Entities").error(
            f"{len(cars)} vehicles, allowed are {CARS_MAX}: the ego and one ahead"
        )
    drive = Reader(cars, ego, wanted.duration_s).read(root.one("Storyboard"))
    check_road(root)
    return drive, tuple(one for tree in (root, *entries) for one in account(tree)), description


def _find_ego(root: Element, asked: str | None) -> str:
    things = root.one("Entities").every("ScenarioObject")
    names = [thing.word("name") for thing in things]
    if asked is not None and asked not in names:
        raise ConfigError(f"--ego: {unknown('vehicle', asked, names)}")
    egos = [name for name in names if name == asked or (asked is None and name.lower() == "ego")]
    if len(egos) != 1:
        shown = ", ".join(names) or "none"
        raise root.one("Entities").error(f"which vehicle is the ego? --ego NAME says it (one of: {shown})")
    return egos[0]


def _set_aside(root: Element, ego: str, wanted: Wanted) -> None:
    """Mark what the caller has said to be replaced."""
    for element in root.walk():
        of_ego = ego in (element.attributes.get("entityRef"), element.attributes.get("name"))
        if wanted.replace_controller and of_ego and element.tag in ("Private", "ScenarioObject"):
            for inner in element.walk():
                if inner.tag in CONTROLLERS:
                    inner.ignore("replaced by aftbed's function, as asked for")
        if wanted.duration_s is not None and element.tag == "Storyboard":
            for child in element.children:
                if child.tag == "StopTrigger":
                    child.ignore("the length of the drive was asked for")


def _variation(name: str, values: Values, drive: Drive, description: str, wanted: Wanted) -> Variation:
    keys = _keys(drive, description, wanted.expect)
    try:
        scenario_of(name, name, msgspec.convert(keys, ScenarioKeys))
    except msgspec.ValidationError as error:
        raise ConfigError(f"the scenario would be out of range: {error}") from error
    return Variation(name, values, drive, _yaml(keys))


def _keys(drive: Drive, description: str, expect: str) -> dict[str, object]:
    """The keys of the scenario file, in the order of the page that describes them."""
    printable = "".join(one if one.isprintable() else " " for one in description)
    shown = " ".join(printable.split())[:DESCRIPTION_CHARACTERS_MAX]
    keys: dict[str, object] = {"description": shown, "duration_s": _round(drive.duration_s)}
    keys["ego"] = {"speed_kmh": _round(drive.speed_ms * KMH_PER_MS)}
    if drive.lead is not None:
        lead: dict[str, object] = {"gap_m": _round(drive.lead.gap_m)}
        lead["speed_kmh"] = _round(drive.lead.speed_ms * KMH_PER_MS)
        if drive.lead.braking is not None:
            braking = drive.lead.braking
            lead["braking"] = {
                "after_s": _round(braking.after_s),
                "deceleration_ms2": _round(braking.deceleration_ms2),
                "ramp_s": 0.0,  # a linear SpeedAction has its rate from its first moment on
            }
        keys["lead"] = lead
    keys["road"] = {"friction": drive.friction}
    keys["expect"] = {"outcome": expect}
    return keys


def _round(value: float) -> float:
    """To the micrometre, and no -0."""
    return round(value, 6) + 0.0


def _yaml(keys: Mapping[str, object]) -> str:
    """One key in a line; what JSON says of a text or a number, YAML says too."""
    return "".join(f"{key}: {_flow(value)}\n" for key, value in keys.items())


def _flow(value: object) -> str:
    match value:
        case dict():
            return "{" + ", ".join(f"{key}: {_flow(inner)}" for key, inner in value.items()) + "}"
        case float():
            return f"{value:.6f}".rstrip("0").rstrip(".")
        case _:
            return json.dumps(value, ensure_ascii=False)


def _of_variation(error: ConfigError, values: Values) -> ConfigError:
    if not values:
        return error
    shown = ", ".join(f"{name} = {value}" for name, value in values.items())
    return ConfigError(f"{error}\n  with {shown}")
