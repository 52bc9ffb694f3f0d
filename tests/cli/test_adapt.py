"""`aftbed adapt`: what is asked for, what is shown, and what is refused before the run is asked.

The run that the commands speak to is played here; real ones are in `tests/process/test_adapt_cli.py`.
"""

import json
from pathlib import Path

import pytest
from playedrun import CAUTIOUS, CLOSED, OUTCOME, RANDOM, VARIANTS, Call, PlayedRun, Run

from aftbed.adapt.plan import APPLICATION, updated
from aftbed.core.messages import Goal
from aftbed.ftm.compose import build
from aftbed.runtime.unix import ask

# -- what is asked for


@pytest.mark.parametrize(
    ("running", "arguments", "goal"),
    [
        ("pbr", ("to", "lfr+tr"), Goal(expression="lfr+tr")),
        ("pbr", ("switch", "lfr"), Goal(expression="lfr")),
        ("pbr", ("compose", "pbr+tr"), Goal(expression="pbr+tr")),
        ("pbr+tr", ("decompose",), Goal(expression="pbr")),
        ("pbr", ("to", "lfr", "--recipe", "paper"), Goal(expression="lfr", recipe="paper")),
        ("pbr+tr", ("decompose", "--recipe", "paper"), Goal(expression="pbr", recipe="paper")),
        (
            "pbr",
            ("update", "after", "--to", "some.module:After"),
            Goal(part="after", source="some.module:After"),
        ),
        ("pbr", ("update", "app", "--to", CAUTIOUS), Goal(part="app", source=CAUTIOUS)),
    ],
)
def test_a_verb_asks_for_its_goal(
    played: PlayedRun, told: Run, running: str, arguments: tuple[str, ...], goal: Goal
) -> None:
    played.graph = build(running, "process")
    assert told("adapt", *arguments).startswith("run abc123: pbr to lfr: done\n")
    assert played.goals == [goal]
    assert played.seconds == ask.ADAPT_SECONDS_MAX, "an adaptation takes longer than other questions"


