"""The journal: what each node did, as fixed-size records in a mapping that survives the node.

Layout of a journal file: one header page, then records of 32 bytes, little endian. A record is
committed by its event code, which is written last; the first record without one ends the journal.
So a `kill -9` loses at most the record in the making. The header also holds the node's activity (whether
its host waits or executes bricks), the flag by which the runtime announces control mail, and a lock that
dies with the node.

The client keeps a *dialogue* beside it: every request with its bytes, every reply with its bytes, in
the order in which they happened. It is what G2 and G3 are judged by. Now and then it writes its own state
among them, and into the header where that is: a successor goes on from there, and so begins as fast after a
million requests as after the first.
"""

import functools
import itertools
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Final, TypeVar, overload

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.events import BY_CODE, Event

MAGIC: Final = b"AFTBEDJ1"
HEADER_BYTES: Final = 4096
ACTIVITY_OFFSET: Final = 8  # u8, even: the host waits, odd: it executes; another value each time
FLAG_OFFSET: Final = 16  # u8, not 0: control mail waits
DROPPED_OFFSET: Final = 24  # u32, records that found no room
LIFELINE_OFFSET: Final = 32  # u32, a futex that the node holds
STATE_OFFSET: Final = 40  # u64, of a dialogue: where the last state of its Client begins, 0: nowhere
NAME_OFFSET: Final = 64  # u8 length, then UTF-8
NAME_BYTES_MAX: Final = 120

RECORD: Final = struct.Struct("<QQQII")  # time ns, request id, detail, brick, event code
ENTRY: Final = struct.Struct("<QQIHH")  # time ns, request id, payload length, epoch, kind

Kept = TypeVar("Kept")


class Record(msgspec.Struct, frozen=True, gc=False):
    """One event of one node; `t_ns` is monotonic and common to all nodes of a host.

    `brick` tells the bricks of a node apart: 0 for the first that it hosts, 1 for the next.
    """

    t_ns: int
    event: Event
    request_id: int
    detail: int
    node: str
    brick: int = 0


class EntryKind(IntEnum):
    """What an entry of a dialogue is about."""

    SENT = 1
    ANSWERED = 2
    STATE = 3  # of the Client, from which its successor goes on; no part of the history


class Entry(msgspec.Struct, frozen=True, gc=False):
    """A request that was sent, or a reply that was delivered, with its bytes."""

    t_ns: int
    request_id: int
    epoch: int
    kind: EntryKind
    payload: bytes


class Stored(Sequence[Kept]):
    """What is too long to be kept in memory: `read` gives it from the first on, as often as it is asked."""

    def __init__(self, read: Callable[[], Iterable[Kept]]) -> None:
        self._read, self._count = read, sum(1 for _ in read())

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Kept]:
        return iter(self._read())

    @overload
    def __getitem__(self, index: int) -> Kept: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Kept]: ...
    def __getitem__(self, index: int | slice) -> Kept | Sequence[Kept]:
        """Reads all that is before it."""
        if isinstance(index, slice):
            return list(self)[index]
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return next(itertools.islice(self, index % self._count, None))


class StoredRecords(Stored[Record]):
    """The records of a journal; `parts` gives them packed, as `committed` has checked them."""

    def __init__(self, node: str, parts: Callable[[], Iterable[bytes]]) -> None:
        self._node, self._parts = node, parts
        self._read, self._count = functools.partial(self.of, *Event), sum(map(len, parts())) // RECORD.size

    def of(self, *wanted: Event) -> Iterator[Record]:
        """Those of these events; what is not wanted costs almost nothing."""
        if not wanted:
            return
        codes = re.compile(b"[" + re.escape(bytes(event.code for event in wanted)) + b"]")
        for part in self._parts():
            for match in codes.finditer(part[_CODE_AT :: RECORD.size]):
                t_ns, request_id, detail, brick, code = RECORD.unpack_from(part, match.start() * RECORD.size)
                yield Record(t_ns, BY_CODE[code], request_id, detail, self._node, brick)

    def times(self) -> Iterator[int]:
        """Of all records (ns)."""
        return (t_ns for part in self._parts() for (t_ns,) in _TIME.iter_unpack(part))


class JournalsInMemory(dict[str, Sequence[Record]]):
    """The journals of a run that has ended; their records are found by event without a look at the others."""

    @functools.cached_property
    def _by_time(self) -> list[Record]:
        return sorted(itertools.chain.from_iterable(self.values()), key=lambda record: record.t_ns)

    @functools.cached_property
    def _positions(self) -> dict[Event, list[int]]:
        """Of each event, in the order of time."""
        found: dict[Event, list[int]] = {}
        for at, record in enumerate(self._by_time):
            found.setdefault(record.event, []).append(at)
        return found

    def events(self, *wanted: Event) -> list[Record]:
        """The records of these events, of all nodes, by time."""
        found = [self._positions[event] for event in dict.fromkeys(wanted) if event in self._positions]
        at = found[0] if len(found) == 1 else sorted(itertools.chain.from_iterable(found))
        return [self._by_time[position] for position in at]


