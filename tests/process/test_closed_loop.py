"""The closed loop: a run under a policy adapts itself, once, and says why; a bad policy starts nothing."""

import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from liveruns import ENDLESS, WAIT_SECONDS_MAX, Command, Done, Home, adapted, aftbed
from sampling import every
from terminal import Terminal

from aftbed.runtime.unix.closed_loop import AdaptationHistory, Proposed, read_proposals

pytestmark = pytest.mark.process

TWO_DIVERGENCES: Final = """\
dwell_s: 1
rules:
  - {when: {event: divergence, count: 2, within_s: 10}, then: compose tr}
"""
LOSS: Final = """\
dwell_s: 60
rules:
  - {when: {event: EVENT, count: 1, within_s: 10}, then: switch lfr}
"""
DIVERGE: Final = (
    *("--inject", "bitflip result in b nth 100"),
    *("--inject", "bitflip result in b nth 160"),
)
LOAD: Final = ("--load", "800@400")  # 2 s, both faults within its first half


def policy(folder: Path, text: str) -> Path:
    path = folder / "policy.yaml"
    path.write_text(text)
    return path


def proposals(done: Done) -> list[Proposed]:
    """Of a run that must have passed."""
    assert done.code == 0, done.out + done.err
    found = done.verdict().proposals
    assert isinstance(found, list)
    return found


# -- real runs


@pytest.mark.parametrize("placement", every(3, ["process", "replica", "single"]))
def test_two_divergences_compose_tr_once(home: Home, tmp_path: Path, placement: str) -> None:
    """It is told as it happens, and stands in the record and in its verdict."""
    options = ("--ftm", "lfr", "--placement", placement, "--record", tmp_path / "record")
    done = aftbed("run", *options, *LOAD, *DIVERGE, "--policy", policy(tmp_path, TWO_DIVERGENCES))
    assert done.code == 0, done.out + done.err
    assert " proposed: compose tr: lfr to lfr+tr (2 divergence within 10 s)\n" in done.out
    assert " proposal: lfr to lfr+tr (2 divergence within 10 s): done, consistent after " in done.out
    assert "\n  proposal   lfr to lfr+tr (2 divergence within 10 s): done" in done.out
    (one,) = proposals(aftbed("check", tmp_path / "record", "--json"))
    assert (one.rule, one.action, one.running, one.target) == ("rules[0]", "compose tr", "lfr", "lfr+tr")
    assert (one.reason, one.outcome, one.why) == ("2 divergence within 10 s", "done", "")
    assert one.consistent_after_ms is not None and 100 < one.consistent_after_ms < 2500
    assert read_proposals(tmp_path / "record") == [one]
    history = AdaptationHistory(tmp_path / "record" / "adaptations.jsonl").new()
    assert [(o.purpose, o.outcome, o.ftm) for o in history] == [("lfr to lfr+tr", "done", "lfr+tr")]


def test_a_policy_that_has_nothing_to_say(home: Home) -> None:
    """It passes, and its verdict says that no condition held."""
    done = aftbed("run", "--load", "200@400", "--policy", "value-faults")
    assert done.code == 0 and "policy_followed pass" in done.out, done.out + done.err
    never = r"^  policy     2 value_fault within 10 s, .*: never held in [1-9]"
    assert re.search(never, done.out, re.MULTILINE)
    assert "  proposal " not in done.out


def test_without_a_policy_the_document_has_no_proposals(home: Home) -> None:
    done = aftbed("run", "--load", "20", "--json")
    assert done.code == 0 and "proposals" not in json.loads(done.out)


@pytest.mark.parametrize(("fault", "event"), every(2, [("hang backup", "hang"), ("crash backup", "crash")]))
def test_a_loss_is_told_by_its_cause(home: Home, tmp_path: Path, fault: str, event: str) -> None:
    path = policy(tmp_path, LOSS.replace("EVENT", event))
    done = aftbed("run", *LOAD, "--inject", f"{fault} after 600ms", "--policy", path, "--json")
    (one,) = proposals(done)
    assert (one.reason, one.target, one.outcome) == (f"1 {event} within 10 s", "lfr", "done")


def test_what_the_run_refuses_is_an_outcome(home: Home, tmp_path: Path) -> None:
    """The function has lost its state access when the second divergence comes, and TR needs it."""
    record, path = tmp_path / "record", policy(tmp_path, TWO_DIVERGENCES)
    with Command("--ftm", "lfr", "--load", f"{ENDLESS}@400", "--policy", path, "--record", record) as command:
        command.started()
        closed = adapted("update", "app", "--to", "aftbed.vehicle.aeb.variants:WithoutStateAccess")
        assert closed.code == 0, closed.out + closed.err
        for nth in (1, 2):
            struck = aftbed("inject", "bitflip result in b")
            assert struck.code == 0, struck.out + struck.err
            command.wait_for_line("bitflip result in b: activated", nth)
        command.wait_for_line(" proposal: ")
        assert aftbed("stop").code == 0
        done = command.done()
    refused = "policy_followed: lfr to lfr+tr (2 divergence within 10 s): refused: "
    assert done.code == 3 and f"\n  because    {refused}" in done.out
    (one,) = read_proposals(record) or ()
    assert one.outcome == "refused" and "tr needs state access" in one.why
    assert one.consistent_after_ms is None


def asking(tmp_path: Path) -> list[str]:
    """A run that asks whether TR is to be composed; its record is in `tmp_path`."""
    path, record = policy(tmp_path, TWO_DIVERGENCES), tmp_path / "record"
    options = ["--ftm", "lfr", *LOAD, *DIVERGE, "--policy", str(path), "--record", str(record)]
    return [sys.executable, "-m", "aftbed", "run", *options, "--approve", "ask"]


def test_a_person_is_asked(home: Home, tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    try:
        with subprocess.Popen(asking(tmp_path), stdin=theirs, stdout=subprocess.PIPE) as run:
            assert run.stdout is not None
            while b"question: compose tr? y or n" not in (line := run.stdout.readline()):
                assert line, "ended without a question"
            os.write(ours, b"y\n")
            rest = run.stdout.read().decode()
            assert run.wait(WAIT_SECONDS_MAX) == 0, rest
    finally:
        os.close(ours)
        os.close(theirs)
    assert [p.outcome for p in read_proposals(tmp_path / "record") or ()] == ["done"]


def test_a_person_is_asked_in_the_view(home: Home, tmp_path: Path) -> None:
    words = asking(tmp_path)
    with Terminal(lambda: os.execv(words[0], words), 100, 40) as terminal:
        terminal.until_shown("compose tr? y or n")
        terminal.type("n")
        assert terminal.code() == 0, terminal.text
    assert [p.outcome for p in read_proposals(tmp_path / "record") or ()] == ["declined"]
