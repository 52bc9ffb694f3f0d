"""Cells in virtual time: some bytes that the executive and a node both have."""

from aftbed.inject.shared_state import SHARED_BYTES


class Cell:
    """The executive's hold on one; `number` is what travels with an order."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.memory = memoryview(bytearray(SHARED_BYTES))

    def fileno(self) -> int:
        """The number."""
        return self._number

    def seal(self) -> None:
        """Nobody else asks for it."""

    def close(self) -> None:
        """The node that has it keeps it."""
