"""The closed loop: a run under a policy adapts itself, once, and says why; a bad policy starts nothing."""

import json
import os
import pty
import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from liveruns import WAIT_SECONDS_MAX, Done, Home, aftbed

from aftbed.adapt.policy import Seen
from aftbed.core import journal
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import RECORD, Record
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix.closedloop import Proposed, load_policy, policy_names, read_proposals
from aftbed.runtime.unix.observation import CHUNK_BYTES, Journals, Lines, Meter, Tail, lost

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
LOAD: Final = ("--load", "1200@400")  # 3 s, both faults within its first one


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


@pytest.mark.parametrize("placement", ["process", "replica", "single"])
def test_two_divergences_compose_tr_once(home: Home, tmp_path: Path, placement: str) -> None:
    options = ("--ftm", "lfr", "--placement", placement, "--record", tmp_path / "record", "--json")
    done = aftbed("run", *options, *LOAD, *DIVERGE, "--policy", policy(tmp_path, TWO_DIVERGENCES))
    (one,) = proposals(done)
    assert (one.rule, one.action, one.running, one.target) == ("rules[0]", "compose tr", "lfr", "lfr+tr")
    assert (one.reason, one.outcome, one.why) == ("2 divergence within 10 s", "done", "")
    assert one.consistent_after_ms is not None and 100 < one.consistent_after_ms < 2500
    assert read_proposals(tmp_path / "record") == [one]
    history = Lines(tmp_path / "record" / "adaptations.jsonl").new()
    assert [(o.purpose, o.outcome, o.ftm) for o in history] == [("lfr to lfr+tr", "done", "lfr+tr")]
    again = aftbed("check", tmp_path / "record", "--json")
    assert json.loads(again.out)["proposals"] == [msgspec.to_builtins(one)]


def test_it_is_told_as_it_happens(home: Home, tmp_path: Path) -> None:
    done = aftbed("run", "--ftm", "lfr", *LOAD, *DIVERGE, "--policy", policy(tmp_path, TWO_DIVERGENCES))
    assert done.code == 0, done.out + done.err
    assert " proposed: compose tr: lfr to lfr+tr (2 divergence within 10 s)\n" in done.out
    assert " proposal: lfr to lfr+tr (2 divergence within 10 s): done, consistent after " in done.out
    assert "\n  proposal   lfr to lfr+tr (2 divergence within 10 s): done" in done.out


def test_a_policy_that_has_nothing_to_say(home: Home) -> None:
    assert proposals(aftbed("run", "--load", "200@400", "--policy", "value-faults", "--json")) == []


def test_without_a_policy_the_document_has_no_proposals(home: Home) -> None:
    done = aftbed("run", "--load", "20", "--json")
    assert done.code == 0 and "proposals" not in json.loads(done.out)


@pytest.mark.parametrize(("fault", "event"), [("crash backup", "crash"), ("hang backup", "hang")])
def test_a_loss_is_told_by_its_cause(home: Home, tmp_path: Path, fault: str, event: str) -> None:
    path = policy(tmp_path, LOSS.replace("EVENT", event))
    done = aftbed("run", *LOAD, "--inject", f"{fault} after 600ms", "--policy", path, "--json")
    (one,) = proposals(done)
    assert (one.reason, one.target, one.outcome) == (f"1 {event} within 10 s", "lfr", "done")


def test_what_the_run_refuses_is_an_outcome(home: Home, tmp_path: Path) -> None:
    """The function has lost its state access meanwhile, and TR needs it."""
    closed = "update app to aftbed.vehicle.aeb.variants:WithoutStateAccess at request 20"
    options = ("--ftm", "lfr", *LOAD, *DIVERGE, "--adapt", closed, "--json")
    (one,) = proposals(aftbed("run", *options, "--policy", policy(tmp_path, TWO_DIVERGENCES)))[:1]
    assert one.outcome == "refused" and "tr needs state access" in one.why
    assert one.consistent_after_ms is None


@pytest.mark.parametrize(("typed", "outcome"), [(b"y\n", "done"), (b"n\n", "declined")])
def test_a_person_is_asked(home: Home, tmp_path: Path, typed: bytes, outcome: str) -> None:
    ours, theirs = pty.openpty()
    path, record = policy(tmp_path, TWO_DIVERGENCES), tmp_path / "record"
    options = ["--ftm", "lfr", *LOAD, *DIVERGE, "--policy", str(path), "--record", str(record)]
    command = [sys.executable, "-m", "aftbed", "run", *options, "--approve", "ask"]
    try:
        with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE) as run:
            assert run.stdout is not None
            while b"question: compose tr? y or n" not in (line := run.stdout.readline()):
                assert line, "ended without a question"
            os.write(ours, typed)
            rest = run.stdout.read().decode()
            assert run.wait(WAIT_SECONDS_MAX) == 0, rest
    finally:
        os.close(ours)
        os.close(theirs)
    assert [p.outcome for p in read_proposals(record) or ()] == [outcome]


