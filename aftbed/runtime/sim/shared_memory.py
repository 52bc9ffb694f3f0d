"""Shared memory in virtual time: some bytes that the executive and a node both have."""

from aftbed.inject.shared_state import SHARED_BYTES


class SimulatedMemory:
    """See `runtime.interface.SharedMemory`. An order to the node carries its `number`."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.memory = memoryview(bytearray(SHARED_BYTES))

    def fileno(self) -> int:
        """The number."""
        return self._number

    def seal(self) -> None:
        """Nothing is open."""

    def close(self) -> None:
        """The node keeps its view."""
