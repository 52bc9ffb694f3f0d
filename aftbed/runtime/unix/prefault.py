"""The pages that a process writes to, made its own before it needs them.

A child of a fork shares each page with its parent until it writes there; then the kernel stops it and copies
the page. A node that was just born so pays some hundred page faults in its first request: half a millisecond
in each process of a new leader. `written_by` finds out, in a child that is thrown away, which pages some work
writes to (pagemap in proc(5), bit 56: mapped by this process alone); `own` has the kernel copy the same pages
in another child of the same parent, all in one go (MADV_POPULATE_WRITE in madvise(2), Linux 5.14).

That is speed and nothing else: where the kernel tells no pages, or takes no advice, they are copied one by
one as ever.
"""

import os
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from aftbed.runtime.unix import linux

PAGE: Final = os.sysconf("SC_PAGE_SIZE")
ENTRY: Final = struct.Struct("=Q")  # of pagemap
PRESENT: Final = 1 << 63
OF_A_FILE: Final = 1 << 61
EXCLUSIVE: Final = 1 << 56
CHUNK_BYTES: Final = 1 << 15

Area = tuple[int, int]  # address and bytes


def written_by(work: Callable[[], None]) -> tuple[Area, ...]:
    """The memory of this process that `work`, done in a child, writes to; empty if that cannot be known."""
    private = tuple(_private())
    reader, writer = os.pipe()
    parent, child = os.getpid(), os.fork()
    if child == 0:
        try:
            linux.die_with(parent)
            work()
            _tell(private, writer)  # no more than that: to take it apart here would be to write, too
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        told = pipe.read()
    os.waitpid(child, 0)
    if len(told) != sum(size for _, size in private) // PAGE * ENTRY.size:
        return ()
    return tuple(_own_areas(private, told))


def own(areas: Sequence[Area]) -> None:
    """Have a copy of what is there, as it is."""
    linux.populate(areas)


def _private() -> Iterator[Area]:
    """Memory of this process alone that may be written to."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, permissions, *_ = line.split()
        if permissions.startswith("rw-p"):
            low, high = (int(end, 16) for end in span.split("-"))
            yield low, high - low


def _tell(areas: tuple[Area, ...], writer: int) -> None:
    pagemap = os.open("/proc/self/pagemap", os.O_RDONLY)
    for address, size in areas:
        at, end = address // PAGE * ENTRY.size, (address + size) // PAGE * ENTRY.size
        while at < end:
            at += os.write(writer, os.pread(pagemap, min(CHUNK_BYTES, end - at), at))


def _own_areas(areas: tuple[Area, ...], told: bytes) -> Iterator[Area]:
    """What lies side by side in one area is one."""
    entries = ENTRY.iter_unpack(told)
    for address, size in areas:
        first = last = 0
        for page, (entry,) in zip(range(address, address + size, PAGE), entries, strict=False):
            if entry & (PRESENT | OF_A_FILE | EXCLUSIVE) != PRESENT | EXCLUSIVE:
                continue
            if page != last:
                if last:
                    yield first, last - first
                first = page
            last = page + PAGE
        if last:
            yield first, last - first
