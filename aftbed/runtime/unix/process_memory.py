"""Flip a bit of the memory of a process of this run, from outside: process_vm_writev(2).

Where no address is given, one is drawn: of a byte that the process can write, in a private mapping (the heap,
or anonymous memory), in a page that is present (`/proc/PID/pagemap`). One bit of it is flipped, written, and
read back. The process is not stopped for that: it may write the byte in the same microsecond; then what is
read back is what the process wrote.

The consequence can be anything: a crash, a wrong value, a reference count that matters in an hour, or
nothing. There is no undo, and none is needed: the bit is lost with the process.

*The process* is verified as in `runtime.unix.cleanup`: while a pidfd is open on it, its mark shows that it
belongs to this run; so the pid cannot mean another process.

Limits: addresses differ from run to run (ASLR), so a draw repeats the choice and not the byte. The kernel
asks for the rights of ptrace(2) (PTRACE_MODE_ATTACH): under Yama's `ptrace_scope` 0 and 1 a supervisor has
them over its nodes; under 2 only with CAP_SYS_PTRACE; under 3 no process has.
"""

import array
import ctypes
import errno
import mmap
import os
import re
from pathlib import Path
from typing import Final, NamedTuple

from aftbed.core.errors import HarnessError, StepFailed
from aftbed.inject.grammar import BYTE_BITS, drawn
from aftbed.runtime.unix import run_directory

YAMA: Final = Path("/proc/sys/kernel/yama/ptrace_scope")
HEAP: Final = "[heap]"
REMEDY: Final = f"see {YAMA} and `aftbed doctor`; it takes scope 0 or 1, or CAP_SYS_PTRACE"
_MAPPED: Final = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) (....) [0-9a-f]+ [0-9a-f]+:[0-9a-f]+ (\d+) *(.*)$", re.MULTILINE
)
_PRESENT: Final = 1 << 63  # of an entry in pagemap
_ENTRY_BYTES: Final = 8

_libc: Final = ctypes.CDLL(None, use_errno=True)


class Owner(NamedTuple):
    """A process, and the private directory of the run that it has to belong to."""

    name: str
    pid: int
    run: Path

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid})"


class Mapping(NamedTuple):
    """A part of a process's memory that it can write, and that is its alone."""

    start: int
    end: int
    name: str


class _Span(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


def flip(owner: Owner, bit: int | None, address: int | None, draw: int) -> str:
    """Flip one bit of one byte; which, in words. Raises StepFailed, naming what is in the way."""
    try:
        pidfd = os.pidfd_open(owner.pid)
    except OSError:
        raise StepFailed(f"{owner} is gone") from None
    try:
        if run_directory.run_of(owner.pid) != owner.run:
            raise StepFailed(f"{owner} is no process of this run")
        return _flip(owner, bit, address, draw)
    finally:
        os.close(pidfd)


def _flip(owner: Owner, bit: int | None, address: int | None, draw: int) -> str:
    found = mappings(owner.pid)
    address = _draw(owner, found, draw) if address is None else address
    mapping = next((one for one in found if one.start <= address < one.end), None)
    if mapping is None:
        raise StepFailed(
            f"address {address:#x}: in no private memory that {owner} can write:"
            f" the heap, or anonymous, as /proc/{owner.pid}/maps shows it"
        )
    bit = drawn(draw, 1) % BYTE_BITS if bit is None else bit
    before = peek(owner, address)
    poke(owner, address, after := before ^ 1 << bit)
    there = peek(owner, address)
    where = f"byte {address:#x} of {mapping.name} {mapping.start:x}-{mapping.end:x}"
    seen = "read back" if there == after else f"overwritten with {there:#04x} meanwhile"
    return f"bit {bit} of {where} in {owner}: {before:#04x} to {after:#04x}, {seen}"


def mappings(pid: int) -> list[Mapping]:
    """The heap and anonymous memory of a process, as far as it can write it. Raises StepFailed."""
    try:
        text = Path(f"/proc/{pid}/maps").read_text()
    except OSError as error:
        raise StepFailed(f"/proc/{pid}/maps: {error.strerror}; {REMEDY}") from None
    return [
        Mapping(int(start, 16), int(end, 16), name or "anonymous memory")
        for start, end, rights, inode, name in _MAPPED.findall(text)
        if rights.startswith("rw") and rights.endswith("p") and inode == "0" and name in ("", HEAP)
    ]


def _draw(owner: Owner, found: list[Mapping], draw: int) -> int:
    """Any byte of the pages that are present, each with the same chance."""
    pages: list[int] = []
    try:
        with open(f"/proc/{owner.pid}/pagemap", "rb", buffering=0) as file:
            for one in found:
                file.seek(one.start // mmap.PAGESIZE * _ENTRY_BYTES)
                data = file.read((one.end - one.start) // mmap.PAGESIZE * _ENTRY_BYTES)
                entries = array.array("Q", data[: len(data) // _ENTRY_BYTES * _ENTRY_BYTES])
                pages += [
                    one.start + at * mmap.PAGESIZE for at, entry in enumerate(entries) if entry & _PRESENT
                ]
    except OSError as error:
        raise StepFailed(f"/proc/{owner.pid}/pagemap: {error.strerror}; {REMEDY}") from None
    if not pages:
        raise StepFailed(f"{owner} has no memory of its own that is there")
    at = drawn(draw, 0) % (len(pages) * mmap.PAGESIZE)
    return pages[at // mmap.PAGESIZE] + at % mmap.PAGESIZE


def peek(owner: Owner, address: int) -> int:
    """The byte there. Raises StepFailed."""
    buffer = ctypes.create_string_buffer(1)
    _transfer("process_vm_readv", owner, address, buffer)
    return buffer.raw[0]


def poke(owner: Owner, address: int, byte: int) -> None:
    """Write the byte there. Raises StepFailed."""
    _transfer("process_vm_writev", owner, address, ctypes.create_string_buffer(bytes([byte]), 1))


def _transfer(call: str, owner: Owner, address: int, buffer: "ctypes.Array[ctypes.c_char]") -> None:
    ours, theirs = _Span(ctypes.addressof(buffer), 1), _Span(address, 1)
    one, flags = ctypes.c_ulong(1), ctypes.c_ulong(0)
    function = getattr(_libc, call)
    function.restype = ctypes.c_ssize_t
    if function(ctypes.c_int(owner.pid), ctypes.byref(ours), one, ctypes.byref(theirs), one, flags) != 1:
        number = ctypes.get_errno()
        remedy = f"; {REMEDY}" if number in (errno.EPERM, errno.ENOSYS) else ""
        raise StepFailed(f"{call} at {address:#x} of {owner}: {os.strerror(number)}{remedy}")


def try_on_a_child() -> None:
    """Write into a child as into a node. Raises HarnessError where that is not allowed."""
    byte = ctypes.create_string_buffer(b"\x01", 1)
    end, life = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(life)
        os.read(end, 1)  # until the parent has finished, or is gone
        os._exit(0)
    os.close(end)
    child, address = Owner("a child", pid, Path()), ctypes.addressof(byte)
    try:
        poke(child, address, 0x02)
        if peek(child, address) != 0x02:
            raise HarnessError("what was written is not there")
    except StepFailed as failure:
        raise HarnessError(str(failure)) from None
    finally:
        os.close(life)
        os.waitpid(pid, 0)
