"""The brick contract: a mechanism is a chain of pure state machines (sans-I/O).

A brick reads no clock, no socket and no random number. Time comes in as `now_ns`, messages come in by `step`,
and what the brick wants done goes out as effects. The host performs the effects in list order, none before
`step` returns. The order is part of a mechanism's meaning (checkpoint before reply).

A brick declares which of its ports are open in its present state. A host reads from open ports only.
Messages for the other ports wait in their channel, which outlives this node. So "one request at a time" is a
closed port, not a queue in a brick.

A brick with states is a `Machine`. Its table of moves is executed, not commented:

    (state, port, type of the message) -> (handler, next state)

`open_ports` follows from the table: the ports that have a row in the state. A message without a row raises
PeerError and changes nothing. Where the next state depends on what is in the message, the row is a `Choice`,
which names the question and a move for each answer. A row that cannot be written like this shows that a state
is missing.
"""

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, ClassVar, Final, NamedTuple, Protocol

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Message, Rebound
from aftbed.core.script import Phase, Script

CONTROL: Final = "control"  # the port on which the runtime sends to a brick
NO_REQUEST: Final = 0


class BrickState(Enum):
    """Base of the states of bricks: hashed by identity, since tables are looked up on every hop."""

    __hash__ = object.__hash__


class BrickAnswer(Enum):
    """Base of the answers to the question of a `Choice`, for the same reason."""

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

    The runtime reports the result to Recovery as a Situation, to the Engine as Progress.
    """

    script: Script
    phase: Phase = Phase.WHOLE
    number: int = 0


class Halt(msgspec.Struct, frozen=True):
    """A detected stop: end this node, so that no wrong reply leaves it. The last effect of a step."""

    reason: str


Effect = Send | Note | Order | Halt


class Brick(Protocol):
    """The contract. A class that names it as its base gets the defaults of a brick without timers and without
    state that outlives a request. Bricks do not inherit from bricks.
    """

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message from `port`. Raises PeerError on an illegal one, having changed nothing."""
        ...

    def open_ports(self) -> tuple[str, ...]:
        """The ports whose messages this state can take."""
        ...

    def quiescent(self) -> bool:
        """True if no request is inside."""
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


# -- the table of moves ---------------------------------------------------------------------------


class Wildcard(Enum):
    """Stands for all states at the left of a row, and for "the same state" at its right."""

    STATE = "any state"
    SAME = "the same state"


ANY_STATE: Final = Wildcard.STATE
SAME_STATE: Final = Wildcard.SAME

Handler = Callable[[Any, Any], list[Effect]]  # a method of the brick, given the message
Target = BrickState | Wildcard
Move = tuple[Handler, Target]


class DeadlinePassed:
    """Stands for the call of `wake` in a table: (state, CONTROL, DeadlinePassed)."""


DEADLINE_PASSED: Final = DeadlinePassed()


class Choice(NamedTuple):
    """A row whose move depends on the message. An answer without a move is an illegal message."""

    question: Callable[[Any, Any], object]  # a method of the brick, given the message; changes nothing
    moves: Mapping[Any, Move]


Key = tuple[BrickState | Wildcard, str, type]
Moves = Mapping[Key, Move | Choice]

_Answers = dict[object, tuple[Handler, BrickState]]
_Row = tuple[Callable[[Any, Any], Any], BrickState | None, _Answers | None]


