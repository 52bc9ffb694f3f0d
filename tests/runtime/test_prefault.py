"""The pages that some work writes to are found and copied in advance; the rehearsal finds those of a node."""

import ctypes
import mmap
import subprocess
import sys
from collections.abc import Iterator

import pytest

from aftbed.runtime.unix.linux import Area, populate
from aftbed.runtime.unix.prefault import PAGE, written_by

PAGES = 16


@pytest.fixture
def memory() -> Iterator[mmap.mmap]:
    """Private memory of which each page is there."""
    with mmap.mmap(-1, PAGES * PAGE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as mapped:
        mapped.madvise(mmap.MADV_NOHUGEPAGE)
        for page in range(PAGES):
            mapped[page * PAGE] = 1
        yield mapped


def within(memory: mmap.mmap, areas: tuple[Area, ...]) -> list[Area]:
    """Those in `memory`, by number of their first page, and their length in pages."""
    start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    found = [((a - start) // PAGE, size // PAGE) for a, size in areas]
    return [(page, count) for page, count in found if 0 <= page < PAGES]


def test_what_is_written_to_is_found_and_nothing_else(memory: mmap.mmap) -> None:
    def work() -> None:
        for page in (2, 5, 6, 15):
            memory[page * PAGE + 7] = 2
        assert memory[9 * PAGE] == 1, "a page that is only read"

    assert within(memory, written_by(work)) == [(2, 1), (5, 2), (15, 1)]
    assert memory[2 * PAGE + 7] == 0, "it was done in a child"


def test_a_child_that_owns_them_has_its_own_copies_with_what_was_there(memory: mmap.mmap) -> None:
    start = ctypes.addressof(ctypes.c_char.from_buffer(memory))

    def work() -> None:
        populate(((start + 3 * PAGE, PAGE), (start + 8 * PAGE, 3 * PAGE)))
        assert all(memory[page * PAGE] == 1 for page in range(PAGES))

    assert within(memory, written_by(work)) == [(3, 1), (8, 3)]


def test_memory_that_is_not_there_is_passed_over(memory: mmap.mmap) -> None:
    populate(((1 << 46, PAGE),))
    assert memory[0] == 1


def test_where_the_work_fails_nothing_is_known() -> None:
    def fails() -> None:
        raise RuntimeError

    assert written_by(fails) == ()


# -- the rehearsal


SCRIPT = """
import resource
from aftbed.runtime.unix import linux, prefault

areas = prefault.warm_up()

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def prepared():
    linux.populate(areas)
    before = faults()
    prefault.rehearse_host()
    print(sum(size for _, size in areas) // prefault.PAGE, faults() - before, flush=True)

prefault.written_by(prepared)
"""


@pytest.mark.skipif(not written_by(lambda: None), reason="this kernel does not tell which pages are whose")
def test_a_child_that_owns_the_pages_of_the_rehearsal_takes_hardly_a_fault_in_it() -> None:
    """In an interpreter of its own, as in a zygote: the rehearsal freezes the garbage collector."""
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout
    owned, faults = map(int, told.split())
    assert owned > 100
    assert faults < owned / 5, f"{faults} page faults, {owned} pages of {PAGE} bytes were owned before"


REUSES = """
import resource
from aftbed.runtime.unix import linux

linux.reuse_blocks()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def copies(count):
    before, kept = faults(), b""
    for number in range(count):
        kept = bytes({size})  # beside the one before
        kept.count(1)
    return faults() - before
copies(10)
print(copies(50))
"""


@pytest.mark.parametrize("size", [1_000_000, 10_000_000])
def test_the_memory_of_a_large_block_is_used_again(size: int) -> None:
    """Given back, each block would cost a fault for each of its pages."""
    done = subprocess.run([sys.executable, "-c", REUSES.format(size=size)], capture_output=True, check=True)
    assert int(done.stdout) < 50
