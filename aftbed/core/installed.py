"""What installed packages declare for aftbed: their entry points. Nothing of them is imported to find out.

An entry point is a line of a package's metadata: `limit = "aftbed_limit:LIMIT"` in the group
`aftbed.mechanisms`. The metadata are read once, when a name is asked for that aftbed does not have: they
cost as much as the import of typer.
"""

import os
import sys
from functools import cache
from importlib import import_module
from pathlib import Path

import msgspec


class EntryPoint(msgspec.Struct, frozen=True):
    """`place`: MODULE:NAME. `package`: the name and the version of the package that declares it."""

    name: str
    place: str
    package: str

    def load(self) -> object:
        """What stands there. Raises whatever its module raises."""
        module, _, name = self.place.partition(":")
        return getattr(import_module(module), name)


@cache
def entry_points(group: str) -> tuple[EntryPoint, ...]:
    """Those of all packages on the path, by name; two packages may declare the same name."""
    from importlib.metadata import Distribution, distributions  # noqa: PLC0415 - costs 40 ms

    def declared(package: Distribution) -> list[EntryPoint]:
        try:
            points = [point for point in package.entry_points if point.group == group]
        except (OSError, TypeError, ValueError):  # metadata of another package that cannot be read
            return []
        label = f"{package.name} {package.version}" if points else ""  # read only where there are some
        return [EntryPoint(point.name, point.value.partition("[")[0].strip(), label) for point in points]

    found: dict[tuple[str, str], EntryPoint] = {}
    for package in distributions(path=search_path()):
        for point in declared(package):
            name, _, _ = point.package.rpartition(" ")
            found.setdefault((point.name, name), point)  # one that comes first on the path hides the others
    return tuple(sorted(found.values(), key=lambda point: (point.name, point.package)))


def search_path() -> list[str]:
    """Where modules are looked for: `sys.path`, without the working directory unless PYTHONPATH names it."""
    here = str(Path.cwd())
    asked = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return [p for p in sys.path if Path(p).is_absolute() and (p != here or p in asked)]
