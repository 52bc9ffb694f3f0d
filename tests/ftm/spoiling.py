"""Value faults on the Servers in memory, as the runtime does them: behind an execution, to its outcome."""

from collections.abc import Callable
from typing import NamedTuple

import msgspec

from aftbed.core.brick import Effect, Note, Send
from aftbed.core.event import Event
from aftbed.core.fault import Place, flipped
from aftbed.core.message import Reply, Tried
from aftbed.ftm.server import Server


class Hit(NamedTuple):
    """A bit of the last byte of what an execution answers, or of what it leaves behind."""

    place: Place
    bit: int


Spoil = Callable[[str, int], Hit | None]  # an execution in this replica, of this request


class Flips:
    """Value faults that were planned: in the `nth` execution of a replica from now on."""

    def __init__(self) -> None:
        self._planned: list[tuple[str, int, Hit]] = []

    def plan(self, replica: str, nth: int, hit: Hit) -> None:
        self._planned.append((replica, nth, hit))

    def __call__(self, replica: str, request_id: int) -> Hit | None:
        left = [(r, nth - (r == replica), hit) for r, nth, hit in self._planned]
        self._planned = [planned for planned in left if planned[1]]
        return next((hit for _, nth, hit in left if not nth), None)


def spoiled(
    spoil: Spoil, name: str, server: Server, effects: list[Effect], saying: Callable[[str], None]
) -> list[Effect]:
    """`effects` of the Server called `name`, with a value fault in them if it has executed and one is due."""
    match effects:
        case [_, Note(Event.SERVER_EXIT, number), Send(port, Reply() | Tried() as message)]:
            hit = spoil(name[0], number)
            if hit is None or not message.payload:
                return effects
            saying(f"bit {hit.bit} of the {hit.place.value} flips in {name}")
            return [*effects[:2], Send(port, _struck(server, message, hit))]
    return effects


def _struck(server: Server, message: Reply | Tried, hit: Hit) -> Reply | Tried:
    """What `message` is after the hit; a hit in the state is one in the Server's memory."""

    def flip(data: bytes) -> bytes:
        return flipped(data, 8 * (len(data) - 1) + hit.bit)

    if hit.place is Place.RESULT:
        return msgspec.structs.replace(message, payload=flip(message.payload))
    state = flip(server.capture())
    server.restore(state)
    return msgspec.structs.replace(message, state=state) if isinstance(message, Tried) else message
