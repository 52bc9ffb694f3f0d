"""What a shell is offered at a TAB; `test_completion_shells.py` presses it in real shells."""

import functools
import socket
from collections.abc import Iterator
from typing import Any, Final

import pytest
import typer
from fakerun import FakeRun, Output
from hypothesis import given
from hypothesis import strategies as st
from liveruns import Home

from aftbed.adapt.commands import VERBS
from aftbed.campaign.spec import shipped
from aftbed.cli.app import app
from aftbed.cli.completer import VALUES, How, Offer, complete
from aftbed.cli.lazy import LazyCommand
from aftbed.ftm.compose import build
from aftbed.runtime.unix import control_client, run_directory
from aftbed.vehicle.replay.map_file import shipped_maps
from aftbed.vehicle.scenarios.library import scenario_names

FOREVER: Final = 3600.0  # s


def offered(*words: str) -> list[str]:
    """The words only."""
    offer = complete(words)
    assert offer.how in (How.WORDS, How.QUOTED)
    return [word for word, _ in offer.words]


@functools.cache  # all modules of commands are imported
def commands() -> list[tuple[str, Any]]:
    """Every command with its path, groups included."""

    def inside(command: Any, path: str) -> Iterator[tuple[str, Any]]:
        command = command.load() if isinstance(command, LazyCommand) else command
        yield path, command
        for name, inner in getattr(command, "commands", {}).items():
            yield from inside(inner, f"{path} {name}".strip())

    return list(inside(typer.main.get_command(app), ""))


# -- commands and options -------------------------------------------------------------------------


def test_every_command_is_offered_and_takes_its_options() -> None:
    for path, command in commands():
        words = path.split()
        inner = [name for name, one in getattr(command, "commands", {}).items() if not one.hidden]
        if inner:
            assert offered(*words, "") == inner, path
        options = [name for one in command.params if one.param_type_name == "option" for name in one.opts]
        assert {*options, "--help"} <= set(offered(*words, "-")), path


def test_each_kind_of_value_belongs_to_an_option_or_an_argument_that_there_is() -> None:
    known = set[str]()
    for path, command in commands():
        for one in command.params:
            name = one.opts[0] if one.param_type_name == "option" else one.name
            known |= {name, f"{path} {name}"}
    assert set(VALUES) - known == set()


def test_a_command_is_offered_with_what_it_does() -> None:
    assert ("stop", "End a live run; its command prints the verdict so far.") in complete(["st"]).words


def test_an_option_that_was_given_is_offered_again_only_if_it_may_be_repeated() -> None:
    line = ("sim", "--seed", "3", "--inject", "crash primary", "--")
    assert "--seed" not in offered(*line) and "--inject" in offered(*line)


def test_a_command_without_arguments_offers_its_options_at_once() -> None:
    assert offered("status", "") == offered("status", "--") != []


@pytest.mark.parametrize("words", [("bogus", ""), ("inject", "bogus", ""), ("run", "--seed", "")])
def test_nothing_is_offered_where_nothing_is_known(words: tuple[str, ...]) -> None:
    assert offered(*words) == []


@given(st.lists(st.text("abr-+=: \"'\\.", max_size=10), min_size=1, max_size=5))
def test_any_words_at_all_have_an_answer(words: list[str]) -> None:
    assert complete(["sim", *words]).how in How


# -- values ---------------------------------------------------------------------------------------


def test_mechanisms_and_behind_a_plus_the_inner_ones_that_compose() -> None:
    assert {"none", "pbr", "lfr", "tr"} <= set(offered("run", "--ftm", ""))
    assert offered("run", "--ftm", "pbr+t") == ["pbr+tr"]
    assert "pbr+lfr" not in offered("run", "--ftm", "pbr+")
    assert "pbr+assert+tr" in offered("run", "--ftm", "pbr+assert+")
    assert offered("run", "--ftm", "pbr")[:2] == ["pbr", "pbr+tr"], "a shell must not end the word here"


def test_several_with_commas() -> None:
    assert "pbr,lfr" in offered("explore", "crash", "--ftm", "pbr,l")
    assert "pbr,pbr" not in offered("explore", "crash", "--ftm", "pbr,p")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("run", "--scenario", ""), scenario_names()),
        (("scenario", "run", ""), scenario_names()),
        (("campaign", "run", ""), shipped()),
        (("run", "--map", ""), shipped_maps()),
        (("scenario", "table", ""), ["ncap", "negative", "r152"]),
        (("inject", "bitflip", "result", "--level", ""), ["value", "memory"]),
        (("run", "--placement", ""), ["process", "replica", "single"]),
        (("scenario", "ftti", "--brake-policy", ""), ["hold", "release", "latch"]),
        (("graph", "--format", ""), ["text", "dot", "mermaid"]),
    ],
)
def test_names(words: tuple[str, ...], names: list[str]) -> None:
    assert offered(*words) == names


def test_a_file_where_no_name_begins_so() -> None:
    assert complete(["run", "--scenario", "./"]).how is How.FILES
    assert complete(["run", "--html", ""]).how is How.FILES
    assert complete(["check", ""]).how is How.FOLDERS


