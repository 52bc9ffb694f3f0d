"""`aftbed.run`, `aftbed.explore_crashes` in the simulator; for real runs: tests/process/test_api_live.py."""

import shlex
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import called, repeated
from counting_function import REPLIES, REQUESTS, Drawn, Forgetful, Raises, Sum, Worn

import aftbed
import aftbed.api
from aftbed.functions.request_file import read_requests

pytestmark = pytest.mark.simulation

CRASH = "crash primary at server.exit nth 7"
HERE = Path(__file__).resolve().parent


def test_a_run_without_a_fault_passes() -> None:
    report = aftbed.run(Sum, REQUESTS)
    assert (report.verdict, report.reasons) == ("pass", ())
    assert (report.requests.sent, report.requests.answered, report.requests.wrong) == (30, 30, 0)
    assert (report.failovers, report.adaptations, report.faults, report.record) == ((), (), (), None)
    assert report.checks["one_history"] == "pass"


def test_a_crash_is_masked_and_has_its_receipt() -> None:
    report = aftbed.run(Sum, REQUESTS, inject=CRASH)
    assert report.verdict == "pass"
    assert [(one.fault, one.receipt.value) for one in report.faults] == [(CRASH, "activated")]
    assert len(report.failovers) == 1


def test_a_function_whose_state_is_lost_fails_and_says_why() -> None:
    report = aftbed.run(Forgetful, REQUESTS, inject=[CRASH])
    assert report.verdict == "fail"
    assert any("one_history" in reason for reason in report.reasons)
    assert report.requests.wrong > 0
    assert "verdict: fail\n  because    one_history" in str(report)
    assert report.command in str(report)


def test_a_function_that_breaks_is_a_failure_of_its_replicas() -> None:
    report = aftbed.run(Raises, REQUESTS)
    assert report.verdict == "fail"
    assert {one.partition(": ")[0] for one in report.failures} == {"a/server", "b/server"}
    why = "Raises: ZeroDivisionError: the seventh request ("
    assert all(why in one for one in report.failures)
    assert why in str(report)


@pytest.mark.process
def test_the_command_of_a_report_repeats_its_run() -> None:
    report = aftbed.run(Forgetful, REQUESTS, inject=CRASH, seed=5, count=20)
    done = repeated(report.command)
    assert done.returncode == 1, done.stderr
    assert "20 sent" in done.stdout and f"  fault      {CRASH}: activated" in done.stdout
    assert f"{report.requests.wrong} wrong" in done.stdout


def test_what_did_not_happen_is_inconclusive() -> None:
    report = aftbed.run(Sum, REQUESTS, inject="crash primary at server.exit nth 31")
    assert report.verdict == "inconclusive"
    assert "never" in " ".join(report.reasons)


def test_a_service_that_faults_struck_down_is_inconclusive() -> None:
    """The simulator excuses it, since a swarm draws such faults; a user's run proves nothing by it."""
    report = aftbed.run(Sum, REQUESTS, ftm="none", inject="crash a/server at server.exit nth 7")
    assert report.verdict == "inconclusive"
    assert report.requests.lost > 0
    assert "requests were answered" in " ".join(report.reasons)


def test_an_adaptation_is_done() -> None:
    report = aftbed.run(Sum, REQUESTS, adapt="switch lfr at request 10")
    assert report.verdict == "pass"
    assert [one.outcome for one in report.adaptations] == ["done"]


def test_an_adaptation_that_is_not_done_is_inconclusive_unless_it_may_fail() -> None:
    crash = "crash primary at server.exit nth 11"
    asked = {"adapt": "switch lfr at request 10", "inject": crash}
    report = aftbed.run(Sum, REQUESTS, **asked)
    assert report.verdict == "inconclusive"
    assert [one.outcome for one in report.adaptations] == ["refused"]
    assert aftbed.run(Sum, REQUESTS, **asked, may_fail=True).verdict == "pass"


def test_an_update_names_its_class_from_the_folder() -> None:
    adapt = "update app to counting_function.py:Sum at request 10"
    report = aftbed.run(Sum, REQUESTS, adapt=adapt, folder=HERE)
    assert report.verdict == "pass"
    assert f"update app to {HERE}/counting_function.py:Sum at request 10" in report.command


