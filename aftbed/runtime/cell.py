"""A cell: the state of a protected function in memory that somebody else can reach.

While a fault of a field waits, the function of the replica that is meant lives in a cell: the executive has
made it and has it mapped, as has the node. Its layout is that of the captured state. Behind each execution
the state is put there; before the function is used again, what is there is compared with what was put there,
and where it differs, the function takes it over, as a program does that reads its variable anew. One that
refuses what it finds has detected it, and ends its node: fail-silence.

Nothing of this is there in a node that was not told to move in. Whoever takes the place of a dead one has
none, or a fresh one: no cell outlives its process.

Limits: a state that is replaced, by a checkpoint or before a further trial, covers up what was flipped, as
in any memory. An executive that flips while the function works may have its bit overwritten, too, or write
a byte back as it was a microsecond ago: the record says which bits the node really found.
"""

from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.core.application import Application, Field, field_named, fields_of
from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import Event
from aftbed.core.fault import mark
from aftbed.core.valuefault import Byte, Flip, Stuck, hit
from aftbed.ftm.server import Server
from aftbed.runtime.host import AgentHost

CELL_BYTES: Final = 1 << 16  # memory that nobody touches costs nothing

Found = Callable[[list[int], PeerError | None], None]


class Layout(msgspec.Struct, frozen=True):
    """A node's answer: the fields that the function declares; none, and it has not moved in."""

    fields: tuple[Field, ...] = ()


class InCell:
    """The application around one that lives in `memory`. `found` is told of each bit that others changed."""

    def __init__(self, function: Application, memory: memoryview, found: Found) -> None:
        self.characteristics, self.fields = function.characteristics, fields_of(function)
        self._function, self._memory, self._found = function, memory, found
        self._kept = b""  # what was put there last
        self._put()

    def execute(self, request: bytes) -> bytes:
        """As the function does, from the state that is in the cell."""
        self._take()
        reply = self._function.execute(request)
        self._put()
        return reply

    def capture(self) -> bytes:
        """The state that is in the cell, taken over."""
        self._take()
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        """Replace what is in the cell, whatever it is."""
        self._function.restore(state)
        self._put()

    def migrate(self, state: bytes) -> None:
        """The same, of another function's state."""
        getattr(self._function, "migrate", self._function.restore)(state)
        self._put()

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """As the function does."""
        return self._function.acceptable(request, reply)

    def peek(self) -> bytes:
        """What is in the cell, without using it."""
        return bytes(self._memory[: len(self._kept)])

    def _put(self) -> None:
        self._kept = state = self._function.capture()
        self._memory[: len(state)] = state

    def _take(self) -> None:
        there = self.peek()
        if there == self._kept:
            return
        bits = differing(there, self._kept)
        try:
            self._function.restore(there)
        except PeerError as error:
            self._found(bits, error)
        else:
            self._kept = there
            self._found(bits, None)


def check_field(flip: Flip, fields: tuple[Field, ...]) -> Field:
    """The field that is meant. Raises ConfigError where there is none, or it has no such bits."""
    field, pattern = field_named(flip.field, fields), flip.pattern
    behind = pattern.at >= field.size_bits if isinstance(pattern, Stuck) else False
    if behind or hit(pattern, bytes(field.size_bits // 8), 0) is None:
        size = field.size_bits
        unit, count = ("bytes", size // 8) if isinstance(pattern, Byte) else ("bits", size)
        has = f"it is {field.kind}, and has {unit} 0 to {count - 1}"
        raise ConfigError(f"{pattern} of {flip.where}: {has}")
    return field


def differing(one: bytes, other: bytes) -> list[int]:
    """The bits in which they differ; they have the same length."""
    change = int.from_bytes(one, "little") ^ int.from_bytes(other, "little")
    return [bit for bit in range(8 * len(one)) if change >> bit & 1]


def move_in(host: AgentHost, brick: str, number: int, memory: memoryview) -> bytes:
    """Have the function of a Server live in `memory`, for cell `number`. Raises PeerError where it has no
    fields.
    """
    server = host.brick(brick)
    if not isinstance(server, Server):
        raise PeerError(f"{brick} has no function")
    fields = fields_of(server.application)
    if isinstance(server.application, InCell) or not fields:
        return msgspec.msgpack.encode(Layout(fields))  # a repeated order, or there is nothing to move
    size_bytes = len(server.application.capture())
    last_bytes = max(field.offset_bytes + field.size_bits // 8 for field in fields)
    if not last_bytes <= size_bytes <= CELL_BYTES:
        raise PeerError(f"a state of {size_bytes} bytes with fields up to byte {last_bytes}")

    def found(bits: list[int], refusal: PeerError | None) -> None:
        event = Event.FAULT_APPLIED if refusal is None else Event.PEER_REFUSED
        for bit in bits:
            host.record(event, 0, mark(number, bit))
        if refusal is not None:
            host.record(Event.DETECTED_STOP, 0, 0)
            host.stop_detected(brick, f"the state in memory is refused: {refusal}")

    server.application = InCell(server.application, memory, found)
    return msgspec.msgpack.encode(Layout(fields))


def is_shared(brick: Brick) -> bool:
    """Whether `brick` is a Server whose function lives in a cell."""
    return isinstance(brick, Server) and isinstance(brick.application, InCell)


def look(brick: Brick) -> bytes:
    """The state of `brick`, as it stands: to look at it is no use of it."""
    if isinstance(brick, Server) and isinstance(brick.application, InCell):
        return brick.application.peek()
    return brick.capture()
