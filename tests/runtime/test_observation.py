"""What a run under a policy observes: the tails of journals, the history, losses and resources."""

import os
from pathlib import Path
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.adapt.policy import Seen
from aftbed.core import journal
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import RECORD, Record
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix.closed_loop import (
    CHUNK_BYTES,
    AdaptationHistory,
    Journals,
    Meter,
    Tail,
    load_policy,
    loss_in,
    policy_names,
)

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
    lines = AdaptationHistory(path)
    assert lines.new() == []
    data = b"".join(msgspec.json.encode(Outcome(n, "x", "drained", "lfr")) + b"\n" for n in (1, 2))
    numbers = []
    for cut in range(len(data) + 1):
        path.write_bytes(data[:cut])
        numbers += [outcome.number for outcome in lines.new()]
    assert numbers == [1, 2]


def test_crash_or_hang() -> None:
    assert loss_in("alarm", "a: crash") == Seen("crash")
    assert loss_in("alarm", "b: hang") == Seen("hang")
    assert loss_in("died", "a/server (pid 7)") is None


def test_only_what_a_rule_names_is_measured(tmp_path: Path) -> None:
    assert Meter(load_policy("value-faults")).values() == {}
    rules = "dwell_s: 5\nrules:\n"
    rules += "  - {when: {resource: cpu_load, above: 0.9}, then: switch pbr}\n"
    rules += "  - {when: {resource: cpus, below: 2}, then: to tr}\n"
    path = tmp_path / "policy.yaml"
    path.write_text(rules)
    meter = Meter(load_policy(str(path)))
    assert meter.values() == {"cpus": float(len(os.sched_getaffinity(0)))}
    load = 2.0
    while not 0 <= load <= 1:
        load = meter.values().get("cpu_load", 2.0)


def test_the_policies_that_are_shipped_are_read() -> None:
    assert "value-faults" in policy_names()
    for name in policy_names():
        assert load_policy(name).rules
