"""Journals as files mapped into memory: the write is a memory write, the kernel keeps the page.

The format is `core.journal`'s. A file grows by a chunk when it is full; up to a limit, beyond which
a record is dropped and the drop is counted in the header, so that a checker says `unknown` and not
`pass`. The chunk before is given back then (its pages stay the kernel's), so a node takes as much memory for
its journal after a day as after a second.
"""

import contextlib
import functools
import mmap
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from aftbed.core import journal as layout
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.input_file import open_input
from aftbed.runtime.unix import linux

CHUNK_BYTES: Final = 1 << 20
FILE_BYTES_MAX: Final = 16 << 30  # a day at 500 requests a second, where one node hosts a whole replica
READY_BYTES: Final = 1 << 16  # in memory from the start: a backup writes its first record in a failover
STATE_EVERY_BYTES: Final = 1 << 14  # of a dialogue: what a new Client reads of it; 1 << 18 took it 4 ms
STATE_SHARE_MAX: Final = 1 / 8  # of a dialogue, where many requests are unanswered
RECORDED_MAX: Final = 16
RECORDED_BYTES_MAX: Final = 1 << 16
PART_BYTES: Final = 1 << 16  # read at once: most journals are shorter
STEP_BYTES_MAX: Final = 8 * layout.RECORD.size  # what the notes of one step take at most


def stored_records(path: Path) -> tuple[layout.StoredRecords, int]:
    """The records of a journal of any length, and how many found no room. Its parts have been read once then.

    Raises OSError, also where it is no regular file, and PeerError if it is no journal. The file is not
    mapped: where a tmpfs is full, the kernel sends SIGBUS even to a process that reads the empty part of a
    chunk.
    """
    with open_input(path) as file:
        head = file.read(layout.HEADER_BYTES)
    if layout.unfinished(head):
        return layout.StoredRecords("", tuple), 0
    node = layout.node_name(head)

    def parts() -> Iterator[bytes]:
        with open_input(path) as file:
            file.seek(at := layout.HEADER_BYTES)
            while part := file.read(PART_BYTES):
                end = layout.committed(part, node, at)
                yield part[:end]
                if end < len(part):
                    return
                at += end

    return layout.StoredRecords(node, parts), layout.dropped(head)


def trim(folder: Path) -> None:
    """Cut the journals of a run that has ended to what was committed: they grow ahead. Raises OSError.

    Of dialogues there are few, and where one ends is known only after all of it was read.
    """
    for path in folder.glob("*.journal"):
        with contextlib.suppress(PeerError):  # the judge says so
            found, _ = stored_records(path)
            end = layout.HEADER_BYTES + len(found) * layout.RECORD.size
            os.truncate(path, min(end, path.stat().st_size))


def stored_entries(path: Path) -> Iterator[layout.Entry]:
    """The requests and replies in a dialogue of any length. Raises OSError, and PeerError as it goes on."""
    with open_input(path) as file:
        head = file.read(layout.HEADER_BYTES)
        if not layout.unfinished(head):
            layout.node_name(head)
            yield from layout.requests_and_replies(
                layout.entries_in(iter(functools.partial(file.read, PART_BYTES), b""))
            )


def entries_dropped(path: Path) -> int:
    """How many entries of a dialogue found no room. Raises OSError and PeerError."""
    with open_input(path) as file:
        return layout.dropped(file.read(layout.HEADER_BYTES))


