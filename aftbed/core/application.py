"""The contract between a mechanism and the function that it protects.

The mechanisms (`ftm`) and the car (`vehicle`) are strangers to each other; this is all that they
know in common. Requests, replies and states are opaque bytes to the mechanism.
"""

import math
import re
import struct
from collections.abc import Mapping
from enum import Enum
from typing import Annotated, Final, Literal, Protocol, TypeGuard

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown

Width = Literal["bool", "u8", "u16", "u32", "u64", "i8", "i16", "i32", "i64", "f32", "f64"]
CODES: Final[Mapping[str, str]] = {  # of `struct`; a byte that is neither 0 nor 1 is no bool, and is seen
    "bool": "B",
    "u8": "B",
    "u16": "H",
    "u32": "I",
    "u64": "Q",
    "i8": "b",
    "i16": "h",
    "i32": "i",
    "i64": "q",
    "f32": "f",
    "f64": "d",
}
BITS: Final[Mapping[str, int]] = {width: 8 * struct.calcsize(f"<{code}") for width, code in CODES.items()}
REPLY_BYTES_MAX: Final = 60 * 1024  # a reply has to fit into a packet
STATE_BYTES_MAX: Final = 64 << 20


class Field(msgspec.Struct, frozen=True):
    """A variable in the state as `capture` gives it, little-endian: bit 0 is the one of least weight."""

    name: str
    kind: Width
    offset_bytes: int

    @property
    def size_bits(self) -> int:
        return BITS[self.kind]


class AccessKind(Enum):
    EXACT = "exact"
    APPROXIMATE = "approximate"
    NONE = "none"


class StateAccess(msgspec.Struct, frozen=True):
    """What `capture` and `restore` mean: `EXACT`, `NONE`, or `approximate(tolerance)`.

    Behind a restored state, each number in a reply differs by at most `tolerance` from the one without.
    """

    kind: AccessKind = AccessKind.EXACT
    tolerance: float = 0.0

    def __str__(self) -> str:
        return f"approximate({self.tolerance:g})" if self.tolerance else self.kind.value


EXACT: Final = StateAccess()
NONE: Final = StateAccess(AccessKind.NONE)  # `capture` returns no byte


def approximate(tolerance: float) -> StateAccess:
    """Of a function that does not restore all digits. Raises ConfigError."""
    if not (math.isfinite(tolerance) and tolerance > 0):
        raise ConfigError(f"approximate({tolerance:g}): a tolerance is more than 0 and finite")
    return StateAccess(AccessKind.APPROXIMATE, tolerance)


