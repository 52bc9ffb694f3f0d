"""`aftbed run`: what is refused before the run starts, what an adaptation begins from, and its options."""

import socket
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from fakerun import CLOSED, Output
from liveruns import Home

from aftbed.cli import main, run
from aftbed.cli.adapt import scheduled
from aftbed.core.errors import ConfigError
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.compose import build
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.options import RunOptions
from aftbed.vehicle.scenarios.scenario import Scenario


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("--adapt", "compose lfr+tr at request 120"),
            ("--adapt 'compose lfr+tr at request 120'", "switch lfr"),
        ),
        (("--adapt", "to lfr at 5"), ("--adapt 'to lfr at 5'", "'at request N'")),
        (("--adapt", ""), ("--adapt ''", "expected")),
        (("--adapt", "too lfr"), ("unknown adaptation 'too'", "did you mean 'to'")),
        (("--ftm", "none", "--adapt", "to lfr"), ("neither starts nor ends",)),
        (("--adapt", "update proced to m:C"), ("unknown brick 'proced'",)),
        (("--adapt", "update proceed to gone.py:C"), ("no such file",)),
        (("--adapt", f"update app to {CLOSED}"), ("pbr needs state access", "--force")),
        (("--adapt", "to lfr", "--recipe", "papr"), ("did you mean 'paper'",)),
        (("--adapt", "to lfr", "--recipe", "paper", "--placement", "replica"), ("not replica",)),
        (("--recipe", "paper"), ("--recipe says how", "give --adapt too")),
        (("--force",), ("--force is about --adapt and --app",)),
        (("--may-fail",), ("--adapt and --policy", "give one of them too")),
        (
            ("--adapt", "switch lfr", "--adapt", "switch lfr"),
            ("--adapt 'switch lfr'", "is what runs already"),
        ),
        (
            ("--adapt", "to lfr at request 9", "--adapt", "to pbr at request 8"),
            ("--adapt 'to pbr at request 8'", "begins before the one that stands before it"),
        ),
        (("--adapt", "to lfr after 2s", "--adapt", "to pbr after 1s"), ("begins before the one",)),
        (
            ("--adapt", "to lfr", "--adapt", "to pbr at request 9", "--adapt", "to lfr at request 8"),
            ("--adapt 'to lfr at request 8'", "begins before the one"),
        ),
    ],
)
def test_an_adaptation_of_a_run_is_refused_before_it_starts(
    refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    error = refused("run", "--load", "10", *arguments)
    assert all(word in error for word in words), error


def test_each_adaptation_of_a_run_begins_where_the_one_before_ends() -> None:
    texts = ("switch lfr at request 5", "compose lfr+tr after 2s", "decompose at request 90")
    assert scheduled(texts, build("pbr", "process"), "drained", force=False) == (
        Scheduled(Goal(expression="lfr"), at_request=5),
        Scheduled(Goal(expression="lfr+tr"), after_ms=2000.0),
        Scheduled(Goal(expression="lfr"), at_request=90),
    )


def test_later_adaptations_are_checked_with_the_updated_function() -> None:
    graph = build("lfr", "process")
    texts = (f"update app to {CLOSED} at request 5", "switch pbr at request 9")
    with pytest.raises(ConfigError, match="--adapt 'switch pbr at request 9': pbr is not consistent"):
        scheduled(texts, graph, "drained", force=False)
    assert len(scheduled(texts, graph, "paper", force=True)) == 2


@pytest.fixture
def options_of(home: Home, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RunOptions]:
    """The options of the run that `aftbed run` with these arguments would launch."""
    started: list[RunOptions] = []

    class StartedError(Exception):
        pass

    def launch(options: RunOptions, listener: socket.socket | None, *_: object) -> None:
        started.append(options)
        run_directory.remove(Path(options.private))
        if listener is not None:
            listener.close()
        raise StartedError

    def of(*arguments: str) -> RunOptions:
        monkeypatch.setattr(run, "launch", launch)
        monkeypatch.setattr(sys, "argv", ["aftbed", "run", *arguments])
        with pytest.raises(StartedError):
            main()
        return started[-1]

    return of


def test_the_adaptations_of_a_run_are_among_its_options(options_of: Callable[..., RunOptions]) -> None:
    options = options_of("--load", "10", "--adapt", "to lfr after 1s", "--recipe", "paper")
    assert options.adaptations == (Scheduled(Goal(expression="lfr", recipe="paper"), after_ms=1000.0),)


def test_a_drive_of_another_duration_is_no_evidence_for_the_requirements_of_its_scenario(
    options_of: Callable[..., RunOptions], tmp_path: Path
) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "description: an empty road\nduration_s: 9\nego: {speed_kmh: 50}\n"
        "verifies: [SG-1]\nexpect: {outcome: no_braking}\n"
    )
    whole = options_of("--scenario", str(mine))
    assert whole.verifies == ("SG-1",)
    assert msgspec.msgpack.decode(whole.drive, type=Scenario).duration_ms == 9000
    shorter = options_of("--scenario", str(mine), "--duration", "1500ms", "--verifies", "SG-2")
    assert shorter.verifies == ("SG-2",)
    assert msgspec.msgpack.decode(shorter.drive, type=Scenario).duration_ms == 1500


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--verifies", "SG 1"), "--verifies[0]: found 'SG 1', allowed is an identifier such as SG-1"),
        (("--verifies", "SG-1,SG\x012"), "--verifies[1]: found 'SG\\x012', allowed is an identifier"),
        (("--verifies", "SG-1", "--verifies", "SG-1"), "--verifies[1]: SG-1 stands twice"),
        (("--verifies", ""), "--verifies[0]: found ''"),
        (("--junit", "absent/j.xml"), "--junit absent/j.xml: a file in a directory that exists is allowed"),
        (("--junit", "/"), "--junit /: a file"),
    ],
)
def test_what_is_no_requirement_or_no_file_starts_nothing(
    refused: Output, arguments: tuple[str, ...], words: str
) -> None:
    assert words in refused("run", "--load", "10", *arguments)
    assert words in refused("scenario", "run", "ccrs-20", *arguments)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dwell_s: 5\nrules: []\n", "rules: found 0"),
        ("dwell_s: 5\n", "key 'rules' is missing"),
        (
            "dwell_s: 5\nrules:\n"
            "  - {when: {resource: cpu_load, above: 0.8}, then: switch pbr}\n"
            "  - {when: {resource: cpu_load, below: 0.9}, then: switch lfr}\n",
            "both can hold at once",
        ),
        (
            "dwell_s: 5\nrules:\n  - {when: {resource: traffic_kbit_s, above: 600}, then: switch lfr}\n",
            "found traffic_kbit_s, which no run measures; measured are: cpus, cpu_load",
        ),
    ],
)
def test_a_bad_policy_starts_nothing(refused: Output, tmp_path: Path, text: str, words: str) -> None:
    path, record = tmp_path / "policy.yaml", tmp_path / "record"
    path.write_text(text)
    error = refused("run", "--load", "10", "--record", record, "--policy", path)
    assert error.startswith(f"aftbed: error: {path}: ") and words in error
    assert not record.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--policy", "value-fault"), "did you mean 'value-faults'"),
        (("--policy", "absent.yaml"), "absent.yaml: cannot be read"),
        (("--policy", "value-faults", "--approve", "auto-matic"), "unknown approval"),
        (("--policy", "value-faults", "--approve", "ask"), "standard input is no terminal"),
        (("--policy", "value-faults", "--approve", "ask", "--json"), "--json prints no question"),
        (("--policy", "value-faults", "--ftm", "none"), "none has no Engine"),
        (("--approve", "ask"), "give --policy too"),
    ],
)
def test_options_of_a_policy_that_do_not_go_together(
    refused: Output, arguments: tuple[str, ...], words: str
) -> None:
    assert words in refused("run", "--load", "10", *arguments)
