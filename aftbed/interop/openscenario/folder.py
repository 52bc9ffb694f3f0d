"""Imports every OpenSCENARIO file of a folder and of the folders in it, and reports one line for each.

A file that cannot be imported is reported with the first line that is in the way, the reason and its `Cause`;
it does not stop the others. A distribution is a file like any other: its scenarios are those of the file that
it varies. A catalog is refused: it is read where an entry of it is needed.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.progress import Show, unshown
from aftbed.interop.openscenario.catalog import Catalogs
from aftbed.interop.openscenario.document import Cause, RefusedError
from aftbed.interop.openscenario.importer import (
    ImportedFile,
    ImportOptions,
    LeftOut,
    check_options,
    import_scenario,
    write,
)

FILES_MAX: Final = 10_000


class ReportedScenario(msgspec.Struct, frozen=True):
    """A scenario of a file: its name, where it was written, None if nothing was, and the values for it."""

    name: str
    path: str | None
    parameters: dict[str, str]


class FileReport(msgspec.Struct, frozen=True):
    """What became of a file. `reason`, `line` and `cause` are None for one that was imported."""

    file: str
    accepted: bool
    reason: str | None = None
    line: int | None = None
    cause: Cause | None = None
    scenarios: tuple[ReportedScenario, ...] = ()
    left_out: tuple[LeftOut, ...] = ()


def import_folder(
    folder: Path, options: ImportOptions, out: Path | None, *, force: bool, show: Show = unshown
) -> Iterator[FileReport]:
    """Import the files of `folder` in the order of their paths; a report of each as it is done.
    `show` gets how many files are done.

    With `out` the scenarios are written, in folders like those of the files. Raises ConfigError if there is
    no file, an option is wrong, or a scenario cannot be written.
    """
    check_options(options)
    try:
        paths = sorted(path for path in folder.rglob("*.xosc") if path.is_file())
    except OSError as error:
        raise ConfigError(f"{error.filename or folder}: cannot be read: {error.strerror}") from error
    if not paths:
        raise ConfigError(f"{folder}: no .xosc file in it, or in a folder of it")
    if len(paths) > FILES_MAX:
        raise ConfigError(f"{folder}: {len(paths)} files, allowed are {FILES_MAX}; import a part of it")
    catalogs = Catalogs()
    for number, path in enumerate(paths):
        show(number, len(paths))
        place = path.relative_to(folder)
        try:
            imported = import_scenario(path, None, options, catalogs)
        except RefusedError as error:
            yield _refused(place, path, error)
            continue
        except ConfigError as error:  # of an option that does not fit this file
            yield FileReport(str(place), False, str(error), None, Cause.MISTAKE)
            continue
        written = write(imported, out / place.parent, force=force) if out is not None else None
        yield FileReport(
            str(place), True, scenarios=_scenarios(imported, written), left_out=imported.left_out
        )


def _refused(place: Path, path: Path, error: RefusedError) -> FileReport:
    """The report of a file that is refused. A line in another file, as of a catalog, is in the reason."""
    if error.path == str(path):
        return FileReport(str(place), False, error.reason, error.line or None, error.cause)
    elsewhere = f"{error.path}: line {error.line}: {error.reason}"
    return FileReport(str(place), False, elsewhere, None, error.cause)


def _scenarios(imported: ImportedFile, written: list[Path] | None) -> tuple[ReportedScenario, ...]:
    paths = [None] * len(imported.variations) if written is None else [str(path) for path in written]
    return tuple(
        ReportedScenario(one.name, path, dict(one.parameters))
        for one, path in zip(imported.variations, paths, strict=True)
    )
