"""The rows of the architecture, read off the imports: an upper row may import a lower one, never the reverse.

Imports inside of functions and under TYPE_CHECKING count: either is a dependency. No cycle of modules is
allowed, and a class name is defined once in the package.
"""

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import pytest

import aftbed

PACKAGE: Final = Path(aftbed.__file__).parent

ROWS: Final = {  # package: row, the lowest first
    "core": 0,
    "functions": 1,
    "ftm": 1,
    "vehicle": 1,
    "inject": 2,
    "adapt": 3,
    "runtime": 4,
    "judge": 5,
    "search": 6,
    "campaign": 7,
    "report": 8,
    "interop": 8,
    "bench": 9,
    "cli": 10,
    "api": 11,  # a module of the package itself: it carries out what the commands do
    "pytest_plugin": 12,
}
STRANGERS: Final = (  # neither imports the other
    frozenset({"ftm", "vehicle"}),
    frozenset({"functions", "ftm"}),
    frozenset({"functions", "vehicle"}),
    frozenset({"report", "interop"}),
)
NO_ROW: Final = {  # all that they may import
    "aftbed": ("aftbed.api", "aftbed.core.application", "aftbed.core.errors", "aftbed.search.explore"),
    "aftbed.__main__": ("aftbed.cli",),
}
OF_THE_PACKAGE: Final = frozenset({"__version__", "__file__"})  # all that modules take of `aftbed` itself

IMPURE_PLACES: Final = (  # where clock, socket, process, file and chance may live
    "aftbed.runtime.unix",
    "aftbed.functions",
    "aftbed.vehicle",
    "aftbed.inject",
    "aftbed.judge",
    "aftbed.search",
    "aftbed.campaign",
    "aftbed.report",
    "aftbed.interop",
    "aftbed.bench",
    "aftbed.cli",
    "aftbed.api",
    "aftbed.pytest_plugin",
    "aftbed.core.archive",
    "aftbed.core.input_file",  # the readers of files in core: all upper rows read by them
    "aftbed.core.installed",  # metadata of packages
    "aftbed.core.yaml_file",
)
SEEDED_PLACES: Final = ("aftbed.runtime.sim",)  # chance, but from a seed: nothing of `random` but its class
SEEDED: Final = "from random import Random"
PURE_MODULES: Final = frozenset(  # what the rest may import beside aftbed: neither clock nor I/O nor chance
    ("__future__", "_blake2", "abc", "bisect", "collections", "contextlib", "copy", "dataclasses", "difflib")
    + ("enum", "functools", "hashlib", "heapq", "itertools", "math", "msgspec", "operator", "re")
    + ("statistics", "string", "struct", "textwrap", "types", "typing", "zlib")
)
IMPURE_CALLS: Final = frozenset({"open", "input", "print", "exec", "eval", "__import__", "breakpoint"})


class Import(NamedTuple):
    """`module` imports `target`, at `line`."""

    module: str
    target: str
    line: int

    def __str__(self) -> str:
        return f"{self.module}:{self.line} imports {self.target}"


@cache
def tree(source: str) -> ast.Module:
    """Parsed once for all tests."""
    return ast.parse(source)


@cache
def nodes(source: str) -> tuple[ast.Import | ast.ImportFrom | ast.Call | ast.Attribute, ...]:
    """The nodes that these tests look at, wherever they stand: a tenth of all, walked once for all tests."""
    wanted = (ast.Import, ast.ImportFrom, ast.Call, ast.Attribute)
    return tuple(node for node in ast.walk(tree(source)) if isinstance(node, wanted))


def imports(module: str, source: str) -> Iterator[Import]:
    """Every import in `source`, wherever it stands."""
    for node in nodes(source):
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
    """The package of `module`: `aftbed.core.wire` is in `core`."""
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
    if here != there and any({here, there} <= strangers for strangers in STRANGERS):
        return [f"{one}: {here} and {there} are strangers"]
    if there == "runtime" and lies_in(one.target, IMPURE_PLACES) and not lies_in(one.module, IMPURE_PLACES):
        return [f"{one}: what is pure imports what is not"]
    return []


