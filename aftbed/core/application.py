"""The contract between a mechanism and the function that it protects.

The mechanisms (`ftm`) and the car (`vehicle`) are strangers to each other; this is all that they
know in common. Requests, replies and states are opaque bytes to the mechanism.
"""

from typing import Protocol

import msgspec


class Characteristics(msgspec.Struct, frozen=True):
    """The A of FT/A/R: what a function declares of itself, and what the choice of a mechanism rests on.

    `deterministic`: equal states and requests give equal replies and states. `state_access`: `capture`
    and `restore` mean the whole state.
    """

    deterministic: bool = True
    state_access: bool = True


class Application(Protocol):
    """A protected function. What it declares is believed, and measured by campaigns.

    `execute` is the only thing that changes the state. No clock, no chance, no I/O: time comes
    in with the request.
    """

    characteristics: Characteristics

    def execute(self, request: bytes) -> bytes:
        """Return the reply to `request`, updating the state. Raises PeerError, state unchanged."""
        ...

    def capture(self) -> bytes:
        """Return the whole state; equal states give equal bytes."""
        ...

    def restore(self, state: bytes) -> None:
        """Replace the whole state. Raises PeerError, state unchanged, if `state` is not one."""
        ...

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """The executable assertion: whether `reply` can be right as an answer to `request`.

        Looks at nothing but these two, and changes nothing.
        """
        ...