def _mapped(path: Path | str, name: str) -> mmap.mmap:
    """A new file of one chunk with the header of `name`, mapped."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        os.ftruncate(descriptor, CHUNK_BYTES)
        mapping = mmap.mmap(descriptor, CHUNK_BYTES)
    finally:
        os.close(descriptor)
    try:  # noqa: SIM105 - each node makes a journal, and this writes to fewer pages
        mapping.madvise(linux.MADV_POPULATE_WRITE, 0, READY_BYTES)
    except (OSError, ValueError):  # Linux before 5.14: the pages come one by one
        pass
    mapping[: layout.HEADER_BYTES] = layout.header(name)
    return mapping


def _grow(mapping: mmap.mmap) -> bool:
    """Add a chunk; False, with the loss counted, at the limit or where the file cannot grow."""
    full = len(mapping)
    if full < FILE_BYTES_MAX:
        with contextlib.suppress(OSError):  # a limit of the user (RLIMIT_FSIZE), or of the disk
            mapping.resize(full + CHUNK_BYTES)
            first = max(layout.HEADER_BYTES, full - CHUNK_BYTES)
            mapping.madvise(mmap.MADV_DONTNEED, first, full - first)  # what was written stays in the file
            return True
    _count_loss(mapping)
    return False


def _count_loss(mapping: mmap.mmap) -> None:
    """Count one record or entry that found no room."""
    at = layout.DROPPED_OFFSET
    lost = int.from_bytes(mapping[at : at + 4], "little") + 1
    mapping[at : at + 4] = min(lost, 0xFFFF_FFFF).to_bytes(4, "little")


class JournalFile:
    """The records of one node. All is public for the host's hot path, which packs records itself.

    `at` is where the next record goes; beyond `end` the file must grow before another step.
    """

    def __init__(self, path: Path | str | None, node: str) -> None:
        """Without a path, one in memory that is not read."""
        self.mapping = mmap.mmap(-1, CHUNK_BYTES) if path is None else _mapped(path, node)
        self.at, self.end = layout.HEADER_BYTES, CHUNK_BYTES - STEP_BYTES_MAX
        self._pack = layout.RECORD.pack_into

    def write(self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0) -> None:
        at = self.at
        if at > self.end:
            if not _grow(self.mapping):
                return
            self.end = len(self.mapping) - STEP_BYTES_MAX
        self._pack(self.mapping, at, now_ns, request_id, detail, brick, event.code)
        self.at = at + layout.RECORD.size


class DialogueFile:
    """Requests and replies with their bytes, as the client saw them.

    After the first entry that found no room no other is written: what is there has no gap.
    """

    def __init__(self, path: Path, node: str) -> None:
        self.mapping = _mapped(path, node)
        self._at, self._full = layout.HEADER_BYTES, False
        self._state_due = layout.HEADER_BYTES

    def keep(self, now_ns: int, capture: Callable[[], bytes]) -> None:
        """Write the state of the Client, if the last one is far behind: a successor reads from there on."""
        at = self._at
        if at < self._state_due or self._full:
            return
        self.write(now_ns, 0, 0, layout.EntryKind.STATE, capture())
        if not self._full:  # it is complete
            self.mapping[layout.STATE_OFFSET : layout.STATE_OFFSET + 8] = at.to_bytes(8, "little")
            self._state_due = self._at + max(STATE_EVERY_BYTES, round((self._at - at) / STATE_SHARE_MAX))

    def write(self, now_ns: int, request_id: int, epoch: int, kind: layout.EntryKind, payload: bytes) -> None:
        """Append an entry; its kind is written last and commits it."""
        if self._full:
            _count_loss(self.mapping)
            return
        end = self._at + layout.ENTRY.size + len(payload)
        while end > len(self.mapping):
            if not _grow(self.mapping):
                self._full = True
                return
        self.mapping[self._at + layout.ENTRY.size : end] = payload
        layout.ENTRY.pack_into(self.mapping, self._at, now_ns, request_id, len(payload), epoch, kind)
        self._at = end


class JournalHeader:
    """The header page of another node's journal: its activity, and the flag that announces control mail."""

    def __init__(self, path: Path | str) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            self._mapping = mmap.mmap(descriptor, layout.HEADER_BYTES)
        finally:
            os.close(descriptor)

    def activity(self) -> int:
        """Even: the host of the node waits; odd: it executes bricks. Another value each time, modulo 256."""
        return self._mapping[layout.ACTIVITY_OFFSET]

    def lifeline(self) -> int:
        """The futex word that the node holds: see `death_notice`; 0 if it holds none."""
        return int.from_bytes(self._mapping[layout.LIFELINE_OFFSET : layout.LIFELINE_OFFSET + 4], "little")

    def announced(self) -> bool:
        """Whether the node has not yet seen the flag."""
        return self._mapping[layout.FLAG_OFFSET] != 0

    def announce(self) -> None:
        self._mapping[layout.FLAG_OFFSET] = 1

    def close(self) -> None:
        self._mapping.close()


def dialogue_path(journals: Path, incarnation: int) -> Path:
    """Of the Client that was made as the `incarnation`th."""
    return journals / f"client.{incarnation}.dialogue"


def last_words(journals: Path, incarnation: int) -> tuple[bytes, list[layout.Entry]]:
    """The last state that the predecessors of that Client have written, and what happened since.

    Without a state (none of them came to its first request) it is empty. Raises PeerError.
    """
    since: list[layout.Entry] = []
    for before in range(incarnation - 1, 0, -1):
        try:
            with open(dialogue_path(journals, before), "rb") as file:
                at = layout.state_at(file.read(layout.HEADER_BYTES))
                file.seek(at or layout.HEADER_BYTES)
                parts = iter(functools.partial(file.read, PART_BYTES), b"")  # most of a chunk may be empty
                found = list(layout.entries_in(parts, at or layout.HEADER_BYTES))
        except FileNotFoundError:  # it died before
            continue
        if at:
            return found[0].payload, found[1:] + since
        since = found + since
    return b"", since


def recorded_requests(record: Path) -> tuple[bytes, ...]:
    """The first few requests of a run: the self-test of new bricks replays them."""
    found: list[bytes] = []
    path = dialogue_path(record / "journal", 1)
    with open(path, "rb") as file, contextlib.suppress(PeerError):  # the last entry is cut off
        for entry in layout.entries(file.read(RECORDED_BYTES_MAX)):
            found += [entry.payload] if entry.kind is layout.EntryKind.SENT else []
    return tuple(found[:RECORDED_MAX])