def test_expected_replies_are_compared() -> None:
    assert aftbed.run(Sum, REQUESTS, expect=REPLIES).verdict == "pass"
    other = aftbed.run(Sum, REQUESTS, expect=[*REPLIES[:9], b"else", *REPLIES[10:]])
    assert other.verdict == "fail"
    assert any("request 10" in reason for reason in other.reasons)


def test_requests_of_a_file_and_a_function_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "requests.csv").write_text("n:u32\n" + "".join(f"{n}\n" for n in range(1, 31)))
    report = aftbed.run(f"{HERE}/counting_function.py:Sum", "requests.csv", folder=tmp_path, inject=CRASH)
    assert report.verdict == "pass"
    assert f"--requests {tmp_path}/requests.csv" in report.command
    assert "PYTHONPATH" not in report.command


def test_a_bare_server_that_breaks_leaves_the_verdict_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Worn, "executed", 0)
    report = aftbed.run(Worn, REQUESTS, ftm="none")
    assert report.requests.answered == 30
    assert report.verdict == "inconclusive"
    assert "the bare function fails at request 10: Worn: ValueError: worn out" in " ".join(report.reasons)


def test_the_latest_requests_are_kept_and_only_for_this_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(aftbed.api, "KEPT_MAX", 2)
    commands = [aftbed.run(Sum, REQUESTS[:count]).command for count in range(1, 5)]
    place = tmp_path / "aftbed"
    kept = {str(path) for path in (place / "requests").iterdir()}
    assert kept == {word for command in commands[-2:] for word in command.split() if ".csv" in word}
    assert [path.stat().st_mode & 0o077 for path in (place, place / "requests")] == [0, 0]


def test_requests_of_the_same_bytes_are_kept_once() -> None:
    kept = {shlex.split(aftbed.run(Sum, REQUESTS, seed=seed).command)[-3] for seed in range(2)}
    (path,) = kept
    assert read_requests(Path(path)).requests == tuple(REQUESTS)


def test_without_a_place_for_the_requests_there_is_no_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    report = aftbed.run(Sum, REQUESTS)
    assert (report.verdict, report.command) == ("pass", "")
    with pytest.raises(aftbed.ConfigError, match="cannot be written; give a file"):
        aftbed.run(Sum, REQUESTS, runtime="unix")


def test_the_built_in_function_has_requests_of_its_own() -> None:
    report = aftbed.run(inject=CRASH, count=50, rate=1000, ftm="lfr", placement="replica")
    assert (report.verdict, report.requests.sent) == ("pass", 50)


def test_a_run_needs_no_main_thread() -> None:
    found: list[aftbed.RunReport] = []
    thread = threading.Thread(target=lambda: found.append(aftbed.run(Sum, REQUESTS, inject=CRASH)))
    thread.start()
    thread.join(60)
    assert [report.verdict for report in found] == ["pass"]


def _of_a_function() -> type:
    class Local(Sum):
        pass

    return Local


SCRIPT = """
import aftbed, sys

class Echo:
    characteristics = aftbed.Characteristics()
    def execute(self, request): return request
    def capture(self): return b"."
    def restore(self, state): pass

if CALL:
    print(aftbed.run(Echo if "class" in sys.argv else f"{__file__}:Echo", [b"1", b"2"], **OPTIONS).verdict)
"""


def script(tmp_path: Path, call: str, options: str, *words: str) -> subprocess.CompletedProcess[str]:
    path = tmp_path / "echo.py"
    path.write_text(SCRIPT.replace("CALL", call).replace("OPTIONS", options))
    return called(sys.executable, str(path), *words, folder=tmp_path)


