"""The contract between a mechanism and the function that it protects.

The mechanisms (`ftm`) and the car (`vehicle`) are strangers to each other; this is all that they
know in common. Requests, replies and states are opaque bytes to the mechanism.
"""

from typing import Protocol


class Application(Protocol):
    """A protected function: deterministic and with state access (the A of FT/A/R).

    `execute` is the only thing that changes the state. No clock, no chance, no I/O: time comes
    in with the request.
    """

    def execute(self, request: bytes) -> bytes:
        """Return the reply to `request`, updating the state. Raises PeerError, state unchanged."""
        ...

    def capture(self) -> bytes:
        """Return the whole state; equal states give equal bytes."""
        ...

    def restore(self, state: bytes) -> None:
        """Replace the whole state. Raises PeerError, state unchanged, if `state` is not one."""
        ...