class ApproximateAccess(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    approximate: Annotated[float, Meta(gt=0)]  # by so much replies may differ behind a restored state


WrittenAccess = Literal["exact", "none"] | ApproximateAccess  # as files and programs write it


def access_of(written: WrittenAccess) -> StateAccess:
    """Raises ConfigError."""
    match written:
        case "exact":
            return EXACT
        case "none":
            return NONE
        case ApproximateAccess(tolerance):
            return approximate(tolerance)


class Characteristics(msgspec.Struct, frozen=True):
    """The A of FT/A/R: what a function declares of itself, and what the choice of a mechanism rests on.

    `deterministic`: equal states and requests give equal replies and states.
    """

    deterministic: bool = True
    state_access: StateAccess = EXACT

    def told(self) -> dict[str, object]:
        """For documents of `--json`."""
        access = self.state_access
        return {
            "deterministic": self.deterministic,
            "state_access": access.kind.value,
            "tolerance": access.tolerance,
        }


class Application(Protocol):
    """A protected function. What it declares is believed, and measured by campaigns.

    One whose state has a fixed layout may declare it, as `fields: tuple[Field, ...]`: see `fields_of`; one
    whose replies have, as `reply_fields`. One with a large state may know its changes (`KnowsChanges`); one
    that holds more than memory may have `close()`.

    `execute` is the only thing that changes the state. No clock, no chance, no I/O: time comes
    in with the request.
    """

    characteristics: Characteristics

    def execute(self, request: bytes) -> bytes:
        """Return the reply to `request`, at most `REPLY_BYTES_MAX` long, updating the state.

        Raises PeerError, state unchanged.
        """
        ...

    def capture(self) -> bytes:
        """Return the whole state, at most `STATE_BYTES_MAX` long; equal states give equal bytes."""
        ...

    def restore(self, state: bytes) -> None:
        """Replace the whole state. Raises PeerError, state unchanged, if `state` is not one."""
        ...

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """The executable assertion: whether `reply` can be right as an answer to `request`.

        Looks at nothing but these two, and changes nothing.
        """
        ...


def close(application: Application) -> None:
    """Free what a function holds beside its memory, as a process; it is not used from then on."""
    closing = getattr(application, "close", None)
    if closing is not None:
        closing()


class KnowsChanges(Application, Protocol):
    """What a function with a large state may have besides, both or neither.

    Its checkpoints then cost as much as what changed, and not as much as the state. The length of the state
    never changes. Page N of it begins at byte N * `page_bytes`, and is as long, unless the state ends in it.
    """

    def changes(self, page_bytes: int) -> Mapping[int, bytes]:
        """Return the pages that `capture` would show changed since the last call of `changes`, by number.

        Whatever changed them: `execute`, `restore`, `patch`. A page too many does no harm, one too few does.
        """
        ...

    def patch(self, page_bytes: int, pages: Mapping[int, bytes]) -> None:
        """Replace these pages of the state. Raises PeerError, state unchanged, if the result is no state."""
        ...


def knows_changes(application: Application) -> TypeGuard[KnowsChanges]:
    """Whether it has both methods."""
    return hasattr(application, "changes") and hasattr(application, "patch")


def fields_of(application: Application | type[Application]) -> tuple[Field, ...]:
    """The variables that the state consists of, where the function declares them; else none."""
    fields: tuple[Field, ...] = getattr(application, "fields", ())
    return fields


def reply_fields_of(application: Application | type[Application]) -> tuple[Field, ...]:
    """The variables that a reply consists of, where the function declares them; else none."""
    fields: tuple[Field, ...] = getattr(application, "reply_fields", ())
    return fields


def value_of(field: Field, data: bytes) -> float:
    """The number in `data`, which is long enough."""
    found: float = struct.unpack_from(f"<{CODES[field.kind]}", data, field.offset_bytes)[0]
    return found


def difference(fields: tuple[Field, ...], one: bytes, other: bytes) -> float:
    """The largest difference between the numbers of two replies, or states.

    Infinite where anything else differs, or a number is not finite in one of them.
    """
    if one == other:
        return 0.0
    if not fields or len(one) != len(other):
        return math.inf
    rest, largest = [bytearray(one), bytearray(other)], 0.0
    for field in fields:
        end = field.offset_bytes + field.size_bits // 8
        if end > len(one):
            return math.inf
        first, second = value_of(field, one), value_of(field, other)
        if one[field.offset_bytes : end] != other[field.offset_bytes : end] and first != second:
            apart = abs(first - second)
            largest = max(largest, apart if math.isfinite(apart) else math.inf)
        for data in rest:
            data[field.offset_bytes : end] = bytes(end - field.offset_bytes)
    return largest if rest[0] == rest[1] else math.inf


def field_named(name: str, fields: tuple[Field, ...]) -> Field:
    """The field called `name`. Raises ConfigError naming those there are, with N for any number."""
    if not fields:
        raise ConfigError(f"state.{name}: the function declares no fields; state is allowed, as a whole")
    found = next((field for field in fields if field.name == name), None)
    if found is None:
        raise unknown("field of the state", name, {re.sub(r"\d+\.", "N.", field.name) for field in fields})
    return found