def impure_calls(source: str) -> Iterator[tuple[str, int]]:
    """Calls of builtins that do I/O."""
    for node in nodes(source):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in IMPURE_CALLS:
            yield node.func.id, node.lineno


def modules() -> dict[str, Path]:
    """All modules of the package by name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def sources() -> dict[str, str]:
    return {name: path.read_text() for name, path in modules().items()}


def imported_modules(module: str, source: str, known: Iterable[str]) -> set[str]:
    """The modules of ours that `module` imports; `from package import module` names the module."""
    known, found = set(known), set()
    for node in nodes(source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & known
            if names - known and node.module in known:
                found.add(node.module)
    return found - {module}


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """The strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for target in sorted(graph.get(module, ())):
            if target not in index:
                visit(target)
                low[module] = min(low[module], low[target])
            elif target in stack:
                low[module] = min(low[module], index[target])
        if low[module] == index[module]:
            at = stack.index(module)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    for module in sorted(graph):
        if module not in index:
            visit(module)
    return found


def import_graph(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Without `aftbed` itself, which names for others what it offers: see `taken_of_the_package`."""
    return {name: imported_modules(name, source, sources) - {"aftbed"} for name, source in sources.items()}


def taken_of_the_package(source: str, known: Iterable[str]) -> set[str]:
    """The names that `source` takes of `aftbed`, but for the modules in it."""
    found, known = set[str](), set(known)
    for node in nodes(source):
        if isinstance(node, ast.ImportFrom) and node.module == "aftbed":
            found |= {alias.name for alias in node.names if f"aftbed.{alias.name}" not in known}
        elif (
            isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "aftbed"
        ):
            found |= {node.attr} if f"aftbed.{node.attr}" not in known else set()
    return found


def double_names(sources: Mapping[str, str]) -> list[str]:
    """Class names, not private ones, that more than one module defines at its top level."""
    homes = defaultdict(list)
    for name, source in sources.items():
        for node in tree(source).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(name)
    return [f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(where) > 1]


def test_no_module_breaches_the_architecture() -> None:
    found = [p for name, source in sources().items() for p in problems(name, source)]
    assert found == []


def test_no_modules_import_one_another() -> None:
    assert not cycles(import_graph(sources()))


def test_modules_take_nothing_of_the_package_itself_but_its_version_and_place() -> None:
    """What it offers to other programs lies above them."""
    known = modules()
    taken = {name: taken_of_the_package(source, known) - OF_THE_PACKAGE for name, source in sources().items()}
    assert {name: names for name, names in taken.items() if names} == {}


def test_a_name_that_is_taken_of_the_package_is_found() -> None:
    known = ("aftbed", "aftbed.cli")
    assert taken_of_the_package("from aftbed import cli, run", known) == {"run"}
    assert taken_of_the_package("import aftbed\naftbed.run()\naftbed.cli.main()", known) == {"run"}


def test_what_the_package_offers_is_where_a_type_checker_is_told() -> None:
    assert set(aftbed._HOMES) == set(NO_ROW["aftbed"])
    offered = {name for names in aftbed._HOMES.values() for name in names}
    assert offered == set(aftbed.__all__)
    told = {
        alias.name
        for node in nodes(Path(aftbed.__file__).read_text())
        if isinstance(node, ast.ImportFrom) and node.module in NO_ROW["aftbed"]
        for alias in node.names
    }
    assert told == offered


def test_a_class_name_is_defined_once() -> None:
    assert not double_names(sources())


def test_every_row_that_exists_is_looked_at() -> None:
    seen = {part(name) for name in modules() if name not in NO_ROW}
    assert seen == set(ROWS)


@pytest.mark.parametrize(
    ("module", "source", "reason"),
    [
        ("aftbed.core.wire", "import aftbed.ftm.proxy", "a lower row imports an upper one"),
        ("aftbed.core.wire", "from aftbed import ftm", "a lower row imports an upper one"),
        ("aftbed.ftm.proxy", "from aftbed.runtime.unix import node_io", "a lower row imports an upper one"),
        ("aftbed.inject.grammar", "from aftbed.runtime import control", "a lower row imports an upper one"),
        (
            "aftbed.runtime.unix.node_io",
            "from aftbed.judge import record",
            "a lower row imports an upper one",
        ),
        ("aftbed.search.swarm", "from aftbed.campaign import plan", "a lower row imports an upper one"),
        ("aftbed.campaign.plan", "from aftbed.bench import runs", "a lower row imports an upper one"),
        ("aftbed.report.html", "from aftbed.interop import mcap", "report and interop are strangers"),
        ("aftbed.ftm.proxy", "from aftbed.vehicle.frame import Frame", "ftm and vehicle are strangers"),
        ("aftbed.vehicle.car", "import aftbed.ftm", "vehicle and ftm are strangers"),
        ("aftbed.ftm.proxy", "def f():\n    from aftbed.vehicle import bus", ":2 imports aftbed.vehicle"),
        ("aftbed.core.wire", "import time", "only aftbed.runtime.unix"),
        ("aftbed.ftm.proxy", "def f():\n    from os import fork", ":2 imports os"),
        ("aftbed.ftm.proxy", "if True:\n    import socket as s", ":2 imports socket"),
        ("aftbed.ftm.proxy", "from random import Random", "imports random"),
        ("aftbed.runtime.sim.world", "import random", "chance is only to be had by"),
        ("aftbed.runtime.sim.world", "from random import random", "chance is only to be had by"),
        ("aftbed.runtime.deployment", "from pathlib import Path", "imports pathlib"),
        ("aftbed.runtime.deployment", "from aftbed.runtime import unix", "what is pure imports what is not"),
        ("aftbed.ftm.proxy", "def f():\n    open('x')", "calls open"),
        ("aftbed.attic.old", "import aftbed.core.wire", "attic is no row"),
        ("aftbed", "from aftbed.core import wire", "it may not"),
        ("aftbed.cli.run", "from aftbed.api import run", "a lower row imports an upper one"),
        ("aftbed.api", "import aftbed.pytest_plugin", "a lower row imports an upper one"),
        ("aftbed.__main__", "from aftbed.core import wire", "it may not"),
    ],
)
def test_a_planted_breach_is_found(module: str, source: str, reason: str) -> None:
    found = problems(module, source)
    assert len(found) == 1 and reason in found[0], found


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("aftbed.cli.app", "from aftbed.core import wire\nimport aftbed.campaign.plan, time"),
        ("aftbed.bench.runs", "from aftbed.campaign.statistics import quantile"),
        ("aftbed.runtime.unix.node_io", "import socket\nfrom aftbed.vehicle.function import AebFunction"),
        ("aftbed.runtime.sim.world", "from random import Random"),
        ("aftbed.ftm.proxy", "import msgspec\nfrom collections.abc import Callable"),
        ("aftbed.__main__", "from aftbed.cli import main"),
        ("aftbed", "def f():\n    from aftbed.api import run"),
        ("aftbed.api", "import subprocess\nfrom aftbed.cli import sim"),
        ("aftbed.runtime.unix.launch", "from aftbed import __version__"),
    ],
)
def test_what_is_allowed_is_let_through(module: str, source: str) -> None:
    assert problems(module, source) == []


@pytest.mark.parametrize(
    "back",
    [
        "from aftbed.core import graph",
        "def f():\n    from aftbed.core.graph import Graph",
        "if TYPE_CHECKING:\n    from aftbed.core.graph import Graph",
    ],
    ids=["plain", "lazy", "type-only"],
)
def test_a_planted_cycle_is_found(back: str) -> None:
    planted = {
        "aftbed.core": "",
        "aftbed.core.graph": "from aftbed.core.script import Step",
        "aftbed.core.script": "import aftbed.core.units",
        "aftbed.core.units": back,
    }
    assert cycles(import_graph(planted)) == [["aftbed.core.graph", "aftbed.core.script", "aftbed.core.units"]]


def test_a_planted_second_class_of_one_name_is_found() -> None:
    planted = {"aftbed.core.graph": "class Link: ...", "aftbed.ftm.tr": "class Link: ...\nclass _Own: ..."}
    assert double_names(planted) == ["Link: aftbed.core.graph, aftbed.ftm.tr"]