class Table:
    """A table of moves made ready for execution.

    `rows`: handler, next state, None; or question, None, moves by answer. A row for a state goes before one
    for `ANY_STATE`. `moves` are the same by state, port and type: three look-ups by identity or a cached hash
    take half the time of one by a tuple. `open_ports`: by state, in the order of the rows; without `CONTROL`,
    always open.
    """

    def __init__(self, owner: type["Machine"], moves: Moves) -> None:
        """A handler that a subclass overrides is the subclass's own."""
        self.states = type(owner.AT_REST[0])
        self.rows: dict[tuple[BrickState, str, type], _Row] = {}
        self.moves: dict[BrickState, dict[str, dict[type, _Row]]] = {}
        self.open_ports: dict[BrickState, tuple[str, ...]] = {}
        self.fill(owner, moves)

    def fill(self, owner: type["Machine"], moves: Moves) -> None:
        """Make `rows`, `moves` and `open_ports` anew, in place."""
        self.rows.clear()
        for (at, port, kind), move in moves.items():
            if isinstance(at, BrickState):
                self.rows[at, port, kind] = _row(owner, at, move)
        for (at, port, kind), move in moves.items():
            if not isinstance(at, BrickState):
                for state in self.states:
                    self.rows.setdefault((state, port, kind), _row(owner, state, move))
        for state in self.states:  # the runtime sends a Rebound to every brick; most of them need none
            self.rows.setdefault((state, CONTROL, Rebound), (ignore, state, None))
            ports = (port for at, port, _ in self.rows if at is state and port != CONTROL)
            self.open_ports[state] = tuple(dict.fromkeys(ports))
            self.moves[state] = {}
        for (state, port, kind), row in self.rows.items():
            self.moves[state].setdefault(port, {})[kind] = row


def _row(owner: type, state: BrickState, move: Move | Choice) -> _Row:
    if isinstance(move, Choice):
        answers = {answer: _move(owner, state, one) for answer, one in move.moves.items()}
        return _method(owner, move.question), None, answers
    return *_move(owner, state, move), None


def _move(owner: type, state: BrickState, move: Move) -> tuple[Handler, BrickState]:
    do, then = move
    return _method(owner, do), state if isinstance(then, Wildcard) else then


def _method(owner: type, method: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return getattr(owner, method.__name__, method)


def ignore(brick: Any, msg: object) -> list[Effect]:
    """A handler: nothing is to be done."""
    return []


def hand_on(port: str) -> Handler:
    """A handler: the message goes on through `port`, as it is."""

    def hand_on(brick: Any, msg: Message) -> list[Effect]:
        return [Send(port, msg)]

    return hand_on


class Machine(Brick):
    """A brick with states: runs its table of moves.

    A subclass has `MOVES` and the states in which no request is inside (`AT_REST`). Its handlers check a
    message before they change anything. It may have `FURTHER_MOVES`, by name, and go by one of them from some
    point on; all have the same states.
    """

    MOVES: ClassVar[Moves]
    FURTHER_MOVES: ClassVar[Mapping[str, Moves]] = {}
    AT_REST: ClassVar[tuple[BrickState, ...]]
    TABLES: ClassVar[dict[str, Table]]  # by name; "" is that of MOVES
    state: BrickState

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.TABLES = {name: Table(cls, moves) for name, moves in cls.all_moves().items()}

    @classmethod
    def all_moves(cls) -> dict[str, Moves]:
        """The tables as they are written, by name."""
        return {"": cls.MOVES, **cls.FURTHER_MOVES}

    def __init__(self, state: BrickState | None = None) -> None:
        """Begins in `state`, or in the first of `AT_REST`."""
        self.state = self.AT_REST[0] if state is None else state
        self.go_by("")

    def go_by(self, table: str) -> None:
        """The table of that name holds from the next message on."""
        chosen = self.TABLES[table]
        self._moves, self._open = chosen.moves, chosen.open_ports

    def step(self, port: str, msg: AnyMessage | DeadlinePassed, now_ns: int) -> list[Effect]:
        """Look the move up, run its handler, enter the next state."""
        try:
            do, then, answers = self._moves[self.state][port][type(msg)]
        except KeyError:
            raise self._illegal(port, msg) from None
        if answers is not None:
            move = answers.get(do(self, msg))
            if move is None:
                raise self._illegal(port, msg)
            do, then = move
        effects: list[Effect] = do(self, msg)
        self.state = then  # type: ignore[assignment]
        return effects

    def _illegal(self, port: str, msg: object) -> PeerError:
        return PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")

    def open_ports(self) -> tuple[str, ...]:
        return self._open[self.state]

    def quiescent(self) -> bool:
        return self.state in self.AT_REST
