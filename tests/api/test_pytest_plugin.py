"""The marker and the fixture `aftbed`, in projects that pytest's own `pytester` runs."""

import inspect
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from command_line import PLUGIN

import aftbed
import aftbed.api  # here, for pytester would import it anew for each project
from aftbed import pytest_plugin

pytest_plugins = ("pytester",)

pytestmark = pytest.mark.simulation

FUNCTION: Final = (Path(__file__).resolve().parent / "counting_function.py").read_text()
CRASH: Final = "crash primary at server.exit nth"

Pytester = pytest.Pytester


@pytest.fixture
def project(pytester: Pytester) -> Pytester:
    """A project with a function and its requests."""
    pytester.makepyfile(function=FUNCTION)
    (pytester.path / "requests.csv").write_text("n:u32\n" + "".join(f"{n}\n" for n in range(1, 31)))
    return pytester


def run(project: Pytester, tests: str, *arguments: str) -> pytest.RunResult:
    project.makepyfile(
        test_it='import pytest\n\nSUM = {"app": "function.py:Sum", "requests": "requests.csv"}\n' + tests
    )
    return project.runpytest_inprocess(*PLUGIN, "-p", "no:cacheprovider", *arguments)


def test_a_range_makes_a_test_for_each_number(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(**SUM, inject="{CRASH} {{1..3}}")
def test_crash(aftbed):
    assert len(aftbed.failovers) == 1
""",
        "-v",
    )
    result.assert_outcomes(passed=3)
    result.stdout.fnmatch_lines([f"*::test_crash?nth-{n}? PASSED*" for n in range(1, 4)])


def test_ranges_of_several_texts_are_combined(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(**SUM, inject=["{CRASH} {{3..4}}"], adapt="to lfr at request {{8..9}}")
def test_both(): ...
""",
        "-v",
    )
    result.assert_outcomes(passed=4)
    result.stdout.fnmatch_lines(["*test_both?nth-4-request-9? PASSED*"])


def test_an_empty_test_fails_by_its_verdict_and_says_how_to_repeat_it(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(app="function.py:Forgetful", requests="requests.csv", inject="{CRASH} 7")
def test_state(): ...
""",
    )
    result.assert_outcomes(failed=1)
    place = project.path
    result.stdout.fnmatch_lines(
        [
            "verdict: fail",
            "  because    one_history*",
            f"  repeat     aftbed sim *--app {place}/function.py:Forgetful --requests {place}/requests.csv*",
            "the verdict has to be pass",
        ]
    )


def test_what_did_not_happen_fails_with_the_reason(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(**SUM, inject="{CRASH} 31")
def test_late(): pass
""",
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["verdict: inconclusive", "  because    faults_applied: *nth 31*"])


