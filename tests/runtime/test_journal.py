"""Journals in mapped files: they grow by chunks, outlive their node, and are read while they are written."""

import os
import re
import signal
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.journal import (
    ACTIVITY_OFFSET,
    ENTRY,
    FLAG_OFFSET,
    HEADER_BYTES,
    RECORD,
    EntryKind,
    dropped,
    entries,
    node_name,
    records,
)
from aftbed.core.messages import Request
from aftbed.ftm.client import Client
from aftbed.runtime.devices import resume_client
from aftbed.runtime.unix import journal_files as mapped
from aftbed.runtime.unix.journal_files import (
    CHUNK_BYTES,
    STATE_EVERY_BYTES,
    STATE_SHARE_MAX,
    DialogueFile,
    JournalFile,
    JournalHeader,
    dialogue_path,
    last_words,
    trim,
)

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


def resident(path: Path) -> int:
    """How many bytes of the file this process has in its memory."""
    text = Path("/proc/self/smaps").read_text()
    sizes = re.findall(rf"{re.escape(str(path))}\n.*?^Rss: +(\d+) kB", text, re.DOTALL | re.MULTILINE)
    assert sizes
    return 1024 * sum(map(int, sizes))


def test_memory_does_not_grow_with_the_journal(tmp_path: Path) -> None:
    path, other = tmp_path / "a.journal", tmp_path / "client.1.dialogue"
    journal, dialogue = JournalFile(path, "a"), DialogueFile(other, "client")
    for number in range(4 * PER_CHUNK):
        journal.write(number, Event.SERVER_EXIT, number, 0)
    for number in range(400):
        dialogue.write(number, number, 1, EntryKind.SENT, bytes(CHUNK_BYTES // 100))
    assert path.stat().st_size >= 4 * CHUNK_BYTES <= other.stat().st_size
    assert resident(path) <= CHUNK_BYTES + HEADER_BYTES >= resident(other)
    assert len(list(records(path.read_bytes()))) == 4 * PER_CHUNK
    assert len(list(entries(other.read_bytes()))) == 400


def test_the_journals_of_a_run_that_has_ended_are_cut_to_what_is_in_them(tmp_path: Path) -> None:
    counts = {"a.1": 5, "b.1": PER_CHUNK + 1, "c.1": 0}
    for name, count in counts.items():
        journal = JournalFile(tmp_path / f"{name}.journal", name)
        for number in range(count):
            journal.write(number, Event.SERVER_EXIT, number, 0)
    (tmp_path / "died.1.journal").write_bytes(b"")
    (tmp_path / "strange.1.journal").write_bytes(b"no journal")
    trim(tmp_path)
    for name, count in counts.items():
        data = (tmp_path / f"{name}.journal").read_bytes()
        assert len(data) == HEADER_BYTES + count * RECORD.size
        assert [r.request_id for r in records(data)] == list(range(count))
    assert (tmp_path / "strange.1.journal").read_bytes() == b"no journal"


def client_of(next_id: int, *waiting: int) -> bytes:
    client = Client()
    client.next_id, client.unanswered = next_id, {n: Request(0, n, b"%d" % n) for n in waiting}
    return client.capture()


def serve(dialogue: DialogueFile, first: int, last: int) -> None:
    """Requests that are answered, as a device writes them."""
    for number in range(first, last + 1):
        dialogue.keep(number, lambda n=number: client_of(n))
        dialogue.write(number, number, 0, EntryKind.SENT, b"request")
        dialogue.write(number, number, 1, EntryKind.ANSWERED, b"reply")


def resumed(folder: Path, incarnation: int) -> tuple[int, list[int]]:
    """From which request on a Client goes on, and which it asks for again."""
    client, (state, since) = Client(), last_words(folder, incarnation)
    resume_client(client, since, state)
    return client.next_id, list(client.unanswered)


def test_a_successor_reads_as_little_after_many_requests_as_after_few(tmp_path: Path) -> None:
    dialogue = DialogueFile(dialogue_path(tmp_path, 1), "client")
    serve(dialogue, 1, 20_000)
    dialogue.write(20_001, 20_001, 0, EntryKind.SENT, b"unanswered")
    assert resumed(tmp_path, 2) == (20_002, [20_001])
    most = STATE_EVERY_BYTES // ENTRY.size
    assert len(last_words(tmp_path, 2)[1]) <= most < 20_000
    assert len(list(entries(dialogue_path(tmp_path, 1).read_bytes()))) == 40_001, "the judge has them all"


def test_large_states_take_a_small_share_of_a_dialogue(tmp_path: Path) -> None:
    """As many requests wait as a Client may have."""
    dialogue, states = DialogueFile(dialogue_path(tmp_path, 1), "client"), 0

    def capture() -> bytes:
        nonlocal states
        states += 1
        return bytes(2 * STATE_EVERY_BYTES)

    for number in range(10_000):
        dialogue.keep(number, capture)
        dialogue.write(number, number, 0, EntryKind.SENT, bytes(50))
    between = 10_000 * (ENTRY.size + 50)
    assert 2 <= states <= 1 + STATE_SHARE_MAX * between / (2 * STATE_EVERY_BYTES)


def test_a_successor_goes_on_from_predecessors_that_have_kept_no_state(tmp_path: Path) -> None:
    """The third takes a reply for the first and sends nothing; the second and the fourth leave nothing."""
    first, third = (DialogueFile(dialogue_path(tmp_path, n), "client") for n in (1, 3))
    dialogue_path(tmp_path, 4).write_bytes(b"")  # it died while it made it
    serve(first, 1, 5)
    for number in (6, 7):
        first.write(number, number, 0, EntryKind.SENT, b"request")
    third.write(8, 6, 1, EntryKind.ANSWERED, b"reply")
    assert resumed(tmp_path, 5) == (8, [7])
    assert resumed(tmp_path, 1) == (1, [])


def test_a_state_has_what_waited(tmp_path: Path) -> None:
    first, second = (DialogueFile(dialogue_path(tmp_path, n), "client") for n in (1, 2))
    serve(first, 1, 5)
    second.keep(9, lambda: client_of(9, 7, 8))
    second.write(9, 9, 0, EntryKind.SENT, b"request")
    second.write(10, 7, 1, EntryKind.ANSWERED, b"reply")
    assert resumed(tmp_path, 3) == (10, [8, 9])


def test_a_state_that_finds_no_room_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped, "FILE_BYTES_MAX", CHUNK_BYTES)
    dialogue = DialogueFile(dialogue_path(tmp_path, 1), "client")
    serve(dialogue, 1, 3)
    dialogue.write(4, 4, 0, EntryKind.SENT, bytes(CHUNK_BYTES - STATE_EVERY_BYTES // 2))
    dialogue.keep(5, lambda: bytes(STATE_EVERY_BYTES))
    assert resumed(tmp_path, 2) == (5, [4])


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


def test_the_header_carries_activity_and_a_flag_between_processes(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal, header = JournalFile(path, "a"), JournalHeader(path)
    assert header.activity() == 0
    journal.mapping[ACTIVITY_OFFSET] = 255
    assert header.activity() == 255
    assert journal.mapping[FLAG_OFFSET] == 0
    header.announce()
    assert journal.mapping[FLAG_OFFSET] == 1
    journal.write(1, Event.SERVER_EXIT, 1, 0)
    assert header.activity() == 255, "records do not touch the header"
    header.close()


def test_the_header_is_still_seen_after_the_journal_has_grown(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal, header = JournalFile(path, "a"), JournalHeader(path)
    for number in range(PER_CHUNK + 1):
        journal.write(number, Event.SERVER_EXIT, number, 0)
    journal.mapping[ACTIVITY_OFFSET] = 7
    header.announce()
    assert header.activity() == 7 and journal.mapping[FLAG_OFFSET] == 1
    header.close()