# -- refused before anything runs


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
def test_a_bad_policy_starts_nothing(home: Home, tmp_path: Path, text: str, words: str) -> None:
    path = policy(tmp_path, text)
    refused = aftbed("run", *LOAD, "--record", tmp_path / "record", "--policy", path)
    assert refused.code == 2 and refused.out == ""
    assert refused.err.startswith(f"aftbed: error: {path}: ") and words in refused.err
    assert not (tmp_path / "record").exists() and home.left() == []


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
def test_options_that_do_not_go_together(home: Home, arguments: tuple[str, ...], words: str) -> None:
    refused = aftbed("run", *LOAD, *arguments)
    assert refused.code == 2 and refused.out == "" and words in refused.err


def test_the_policies_that_are_shipped_are_read() -> None:
    assert "value-faults" in policy_names()
    for name in policy_names():
        assert load_policy(name).rules


# -- the tail of a journal

EVENTS: Final = (Event.SERVER_EXIT, Event.FOLLOWER_DIVERGED, Event.VOTE_COMPARED)
WRITTEN: Final = [Record(10 + n, EVENTS[n % 3], n, n, "a/after", n % 2) for n in range(6)]


def packed(records: list[Record]) -> bytes:
    whole = [RECORD.pack(r.t_ns, r.request_id, r.detail, r.brick, r.event.code) for r in records]
    return journal.header("a/after") + b"".join(whole)


def seen(path: Path, looks: list[bytes]) -> list[list[Record]]:
    """What each look sees of a file that is first this, then that."""
    tail, found = Tail(path), []
    for data in looks:
        path.write_bytes(data)
        found.append(tail.new())
    return found


@pytest.mark.parametrize("padded", [False, True], ids=["cut", "zeros behind"])
def test_a_record_that_is_cut_anywhere_is_read_once_and_whole(tmp_path: Path, padded: bool) -> None:
    data = packed(WRITTEN)
    for cut in [0, 1, 7, 8, 64, 4095, *range(journal.HEADER_BYTES, len(data) + 1)]:
        rest = bytes(len(data) - cut) if padded else b""
        first, second, third = seen(tmp_path / "j", [data[:cut] + rest, data, data])
        assert first + second == WRITTEN and third == [], cut


@given(cuts=st.lists(st.integers(0, len(packed(WRITTEN)))).map(sorted))
def test_however_often_it_is_looked_at(tmp_path_factory: pytest.TempPathFactory, cuts: list[int]) -> None:
    data, folder = packed(WRITTEN), tmp_path_factory.mktemp("tail")
    looks = seen(folder / "j", [*(data[:cut] for cut in cuts), data])
    assert [record for look in looks for record in look] == WRITTEN


def test_more_than_a_chunk_is_read_at_once(tmp_path: Path) -> None:
    many = [Record(n, Event.SERVER_EXIT, n, 0, "a/after") for n in range(2 * CHUNK_BYTES // RECORD.size)]
    assert [len(look) for look in seen(tmp_path / "j", [packed(many), packed(many)])] == [len(many), 0]


def test_what_is_no_journal_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PeerError, match="not a journal"):
        seen(tmp_path / "j", [b"x" * 5000])


def test_only_journals_that_can_hold_a_symptom_are_read(tmp_path: Path) -> None:
    for name in ("a.after.1", "a.tr.after.1", "a.server.1", "supervisor.1", "b.3", "single.1", "client.1"):
        (tmp_path / f"{name}.journal").write_bytes(packed(WRITTEN[:1]))
    for incarnation in (2, 10):
        (tmp_path / f"a.after.{incarnation}.journal").write_bytes(packed(WRITTEN[:1]))
    journals = Journals(tmp_path)
    assert len(journals.new()) == 5, "of a.after the newest two"
    assert journals.new() == []


def test_half_a_line_of_the_history_waits_for_its_end(tmp_path: Path) -> None:
    path = tmp_path / "adaptations.jsonl"
    lines = Lines(path)
    assert lines.new() == []
    data = b"".join(msgspec.json.encode(Outcome(n, "x", "drained", "lfr")) + b"\n" for n in (1, 2))
    numbers = []
    for cut in range(len(data) + 1):
        path.write_bytes(data[:cut])
        numbers += [outcome.number for outcome in lines.new()]
    assert numbers == [1, 2]


# -- crash or hang, and resources


def test_crash_or_hang() -> None:
    assert lost("alarm", "a: crash") == Seen("crash")
    assert lost("alarm", "b: hang") == Seen("hang")
    assert lost("died", "a/server (pid 7)") is None


def test_only_what_a_rule_names_is_measured(tmp_path: Path) -> None:
    assert Meter(load_policy("value-faults")).values() == {}
    rules = "dwell_s: 5\nrules:\n"
    rules += "  - {when: {resource: cpu_load, above: 0.9}, then: switch pbr}\n"
    rules += "  - {when: {resource: cpus, below: 2}, then: to tr}\n"
    meter = Meter(load_policy(str(policy(tmp_path, rules))))
    assert meter.values() == {"cpus": float(len(os.sched_getaffinity(0)))}
    load = 2.0
    while not 0 <= load <= 1:
        load = meter.values().get("cpu_load", 2.0)
