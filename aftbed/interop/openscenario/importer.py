"""Imports OpenSCENARIO XML 1.0 to 1.3 as scenarios of aftbed: one car behind another on a straight road.

`document` has the tree with line numbers and the account of unused elements, `expression` the parameters and
variations, `catalog` the entries of catalogs, `placing` the cars and the road, `timeline` the moments of the
story, `storyboard` the drive; `folder` imports all files of a folder. An import runs in this order:

    1. elements that cannot matter in any drive are marked (`set_aside`)
    2. elements that are refused for their tag: all of them, with line and reason, in one error
    3. elements that are read, with their meaning for the drive
    4. elements that were not read: ignored (printed with the reason), or refused
    5. what does not fit the schema is refused, unless it is ignored; also in the place of a mistake of 3 or 4

A distribution gives one drive for each set of values. Sets that no scenario can express are left out, with
the reason; if that are all, the file is refused. No file is written before every variation has been
converted, and each scenario has been read back in the way in which `aftbed run` reads it. The file does not
contain the expected outcome of the drive; the caller gives it.

No library reads the files. The well-kept one, scenariogeneration, is made to write them: its objects have no
line numbers, and it skips elements that it does not know; here both matter. The protection of defusedxml
against hostile XML would amount to refusing a DOCTYPE, which expat can do.
"""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from aftbed.core.errors import ConfigError, FileKeyError, unknown
from aftbed.interop.files import write_text_whole
from aftbed.interop.openscenario.catalog import Catalogs
from aftbed.interop.openscenario.document import (
    Cause,
    Element,
    IgnoredElement,
    RefusedError,
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
from aftbed.interop.openscenario.schema import fitting
from aftbed.interop.openscenario.storyboard import ImportedDrive, StoryboardReader, UsedElement, set_aside
from aftbed.interop.openscenario.timeline import SlowedEgo
from aftbed.vehicle.plant import KMH_PER_MS
from aftbed.vehicle.scenarios.scenario import ScenarioKeys, scenario_of

EXPECTATIONS: Final = ("stop", "no_collision", "no_braking")
VERSIONS: Final = ("1.0", "1.1", "1.2", "1.3")
EGOS: Final = ("ego", "ego_vehicle", "egovehicle", "hero", "vut")  # in small letters; hero is CARLA's
DESCRIPTION_CHARACTERS_MAX: Final = 200
DURATION_S_MAX: Final = 3600.0
_FOR_ALL: Final = (Cause.UNREADABLE, Cause.CATALOG, Cause.VERSION, Cause.MISSING, Cause.MISTAKE)
_ROOTS: Final = ("OpenSCENARIO", "OpenScenario")


class ImportOptions(msgspec.Struct, frozen=True):
    """What the caller adds to the file. None for `ego`: the car called Ego; for `duration_s`: the file's.

    `pick`: of the variations, only those in which a parameter has one of the values that are given for it.
    """

    ego: str | None = None
    expect: str = "no_collision"
    duration_s: float | None = None
    pick: tuple[tuple[str, str], ...] = ()
    seed: int = 0


class ScenarioVariation(msgspec.Struct, frozen=True):
    """A scenario of aftbed, as YAML in `text`, and the values of the file's parameters for it."""

    name: str
    parameters: Values
    drive: ImportedDrive
    text: str


class LeftOut(msgspec.Struct, frozen=True):
    """A set of values that no scenario can express, and why."""

    parameters: Values
    line: int
    reason: str


class ImportedFile(msgspec.Struct, frozen=True):
    """The result of an import. `taken` and `ignored` are those of the first variation.

    `path` is the file that was asked for, `scenario` the one with the storyboard. `sets` counts the sets of
    values. Equal sets, as random draws may give, are one variation.
    """

    path: str
    scenario: str
    version: str
    description: str
    sets: int
    variations: tuple[ScenarioVariation, ...]
    left_out: tuple[LeftOut, ...]
    taken: tuple[UsedElement, ...]
    ignored: tuple[IgnoredElement, ...]


def import_scenario(
    path: Path, distribution: Path | None, options: ImportOptions, catalogs: Catalogs | None = None
) -> ImportedFile:
    """The scenarios that the file at `path` describes. Raises ConfigError naming file, line and element.

    If `path` is a distribution, they are those of the file that it varies. Imports that share `catalogs` read
    each catalog once.
    """
    check_options(options)
    root, stem, scenario = read_tree(path), path.stem, path
    description = _description(root)
    if (varied := _varied_file(root)) is not None:
        if distribution is not None:
            raise varied.error("a distribution, and --variations gives another one")
        filepath = varied.word("filepath").replace("\\", "/")
        distribution, scenario = path, Path(os.path.normpath(path.parent / filepath))
        if "\0" in filepath or not scenario.is_file():
            raise varied.error(f"filepath: {str(scenario)!r} is not there", Cause.MISSING)
        root = read_tree(scenario)
    version = _check_root(root)
    sets: list[Values] = [{}]
    if distribution is not None:
        sets = _read_distribution(distribution, scenario, declared(root), options)
    elif options.pick:
        raise ConfigError(f"--pick: {path} has no variations; a distribution gives them")
    found: dict[str, ScenarioVariation] = {}
    left_out: list[LeftOut] = []
    first_error: RefusedError | None = None
    ignored: list[tuple[IgnoredElement, ...]] = []
    catalogs = catalogs or Catalogs()
    for values in sets:
        shown = values if stem == scenario.stem else _varying(values, sets, options.pick)
        try:
            drive, unused = _read(substituted(root, values), options, catalogs)
            name = variation_name(stem, shown)
            text = _scenario_file(name, drive, description, options.expect, scenario)
        except RefusedError as error:
            refused = _with_values(error, _varying(values, sets) or shown)
            if error.cause in _FOR_ALL:
                raise refused from error
            first_error = first_error or refused
            left_out.append(LeftOut(values, error.line, error.reason))
            continue
        found[name] = ScenarioVariation(name, values, drive, text)
        ignored.append(unused)
    if not found:
        assert first_error is not None, "a file has at least one set of values"
        raise first_error
    variations = tuple(found.values())
    return ImportedFile(
        path=str(path),
        scenario=str(scenario),
        version=version,
        description=description,
        sets=len(sets),
        variations=variations,
        left_out=tuple(left_out),
        taken=variations[0].drive.taken,
        ignored=ignored[0],
    )


def check_options(options: ImportOptions) -> None:
    """Raise ConfigError for an option that is wrong whatever the file is."""
    if options.expect not in EXPECTATIONS:
        raise ConfigError(f"--expect: {unknown('outcome', options.expect, EXPECTATIONS)}")
    if options.duration_s is not None and not 0.0 < options.duration_s <= DURATION_S_MAX:
        allowed = f"allowed is more than 0 and at most {DURATION_S_MAX:g}"
        raise ConfigError(f"--duration: found {options.duration_s:g}, {allowed}")


def _varying(values: Values, sets: list[Values], pick: Sequence[tuple[str, str]] = ()) -> Values:
    """The values that are not the same in all sets, and those that were picked: their names stay the same."""
    picked = {name for name, _ in pick}
    return {
        name: value
        for name, value in values.items()
        if name in picked or any(one[name] != value for one in sets)
    }


def _with_values(error: RefusedError, values: Values) -> RefusedError:
    """The same error, with the values of the parameters for which it was found."""
    if not values:
        return error
    shown = ", ".join(f"{name} = {value}" for name, value in values.items())
    return RefusedError(f"{error}\n  with {shown}", error.path, error.line, error.reason, error.cause)


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


def _description(root: Element) -> str:
    headers = [one for one in root.children if one.tag == "FileHeader"]
    return (headers[0].attributes.get("description") if headers else "") or root.path


def _read_version(header: Element) -> str:
    return f"{header.word('revMajor')}.{header.word('revMinor')}"


def _check_root(root: Element) -> str:
    """Check root and header; the version of OpenSCENARIO."""
    if root.tag not in _ROOTS:
        raise root.error(f"allowed is {_ROOTS[0]}", Cause.VERSION)
    header = root.one("FileHeader")
    version = _read_version(header)
    if version not in VERSIONS:
        reason = f"OpenSCENARIO {version[:20]}, allowed are {', '.join(VERSIONS)}"
        raise header.error(reason, Cause.VERSION)
    for child in root.children:
        if child.tag == "Catalog":
            raise child.error("a catalog: read where an entry of it is needed", Cause.CATALOG)
        if child.tag == "ParameterValueDistribution":
            raise child.error("a distribution of a distribution")
    return version


def _varied_file(root: Element) -> Element | None:
    """The element of a distribution that names the file that it varies; None if `root` is none."""
    distributions = [one for one in root.children if one.tag == "ParameterValueDistribution"]
    return distributions[0].one("ScenarioFile") if distributions else None


def _read_distribution(
    path: Path, scenario: Path, parameters: list[str], options: ImportOptions
) -> list[Values]:
    root = read_tree(path)
    if _varied_file(root) is None:
        raise ConfigError(f"{root.path}: no ParameterValueDistribution in it")
    _read_version(root.one("FileHeader"))
    with fitting(root):
        found = variations_of(root, scenario.name, parameters, options.seed, options.pick)
        account(root)
    return found


def _read(
    root: Element, options: ImportOptions, catalogs: Catalogs
) -> tuple[ImportedDrive, tuple[IgnoredElement, ...]]:
    _read_version(root.one("FileHeader"))
    ego = _find_ego(root, options.ego)
    with fitting(root) as take_in:
        set_aside(root, ego, catalogs, options.duration_s)
        for entry in of_catalogs(root):
            take_in(entry)
        refuse(root)
        cars, entries = read_cars(root, catalogs)
        for entry in entries:
            take_in(entry)
        drive = StoryboardReader(root, cars, ego, options.duration_s).read()
        check_road(root, empty=drive.lead is None)
        return drive, tuple(one for tree in (root, *entries) for one in account(tree))


def of_catalogs(element: Element) -> Iterator[Element]:
    """The entries of catalogs that were put into the tree."""
    for child in element.children:
        if child.path != element.path:
            yield child
        else:
            yield from of_catalogs(child)


def _find_ego(root: Element, asked: str | None) -> str:
    things = root.one("Entities").every("ScenarioObject")
    names = [thing.word("name") for thing in things]
    if asked is not None and asked not in names:
        raise ConfigError(f"--ego: {unknown('vehicle', asked, names)}")
    egos = [name for name in names if name == asked or (asked is None and name.lower() in EGOS)]
    if len(egos) != 1:
        shown = ", ".join(names) or "none"
        raise root.one("Entities").error(f"which vehicle is the ego? --ego NAME says it (one of: {shown})")
    return egos[0]


def _scenario_file(name: str, drive: ImportedDrive, description: str, expect: str, path: Path) -> str:
    """The text of the scenario file. Its keys are in the order in which docs/scenarios.md describes them."""
    printable = "".join(one if one.isprintable() else " " for one in description)
    keys: dict[str, object] = {
        "description": " ".join(printable.split())[:DESCRIPTION_CHARACTERS_MAX],
        "duration_s": _round(drive.duration_s),
        "ego": {"speed_kmh": _round(drive.speed_ms * KMH_PER_MS)},
    }
    if drive.lead is not None:
        lead: dict[str, Any] = {"gap_m": _round(drive.lead.gap_m)}
        lead["speed_kmh"] = _round(drive.lead.speed_ms * KMH_PER_MS)
        if drive.lead.lateral_m:
            lead["lateral_m"] = _round(drive.lead.lateral_m)
        if (braking := drive.lead.braking) is not None:
            lead["braking"] = {
                "after_s": _round(braking.after_s),
                "deceleration_ms2": _round(braking.rate_ms2),
                "ramp_s": 0.0,  # a linear SpeedAction has its full rate from its start
            }
            if braking.final_ms:
                lead["braking"]["to_kmh"] = _round(braking.final_ms * KMH_PER_MS)
        elif drive.lead.changes:
            lead["speeds"] = [
                {
                    "after_s": _round(one.after_s),
                    "to_kmh": _round(one.final_ms * KMH_PER_MS),
                    "rate_ms2": _round(one.rate_ms2),
                }
                for one in drive.lead.changes
            ]
        keys["lead"] = lead
    if drive.slow_ends:
        keys["ends"] = _ends(drive.slow_ends)
    keys["road"] = {"friction": drive.friction}
    keys["expect"] = {"outcome": expect}
    try:
        scenario_of(name, msgspec.convert(keys, ScenarioKeys))
    except FileKeyError as error:
        raise ConfigError(f"{name}: {error}") from error
    except msgspec.ValidationError as error:
        reason = f"the scenario would be out of range: {error}"
        raise RefusedError(f"{path}: {reason}", str(path), 0, reason, Cause.RANGE) from error
    return "".join(f"{key}: {_yaml(value)}\n" for key, value in keys.items())


def _ends(slow_ends: Sequence[SlowedEgo]) -> dict[str, object]:
    """Of several ends the slowest and the latest: the drive is not shorter than the file's."""
    ends: dict[str, object] = {}
    for key, speeds_ms in (
        ("below_kmh", [one.below_ms for one in slow_ends if one.below_ms is not None]),
        ("below_lead_kmh", [one.below_lead_ms for one in slow_ends if one.below_lead_ms is not None]),
    ):
        if speeds_ms:
            ends[key] = _round((max if key == "below_lead_kmh" else min)(speeds_ms) * KMH_PER_MS)
    ends["after_s"] = _round(max(one.after_s for one in slow_ends))
    return ends


def _round(value: float) -> float:
    """Rounded to 6 decimals, without -0."""
    return round(value, 6) + 0.0


def _yaml(value: object) -> str:
    """In one line. A text or number in JSON notation is valid YAML."""
    match value:
        case dict():
            return "{" + ", ".join(f"{key}: {_yaml(inner)}" for key, inner in value.items()) + "}"
        case list():
            return "[" + ", ".join(map(_yaml, value)) + "]"
        case float():
            return f"{value:.6f}".rstrip("0").rstrip(".")
        case _:
            return json.dumps(value, ensure_ascii=False)
