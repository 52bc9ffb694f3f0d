"""The pytest plugin: a marked test is a run of a protected function, with faults and adaptations.

    @pytest.mark.aftbed(app="function.py:Function", requests="requests.csv",
                        inject="crash primary at server.exit nth {1..50}")
    def test_a_crash_is_masked(aftbed):  # 50 tests
        assert aftbed.requests.lost == 0

The arguments are those of `aftbed.run`; paths are relative to the file of the test. Markers of the class and
the module give what that of the function leaves out. The fixture `aftbed` is the RunReport of the run.

Whatever the body of a marked test does, also nothing, the test passes only if the verdict is `pass`, or the
one that the marker names (`verdict="fail"`, for a test that shows what a mechanism does not tolerate).

This module is imported by every pytest of an environment that has aftbed, so it imports nothing large.
"""

import inspect
import itertools
import re
from collections.abc import Iterator
from typing import Any

import pytest

TYPE_CHECKING = False
if TYPE_CHECKING:
    from aftbed.api import RunReport

MARKER = "aftbed"  # and the name of the fixture
RUN_KEYS = (  # the parameters of `aftbed.run`
    "app",
    "requests",
    "ftm",
    "placement",
    "count",
    "rate",
    "seed",
    "inject",
    "adapt",
    "runtime",
    "expect",
    "force",
    "may_fail",
    "record",
    "folder",
)
KEYS = (*RUN_KEYS, "verdict")
RANGED_KEYS = ("inject", "adapt")  # whose texts may have ranges
VERDICTS = ("pass", "fail", "inconclusive")
TESTS_MAX = 10_000  # of one function
RANGE = re.compile(r"(?P<word>[A-Za-z_]*)(?P<between>\W*)\{(?P<first>[0-9]{1,9})\.\.(?P<last>[0-9]{1,9})\}")

_report: "pytest.StashKey[RunReport]" = pytest.StashKey()

Given = dict[str, Any]  # `aftbed.run` checks it


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("aftbed").addoption(
        "--aftbed-runtime",
        choices=("sim", "unix"),
        help="Where all tests with the marker aftbed run: in the simulator, or on real processes.",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "aftbed(app=..., requests=..., ftm='pbr', inject=..., adapt=..., ...): a run of a protected function,"
        " whose verdict has to be 'pass'; the arguments are those of aftbed.run, and verdict=...",
    )


# -- collection -----------------------------------------------------------------------------------


def pytest_pycollect_makeitem(collector: pytest.Collector, name: str, obj: object) -> None:
    """Have each marked function use the fixture, whether it names it or not."""
    if inspect.isfunction(obj) and isinstance(collector, pytest.Module | pytest.Class):
        own = getattr(obj, "pytestmark", [])
        if collector.get_closest_marker(MARKER) is not None or any(mark.name == MARKER for mark in own):
            pytest.mark.usefixtures(MARKER)(obj)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    given = _given(metafunc.definition)
    if given is None:
        return
    where = metafunc.definition.nodeid
    variants = list(itertools.islice(_variants(given, where), TESTS_MAX + 1))
    if len(variants) > TESTS_MAX:
        raise pytest.Collector.CollectError(f"{where}: the ranges make more than {TESTS_MAX} tests")
    if any(name for name, _ in variants):
        names = [name for name, _ in variants]
        metafunc.parametrize(MARKER, [texts for _, texts in variants], indirect=True, ids=names)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        marked = item.get_closest_marker(MARKER) is not None
        if marked and MARKER not in getattr(item, "fixturenames", ()):
            raise pytest.UsageError(
                f"{item.nodeid}: the marker aftbed is for functions, and methods of plain classes"
            )


