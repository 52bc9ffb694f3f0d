"""Journals in mapped files: they grow by chunks, outlive their node, and are read while they are written."""

import os
import signal
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.journal import (
    FLAG_OFFSET,
    HEADER_BYTES,
    PULSE_OFFSET,
    RECORD,
    EntryKind,
    dropped,
    entries,
    node_name,
    records,
)
from aftbed.runtime.unix import journal_files as mapped
from aftbed.runtime.unix.journal_files import CHUNK_BYTES, DialogueFile, JournalFile, JournalHeader

PER_CHUNK: Final = (CHUNK_BYTES - HEADER_BYTES) // RECORD.size


def test_a_new_journal_is_empty_private_and_has_a_name(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    JournalFile(path, "a/after")
    data = path.read_bytes()
    assert node_name(data) == "a/after" and list(records(data)) == []
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_record_is_in_the_file_as_soon_as_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal = JournalFile(path, "a/after")
    journal.write(5, Event.CHECKPOINT_SENT, 7, 9)
    (found,) = records(path.read_bytes())
    assert (found.t_ns, found.event, found.request_id, found.detail) == (5, Event.CHECKPOINT_SENT, 7, 9)
    assert found.node == "a/after"


@pytest.mark.parametrize("count", [PER_CHUNK - 1, PER_CHUNK, PER_CHUNK + 1, 2 * PER_CHUNK + 500])
def test_a_journal_grows_past_a_chunk(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.journal"
    journal = JournalFile(path, "a")
    for number in range(count):
        journal.write(number, Event.SERVER_EXIT, number, 0)
    assert [r.request_id for r in records(path.read_bytes())] == list(range(count))


def test_a_dialogue_grows_past_a_chunk_and_takes_an_entry_larger_than_one(tmp_path: Path) -> None:
    path = tmp_path / "client.dialogue"
    dialogue = DialogueFile(path, "client")
    payloads = [bytes([number]) * (CHUNK_BYTES // 3) for number in range(7)] + [b"", b"x" * (3 * CHUNK_BYTES)]
    for number, payload in enumerate(payloads):
        dialogue.write(number, number, 1, EntryKind.SENT, payload)
    found = list(entries(path.read_bytes()))
    assert [e.payload for e in found] == payloads
    assert {e.kind for e in found} == {EntryKind.SENT}


def test_a_record_that_finds_no_room_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped, "FILE_BYTES_MAX", 2 * CHUNK_BYTES)
    path = tmp_path / "a.journal"
    journal = JournalFile(path, "a")
    for number in range(3 * PER_CHUNK):
        journal.write(number, Event.SERVER_EXIT, number, 0)
    data = path.read_bytes()
    kept = [r.request_id for r in records(data)]
    assert len(data) == 2 * CHUNK_BYTES and kept == list(range(len(kept)))
    assert dropped(data) == 3 * PER_CHUNK - len(kept) > 0


def test_an_entry_that_finds_no_room_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped, "FILE_BYTES_MAX", CHUNK_BYTES)
    path = tmp_path / "client.dialogue"
    dialogue = DialogueFile(path, "client")
    for number in range(5):
        dialogue.write(number, number, 1, EntryKind.SENT, bytes(CHUNK_BYTES // 3))
    data = path.read_bytes()
    assert [e.request_id for e in entries(data)] == [0, 1] and dropped(data) == 3


def test_a_journal_is_made_once(tmp_path: Path) -> None:
    JournalFile(tmp_path / "a.journal", "a")
    with pytest.raises(FileExistsError):
        JournalFile(tmp_path / "a.journal", "a")


def test_what_was_written_outlives_a_kill(tmp_path: Path) -> None:
    """The node dies by SIGKILL right behind its last write; the kernel keeps the pages."""
    path = tmp_path / "a.journal"
    child = os.fork()
    if child == 0:
        journal = JournalFile(path, "a")
        for number in range(1000):
            journal.write(number, Event.REPLY_SENT, number, 0)
        os.kill(os.getpid(), signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert len(list(records(path.read_bytes()))) == 1000


def test_the_header_carries_a_pulse_and_a_flag_between_processes(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal, header = JournalFile(path, "a"), JournalHeader(path)
    assert header.pulse_ns() == 0
    journal.mapping[PULSE_OFFSET : PULSE_OFFSET + 8] = (2**63 + 5).to_bytes(8, "little")
    assert header.pulse_ns() == 2**63 + 5
    assert journal.mapping[FLAG_OFFSET] == 0
    header.announce()
    assert journal.mapping[FLAG_OFFSET] == 1
    journal.write(1, Event.SERVER_EXIT, 1, 0)
    assert header.pulse_ns() == 2**63 + 5, "records do not touch the header"
    header.close()


def test_the_header_is_still_seen_after_the_journal_has_grown(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal, header = JournalFile(path, "a"), JournalHeader(path)
    for number in range(PER_CHUNK + 1):
        journal.write(number, Event.SERVER_EXIT, number, 0)
    journal.mapping[PULSE_OFFSET] = 7
    header.announce()
    assert header.pulse_ns() == 7 and journal.mapping[FLAG_OFFSET] == 1
    header.close()