def test_words_that_bash_takes_apart() -> None:
    assert offered("run", "--ftm", "=", "pbr+t") == offered("run", "--ftm", "pbr+t") == ["pbr+tr"]
    assert "none" in offered("run", "--ftm", "=")
    assert "--ftm=pbr+tr" in offered("run", "--ftm=pbr+t")
    assert "m1-60" in offered("scenario", "run", "r152", ":", "m1-6")
    assert "r152:m1-60" in offered("scenario", "run", "r152:m1-6")


# -- words in quotes ------------------------------------------------------------------------------


def test_a_fault_in_quotes_word_by_word() -> None:
    assert offered("run", "--inject", '"crash primary at server.ex') == [
        "crash primary at server.exit nth",
        "crash primary at server.exit when",
    ], "more may follow: a shell must not close the quotes"
    assert "crash primary at follower.notified" not in offered("run", "--inject", '"crash primary at f')
    assert "crash primary at follower.notified" in offered(
        "run", "--ftm", "lfr", "--inject", "'crash primary at f"
    )


def test_a_quote_is_opened_for_a_fault_that_has_not_begun() -> None:
    assert complete(["sim", "--inject", "cra"]) == Offer(How.QUOTED, [('"crash', "")])


def test_fields_are_offered_part_by_part() -> None:
    assert offered("sim", "--inject", '"bitflip s') == ["bitflip state.", "bitflip state"]
    fields = offered("sim", "--inject", '"bitflip state.')
    assert "bitflip state.track0." in fields and "bitflip state.ego_ms" in fields
    assert "bitflip state.track0.range_m" in offered("sim", "--inject", '"bitflip state.track0.')


def test_an_adaptation_in_quotes() -> None:
    assert offered("run", "--adapt", '"') == list(VERBS)
    assert "compose pbr+tr" in offered("run", "--adapt", '"compose ')
    assert "compose lfr+tr" in offered("run", "--ftm", "lfr", "--adapt", '"compose ')
    assert offered("run", "--adapt", '"compose pbr+tr at ') == [
        "compose pbr+tr at request 10",
        "compose pbr+tr at request 120",
    ]
    assert "update tr.after" in offered("run", "--ftm", "pbr+tr", "--adapt", '"update t')


# -- a live run -----------------------------------------------------------------------------------


@pytest.fixture
def live(fake: FakeRun, monkeypatch: pytest.MonkeyPatch) -> FakeRun:
    """A live run of pbr+tr in two nodes, called abc123."""
    monkeypatch.setattr(run_directory, "owned_runs", lambda: ["abc123"])
    fake.graph = build("pbr+tr", "replica")
    return fake


def test_roles_and_nodes_are_those_of_the_live_run(live: FakeRun) -> None:
    found = offered("inject", "crash", "")
    assert {"primary", "backup", "a", "b/watchdog", "hub"} <= set(found) and "a/server" not in found
    assert "vote.compared" in offered("inject", "crash", "primary", "--at", "")
    assert "crash primary at vote.compared nth" in offered("inject", '"crash primary at v')


def test_what_runs_is_adapted(live: FakeRun) -> None:
    assert "pbr+assert+tr" in offered("adapt", "compose", "pbr+a")
    assert all(not name.startswith("pbr") for name in offered("adapt", "switch", ""))
    assert "tr.after" in offered("adapt", "update", "")
    assert offered("stop", "--run", "a") == ["abc123"]


def test_two_live_runs_are_offered_and_neither_is_asked(
    live: FakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_directory, "owned_runs", lambda: ["abc123", "def456"])
    assert offered("status", "--run", "") == ["abc123", "def456"]
    assert "a/server" in offered("inject", "crash", "")
    assert "a/server" not in offered("inject", "--run", "abc", "crash", ""), "an option of a command only"
    assert "a/server" not in offered("inject", "crash", "--run", "abc", "")


@pytest.mark.parametrize("backlog", [0, 8], ids=["busy", "stopped"])
def test_a_run_that_does_not_answer_is_not_waited_for(
    home: Home, backlog: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What asks without saying how long waits here for longer than any test lasts."""
    for module in (control_client, run_directory):
        monkeypatch.setattr(module, "ANSWER_SECONDS_MAX", FOREVER)
    for function in (control_client.ask, control_client.send, control_client.receive, run_directory.connect):
        monkeypatch.setattr(function, "__defaults__", (FOREVER,))
    private = run_directory.free()
    run_directory.make(private)
    others = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        listening.bind(str(private / run_directory.SOCKET_NAME))
        listening.listen(backlog)
        if backlog == 0:  # one waits to be accepted: a further one finds no room
            others.append(run_directory.connect(private))
        try:
            assert offered("inject", "crash", "a/ser") == ["a/server"]
            assert offered("stop", "--run", "") == [private.name]
        finally:
            for other in others:
                other.close()
            run_directory.remove(private)


def test_nothing_is_made_where_there_was_no_run(home: Home) -> None:
    assert offered("stop", "--run", "") == []
    assert list(home.path.iterdir()) == []


# -- the command ----------------------------------------------------------------------------------


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell(output: Output, shell: str) -> None:
    assert "completion answer -- " in output("completion", shell)


def test_the_answer_as_the_scripts_read_it(output: Output) -> None:
    assert output("completion", "answer", "--", "st").splitlines() == [
        "words",
        "status\tShow the state of a live run.",
        "stop\tEnd a live run; its command prints the verdict so far.",
    ]
    assert output("completion", "answer", "--", "--").startswith("words\n--version\t")
