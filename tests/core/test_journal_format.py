"""The journal's format: what was written is read, a torn end is no end of the world, garbage is refused."""

from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import (
    DROPPED_OFFSET,
    ENTRY,
    HEADER_BYTES,
    NAME_BYTES_MAX,
    RECORD,
    Entry,
    EntryKind,
    History,
    JournalsInMemory,
    Record,
    StoredRecords,
    committed,
    dropped,
    entries,
    entries_in,
    header,
    node_name,
    records,
)

u64 = st.integers(0, 2**64 - 1)
some_records = st.lists(st.builds(Record, u64, st.sampled_from(Event), u64, u64, st.just("a/after")))
some_entries = st.lists(
    st.builds(Entry, u64, u64, st.integers(0, 2**16 - 1), st.sampled_from(EntryKind), st.binary(max_size=50))
)


def journal(found: list[Record]) -> bytes:
    parts = [RECORD.pack(r.t_ns, r.request_id, r.detail, 0, r.event.code) for r in found]
    return header("a/after") + b"".join(parts)


def dialogue(found: list[Entry]) -> bytes:
    parts = [ENTRY.pack(e.t_ns, e.request_id, len(e.payload), e.epoch, e.kind) + e.payload for e in found]
    return header("client") + b"".join(parts)


@given(some_records, st.integers(0, 100))
def test_records_are_read_as_written_and_end_where_none_is_committed(found: list[Record], room: int) -> None:
    assert list(records(journal(found) + bytes(room))) == found


@given(some_entries, st.integers(0, 100))
def test_entries_are_read_as_written_and_end_where_none_is_committed(found: list[Entry], room: int) -> None:
    told = [entry for entry in found if entry.kind is not EntryKind.STATE]
    assert list(entries(dialogue(found) + bytes(room))) == told, "states of the Client are no history"


@given(some_entries, st.integers(1, 80))
def test_entries_are_the_same_however_the_file_is_cut_into_parts(found: list[Entry], size: int) -> None:
    data = dialogue(found)[HEADER_BYTES:] + bytes(ENTRY.size)
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    assert list(entries_in(parts)) == found


@given(some_records, st.sets(st.sampled_from(Event)), st.integers(1, 5))
def test_stored_records_are_the_same_as_those_in_memory(
    found: list[Record], wanted: set[Event], size: int
) -> None:
    data = journal(found)[HEADER_BYTES:]
    parts = [data[at : at + size * RECORD.size] for at in range(0, len(data), size * RECORD.size)]
    stored, kept = StoredRecords("a/after", lambda: parts), found
    assert (len(stored), list(stored), stored[1:]) == (len(found), found, found[1:])
    assert not found or (stored[0], stored[-1]) == (found[0], found[-1])
    one, other = History({"a.after.1": stored}, []), History({"a.after.1": kept}, [])
    assert one.events(*wanted) == other.events(*wanted)
    assert list(one.times()) == list(other.times())
    assert one.in_memory() == other


@given(st.lists(some_records, max_size=3), st.sets(st.sampled_from(Event)))
def test_journals_in_memory_are_found_by_event_as_by_a_look_at_all(
    journals: list[list[Record]], wanted: set[Event]
) -> None:
    named = {f"a.after.{number}": found for number, found in enumerate(journals)}
    by_event, looked_through = History(JournalsInMemory(named), []), History(named, [])
    assert by_event.events(*wanted) == looked_through.events(*wanted)
    assert by_event.events(*wanted, *wanted) == looked_through.events(*wanted)


@given(some_records, st.integers(0, 100), st.sampled_from([36, 256, 1 << 16, 1 << 24, 2**32 - 1]))
def test_committed_ends_where_the_records_do_and_refuses_an_unknown_code(
    found: list[Record], room: int, code: int
) -> None:
    data = journal(found)[HEADER_BYTES:]
    assert committed(data + bytes(room), "a", 0) == len(data)
    with pytest.raises(PeerError, match=f"record at byte {7 + len(data)} has the unknown event code {code}"):
        committed(data + RECORD.pack(1, 2, 3, 0, code), "a", 7)


RECORDS: Final = [Record(7, Event.SERVER_EXIT, 1, 2, "a/after"), Record(8, Event.NODE_DIED, 0, 9, "a/after")]
ENTRIES: Final = [Entry(7, 1, 0, EntryKind.SENT, b"what"), Entry(8, 1, 1, EntryKind.ANSWERED, b"that")]


