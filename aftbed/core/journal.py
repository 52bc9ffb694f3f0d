"""The journal: what each node did, as fixed-size records in a mapping that survives the node.

Layout of a journal file: one header page, then records of 32 bytes, little endian. A record is
committed by its event code, which is written last; the first record without one ends the journal.
So a `kill -9` loses at most the record in the making. The header also holds the node's pulse (when
it was last seen running), the flag by which the runtime announces control mail, and a lock that dies
with the node.

The client keeps a *dialogue* beside it: every request with its bytes, every reply with its bytes, in
the order in which they happened. It is what G2 and G3 are judged by.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import Final

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.events import BY_CODE, Event

MAGIC: Final = b"AFTBEDJ1"
HEADER_BYTES: Final = 4096
PULSE_OFFSET: Final = 8  # u64, monotonic ns
FLAG_OFFSET: Final = 16  # u8, not 0: control mail waits
DROPPED_OFFSET: Final = 24  # u32, records that found no room
LIFELINE_OFFSET: Final = 32  # u32, a futex that the node holds
NAME_OFFSET: Final = 64  # u8 length, then UTF-8
NAME_BYTES_MAX: Final = 120

RECORD: Final = struct.Struct("<QQQII")  # time ns, request id, detail, brick, event code
ENTRY: Final = struct.Struct("<QQIHH")  # time ns, request id, payload length, epoch, kind


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


class Entry(msgspec.Struct, frozen=True, gc=False):
    """A request that was sent, or a reply that was delivered, with its bytes."""

    t_ns: int
    request_id: int
    epoch: int
    kind: EntryKind
    payload: bytes


class History(msgspec.Struct, frozen=True):
    """What a run leaves behind: the records of all its nodes, by journal, and the dialogue of its client.

    Real processes and the simulator produce the same type, so one judge reads both.
    """

    journals: dict[str, list[Record]]
    dialogue: list[Entry]
    dropped: int = 0  # records that found no room, whose content is not known

    def events(self, *wanted: Event) -> list[Record]:
        """The records of these events, of all nodes, by time."""
        found = [r for records in self.journals.values() for r in records if r.event in wanted]
        return sorted(found, key=lambda record: record.t_ns)


Data = bytes | memoryview  # of a whole file, or of its beginning
_KINDS: Final = frozenset(EntryKind)


def header(node: str) -> bytes:
    """The first page of the journal of `node`."""
    name = node.encode()
    assert len(name) <= NAME_BYTES_MAX, node
    page = bytearray(HEADER_BYTES)
    page[: len(MAGIC)] = MAGIC
    page[NAME_OFFSET] = len(name)
    page[NAME_OFFSET + 1 : NAME_OFFSET + 1 + len(name)] = name
    return bytes(page)


def node_name(data: Data) -> str:
    """Whose journal this is. Raises PeerError if it is none."""
    if len(data) < HEADER_BYTES or data[: len(MAGIC)] != MAGIC:
        raise PeerError(f"not a journal ({len(data)} bytes)")
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


def entries(data: Data) -> Iterator[Entry]:
    """The committed entries of a dialogue. Raises PeerError on a malformed one."""
    if unfinished(data):
        return
    node_name(data)
    at = HEADER_BYTES
    while at + ENTRY.size <= len(data):
        t_ns, request_id, length, epoch, kind = ENTRY.unpack_from(data, at)
        if kind == 0:
            return
        start = at + ENTRY.size
        if kind not in _KINDS or start + length > len(data):
            raise PeerError(f"entry at byte {at}: kind {kind}, {length} bytes")
        yield Entry(t_ns, request_id, epoch, EntryKind(kind), bytes(data[start : start + length]))
        at = start + length
