"""The brick contract: a mechanism is a chain of pure state machines (sans-I/O).

A brick never reads a clock, a socket or a random number: time comes in as `now_ns`, mail as `step`,
and what it wants done goes out as effects. The host performs the effects in list order, none before
`step` returns; the order is part of a mechanism's meaning (checkpoint before reply).

A brick also says which of its ports are open in its present state. A host reads from open ports
only: mail for the others waits in its channel, where it outlives this node. So "one request at a
time" is not a queue in a brick, it is a closed port.
"""

from enum import Enum
from typing import Final, Protocol

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Message, Rebound
from aftbed.core.script import Phase, Script

CONTROL: Final = "control"  # the port on which the runtime speaks to a brick
NO_REQUEST: Final = 0


class BrickState(Enum):
    """Base of the states of bricks: hashed by identity, since tables of moves are looked up on every hop."""

    __hash__ = object.__hash__


class Send(msgspec.Struct, frozen=True, gc=False):
    """Put `message` into the channel bound to `port`."""

    port: str
    message: Message


class Note(msgspec.Struct, frozen=True, gc=False):
    """Record that `event` happened; faults are aimed at these points."""

    event: Event
    request_id: int = NO_REQUEST
    detail: int = 0


class Order(msgspec.Struct, frozen=True):
    """Have the runtime execute `script` (Recovery and Engine only), or one `phase` of adaptation `number`.

    Recovery hears how it ended by Situation, the Engine by Progress.
    """

    script: Script
    phase: Phase = Phase.WHOLE
    number: int = 0


class Halt(msgspec.Struct, frozen=True):
    """A detected stop: end this node, so that no wrong reply leaves it. The last effect of a step."""

    reason: str


Effect = Send | Note | Order | Halt


def no_move(state: BrickState, port: str, msg: AnyMessage) -> list[Effect]:
    """The answer to a message for which a brick's table of moves has no row in `state`.

    A Rebound is told to every brick and is nothing to most of them. Raises PeerError on all else. The look-up
    itself stays in `step`: it is done on every hop, and a call is not free.
    """
    if isinstance(msg, Rebound):
        return []
    raise PeerError(f"{type(msg).__name__} on {port} while {state.name}")


class Brick(Protocol):
    """See the module's theory. A class that names this contract as its base gets the defaults of a
    brick without timers and without state that outlives a request; bricks never inherit from bricks.
    """

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message from `port`. Raises PeerError on an illegal one, having changed nothing."""
        ...

    def open_ports(self) -> tuple[str, ...]:
        """The ports whose mail this state can take."""
        ...

    def quiescent(self) -> bool:
        """True where no request is inside."""
        ...

    def wake(self, now_ns: int) -> list[Effect]:
        """Handle the passing of `deadline_ns()`."""
        raise AssertionError(f"{type(self).__name__} has no deadline, woken at {now_ns}")

    def deadline_ns(self) -> int | None:
        """When to be woken at the latest (monotonic ns), or None."""
        return None

    def capture(self) -> bytes:
        """The state that a successor needs."""
        return b""

    def restore(self, state: bytes) -> None:
        """Take over a captured state. Raises PeerError, having changed nothing."""
        if state != b"":
            raise PeerError(f"{type(self).__name__} has no state to restore, given {len(state)} bytes")
