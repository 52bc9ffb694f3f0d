"""Imports OpenSCENARIO XML 1.0 to 1.3 as scenarios of aftbed: one car behind another on a straight road.

`document` has the tree with line numbers and the account of unused elements, `expression` the parameters,
`placing` the cars and the road, `storyboard` the drive. An import runs in this order:

    1. elements that are refused for their tag: all of them, with line and reason, in one error
    2. elements that are read, with their meaning for the drive
    3. elements that were not read: ignored (printed with the reason), or refused

No file is written before every variation has been converted, and each scenario has been read back in the way
in which `aftbed run` reads it. The file does not contain the expected outcome of the drive; the caller gives
it.

No library reads the files. The well-kept one, scenariogeneration, is made to write them: its objects have no
line numbers, and it skips elements that it does not know; here both matter. The protection of defusedxml
against hostile XML would amount to refusing a DOCTYPE, which expat can do.
"""

import json
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.interop.files import write_text_whole
from aftbed.interop.openscenario.document import (
    CONTROLLERS,
    Element,
    IgnoredElement,
    account,
    read_tree,
    refuse,
)
from aftbed.interop.openscenario.expression import (
    Values,
    declared,
    substituted,
    variation_name,
    variations_of,
)
from aftbed.interop.openscenario.placing import check_road, read_cars
from aftbed.interop.openscenario.storyboard import ImportedDrive, StoryboardReader, UsedElement
from aftbed.vehicle.plant import KMH_PER_MS
from aftbed.vehicle.scenarios.scenario import ScenarioKeys, scenario_of

EXPECTATIONS: Final = ("stop", "no_collision", "no_braking")
VERSIONS: Final = ("1.0", "1.1", "1.2", "1.3")
DESCRIPTION_CHARACTERS_MAX: Final = 200
DURATION_S_MAX: Final = 3600.0
CARS_MAX: Final = 2
_ROOTS: Final = ("OpenSCENARIO", "OpenScenario")


class ImportOptions(msgspec.Struct, frozen=True):
    """What the caller adds to the file. None for `ego`: the car called Ego; for `duration_s`: the file's."""

    ego: str | None = None
    expect: str = "no_collision"
    duration_s: float | None = None
    replace_controller: bool = False
    seed: int = 0


class ScenarioVariation(msgspec.Struct, frozen=True):
    """A scenario of aftbed, as YAML in `text`, and the values of the file's parameters for it."""

    name: str
    parameters: Values
    drive: ImportedDrive
    text: str


class ImportedFile(msgspec.Struct, frozen=True):
    """The result of an import. `taken` and `ignored` are those of the first variation.

    `sets` counts the sets of values. Equal sets, as random draws may give, are one variation.
    """

    path: str
    version: str
    description: str
    sets: int
    variations: tuple[ScenarioVariation, ...]
    taken: tuple[UsedElement, ...]
    ignored: tuple[IgnoredElement, ...]


def import_scenario(path: Path, distribution: Path | None, options: ImportOptions) -> ImportedFile:
    """The scenarios that the file at `path` describes. Raises ConfigError naming file, line and element."""
    if options.expect not in EXPECTATIONS:
        raise ConfigError(f"--expect: {unknown('outcome', options.expect, EXPECTATIONS)}")
    if options.duration_s is not None and not 0.0 < options.duration_s <= DURATION_S_MAX:
        allowed = f"allowed is more than 0 and at most {DURATION_S_MAX:g}"
        raise ConfigError(f"--duration: found {options.duration_s:g}, {allowed}")
    root = read_tree(path)
    version = _check_root(root)
    sets: list[Values] = [{}]
    if distribution is not None:
        sets = _read_distribution(distribution, path, declared(root), options.seed)
    found: dict[str, ScenarioVariation] = {}
    accounts: list[tuple[tuple[UsedElement, ...], tuple[IgnoredElement, ...]]] = []
    for values in sets:
        name = variation_name(path.stem, values)
        try:
            drive, ignored, description = _read(substituted(root, values), options)
            text = _scenario_file(name, drive, description, options.expect)
        except ConfigError as error:
            shown = ", ".join(f"{name} = {value}" for name, value in values.items())
            raise (ConfigError(f"{error}\n  with {shown}") if values else error) from error
        found[name] = ScenarioVariation(name, values, drive, text)
        accounts.append((drive.taken, ignored))
    return ImportedFile(str(path), version, description, len(sets), tuple(found.values()), *accounts[0])


