"""Cells as shared memory: a memfd without a name in any directory, which its last process takes with it."""

import mmap
import os
from typing import Final

from aftbed.inject.shared_state import SHARED_BYTES

NAME: Final = "aftbed-cell"  # as /proc/PID/maps shows it


def mapped(descriptor: int) -> memoryview:
    """The memory behind `descriptor`, which is closed. Whoever is forked from here does not inherit it."""
    try:
        memory = mmap.mmap(descriptor, SHARED_BYTES)
    finally:
        os.close(descriptor)
    memory.madvise(mmap.MADV_DONTFORK)
    return memoryview(memory)


class Cell:
    """The executive's hold on one."""

    def __init__(self) -> None:
        self._descriptor = os.memfd_create(NAME)
        os.ftruncate(self._descriptor, SHARED_BYTES)
        self.memory = mapped(os.dup(self._descriptor))

    def fileno(self) -> int:
        """The descriptor that travels."""
        return self._descriptor

    def seal(self) -> None:
        """Nobody else is to have it: only the mappings are left."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def close(self) -> None:
        """Let go of the memory as well."""
        self.seal()
        self.memory.release()
