"""Memory that the supervisor shares with a node: a memfd, which has no name in any directory and goes with
its processes.
"""

import mmap
import os
from typing import Final

from aftbed.inject.shared_state import SHARED_BYTES

NAME: Final = "aftbed-cell"  # as /proc/PID/maps shows it


def mapped(descriptor: int) -> memoryview:
    """The memory behind `descriptor`, which is closed.

    A process that is forked from here does not inherit it.
    """
    try:
        memory = mmap.mmap(descriptor, SHARED_BYTES)
    finally:
        os.close(descriptor)
    memory.madvise(mmap.MADV_DONTFORK)
    return memoryview(memory)


class MemfdMemory:
    """The supervisor's end: see `runtime.interface.SharedMemory`."""

    def __init__(self) -> None:
        self._descriptor = os.memfd_create(NAME)
        os.ftruncate(self._descriptor, SHARED_BYTES)
        self.memory = mapped(os.dup(self._descriptor))

    def fileno(self) -> int:
        """The descriptor that is passed to the node."""
        return self._descriptor

    def seal(self) -> None:
        """Close the descriptor: from here on only the two mappings are left."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def close(self) -> None:
        """Unmap it as well."""
        self.seal()
        self.memory.release()