def test_a_file_is_named_with_its_whole_path(
    played: PlayedRun, told: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run lives in another directory than the command."""
    (tmp_path / "mine.py").write_text("class Mine: pass\n")
    monkeypatch.chdir(tmp_path)
    told("adapt", "update", "proceed", "--to", "mine.py:Mine")
    assert played.goals == [Goal(part="proceed", source=f"{tmp_path}/mine.py:Mine")]


# -- what is shown


def test_the_outcome_is_shown(played: PlayedRun, told: Run) -> None:
    assert told("adapt", "to", "lfr") == (
        "run abc123: pbr to lfr: done\n"
        "  prepare 12.25 ms, blackout 0.75 ms, total 118.50 ms; 4 of 16 bricks\n"
    )


def test_the_outcome_as_json_is_the_document_of_the_run(played: PlayedRun, told: Run) -> None:
    assert json.loads(told("adapt", "to", "lfr", "--json")) == OUTCOME


def test_what_was_rolled_back_ends_with_code_1(played: PlayedRun, call: Call) -> None:
    played.outcome |= {"outcome": "rolled back", "reason": "b/after died"}
    for options in ((), ("--json",)):
        code, out, _ = call("adapt", "to", "lfr", *options)
        assert code == 1
        assert "rolled back" in out and "b/after died" in out


def test_what_the_run_refuses_ends_with_code_2(played: PlayedRun, refused: Run) -> None:
    played.outcome |= {"outcome": "refused", "reason": "adaptation 2 (pbr to lfr) is under way"}
    assert "adaptation 2 (pbr to lfr) is under way" in refused("adapt", "to", "lfr")
    assert len(played.goals) == 1


def test_what_is_refused_without_a_reason_is_refused_all_the_same(played: PlayedRun, call: Call) -> None:
    played.outcome |= {"outcome": "refused"}
    assert call("adapt", "to", "lfr")[0] == 2


def test_the_history_is_a_line_for_each(played: PlayedRun, told: Run) -> None:
    assert told("adapt", "history").splitlines()[1:] == ["0 adaptations"]
    failed = {"number": 4, "outcome": "rolled back", "reason": "b/after died"}
    played.history = [OUTCOME, OUTCOME | failed]
    head, first, second, count = told("adapt", "history").splitlines()
    assert head.split() == ["#", "ASKED", "PREPARE", "BLACKOUT", "TOTAL", "BRICKS", "RECIPE", "WHAT"]
    assert first == "  3    1.23 s   12.25 ms    0.75 ms  118.50 ms    4/16 drained pbr to lfr: done"
    assert second.endswith("pbr to lfr: rolled back: b/after died")
    assert count == "2 adaptations"
    assert json.loads(told("adapt", "history", "--json")) == {"adaptations": played.history}


# -- what is refused before the run is asked


@pytest.mark.parametrize(
    ("running", "arguments", "words"),
    [
        (
            "pbr",
            ("compose", "lfr+tr"),
            ("lfr is not what runs (pbr): aftbed adapt to lfr+tr, or switch lfr first",),
        ),
        ("pbr", ("switch", "pbr+tr"), ("pbr is the outer mechanism already", "aftbed adapt compose pbr+tr")),
        ("pbr", ("decompose",), ("there is nothing inside pbr",)),
        ("pbr", ("to", "pbr"), ("pbr is what runs already",)),
        ("pbr", ("to", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'", "lfr")),
        ("pbr", ("to", "tr+pbr"), ("innermost (pbr+tr?)",)),
        ("pbr", ("to", "none"), ("an adaptation neither starts nor ends there",)),
        ("none", ("to", "pbr"), ("an adaptation neither starts nor ends there",)),
        ("pbr", ("to", "lfr", "--recipe", "papr"), ("unknown recipe 'papr'", "did you mean 'paper'")),
        (
            "pbr",
            ("update", "proced", "--to", "m:C"),
            ("unknown brick 'proced'", "did you mean 'proceed'", "app"),
        ),
        ("pbr", ("update", "tr.after", "--to", "m:C"), ("unknown brick 'tr.after'",)),
        ("pbr", ("update", "after", "--to", "m"), ("'m' names no class", "FILE.py:CLASS")),
        ("pbr", ("update", "after", "--to", "m:"), ("'m:' names no class",)),
        ("pbr", ("update", "after", "--to", ":C"), ("':C' names no class",)),
        ("pbr", ("update", "after", "--to", "m:C d"), ("'m:C d' names no class",)),
        ("pbr", ("update", "after", "--to", "gone.py:C"), ("gone.py:C", "no such file")),
        ("pbr", ("update", "app", "--to", "no.such.module:C"), ("no.such.module:C: cannot be imported",)),
        ("pbr", ("update", "app", "--to", f"{VARIANTS}:Calm"), ("has no class Calm", "Cautious")),
        (
            "pbr",
            ("update", "app", "--to", "pathlib:Path"),
            ("pathlib:Path is no protected function", "execute"),
        ),
    ],
)
def test_a_wrong_word(
    played: PlayedRun, refused: Run, running: str, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    played.graph = build(running, "process")
    error = refused("adapt", *arguments)
    assert all(word in error for word in words), error
    assert played.goals == []


def test_the_recipe_of_the_paper_is_for_one_brick_per_process(played: PlayedRun, refused: Run) -> None:
    played.graph = build("pbr", "replica")
    assert "placement process, not replica" in refused("adapt", "to", "lfr", "--recipe", "paper")


@pytest.mark.parametrize(
    ("running", "function", "arguments", "reason", "instead"),
    [
        ("pbr", "", ("update", "app", "--to", CLOSED), "pbr needs state access", "lfr, lfr+assert"),
        (
            "lfr",
            "",
            ("update", "app", "--to", RANDOM),
            "lfr needs a deterministic function",
            "pbr, pbr+assert",
        ),
        ("lfr", CLOSED, ("to", "pbr"), "pbr needs state access", "lfr, lfr+assert"),
        ("lfr", CLOSED, ("switch", "pbr+assert"), "pbr needs state access", "lfr, lfr+assert"),
        ("lfr", CLOSED, ("compose", "lfr+tr"), "tr needs state access", "lfr, lfr+assert"),
        ("pbr", RANDOM, ("to", "lfr"), "lfr needs a deterministic function", "pbr, pbr+assert"),
    ],
)
def test_what_does_not_suit_the_function_is_refused_unless_forced(
    played: PlayedRun,
    refused: Run,
    call: Call,
    running: str,
    function: str,
    arguments: tuple[str, ...],
    reason: str,
    instead: str,
) -> None:
    played.graph = updated(build(running, "process"), APPLICATION, function)
    error = refused("adapt", *arguments)
    assert reason in error and f"(consistent: {instead})" in error and "--force" in error
    assert played.goals == []
    code, _, notes = call("adapt", *arguments, "--force")
    assert code == 0 and len(played.goals) == 1
    assert notes.startswith("aftbed: forced: ") and reason in notes


def test_to_take_away_is_not_refused(played: PlayedRun, call: Call) -> None:
    """What is left needs no more than what runs; so it is with a brick."""
    played.graph = updated(build("pbr+tr", "process"), APPLICATION, CLOSED)
    assert call("adapt", "decompose")[::2] == (0, "")
    assert call("adapt", "update", "after", "--to", "m:C")[::2] == (0, "")
    assert len(played.goals) == 2


def test_where_nothing_suits_it_says_so(played: PlayedRun, refused: Run, tmp_path: Path) -> None:
    """Under a mechanism that replicates, with a function that has neither characteristic."""
    (tmp_path / "neither.py").write_text(
        "from aftbed.core.application import Characteristics\n"
        f"from {VARIANTS} import WithoutStateAccess\n"
        "class Neither(WithoutStateAccess):\n"
        "    characteristics = Characteristics(deterministic=False, state_access=False)\n"
    )
    assert "(no consistent FTM)" in refused("adapt", "update", "app", "--to", tmp_path / "neither.py:Neither")


def test_a_function_that_does_not_say_what_it_is(played: PlayedRun, refused: Run, tmp_path: Path) -> None:
    (tmp_path / "mute.py").write_text(
        f"from {VARIANTS} import Cautious\nclass Mute(Cautious):\n    characteristics = 'good'\n"
    )
    error = refused("adapt", "update", "app", "--to", tmp_path / "mute.py:Mute")
    assert "mute.py:Mute: characteristics: found 'good', allowed is Characteristics(...)" in error


def test_what_suits_with_a_reservation_is_done_with_a_note(played: PlayedRun, call: Call) -> None:
    played.graph = build("lfr", "process")
    code, _, notes = call("adapt", "update", "app", "--to", CLOSED)
    assert code == 0
    assert notes == "aftbed: note: lfr without state access: after a failover the survivor stays alone\n"


@pytest.mark.parametrize(
    "arguments",
    [("to", "lfr"), ("decompose",), ("update", "after", "--to", "m:C"), ("history",), ("plan", "lfr")],
)
def test_no_run_is_alive(refused: Run, arguments: tuple[str, ...]) -> None:
    assert "no run is alive; start one with `aftbed run`" in refused("adapt", *arguments)
    assert "--run abcdef: no such run is alive" in refused("adapt", *arguments, "--run", "abcdef")