class History(msgspec.Struct, frozen=True):
    """What a run leaves behind: the records of all its nodes, by journal, and the dialogue of its client.

    Real processes and the simulator produce the same type, so one judge reads both.
    """

    journals: Mapping[str, Sequence[Record]]
    dialogue: Sequence[Entry]
    dropped: int = 0  # records that found no room, whose content is not known

    def events(self, *wanted: Event) -> list[Record]:
        """The records of these events, of all nodes, by time."""
        if isinstance(self.journals, JournalsInMemory):
            return self.journals.events(*wanted)
        found = [record for name in self.journals for record in self.events_of(name, *wanted)]
        return sorted(found, key=lambda record: record.t_ns)

    def events_of(self, journal: str, *wanted: Event) -> Iterator[Record]:
        """The records of these events in one journal, as they stand there."""
        found = self.journals[journal]
        if isinstance(found, StoredRecords):
            return found.of(*wanted)
        return (record for record in found if record.event in wanted)

    def in_memory(self) -> "History":
        """The same, kept."""
        journals = {name: list(found) for name, found in self.journals.items()}
        return History(JournalsInMemory(journals), list(self.dialogue), self.dropped)

    def times(self) -> Iterator[int]:
        """Of all records and entries (ns)."""
        for found in self.journals.values():
            yield from found.times() if isinstance(found, StoredRecords) else (one.t_ns for one in found)
        yield from (entry.t_ns for entry in self.dialogue)


Data = bytes | memoryview  # of a whole file, or of its beginning
_KINDS: Final = {kind.value: kind for kind in EntryKind}
_CODES: Final = bytes(BY_CODE)  # each is less than 256
_CODE_AT: Final = RECORD.size - 4  # little endian: its lowest byte comes first
_TIME: Final = struct.Struct(f"<Q{RECORD.size - 8}x")


def header(node: str) -> bytes:
    """The first page of the journal of `node`."""
    name = node.encode()
    assert len(name) <= NAME_BYTES_MAX, node
    return (MAGIC.ljust(NAME_OFFSET, b"\0") + bytes((len(name),)) + name).ljust(HEADER_BYTES, b"\0")


def node_name(data: Data) -> str:
    """Whose journal this is. Raises PeerError if it is none."""
    if len(data) < HEADER_BYTES or data[: len(MAGIC)] != MAGIC:
        raise PeerError(f"not a journal ({len(data)} bytes, begins with {bytes(data[: len(MAGIC)]).hex()})")
    length = data[NAME_OFFSET]
    return bytes(data[NAME_OFFSET + 1 : NAME_OFFSET + 1 + length]).decode(errors="replace")


def unfinished(data: Data) -> bool:
    """A journal whose node died while it made it: empty, or not yet with a header."""
    return not data or not any(data[: len(MAGIC)])


def dropped(data: Data) -> int:
    """How many records or entries found no room in the file. Raises PeerError if it is no journal."""
    if unfinished(data):
        return 0
    node_name(data)
    return int.from_bytes(data[DROPPED_OFFSET : DROPPED_OFFSET + 4], "little")


def records(data: Data) -> Iterator[Record]:
    """The committed records of a journal. Raises PeerError on what is no journal or has no such event."""
    if unfinished(data):
        return
    node = node_name(data)
    for at in range(HEADER_BYTES, len(data) - RECORD.size + 1, RECORD.size):
        t_ns, request_id, detail, brick, code = RECORD.unpack_from(data, at)
        if code == 0:
            return
        event = BY_CODE.get(code)
        if event is None:
            raise PeerError(f"{node}: record at byte {at} has the unknown event code {code}")
        yield Record(t_ns, event, request_id, detail, node, brick)


def committed(data: bytes, node: str, at: int) -> int:
    """How many bytes of `data`, which stands at byte `at` of a journal, are committed records.

    Raises PeerError on a record that has no such event.
    """
    count = len(data) // RECORD.size
    for place, allowed in ((0, _CODES), (1, b"\0"), (2, b"\0"), (3, b"\0")):
        found = data[_CODE_AT + place :: RECORD.size][:count]
        count = len(found) - len(found.lstrip(allowed))
    end = count * RECORD.size
    if end + RECORD.size <= len(data):
        *_, code = RECORD.unpack_from(data, end)
        if code:
            raise PeerError(f"{node}: record at byte {at + end} has the unknown event code {code}")
    return end


def entries(data: Data) -> Iterator[Entry]:
    """The committed requests and replies of a dialogue. Raises PeerError on a malformed entry."""
    if unfinished(data):
        return
    node_name(data)
    yield from requests_and_replies(entries_in((data[HEADER_BYTES:],)))


def requests_and_replies(found: Iterable[Entry]) -> Iterator[Entry]:
    """Without the states of the Client."""
    return (entry for entry in found if entry.kind is not EntryKind.STATE)


def state_at(data: Data) -> int:
    """Where the last state in a dialogue begins, by its header; 0: it has none. Raises PeerError."""
    if unfinished(data):
        return 0
    node_name(data)
    return int.from_bytes(data[STATE_OFFSET : STATE_OFFSET + 8], "little")


def entries_in(parts: Iterable[Data], begin: int = HEADER_BYTES) -> Iterator[Entry]:
    """All committed entries of a dialogue from byte `begin` on, where one begins; `parts` may cut them.

    Raises PeerError on a malformed one.
    """
    size, unpack_from = ENTRY.size, ENTRY.unpack_from
    data, at = bytearray(), 0
    for part in parts:
        del data[:at]
        data += part
        begin, at = begin + at, 0
        there = len(data)
        while (start := at + size) <= there:
            t_ns, request_id, length, epoch, number = unpack_from(data, at)
            kind = _KINDS.get(number)
            if kind is None:
                if number:
                    raise PeerError(f"entry at byte {begin + at}: kind {number}, {length} bytes")
                return
            if start + length > there:
                break
            at = start + length
            yield Entry(t_ns, request_id, epoch, kind, bytes(data[start:at]))
    if at + size <= len(data):
        raise PeerError(f"entry at byte {begin + at}: kind {number}, {length} bytes: longer than the file")