def test_a_journal_cut_at_any_byte_gives_what_was_whole() -> None:
    whole = journal(RECORDS)
    for length in range(HEADER_BYTES, len(whole) + 1):
        expected = RECORDS[: (length - HEADER_BYTES) // RECORD.size]
        assert list(records(whole[:length])) == expected, length


def test_a_record_in_the_making_is_none() -> None:
    """The event's code is written last: whatever else of it is there does not count."""
    whole = journal(RECORDS)
    for written in range(RECORD.size - 4 + 1):
        torn = whole[: HEADER_BYTES + RECORD.size + written].ljust(len(whole), b"\0")
        assert list(records(torn)) == RECORDS[:1], written


def test_the_first_record_without_an_event_ends_the_journal() -> None:
    gap = bytes(RECORD.size)
    assert list(records(journal(RECORDS[:1]) + gap + journal(RECORDS[1:])[HEADER_BYTES:])) == RECORDS[:1]


def test_a_dialogue_cut_at_any_byte_gives_what_was_whole_or_is_refused() -> None:
    whole = dialogue(ENTRIES)
    ends = [HEADER_BYTES, HEADER_BYTES + ENTRY.size + 4, len(whole)]
    for length in range(HEADER_BYTES, len(whole) + 1):
        expected = [e for e, end in zip(ENTRIES, ends[1:], strict=True) if end <= length]
        found = []
        try:
            for entry in entries(whole[:length]):
                found.append(entry)
        except PeerError as error:
            assert "entry at byte" in str(error)
        assert found == expected, length


def test_an_entry_in_the_making_is_none() -> None:
    """The payload is written first and the kind last."""
    whole = dialogue(ENTRIES)
    kind_at = HEADER_BYTES + ENTRY.size - 2
    torn = whole[:kind_at] + b"\0\0" + whole[kind_at + 2 :]
    assert list(entries(torn)) == []


@pytest.mark.parametrize("length", [1, 8, HEADER_BYTES - 1])
def test_a_header_cut_short_is_no_journal(length: int) -> None:
    with pytest.raises(PeerError, match=f"not a journal \\({length} bytes, begins with "):
        list(records(header("a/after")[:length]))
    with pytest.raises(PeerError, match="not a journal"):
        list(entries(header("client")[:length]))


@pytest.mark.parametrize("data", [b"", bytes(HEADER_BYTES), bytes(2 * HEADER_BYTES)])
def test_a_journal_whose_node_died_while_it_made_it_is_empty(data: bytes) -> None:
    assert list(records(data)) == [] and list(entries(data)) == [] and dropped(data) == 0


def test_another_magic_is_no_journal() -> None:
    with pytest.raises(PeerError, match="not a journal"):
        node_name(b"AFTBEDJ9" + header("a/after")[8:])


def test_the_name_of_the_node() -> None:
    for name in ("a/after", "é" * (NAME_BYTES_MAX // 2), ""):
        assert node_name(header(name)) == name
    with pytest.raises(AssertionError):
        header("x" * (NAME_BYTES_MAX + 1))


def test_what_found_no_room_is_counted_in_the_header() -> None:
    data = bytearray(journal(RECORDS))
    assert dropped(bytes(data)) == 0
    data[DROPPED_OFFSET : DROPPED_OFFSET + 4] = b"\xff\xff\xff\xff"
    assert dropped(bytes(data)) == 2**32 - 1
    assert list(records(bytes(data))) == RECORDS
    with pytest.raises(PeerError, match="not a journal"):
        dropped(bytes(data[: HEADER_BYTES - 1]))


@pytest.mark.parametrize("code", [9999, 2**32 - 1])
def test_an_unknown_event_code_is_refused_with_its_place(code: int) -> None:
    data = journal(RECORDS[:1]) + RECORD.pack(1, 2, 3, 0, code)
    with pytest.raises(PeerError, match=f"a/after: record at byte {HEADER_BYTES + RECORD.size} .* {code}"):
        list(records(data))


@pytest.mark.parametrize(("kind", "length"), [(9, 0), (1, 5), (1, 2**32 - 1)])
def test_an_entry_of_no_kind_or_past_the_end_is_refused(kind: int, length: int) -> None:
    data = dialogue(ENTRIES[:1]) + ENTRY.pack(1, 2, length, 3, kind) + b"four"
    with pytest.raises(PeerError, match=f"kind {kind}, {length} bytes"):
        list(entries(data))


@given(st.binary(max_size=300))
def test_garbage_behind_a_header_gives_records_or_a_peer_error(data: bytes) -> None:
    for read in (records, entries):
        try:
            list(read(header("x") + data))
        except PeerError:
            continue


@given(st.binary(min_size=1, max_size=300).filter(lambda data: any(data[:8])))
def test_garbage_is_no_journal(data: bytes) -> None:
    for read in (records, entries):
        with pytest.raises(PeerError):
            list(read(data))