def test_the_class_of_a_script_is_simulated_as_it_is(tmp_path: Path) -> None:
    assert script(tmp_path, "True", "{}", "class").stdout == "pass\n"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        pytest.param("{}", (), id="simulated"),
        pytest.param("{'runtime': 'unix'}", ("class",), id="real", marks=pytest.mark.process),
    ],
)
def test_a_module_that_calls_a_run_when_it_is_loaded_has_no_endless_run(
    tmp_path: Path, options: str, words: tuple[str, ...]
) -> None:
    done = script(tmp_path, "True", options, *words)
    assert done.returncode == 1 and done.stdout == ""
    assert 'below `if __name__ == "__main__":`' in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ftm": "pbf"}, "unknown FTM 'pbf'; did you mean 'pbr'?"),
        ({"ftm": 3}, "Expected `str`, got `int` - at `ftm`"),
        ({"placement": "here"}, "unknown placement 'here'"),
        ({"seed": -1}, "--seed -1: 0 to"),
        ({"count": 0}, "--count 0: 1 to 100000 are allowed"),
        ({"rate": -1.0}, "--rate -1.0"),
        ({"runtime": "real"}, "Invalid enum value 'real'"),
        ({"inject": "crash primary at nowhere"}, "unknown event 'nowhere'"),
        ({"inject": 5}, "inject: found 5, a text or a list of texts is allowed"),
        ({"inject": [5]}, "inject: found [5], a text or a list of texts is allowed"),
        ({"inject": "partition radar|brake,gateway for 50ms"}, "there is no bus"),
        ({"adapt": "swap lfr"}, "unknown adaptation 'swap'"),
        ({"adapt": "to lfr at request 99"}, "at request 99: there are 30 requests"),
        ({"record": "here"}, "record: a simulated run leaves none; runtime='unix' does"),
        ({"requests": None, "expect": REPLIES}, "expect: these are replies to requests: give them too"),
        ({"requests": []}, "requests: found none, at least one is required"),
        ({"requests": [7]}, "requests: found '[7]', a path or a list of bytes is allowed"),
        ({"requests": "missing.csv"}, "missing.csv: no such file"),
        ({"requests": [bytes(70_000)]}, "a request of 70000 bytes"),
        ({"expect": REPLIES[:9]}, "9 replies, and 30 requests are sent"),
        ({"app": "missing.py:Sum"}, "missing.py: no such file"),
        ({"app": 7}, "app: found 7, a text, a class or None is allowed"),
        ({"app": int}, "no other process would find it"),
        ({"app": _of_a_function()}, "no other process would find it"),
        ({"app": Drawn, "ftm": "lfr"}, "lfr needs a deterministic function"),
        ({"app": Drawn, "adapt": "switch lfr at request 9"}, "lfr needs a deterministic function"),
    ],
)
def test_what_is_not_allowed_is_said_before_anything_runs(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(aftbed.ConfigError) as found:
        aftbed.run(**{"app": Sum, "requests": REQUESTS, **arguments})  # type: ignore[arg-type]
    assert message in str(found.value)


def test_force_runs_what_does_not_suit() -> None:
    assert aftbed.run(Drawn, REQUESTS, ftm="lfr", force=True).command.endswith("--force")


# -- explore_crashes ------------------------------------------------------------------------------


def test_every_crash_of_a_good_function_is_survived() -> None:
    found = aftbed.explore_crashes(Sum, REQUESTS, ftm="pbr", count=2)
    assert found.broken == ()
    assert found.survived == found.explored > 50


@pytest.mark.process
def test_a_crash_that_loses_the_state_is_found_and_repeated() -> None:
    found = aftbed.explore_crashes(Forgetful, REQUESTS, ftm="pbr", count=2)
    assert found.broken
    one = found.broken[0]
    assert "one_history" in " ".join(one.breaches)
    assert "aftbed explore crash --ftm pbr" in one.command
    done = repeated(one.command)
    assert done.returncode == 1, done.stderr
    assert f"broken: {one.number}: " in done.stdout and "one_history" in done.stdout
    (again,) = aftbed.explore_crashes(Forgetful, REQUESTS, ftm="pbr", count=2, only=one.number).broken
    assert again == one


def test_an_experiment_that_is_none_is_refused() -> None:
    with pytest.raises(aftbed.ConfigError, match="only=100000: there are the experiments 0 to"):
        aftbed.explore_crashes(Sum, REQUESTS, only=100_000, count=1)


# -- the package ----------------------------------------------------------------------------------


def test_the_package_is_as_cheap_as_before() -> None:
    """Each process of a run imports it."""
    code = "import sys; before = set(sys.modules); import aftbed; print(set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "{'aftbed'}\n"


def test_the_package_offers_what_it_names() -> None:
    assert all(getattr(aftbed, name) is not None for name in aftbed.__all__)
    assert set(aftbed.__all__) <= set(dir(aftbed))
    assert (Path(aftbed.__file__).parent / "py.typed").exists()
    with pytest.raises(AttributeError, match="module 'aftbed' has no attribute 'rum'"):
        _ = aftbed.rum  # type: ignore[attr-defined]
