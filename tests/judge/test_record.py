"""Records: what is read as one, and what is none."""

import re
from pathlib import Path

import msgspec
import pytest
from records import CAR, whole

from aftbed.core.errors import ConfigError
from aftbed.core.journal import Stored
from aftbed.judge import record as judged
from aftbed.judge.record import read_record
from aftbed.judge.verdict import judge
from aftbed.runtime.unix.journal_files import DialogueFile


def test_several_incarnations_of_the_client_are_one_dialogue(path: Path) -> None:
    """In the order of their numbers, not of their names: 10 comes after 9."""
    record = whole(path)
    for incarnation in range(2, 11):
        record._dialogue = DialogueFile(path / "journal" / f"client.{incarnation}.dialogue", "client")
        record.request()
    verdict = record.verdict()
    assert verdict.verdict == "pass" and verdict.requests.sent == 12


def test_a_record_that_is_too_long_for_memory_is_judged_like_a_short_one(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a failover, a reply that is wrong, one that is doubled, and one that is lost."""
    record = whole(path)
    record.failover()
    record.request(epoch=2, replica=2, flipped_bit=8)
    record.request(epoch=2, replica=2, answers=2)
    record.request(epoch=2, replica=2, answers=0)
    short = record.verdict()
    assert (short.requests.lost, short.requests.duplicated, short.requests.wrong) == (1, 1, 1)
    assert len(short.failovers) == 1 and short.verdict == "fail"
    monkeypatch.setattr(judged, "IN_MEMORY_MAX", 0)
    long = read_record(path)
    assert isinstance(long.history.dialogue, Stored)
    assert judge(long) == short
    assert read_record(path, in_memory=True).history == long.history.in_memory()


def test_what_a_full_dialogue_has_not_seen_is_not_asked_of_a_long_record(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = whole(path)
    record.request(answers=0)
    record.lose("client.1.dialogue", 1)
    short = record.verdict()
    assert (
        short.requests.lost == 0 and "whole_history: 1 records found no room in the journals" in short.reasons
    )
    monkeypatch.setattr(judged, "IN_MEMORY_MAX", 0)
    assert judge(read_record(path)) == short


def test_what_a_run_verifies_is_in_its_verdict_again(path: Path) -> None:
    record = whole(path)
    record.options = msgspec.structs.replace(
        record.options, verifies=("SG-1",), ftti_ms=60.0, command="aftbed run", code="0.1.0+0badc0de"
    )
    verdict = record.verdict()
    assert (verdict.verifies, verdict.ftti_ms) == (("SG-1",), 60.0)
    assert (verdict.command, verdict.code) == ("aftbed run", "0.1.0+0badc0de")


def test_a_requirement_that_is_none_is_refused_in_a_record(path: Path) -> None:
    record = whole(path)
    record.options = msgspec.structs.replace(record.options, verifies=("SG-1", "SG\x012"))
    with pytest.raises(ConfigError, match=r"run\.json: verifies\[1\]: found 'SG\\x012', allowed is an id"):
        record.verdict()


def test_a_directory_that_is_no_record(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"run\.json: No such file or directory; is this the record of a run\?"
    ):
        read_record(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        ("{}", "not the options of a run: "),
        ('{"run": 1}', "not the options of a run: "),
    ],
)
def test_a_run_json_that_is_none(path: Path, text: str, message: str) -> None:
    record = whole(path)
    record.verdict()
    (path / "run.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"run\.json: {message}"):
        read_record(path)


@pytest.mark.parametrize("name", ["a.server.1.journal", "client.1.dialogue"])
def test_a_journal_that_is_none(path: Path, name: str) -> None:
    whole(path).verdict()
    (path / "journal" / name).write_bytes(b"garbage")
    with pytest.raises(ConfigError, match=rf"{name}: not a journal \(7 bytes, begins with [0-9a-f]+\)"):
        read_record(path)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("adaptations.jsonl", '{"outcome": 5}\n', "adaptations.jsonl: line 1: "),
        ("adaptations.jsonl", "[]\n", "adaptations.jsonl: line 1: "),
        ("end.json", '{"result": {"result": 5}}', "end.json: not the result of a drive: "),
        ("end.json", '{"result": {}}', "end.json: not the result of a drive: "),
    ],
)
def test_what_is_json_and_not_of_a_run_is_refused(path: Path, name: str, text: str, words: str) -> None:
    whole(path, CAR).verdict()
    (path / name).write_text(text)
    with pytest.raises(ConfigError, match=re.escape(words)):
        read_record(path)