def _given(node: pytest.Item) -> Given | None:
    """What the markers of `node` say, the closest first; None without one. Raises CollectError."""
    found: Given = {}
    marks = list(node.iter_markers(MARKER))
    for mark in reversed(marks):
        if mark.args:
            raise pytest.Collector.CollectError(
                f"{node.nodeid}: the marker aftbed has the argument {mark.args[0]!r}; named ones are"
                " allowed, as app=..."
            )
        for key in mark.kwargs:
            if key not in KEYS:
                raise pytest.Collector.CollectError(
                    f"{node.nodeid}: the marker aftbed has an unknown argument {key!r}"
                    f" (one of: {', '.join(KEYS)})"
                )
        found |= mark.kwargs
    if found.get("verdict", "pass") not in VERDICTS:
        raise pytest.Collector.CollectError(
            f"{node.nodeid}: the marker aftbed: verdict: found {found['verdict']!r}, allowed are"
            f" {', '.join(VERDICTS)}"
        )
    return found if marks else None


def _variants(given: Given, where: str) -> Iterator[tuple[str, Given]]:
    """The texts of each test, with its name, which is empty where there is no range. Raises CollectError."""
    texts = [(key, text) for key in RANGED_KEYS for text in _texts(given.get(key, ()))]
    choices = [list(itertools.islice(_expanded(text, where), TESTS_MAX + 1)) for _, text in texts]
    for chosen in itertools.product(*choices):
        found: Given = {}
        for (key, _), (_, text) in zip(texts, chosen, strict=True):
            found[key] = (*_texts(found.get(key, ())), text)
        yield "-".join(name for name, _ in chosen if name), found


def _texts(value: object) -> tuple[str, ...]:
    """A text alone, or several; `aftbed.run` refuses anything else."""
    found = (value,) if isinstance(value, str) else value
    return tuple(map(str, found)) if isinstance(found, list | tuple) else ()


def _expanded(text: str, where: str) -> Iterator[tuple[str, str]]:
    """Name and text for each number of its ranges: `nth {1..50}` gives the names nth-1 to nth-50."""
    found = RANGE.search(text)
    if found is None:
        yield "", text
        return
    first, last = int(found["first"]), int(found["last"])
    if first > last:
        raise pytest.Collector.CollectError(f"{where}: {text!r}: no number is in {{{first}..{last}}}")
    before, after = text[: found.start()] + found["word"] + found["between"], text[found.end() :]
    for number in range(first, last + 1):
        here = f"{found['word']}-{number}" if found["word"] else str(number)
        for name, rest in _expanded(after, where):
            yield f"{here}-{name}" if name else here, f"{before}{number}{rest}"


# -- the run, and its verdict ---------------------------------------------------------------------


@pytest.fixture
def aftbed(request: pytest.FixtureRequest) -> "RunReport":
    """The report of the run that the marker `aftbed` describes."""
    given = _given(request.node)
    if given is None:
        pytest.fail("the fixture aftbed needs a marker: @pytest.mark.aftbed(app=..., ...)", pytrace=False)
    given |= getattr(request, "param", {})
    given.pop("verdict", None)
    given.setdefault("folder", request.node.path.parent)
    runtime = request.config.getoption("--aftbed-runtime")
    if runtime is not None:
        given["runtime"] = runtime
    # Imported here: only for a marked test.
    from aftbed.api import run  # noqa: PLC0415
    from aftbed.core.errors import AftbedError  # noqa: PLC0415

    try:
        report = run(**given)
    except AftbedError as error:
        refused = f"aftbed: {error}"
    else:
        request.node.stash[_report] = report
        return report
    pytest.fail(refused, pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    report = item.stash.get(_report, None)
    if report is None:
        return (yield)
    try:
        result = yield
    except (Exception, pytest.fail.Exception):  # of the body: show the run too
        item.add_report_section("call", "aftbed", str(report))
        raise
    wanted = (_given(item) or {}).get("verdict", "pass")
    if report.verdict != wanted:
        pytest.fail(f"{report}\nthe verdict has to be {wanted}", pytrace=False)
    return result
