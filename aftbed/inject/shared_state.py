"""The state of a protected function in memory that the supervisor shares, so that it can flip bits of it at
any moment.

While a fault of a field waits (`state`), the function of the target lives in shared memory, which both the
supervisor and the node have mapped. Its layout is that of the captured state. After each execution the
state is written there; before the function is used again, what is there is compared with what was written,
and where it differs, the function takes it over, as a program does that reads its variable anew. A function
that refuses what it finds has detected it, and ends its node: fail-silence.

A node that is not ordered to share its state does none of this. A process that takes the place of a dead
one shares nothing, or fresh memory: the memory does not outlive its process.

Limits: a state that is replaced, by a checkpoint or before a further trial, covers what was flipped, as in
any memory. The supervisor may flip while the function works: then its bit may be overwritten, or it may
write a byte back as it was a microsecond ago. The records show which bits the node really found.
"""

from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

import msgspec

from aftbed.core.application import Application, Field, field_named, fields_of
from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import Event
from aftbed.core.journal import Record
from aftbed.ftm.server import Server
from aftbed.inject.grammar import BitPattern, Byte, bit_names, bits_to_flip, lacks_bits
from aftbed.inject.receipts import Receipt, ReceiptState, fault_and_bits

SHARED_BYTES: Final = 1 << 16  # memory that is never touched costs nothing

Found = Callable[[list[int], PeerError | None], None]


class StateLayout(msgspec.Struct, frozen=True):
    """A node's answer: the fields that the function declares. Without any, its state is not shared."""

    fields: tuple[Field, ...] = ()


def field_with_bits(name: str, pattern: BitPattern, fields: tuple[Field, ...]) -> Field:
    """The field of that name.

    Raises ConfigError where there is none, or it does not have the bits of `pattern`.
    """
    field = field_named(name, fields)
    if lacks_bits(pattern, field.size_bits):
        size = field.size_bits
        unit, count = ("bytes", size // 8) if isinstance(pattern, Byte) else ("bits", size)
        has = f"it is {field.kind}, and has {unit} 0 to {count - 1}"
        raise ConfigError(f"{pattern} of state.{name}: {has}")
    return field


# -- in the supervisor ----------------------------------------------------------------------------


class SharedState:
    """The shared state of `brick`, a Server; `number` is that of the fault for which it was shared first."""

    def __init__(self, number: int, brick: str, journal: str, memory: memoryview) -> None:
        self.number, self.brick, self.journal, self.memory = number, brick, journal, memory
        self.layout: StateLayout | None = None  # until the node has answered

    @property
    def fields(self) -> tuple[Field, ...]:
        return () if self.layout is None else self.layout.fields

    def flip(self, name: str, pattern: BitPattern, now_ns: int, draw: int) -> "StateHit":
        """Flip bits of the field of that name. Raises ConfigError where the function has no such bits."""
        field = field_with_bits(name, pattern, self.fields)
        first, behind = field.offset_bytes, field.offset_bytes + field.size_bits // 8
        bits = bits_to_flip(pattern, bytes(self.memory[first:behind]), draw)
        assert bits is not None, f"{pattern} in {field}"
        for bit in bits:
            self.memory[first + bit // 8] ^= 1 << bit % 8
        in_state = frozenset(8 * first + bit for bit in bits)
        return StateHit(
            self.journal, self.number, f"state.{name} in {self.brick}", pattern, bits, in_state, now_ns
        )


class StateHit(NamedTuple):
    """What was flipped: `bits` of the field, which are the bits `in_state`; none, if they were so already."""

    journal: str
    number: int  # in the records of the node
    where: str
    pattern: BitPattern
    bits: tuple[int, ...]
    in_state: frozenset[int]
    since_ns: int

    def receipt(self, records: Iterable[Record]) -> Receipt:
        """Whether the function has used what was flipped, by the records of its node."""
        if not self.bits:
            detail = f"{self.pattern} of {self.where}: it is so already"
            return Receipt(ReceiptState.NOT_ACTIVATED, detail)
        which = f"{bit_names(self.bits)} of {self.where}"
        for record in records:
            number, bit = fault_and_bits(record.detail)
            if number != self.number or bit not in self.in_state or record.t_ns < self.since_ns:
                continue
            if record.event is Event.FAULT_APPLIED:
                return Receipt(ReceiptState.ACTIVATED, f"{which}, taken over")
            if record.event is Event.PEER_REFUSED:
                return Receipt(ReceiptState.ACTIVATED, f"{which}, refused: its node has ended itself")
        return Receipt(ReceiptState.APPLIED, f"{which}, not used so far, or covered up before")


# -- in the node ----------------------------------------------------------------------------------


class SharedFunction:
    """The application around one whose state is in `memory`.

    `found` is called with the bits that were changed there, and with the function's refusal of them, if any.
    """

    def __init__(self, function: Application, memory: memoryview, found: Found) -> None:
        self.characteristics, self.fields = function.characteristics, fields_of(function)
        self._function, self._memory, self._found = function, memory, found
        self._written = b""
        self._write()

    def execute(self, request: bytes) -> bytes:
        self._take_over()
        reply = self._function.execute(request)
        self._write()
        return reply

    def capture(self) -> bytes:
        self._take_over()
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        self._function.restore(state)
        self._write()

    def migrate(self, state: bytes) -> None:
        """Replace the state by that of another function."""
        getattr(self._function, "migrate", self._function.restore)(state)
        self._write()

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._function.acceptable(request, reply)

    def peek(self) -> bytes:
        """The state in memory, without using it."""
        return bytes(self._memory[: len(self._written)])

    def _write(self) -> None:
        self._written = state = self._function.capture()
        self._memory[: len(state)] = state

    def _take_over(self) -> None:
        there = self.peek()
        if there == self._written:
            return
        bits = differing_bits(there, self._written)
        try:
            self._function.restore(there)
        except PeerError as error:
            self._found(bits, error)
        else:
            self._written = there
            self._found(bits, None)


def differing_bits(one: bytes, other: bytes) -> list[int]:
    """The bits in which two values of the same length differ."""
    change = int.from_bytes(one, "little") ^ int.from_bytes(other, "little")
    return [bit for bit in range(8 * len(one)) if change >> bit & 1]


def look(brick: Brick) -> bytes:
    """The state of `brick` as it is, without using it: what was flipped stays unnoticed."""
    if isinstance(brick, Server) and isinstance(brick.application, SharedFunction):
        return brick.application.peek()
    return brick.capture()
