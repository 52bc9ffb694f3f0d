"""The contract between a mechanism and the function that it protects.

The mechanisms (`ftm`) and the car (`vehicle`) are strangers to each other; this is all that they
know in common. Requests, replies and states are opaque bytes to the mechanism.
"""

import re
from collections.abc import Mapping
from typing import Final, Literal, Protocol, TypeGuard

import msgspec

from aftbed.core.errors import ConfigError, unknown

Width = Literal["u8", "u32", "i64", "u64", "f64"]
BITS: Final[dict[Width, int]] = {"u8": 8, "u32": 32, "i64": 64, "u64": 64, "f64": 64}
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


class Characteristics(msgspec.Struct, frozen=True):
    """The A of FT/A/R: what a function declares of itself, and what the choice of a mechanism rests on.

    `deterministic`: equal states and requests give equal replies and states. `state_access`: `capture`
    and `restore` mean the whole state.
    """

    deterministic: bool = True
    state_access: bool = True


class Application(Protocol):
    """A protected function. What it declares is believed, and measured by campaigns.

    One whose state has a fixed layout may declare it, as `fields: tuple[Field, ...]`: see `fields_of`. One
    with a large state may know its changes: see `KnowsChanges`.

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


def field_named(name: str, fields: tuple[Field, ...]) -> Field:
    """The field called `name`. Raises ConfigError naming those there are, with N for any number."""
    if not fields:
        raise ConfigError(f"state.{name}: the function declares no fields; state is allowed, as a whole")
    found = next((field for field in fields if field.name == name), None)
    if found is None:
        raise unknown("field of the state", name, {re.sub(r"\d+\.", "N.", field.name) for field in fields})
    return found