def write(imported: ImportedFile, folder: Path, *, force: bool) -> list[Path]:
    """Write every scenario into `folder`. Only `force` overwrites a file with other content."""
    paths = [folder / f"{variation.name}.yaml" for variation in imported.variations]
    try:
        for path, variation in zip(paths, imported.variations, strict=True):
            if path.exists() and not force and path.read_bytes() != variation.text.encode():
                raise ConfigError(f"{path}: exists, and says something else; --force writes over it")
        folder.mkdir(parents=True, exist_ok=True)
        for path, variation in zip(paths, imported.variations, strict=True):
            write_text_whole(path, variation.text)
    except OSError as error:
        raise ConfigError(f"{error.filename or folder}: cannot be written: {error.strerror}") from error
    return paths


def _read_version(header: Element) -> str:
    return f"{header.word('revMajor')}.{header.word('revMinor')}"


def _check_root(root: Element) -> str:
    """Check root and header; the version of OpenSCENARIO."""
    if root.tag not in _ROOTS:
        raise root.error(f"allowed is {_ROOTS[0]}")
    header = root.one("FileHeader")
    version = _read_version(header)
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
    if not any(child.tag == "ParameterValueDistribution" for child in root.children):
        raise ConfigError(f"{root.path}: no ParameterValueDistribution in it")
    _read_version(root.one("FileHeader"))
    found = variations_of(root, scenario.name, parameters, seed)
    account(root)
    return found


def _read(root: Element, options: ImportOptions) -> tuple[ImportedDrive, tuple[IgnoredElement, ...], str]:
    header = root.one("FileHeader")
    _read_version(header)
    description = header.word("description", "") or root.path
    ego = _find_ego(root, options.ego)
    _set_aside(root, ego, options)
    refuse(root)
    cars, entries = read_cars(root)
    if len(cars) > CARS_MAX:
        raise root.one("Entities").error(
            f"{len(cars)} vehicles, allowed are {CARS_MAX}: the ego and one ahead"
        )
    drive = StoryboardReader(cars, ego, options.duration_s).read(root.one("Storyboard"))
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


def _set_aside(root: Element, ego: str, options: ImportOptions) -> None:
    """Mark the elements that `options` replaces as ignored."""
    for element in root.walk():
        of_ego = ego in (element.attributes.get("entityRef"), element.attributes.get("name"))
        if options.replace_controller and of_ego and element.tag in ("Private", "ScenarioObject"):
            for inner in element.walk():
                if inner.tag in CONTROLLERS:
                    inner.ignored = "replaced by aftbed's function, as asked for"
        if options.duration_s is not None and element.tag == "Storyboard":
            for child in element.children:
                if child.tag == "StopTrigger":
                    child.ignored = "the length of the drive was asked for"


def _scenario_file(name: str, drive: ImportedDrive, description: str, expect: str) -> str:
    """The text of the scenario file. Its keys are in the order in which docs/scenarios.md describes them."""
    printable = "".join(one if one.isprintable() else " " for one in description)
    keys: dict[str, object] = {
        "description": " ".join(printable.split())[:DESCRIPTION_CHARACTERS_MAX],
        "duration_s": _round(drive.duration_s),
        "ego": {"speed_kmh": _round(drive.speed_ms * KMH_PER_MS)},
    }
    if drive.lead is not None:
        lead: dict[str, object] = {"gap_m": _round(drive.lead.gap_m)}
        lead["speed_kmh"] = _round(drive.lead.speed_ms * KMH_PER_MS)
        if (braking := drive.lead.braking) is not None:
            lead["braking"] = {
                "after_s": _round(braking.after_s),
                "deceleration_ms2": _round(braking.deceleration_ms2),
                "ramp_s": 0.0,  # a linear SpeedAction has its full rate from its start
            }
        keys["lead"] = lead
    keys["road"] = {"friction": drive.friction}
    keys["expect"] = {"outcome": expect}
    try:
        scenario_of(name, name, msgspec.convert(keys, ScenarioKeys))
    except msgspec.ValidationError as error:
        raise ConfigError(f"the scenario would be out of range: {error}") from error
    return "".join(f"{key}: {_yaml(value)}\n" for key, value in keys.items())


def _round(value: float) -> float:
    """Rounded to 6 decimals, without -0."""
    return round(value, 6) + 0.0


def _yaml(value: object) -> str:
    """In one line. A text or number in JSON notation is valid YAML."""
    match value:
        case dict():
            return "{" + ", ".join(f"{key}: {_yaml(inner)}" for key, inner in value.items()) + "}"
        case float():
            return f"{value:.6f}".rstrip("0").rstrip(".")
        case _:
            return json.dumps(value, ensure_ascii=False)
