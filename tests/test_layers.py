"""The rows of the architecture, read off the imports: an upper row may import a lower one, never the reverse.

Imports inside of functions count: a lazy one is a dependency as well.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import pytest

import aftbed

PACKAGE: Final = Path(aftbed.__file__).parent

ROWS: Final = {  # package: row, the lowest first
    "core": 0,
    "ftm": 1,
    "vehicle": 1,
    "runtime": 3,
    "adapt": 2,
    "inject": 4,
    "campaign": 5,
    "bench": 6,
    "report": 6,
    "cli": 7,
}
STRANGERS: Final = frozenset({"ftm", "vehicle", "inject"})  # none of them imports another
NO_ROW: Final = {"aftbed": (), "aftbed.__main__": ("aftbed.cli",)}  # all that they may import

IMPURE_PLACES: Final = (  # where clock, socket, process, file and chance may live
    "aftbed.runtime.unix",
    "aftbed.vehicle",
    "aftbed.inject",
    "aftbed.campaign",
    "aftbed.report",
    "aftbed.bench",
    "aftbed.cli",
)
SEEDED_PLACES: Final = ("aftbed.runtime.sim",)  # chance, but from a seed: nothing of `random` but its class
SEEDED: Final = "from random import Random"
PURE_MODULES: Final = frozenset(  # what the rest may import beside aftbed: neither clock nor I/O nor chance
    ("__future__", "abc", "bisect", "collections", "contextlib", "copy", "dataclasses", "difflib", "enum")
    + ("functools", "hashlib", "heapq", "itertools", "math", "msgspec", "operator", "re", "statistics")
    + ("string", "struct", "textwrap", "types", "typing", "zlib")
)
IMPURE_CALLS: Final = frozenset({"open", "input", "print", "exec", "eval", "__import__", "breakpoint"})


class Import(NamedTuple):
    """`module` imports `target`, at `line`."""

    module: str
    target: str
    line: int

    def __str__(self) -> str:
        return f"{self.module}:{self.line} imports {self.target}"


def imports(module: str, source: str) -> Iterator[Import]:
    """Every import in `source`, wherever it stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(module, alias.name, node.lineno)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{module}:{node.lineno}: a relative import"
            if node.module in ("aftbed", "aftbed.runtime"):  # the names are packages
                for alias in node.names:
                    yield Import(module, f"{node.module}.{alias.name}", node.lineno)
            else:
                yield Import(module, node.module, node.lineno)


def lies_in(module: str, places: tuple[str, ...]) -> bool:
    return any(module == place or module.startswith(f"{place}.") for place in places)


def part(module: str) -> str:
    """The package of `module`: `aftbed.core.messages` is in `core`."""
    return module.split(".")[1]


def problems(module: str, source: str) -> list[str]:
    """Every breach of the architecture in the source of `module`."""
    found = []
    for one in imports(module, source):
        ours = one.target.startswith("aftbed.")
        if module in NO_ROW:
            allowed = NO_ROW[module]
            found += [f"{one}: it may not"] if ours and one.target not in allowed else []
        elif ours:
            found += _row_problems(one)
        elif one.target == "random" and lies_in(module, SEEDED_PLACES):
            line = source.splitlines()[one.line - 1]
            found += [] if line == SEEDED else [f"{one}: chance is only to be had by {SEEDED!r}"]
        elif one.target.split(".")[0] not in PURE_MODULES and not lies_in(module, IMPURE_PLACES):
            found.append(f"{one}: only {', '.join(IMPURE_PLACES)} may")
    if module not in NO_ROW and not lies_in(module, IMPURE_PLACES):
        found += [f"{module}:{line} calls {name}" for name, line in impure_calls(source)]
    return found


