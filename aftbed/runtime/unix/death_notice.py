"""The lifeline: notice of a death half a millisecond before the pidfd has it.

A process that is killed first returns its memory, page by page, and only then becomes a zombie that a pidfd
reports. But before that, the kernel walks the list of robust futexes that the dead thread held
(set_robust_list(2)), marks each with `FUTEX_OWNER_DIED` and wakes its waiters. So each node holds one, a
word in the header of its journal, and the host of each Watchdog has a thread that waits for the words of its
replica, all in one call (futex_waitv(2), Linux 5.16).

No instruction of the dead process runs after that point, so a word is as good as a pidfd. The pidfds are
watched, too: they report the death later where the kernel has no futex_waitv.

The thread is one of `_thread`: the mere import of `threading` has each child of a fork do work and write to
pages, 0.3 ms of CPU in each node and each spare (measured).
"""

import _thread
import ctypes
import errno
import mmap
import os
import signal
import time
from typing import Final

from aftbed.core.journal import HEADER_BYTES, LIFELINE_OFFSET
from aftbed.runtime.unix import linux

SYS_SET_ROBUST_LIST: Final = {"x86_64": 273, "aarch64": 99}.get(os.uname().machine, -1)
SYS_FUTEX_WAITV: Final = 449  # the same number on every architecture
FUTEX_WAITERS: Final = 0x8000_0000
FUTEX_OWNER_DIED: Final = 0x4000_0000
FUTEX2_SIZE_U32: Final = 2  # and not private: the word is shared between processes
CLOCK_MONOTONIC: Final = 1
WAIT_SECONDS: Final = 0.25  # then the thread checks whether it is still wanted

_libc: Final = ctypes.CDLL(None, use_errno=True)


class _RobustList(ctypes.Structure):
    _fields_ = (("next", ctypes.c_void_p),)


class _RobustListHead(ctypes.Structure):
    _fields_ = (
        ("next", ctypes.c_void_p),
        ("futex_offset", ctypes.c_long),
        ("pending", ctypes.c_void_p),
    )


_HEAD_BYTES: Final = ctypes.c_size_t(ctypes.sizeof(_RobustListHead))


class _Waiter(ctypes.Structure):
    _fields_ = (
        ("value", ctypes.c_uint64),
        ("address", ctypes.c_uint64),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    )


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Word:
    """The futex in the header of the journal at `path`, in a mapping of its own, because a journal's mapping
    may move.
    """

    def __init__(self, path: str) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            self._mapping = mmap.mmap(descriptor, HEADER_BYTES)
        finally:
            os.close(descriptor)
        self._word = ctypes.c_uint32.from_buffer(self._mapping, LIFELINE_OFFSET)
        self.address = ctypes.addressof(self._word)

    @property
    def value(self) -> int:
        return self._word.value

    @value.setter
    def value(self, value: int) -> None:
        self._word.value = value


class Lifeline:
    """This thread's lifeline. It must stay referenced: the kernel reads its memory when the thread dies."""

    def __init__(self, path: str) -> None:
        self._word = _Word(path)
        self._entry, self._head = _RobustList(), _RobustListHead()
        self._entry.next = ctypes.addressof(self._head)
        self._head.next = ctypes.addressof(self._entry)
        self._head.futex_offset = self._word.address - ctypes.addressof(self._entry)
        if SYS_SET_ROBUST_LIST < 0:
            return
        if _libc.syscall(SYS_SET_ROBUST_LIST, ctypes.byref(self._head), _HEAD_BYTES) == 0:
            self._word.value = _thread.get_native_id() | FUTEX_WAITERS


class LifelineWatcher:
    """Writes the indices of the first holders that die into a pipe, one byte each; `fd` is its reading end.

    The first death ends it: the replica is lost then, and to handle further deaths would only take the CPU
    from the replica that takes over (0.3 ms of a failover, measured).
    """

    def __init__(self, paths: tuple[str, ...]) -> None:
        self.fd, self._pipe = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self.ended = False  # nothing more comes: the kernel has no lifelines, or no futex_waitv
        self._words = [_Word(path) for path in paths]
        self._wanted = _thread.allocate_lock()  # held until it is closed
        self._wanted.acquire()
        try:
            _thread.start_new_thread(self._watch, ())
        except RuntimeError as error:  # a thread counts as a process
            raise OSError(errno.EAGAIN, str(error)) from None

    def died(self) -> bytes:
        """The indices of those that died since the last call."""
        try:
            found = os.read(self.fd, 64)
        except BlockingIOError:
            return b""
        self.ended = not found
        return found

    def close(self) -> None:
        if self._wanted.locked():
            self._wanted.release()
        os.close(self.fd)

    def _watch(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # they are the main thread's
        linux.use_short_slices()
        alive = [i for i, word in enumerate(self._words) if word.value]
        try:
            while alive and self._wanted.locked():
                dead = [i for i in alive if self._words[i].value & FUTEX_OWNER_DIED]
                if dead:
                    os.write(self._pipe, bytes(dead))
                    self._wanted.acquire()  # the end of a thread takes the CPU too: not just now
                    return
                if not self._wait([self._words[i] for i in alive]):
                    return
        except BrokenPipeError:
            return
        finally:
            os.close(self._pipe)

    @staticmethod
    def _wait(words: list[_Word]) -> bool:
        """Until one of `words` changes, or a while has passed; False where the kernel cannot do it."""
        waiters = (_Waiter * len(words))()
        for waiter, word in zip(waiters, words, strict=True):
            value = word.value
            if value & FUTEX_OWNER_DIED:
                return True
            waiter.value, waiter.address, waiter.flags = value, word.address, FUTEX2_SIZE_U32
        limit_ns = time.monotonic_ns() + round(WAIT_SECONDS * 1e9)
        limit = _Timespec(limit_ns // 10**9, limit_ns % 10**9)
        done = _libc.syscall(
            SYS_FUTEX_WAITV, waiters, len(words), 0, ctypes.byref(limit), ctypes.c_int(CLOCK_MONOTONIC)
        )
        return done >= 0 or ctypes.get_errno() in (errno.ETIMEDOUT, errno.EAGAIN, errno.EINTR)
