"""The entries of catalogs: vehicles, objects, maneuvers and environments that a file refers to.

A reference has the name of a catalog and of an entry, and may give values to the parameters of the entry. The
catalogs lie in the folders, or are the files, that `CatalogLocations` names. Only what a reference asks for
is read: another entry, or another file in the same folder, may be broken.
"""

import os
from pathlib import Path
from typing import Final

from aftbed.core.errors import unknown
from aftbed.interop.openscenario.document import Cause, Element, RefusedError, read_tree
from aftbed.interop.openscenario.expression import replaced_below

CATALOG_FILES_MAX: Final = 100


class Catalogs:
    """Finds entries. Each file is read once, for all scenarios that are imported with the same `Catalogs`."""

    def __init__(self) -> None:
        self._trees: dict[Path, Element] = {}
        self._broken: dict[Path, RefusedError] = {}

    def entry(self, root: Element, reference: Element, *kinds: str, needed: str) -> Element:
        """The entry, of one of `kinds`, to which `reference` in the file `root` refers.

        `needed` ends the message about a catalog that is not there: why the entry matters.
        """
        catalog, name = reference.word("catalogName"), reference.word("entryName")
        assigned = reference.maybe("ParameterAssignments")
        values = {
            one.word("parameterRef").removeprefix("$"): one.word("value")
            for one in (assigned.every("ParameterAssignment") if assigned else [])
        }
        names: list[str] = []
        broken: list[RefusedError] = []
        for path in _files(root, reference, kinds, needed):
            if (tree := self._tree(path, broken)) is None:
                continue
            for group in tree.every("Catalog"):
                for entry in group.every(*kinds) if group.word("name") == catalog else []:
                    names.append(entry.word("name"))
                    if names[-1] == name:
                        return replaced_below(entry, values)
        if broken:
            raise broken[0]
        raise reference.error(str(unknown(f"entry of {catalog!r}", name, names)))

    def _tree(self, path: Path, broken: list[RefusedError]) -> Element | None:
        """The catalog in `path`; None if it cannot be read, and then the reason is in `broken`."""
        if path not in self._trees and path not in self._broken:
            try:
                self._trees[path] = read_tree(path)
            except RefusedError as error:
                self._broken[path] = error
        if path in self._broken:
            broken.append(self._broken[path])
        return self._trees.get(path)


def _files(root: Element, reference: Element, kinds: tuple[str, ...], needed: str) -> list[Path]:
    locations = [f"{kind}Catalog" for kind in kinds]
    places = [
        directory.attributes.get("path", "")
        for group in root.children
        if group.tag == "CatalogLocations"
        for location in group.children
        if location.tag in locations
        for directory in location.children
    ]
    if not places:
        reason = f"found no {' or '.join(locations)} in CatalogLocations; {needed}"
        raise reference.error(reason, Cause.MISSING)
    found: list[Path] = []
    missing: list[str] = []
    for place in places:
        folder = Path(os.path.normpath(Path(root.path).parent / place))
        try:
            if folder.is_file():
                found.append(folder)
            else:
                found += sorted(one for one in folder.iterdir() if one.suffix == ".xosc" and one.is_file())
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else "not a path"
            missing.append(f"catalog {str(folder)!r}: {why}; {needed}")
    if not found and missing:
        raise reference.error(missing[0], Cause.MISSING)
    return found[:CATALOG_FILES_MAX]
