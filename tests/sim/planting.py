"""How a bug is planted for a time, and the experiments that have to find it.

A mutant is right code with one thing wrong in it: a method that is exchanged, a row of a table of moves.
It is planted while a run lasts, and taken out again: the right code then has the same experiment made.
"""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Final, NamedTuple

import msgspec

from aftbed.core.brick import Brick, Effect, Machine, Moves
from aftbed.core.events import Event
from aftbed.core.messages import Goal, Scheduled
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.runtime.sim.world import Setup
from aftbed.search import explore

Plant = Callable[[], AbstractContextManager[object]]
Setups = Callable[[], Iterable[Setup]]

CRASH, ADAPT, PAIRS, CLEAN, OWN = EXPLORERS = ("crash", "adapt", "pairs", "clean", "own")
REQUESTS: Final = 4
LOAD: Final = (explore.ADAPT_REQUESTS, explore.ADAPT_RATE_HZ)


class Mutant(NamedTuple):
    """`explorer`: the one whose experiments `setups` are taken from, or `own` where it has none like them.

    `promise` is broken by one of them, perhaps beside others.
    """

    name: str
    wrong: str
    plant: Plant
    explorer: str
    setups: Setups
    promise: str
    deep: bool = False


# -- planting -------------------------------------------------------------------------------------


@contextmanager
def _exchanged(owner: object, name: str, make: Callable[..., object]) -> Iterator[None]:
    own = name in vars(owner)
    right = getattr(owner, name)
    setattr(owner, name, make(right))
    _fill(owner)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, right)
        else:
            delattr(owner, name)
        _fill(owner)


def _fill(owner: object, rows: Moves | None = None) -> None:
    """Have the tables of a Machine name its present methods, with `rows` in the place of those of MOVES."""
    if isinstance(owner, type) and issubclass(owner, Machine):
        for name, moves in owner.all_moves().items():
            owner.TABLES[name].fill(owner, {**moves, **(rows or {})} if not name else moves)


@contextmanager
def _entered(kind: type[Machine], rows: Moves) -> Iterator[None]:
    _fill(kind, rows)
    try:
        yield
    finally:
        _fill(kind)


def entered(kind: type[Machine], rows: Moves) -> Plant:
    """The table of a brick has these rows in the place of its own."""
    return lambda: _entered(kind, rows)


def wrapped(owner: object, name: str, make: Callable[..., object]) -> Plant:
    """`name` of a class or module is what `make` makes of it."""
    return lambda: _exchanged(owner, name, make)


def instead(owner: object, name: str, wrong: object) -> Plant:
    """`name` of a class or module is `wrong`."""
    return wrapped(owner, name, lambda right: wrong)


def outcome(owner: object, name: str, change: Callable[..., object]) -> Plant:
    """What the function returns is changed."""
    return wrapped(owner, name, lambda right: lambda *args: change(right(*args)))


def answer(kind: type[Brick], message: type, change: Callable[[list[Effect]], list[Effect]]) -> Plant:
    """What a brick asks for after a message of that type is changed."""

    def make(right: Callable[..., list[Effect]]) -> object:
        def step(self: Brick, port: str, msg: object, now_ns: int) -> list[Effect]:
            effects = right(self, port, msg, now_ns)
            return change(effects) if isinstance(msg, message) else effects

        return step

    return wrapped(kind, "step", make)


def heard(kind: type[Brick], message: type, change: Callable[..., object]) -> Plant:
    """A brick hears something else in the place of a message of that type: `change` is given both."""

    def make(right: Callable[..., list[Effect]]) -> object:
        def step(self: Brick, port: str, msg: object, now_ns: int) -> list[Effect]:
            return right(self, port, change(self, msg) if isinstance(msg, message) else msg, now_ns)

        return step

    return wrapped(kind, "step", make)


def skipped(owner: object, name: str, wanted: Callable[..., bool] = lambda *args: True) -> Plant:
    """The steps of the executive that the function stands for are not done, where its arguments are so."""

    def make(right: Callable[..., object]) -> object:
        return lambda *args: nothing() if wanted(*args) else right(*args)

    return wrapped(owner, name, make)


def nothing() -> Generator[object, object, None]:
    """No step."""
    yield from ()


def both(*plants: Plant) -> Plant:
    """Several at a time: they make one bug."""

    @contextmanager
    def planted() -> Iterator[None]:
        with ExitStack() as stack:
            for plant in plants:
                stack.enter_context(plant())
            yield

    return planted


# -- experiments ----------------------------------------------------------------------------------


def crashes(ftm: str, *bricks: str, placement: str = "process", requests: int = REQUESTS) -> Setups:
    """Of `explore crash`: the deaths in these bricks."""
    base = Setup(count=requests)
    return lambda: (s for s in explore.crashes(base, [ftm], [placement]) if s.dooms[0].brick in bricks)


def adapts(
    old: str,
    new: str,
    *nodes: str,
    placement: str = "process",
    load: tuple[int, float] = LOAD,
    seeds: int = 1,
    when: Iterable[Event] = explore.STEPS,
) -> Setups:
    """Of `explore adapt`: the deaths of these nodes, under another load perhaps (requests, and how fast)."""
    events = {event.label for event in when}
    return lambda: (
        msgspec.structs.replace(s, count=load[0], rate_hz=load[1], seed=seed)
        for s in explore.adaptations([(old, new)], [placement])
        if s.faults[0].target in nodes and s.faults[0].trigger.event in events
        for seed in range(seeds)
    )


def pairs(ftm: str, nodes: Iterable[str], delays_ms: Iterable[float], placement: str = "process") -> Setups:
    """Of `explore pairs`: the crashes of these nodes, after these delays, behind any first fault."""
    when_ms = {explore.FIRST_MS + delay for delay in delays_ms}
    hit = set(nodes)
    return lambda: (
        s
        for s in explore.pairs([ftm], [placement])
        if s.faults[1].target in hit and s.faults[1].trigger.after_ms in when_ms
    )


def clean(*setups: Setup) -> Setups:
    """No fault at all."""
    return lambda: setups


def adapted(old: str, new: str, *faults: Fault, placement: str = "process", count: int = 40) -> Setup:
    """A run with one adaptation and these faults."""
    return Setup(
        old,
        placement,
        count=count,
        rate_hz=explore.ADAPT_RATE_HZ,
        faults=faults,
        adaptations=(Scheduled(Goal(expression=new), explore.ADAPT_AT),),
    )


def crash(target: str, event: str, nth: int = 1) -> Fault:
    """At an event."""
    return Fault(Crash(), target, Trigger(event, nth))


def crash_after(target: str, ms: float) -> Fault:
    """At a time."""
    return Fault(Crash(), target, Trigger(after_ms=ms))


def hang(target: str, for_ms: int, event: str, nth: int = 1) -> Fault:
    """At an event; it goes on by itself."""
    return Fault(Hang(for_ms), target, Trigger(event, nth))


def flip(place: ValuePlace, bit: int, event: str, nth: int, target: str = "primary") -> Fault:
    """One bit of one execution."""
    return Fault(ValueFlip(place, Bit(bit)), target, Trigger(event, nth))