def _row_problems(one: Import) -> list[str]:
    if one.target == "aftbed.__version__":
        return []
    here, there = part(one.module), part(one.target)
    if here not in ROWS or there not in ROWS:
        return [f"{one}: {here if here not in ROWS else there} is no row of the architecture"]
    if ROWS[there] > ROWS[here]:
        return [f"{one}: a lower row imports an upper one"]
    if here != there and {here, there} <= STRANGERS:
        return [f"{one}: {here} and {there} are strangers"]
    if there == "runtime" and lies_in(one.target, IMPURE_PLACES) and not lies_in(one.module, IMPURE_PLACES):
        return [f"{one}: what is pure imports what is not"]
    return []


def impure_calls(source: str) -> Iterator[tuple[str, int]]:
    """Calls of builtins that do I/O."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in IMPURE_CALLS:
            yield node.func.id, node.lineno


def modules() -> dict[str, Path]:
    """All modules of the package by name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def test_no_module_breaches_the_architecture() -> None:
    found = [p for name, path in modules().items() for p in problems(name, path.read_text())]
    assert found == []


def test_every_row_that_exists_is_looked_at() -> None:
    seen = {part(name) for name in modules() if name not in NO_ROW}
    assert {"core", "ftm", "vehicle", "runtime", "inject", "campaign", "cli"} <= seen <= set(ROWS)


@pytest.mark.parametrize(
    ("module", "source", "reason"),
    [
        ("aftbed.core.messages", "import aftbed.ftm.client", "a lower row imports an upper one"),
        ("aftbed.core.messages", "from aftbed import ftm", "a lower row imports an upper one"),
        ("aftbed.ftm.client", "from aftbed.runtime.unix import node", "a lower row imports an upper one"),
        ("aftbed.runtime.unix.node", "from aftbed.inject.words import parse", "a lower row imports"),
        ("aftbed.inject.words", "from aftbed.campaign import record", "a lower row imports an upper one"),
        ("aftbed.ftm.client", "from aftbed.vehicle.can.frame import Frame", "ftm and vehicle are strangers"),
        ("aftbed.vehicle.drive_real", "import aftbed.ftm", "vehicle and ftm are strangers"),
        ("aftbed.inject.words", "from aftbed.vehicle import bus", "inject and vehicle are strangers"),
        ("aftbed.ftm.client", "def f():\n    from aftbed.vehicle import bus", ":2 imports aftbed.vehicle"),
        ("aftbed.core.messages", "import time", "only aftbed.runtime.unix"),
        ("aftbed.ftm.client", "def f():\n    from os import fork", ":2 imports os"),
        ("aftbed.ftm.client", "if True:\n    import socket as s", ":2 imports socket"),
        ("aftbed.ftm.client", "from random import Random", "imports random"),
        ("aftbed.runtime.sim.world", "import random", "chance is only to be had by"),
        ("aftbed.runtime.sim.world", "from random import random", "chance is only to be had by"),
        ("aftbed.runtime.targets", "from pathlib import Path", "imports pathlib"),
        ("aftbed.runtime.targets", "from aftbed.runtime import unix", "what is pure imports what is not"),
        ("aftbed.ftm.client", "def f():\n    open('x')", "calls open"),
        ("aftbed.attic.old", "import aftbed.core.messages", "attic is no row"),
        ("aftbed", "from aftbed.core import wire", "it may not"),
        ("aftbed.__main__", "from aftbed.core import wire", "it may not"),
    ],
)
def test_a_planted_breach_is_found(module: str, source: str, reason: str) -> None:
    found = problems(module, source)
    assert len(found) == 1 and reason in found[0], found


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("aftbed.cli.app", "from aftbed.core import wire\nimport aftbed.campaign.verdict, time"),
        ("aftbed.bench.runs", "from aftbed.campaign.record import read_record"),
        ("aftbed.runtime.unix.node", "import socket\nfrom aftbed.vehicle.aeb.function import AebFunction"),
        ("aftbed.runtime.sim.world", "from random import Random"),
        ("aftbed.ftm.client", "import msgspec\nfrom collections.abc import Callable"),
        ("aftbed.__main__", "from aftbed.cli import main"),
        ("aftbed.runtime.unix.launch", "from aftbed import __version__"),
    ],
)
def test_what_is_allowed_is_let_through(module: str, source: str) -> None:
    assert problems(module, source) == []