def test_a_body_that_ignores_the_verdict_changes_nothing(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(app="function.py:Forgetful", requests="requests.csv", inject="{CRASH} 7")
def test_state(aftbed):
    assert aftbed.requests.lost == 0
""",
    )
    result.assert_outcomes(failed=1)


def test_a_body_that_fails_shows_the_run(project: Pytester) -> None:
    result = run(
        project,
        f"""
@pytest.mark.aftbed(**SUM, inject="{CRASH} 7")
def test_failovers(aftbed):
    assert len(aftbed.failovers) == 2
""",
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*assert 1 == 2*", "*Captured aftbed call*", "verdict: pass", "  repeat *"])


def test_a_verdict_that_is_named_is_wanted(project: Pytester) -> None:
    result = run(
        project,
        f"""
WRONG = {{"app": "function.py:Forgetful", "requests": "requests.csv", "verdict": "fail"}}

@pytest.mark.aftbed(**WRONG, inject="{CRASH} 7")
def test_it_fails(): ...

@pytest.mark.aftbed(**WRONG)
def test_it_passes_though(): ...
""",
    )
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["the verdict has to be fail"])


def test_markers_of_module_and_class_are_merged_the_closest_first(project: Pytester) -> None:
    result = run(
        project,
        f"""
pytestmark = pytest.mark.aftbed(**SUM, ftm="none", count=9)

@pytest.mark.aftbed(ftm="lfr")
class TestIt:
    @pytest.mark.aftbed(inject="{CRASH} 7")
    def test_crash(self, aftbed):
        assert (len(aftbed.failovers), aftbed.requests.sent) == (1, 9)
        assert "--ftm lfr" in aftbed.command

def test_plain(aftbed):
    assert "--ftm none" in aftbed.command
""",
    )
    result.assert_outcomes(passed=2)


@pytest.mark.process
@pytest.mark.deep
def test_two_workers_share_the_tests(project: Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    project.makepyfile(
        test_it=f"""
import pytest

@pytest.mark.aftbed(app="function.py:Sum", requests="requests.csv", inject="{CRASH} {{1..4}}")
def test_crash(): ...
"""
    )
    monkeypatch.setenv("PYTHONPATH", str(Path(aftbed.__file__).parents[1]))
    result = project.runpytest_subprocess(*PLUGIN, "-n", "2", "-p", "no:cacheprovider")
    result.assert_outcomes(passed=4)


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        ("inject='crash primary', when=3", "the marker aftbed has an unknown argument 'when' (one of: app,"),
        ("'function.py:Sum'", "the marker aftbed has the argument 'function.py:Sum'; named ones are allowed"),
        ("verdict='fine'", "verdict: found 'fine', allowed are pass, fail, inconclusive"),
        ("inject='crash primary at server.exit nth {9..2}'", "no number is in {9..2}"),
        ("inject='crash primary at server.exit nth {1..20000}'", "the ranges make more than 10000 tests"),
    ],
)
def test_a_marker_that_is_wrong_ends_the_collection(project: Pytester, marker: str, message: str) -> None:
    result = run(project, f"@pytest.mark.aftbed({marker})\ndef test_it(): ...")
    result.assert_outcomes(errors=1)
    assert message in result.stdout.str()


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        ("**SUM, ftm='pbf'", "aftbed: unknown FTM 'pbf'; did you mean 'pbr'?"),
        ("app='nowhere.py:Sum'", "nowhere.py: no such file"),
        ("**SUM, inject=5", "aftbed: inject: found 5, a text or a list of texts is allowed"),
        ("**SUM, count='many'", "aftbed: Expected `int | null`, got `str` - at `count`"),
    ],
)
def test_a_run_that_cannot_be_is_an_error_of_its_test(project: Pytester, marker: str, message: str) -> None:
    result = run(project, f"@pytest.mark.aftbed({marker})\ndef test_it(): ...")
    result.assert_outcomes(errors=1)
    assert message in result.stdout.str()
    assert "Traceback" not in result.stdout.str()


def test_the_fixture_needs_the_marker(project: Pytester) -> None:
    result = run(project, "def test_it(aftbed): ...")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*the fixture aftbed needs a marker*"])


def test_a_marker_where_it_would_do_nothing_is_refused(project: Pytester) -> None:
    tests = """
import unittest

class TestOld(unittest.TestCase):
    @pytest.mark.aftbed(**SUM)
    def test_it(self): ...
"""
    result = run(project, tests)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*::test_it: the marker aftbed is for functions, and methods of plain*"])


def test_the_runtime_of_the_command_line_is_taken(project: Pytester) -> None:
    """The real run is refused here, for its record is there already: none is started."""
    marker = "@pytest.mark.aftbed(**SUM, record='.')\ndef test_it(): ..."
    real = run(project, marker, "--aftbed-runtime=unix")
    real.stdout.fnmatch_lines(["aftbed: --record *: exists already*"])
    run(project, marker).stdout.fnmatch_lines(["*record: a simulated run leaves none*"])


def test_marker_and_option_are_explained(project: Pytester) -> None:
    run(project, "", "--markers").stdout.fnmatch_lines(["@pytest.mark.aftbed(app=..., requests=...*"])
    run(project, "", "--help").stdout.fnmatch_lines(["*--aftbed-runtime={sim,unix}"])


def test_the_arguments_of_the_marker_are_those_of_a_run() -> None:
    assert tuple(inspect.signature(aftbed.run).parameters) == pytest_plugin.RUN_KEYS


def test_the_plugin_costs_nothing_where_it_is_not_used() -> None:
    code = "import sys, pytest; before = set(sys.modules); import aftbed.pytest_plugin"
    code += "; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["aftbed", "aftbed.pytest_plugin"]
