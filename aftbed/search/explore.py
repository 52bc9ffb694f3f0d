"""Exhaustive explorers: not "some", but all there are, with a count that is exact.

    crash    a death before each effect of each brick, and after its last, over a few requests
    adapt    a death before, during and after each step of each adaptation, of each node that takes part
    pairs    each first fault of a few, followed by each second one, after each delay of a grid

In all of them pages are small (`PAGE_BYTES`), so that checkpoints travel as those of a large state do.

Every case is one simulated run of its own, judged by all checkers. An experiment is a value (`Setup`), so
that a broken one is repeated by its number in the same `Selection`.
"""

import itertools
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from functools import lru_cache, partial
from random import Random
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.planner import plan, target
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import Event
from aftbed.core.graph import STAGED
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import Stage, flat
from aftbed.ftm.compose import NONE, build, duplex_expressions, expressions, parse, tolerates
from aftbed.ftm.registry import MECHANISMS, server_emits
from aftbed.functions.load import NO_CODE, OWN_CODE, Code
from aftbed.functions.request_file import GivenRequests
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, FaultAction
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.judge.asked import not_happened
from aftbed.judge.simulated import breaches, record_of
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.interleaving import HeldChannel, orders
from aftbed.runtime.sim.world import Doom, Run, Setup, World, simulate
from aftbed.runtime.unix.worker_pool import SECONDS_MAX, Alone, each, own_seconds_max
from aftbed.search.tally import Happened, happened_in

PLACEMENTS: Final = ("process", "replica")
STEPS: Final = (Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_ACT, Event.ADAPT_STEP_EXIT)
ELSEWHERE: Final = ("client", "a/watchdog", "b/watchdog")  # take no part in an adaptation
ADAPT_REQUESTS: Final = 40
ADAPT_RATE_HZ: Final = 400.0
ADAPT_AT: Final = 4  # the request at which the adaptation begins
EXECUTIVE: Final = "executive"  # beside the checks: it broke down
PAGE_BYTES: Final = 16  # the built-in function's state is that of a large one then: only its changes travel
REASON_MAX: Final = 300  # characters of an error of our own


class ScriptSteps(NamedTuple):
    """The steps of an adaptation at which a fault can strike, and the nodes that the first of them stage."""

    staged: tuple[str, ...]
    total: int


@lru_cache(maxsize=512)
def steps_of(old: str, new: str, placement: str) -> ScriptSteps:
    """Those of the adaptation from `old` to `new`. Raises ConfigError where nothing leads there."""
    start = build(old, placement)
    script = plan(start, target(start, new)).script
    staged = tuple(v.node for v in flat(script.prepare) if isinstance(v, Stage))
    return ScriptSteps(staged, len(staged) + len(script.commit))


class Strike(NamedTuple):
    """A node that dies at a step of an adaptation, before or behind it."""

    old: str
    new: str
    node: str
    when: Event
    step: int


def strikes(old: str, new: str, placement: str) -> Iterator[Strike]:
    """All of one way: each node that takes part, and each process that is staged, as soon as it is."""
    staged, count = steps_of(old, new, placement)
    steps = range(1, count + 1)
    for node, when, step in itertools.product(build(old, placement).nodes, STEPS, steps):
        if node not in ELSEWHERE:
            yield Strike(old, new, node, when, step)
    for node, when, step in itertools.product(staged, STEPS, steps):
        if when is Event.ADAPT_STEP_EXIT or (step, STEPS.index(when)) > (len(staged), 0):  # all are staged
            yield Strike(old, new, f"{node}{STAGED}", when, step)


# -- what there is to explore ---------------------------------------------------------------------


def crashes(
    base: Setup, ftms: Iterable[str], placements: Iterable[str], code: Code = OWN_CODE
) -> Iterator[Setup]:
    """A death at each effect of each brick; `base` has the function and its requests."""
    for ftm, placement in itertools.product(ftms, placements):
        clean = msgspec.structs.replace(base, ftm=ftm, placement=placement, page_bytes=PAGE_BYTES)
        for brick, count in sorted(simulate(clean, code).effects.items()):
            for effect in range(count + 1):
                yield msgspec.structs.replace(clean, dooms=(Doom(brick, effect),))


def adaptations(pairs: Iterable[tuple[str, str]], placements: Iterable[str]) -> Iterator[Setup]:
    """A death at each side of each step of each adaptation."""
    for (old, new), placement in itertools.product(pairs, placements):
        for struck in strikes(old, new, placement):
            yield Setup(
                old,
                placement,
                count=ADAPT_REQUESTS,
                rate_hz=ADAPT_RATE_HZ,
                faults=(Fault(Crash(), struck.node, Trigger(struck.when.label, struck.step)),),
                adaptations=(Scheduled(Goal(expression=new), ADAPT_AT),),
                page_bytes=PAGE_BYTES,
            )


STRIKES: Final[tuple[FaultAction, ...]] = (Crash(), Hang())
FIRST_EVENTS: Final = (  # where the first fault of a pair strikes the leader's side
    Event.REQUEST_RECEIVED,
    Event.BEFORE_EXIT,
    Event.SERVER_EXIT,
    Event.REPLY_STORED,
    Event.REPLY_SENT,
)
DELAYS_MS: Final = (0.05, 0.15, 0.25, 0.35, 0.5, 0.8, 1.2, 2.0, 3.0, 4.0, 6.0, 9.0)  # to the second
PAIR_REQUESTS: Final = 40
PAIR_RATE_HZ: Final = 2000.0
FIRST_MS: Final = 1.0  # from the start of the load to the first fault, about


def pairs(ftms: Iterable[str], placements: Iterable[str]) -> Iterator[Setup]:
    """Each second fault while the first one is being recovered from, and some time after."""
    for ftm, placement in itertools.product(ftms, placements):
        graph = build(ftm, placement)
        nodes = list(graph.nodes)
        firsts = [
            Fault(act, "primary", Trigger(event.label, 3))
            for act, event in itertools.product(STRIKES, FIRST_EVENTS)
        ]
        flips: list[tuple[ValuePlace, str, Event]] = []
        if tolerates(ftm, "value"):
            flips += [(place, "primary", Event.SERVER_EXIT) for place in EXECUTED]
        if server_emits(graph, Event.STATE_RESTORED, backs_up=True):  # in the backup's checkpoint
            flips += [(ValuePlace.STATE, "backup", Event.STATE_RESTORED)]
        firsts += [
            Fault(ValueFlip(place, Bit(bit)), role, Trigger(event.label, 3))
            for place, role, event in flips
            for bit in (0, 100)
        ]
        for first, node, delay_ms in itertools.product(firsts, nodes, DELAYS_MS):
            second = Fault(Crash(), node, Trigger(after_ms=FIRST_MS + delay_ms))
            yield Setup(
                ftm,
                placement,
                count=PAIR_REQUESTS,
                rate_hz=PAIR_RATE_HZ,
                faults=(first, second),
                page_bytes=PAGE_BYTES,
            )


# -- a choice of them -----------------------------------------------------------------------------


class Explorer(NamedTuple):
    """`known`: the mechanisms that can be named; `ftms`: those of a selection that names none; `every`: the
    experiments of a selection, always in the same order.
    """

    known: Callable[[], tuple[str, ...]]
    ftms: Callable[[], tuple[str, ...]]
    every: Callable[["Selection"], Iterator[Setup]]


class Selection(msgspec.Struct, frozen=True):
    """What of all there is is explored; `requests` for `crash` only. An experiment has its number in it.

    `application`, `given`: a function of the user, and the requests that it is sent.
    """

    explorer: str
    ftms: tuple[str, ...]
    placements: tuple[str, ...] = PLACEMENTS
    requests: int = 0
    application: str = ""
    given: GivenRequests | None = None

    def setups(self) -> Iterator[Setup]:
        """Every experiment."""
        for setup in EXPLORERS[self.explorer].every(self):
            yield msgspec.structs.replace(setup, application=self.application, given=self.given)

    @property
    def base(self) -> Setup:
        """What all experiments have in common."""
        return Setup(count=self.requests, application=self.application, given=self.given)


def adaptable() -> tuple[str, ...]:
    """What an adaptation may lead to: nothing leads to `none`, or away from it."""
    return tuple(ftm for ftm in expressions() if ftm != NONE)


def adapted() -> tuple[str, ...]:
    """Those of them that are explored unless others are named."""
    return tuple(
        ftm for ftm in adaptable() if all(MECHANISMS[name].adaptations_explored for name in parse(ftm))
    )


EXPLORERS: Final = {
    "crash": Explorer(
        duplex_expressions, duplex_expressions, lambda s: crashes(s.base, s.ftms, s.placements)
    ),
    "adapt": Explorer(
        adaptable, adapted, lambda s: adaptations(itertools.permutations(s.ftms, 2), s.placements)
    ),
    "pairs": Explorer(duplex_expressions, duplex_expressions, lambda s: pairs(s.ftms, s.placements)),
}


def selected(explorer: str, ftms: Iterable[str], placements: Iterable[str], requests: int = 0) -> Selection:
    """What is named; where nothing is, all that is explored. Raises ConfigError naming what cannot be."""
    found = EXPLORERS[explorer]
    ftms = _chosen("FTM", ftms, found.known()) or found.ftms()
    chosen = Selection(explorer, ftms, _chosen("placement", placements, PLACEMENTS) or PLACEMENTS)
    if explorer == "adapt" and len(chosen.ftms) < 2:
        raise ConfigError(f"--ftm {chosen.ftms[0]}: an adaptation leads to another one: name two")
    return msgspec.structs.replace(chosen, requests=requests)


def _chosen(what: str, names: Iterable[str], known: tuple[str, ...]) -> tuple[str, ...]:
    """Those of `known` that are named, each once, as they were named."""
    named = tuple(dict.fromkeys(names))
    for name in named:
        if name not in known:
            raise unknown(what, name, known)
    return named


# -- exploring ------------------------------------------------------------------------------------


class Broken(msgspec.Struct, frozen=True):
    """An experiment that broke a promise, in words, and the command that repeats it."""

    number: int
    setup: str
    breaches: tuple[str, ...]
    command: str


class Explored(msgspec.Struct, frozen=True):
    """`unavailable` of those that survived: a fault had struck each replica."""

    explored: int
    survived: int
    unavailable: int
    seconds: float
    broken: tuple[Broken, ...]


class Found(NamedTuple):
    """What came of an experiment; `missed` is what was asked for and did not happen (G8).

    `happened` is None where the executive itself broke down.
    """

    lost: bool
    breaches: tuple[Breach, ...]
    requests: int = 0
    missed: tuple[str, ...] = ()
    happened: Happened | None = None


Attempt = Callable[[Setup], tuple[Run | None, tuple[Breach, ...]]]


def attempt(setup: Setup, code: Code = NO_CODE) -> tuple[Run | None, tuple[Breach, ...]]:
    """The run and what it breaks; None where the executive itself broke down: that is a fault of ours."""
    try:
        run = simulate(setup, code)
    except Exception as error:  # noqa: BLE001 - whatever it is, this experiment has found it
        reason = f"the executive broke down: {type(error).__name__}: {error}"
        return None, (Breach(EXECUTIVE, reason[:REASON_MAX]),)
    return run, breaches(run, code)


def attempt_own(setup: Setup) -> tuple[Run | None, tuple[Breach, ...]]:
    """`attempt` of a setup whose function, and bricks, the user has named himself."""
    return attempt(setup, OWN_CODE)


def tried(setup: Setup, attempt: Attempt = attempt) -> Found:
    """One experiment, in numbers, as `attempt` makes and judges it."""
    run, broken = attempt(setup)
    if run is None:
        return Found(False, broken)
    sent = sum(e.kind is EntryKind.SENT for e in run.history.dialogue)
    missed = tuple(not_happened(record_of(run)))
    return Found(run.rest.lost, broken, sent, missed, happened_in(run))


def judged(setup: Setup) -> tuple[bool, tuple[Breach, ...]]:
    """Whether the service was lost, and what was broken."""
    run, broken = attempt_own(setup)
    return run is not None and run.rest.lost, broken


def explore(
    setups: Iterable[Setup], jobs: int = 1, alone: Alone[Setup] | None = None, *, apart: bool = False
) -> Generator[tuple[int, Setup, bool, tuple[Breach, ...]], None, None]:
    """Every experiment with its number and what came of it, in order. See `each`.

    `apart`: each executes a function of the user, so it may crash, or hang.
    """
    seconds_max = SECONDS_MAX
    if apart:
        setups = list(setups)
        seconds_max = own_seconds_max(max((setup.count for setup in setups), default=0))
    with closing(each(judged, setups, jobs, alone=alone, seconds_max=seconds_max, apart=apart)) as found:
        for number, setup, (lost, broken) in found:
            yield number, setup, lost, broken


# -- `explore order`: every order in which messages can arrive ------------------------------------
#
# For a few requests, with and without a crash. What is run, and which orders are left out since they equal
# another: `runtime.sim.interleaving`. An experiment ends when all its orders have been run, or at a bound on
# the runs, which is part of the result: only those that came to their end are `complete`.

RUN_SECONDS_MAX: Final = 1.0  # on a busy machine
RUNS_MAX: Final = 2_000  # per experiment, unless another bound is given
CRASHED: Final = ("protocol", "before", "proceed", "after", "server")  # parts whose death is a crash here


class OrderedRuns(msgspec.Struct, frozen=True):
    """What came of an experiment: `orders` were run to their end, `cut` runs turned out to equal others."""

    setup: Setup
    orders: int
    cut: int
    complete: bool
    breaches: tuple[str, ...]  # of the first order that broke something
    broken: int  # orders that broke something


def experiments(ftms: Iterable[str], placements: Iterable[str], requests: int) -> Iterator[Setup]:
    """Up to `requests` requests undisturbed; and one, with a death in the midst of each part of a replica."""
    for ftm, placement in itertools.product(ftms, placements):
        for count in range(1, requests + 1):
            yield Setup(ftm, placement, count=count, page_bytes=PAGE_BYTES)
        one = Setup(ftm, placement, count=1, page_bytes=PAGE_BYTES)
        for brick, effects in sorted(simulate(one).effects.items()):
            if brick.rpartition("/")[2] in CRASHED and effects > 1:
                yield msgspec.structs.replace(one, dooms=(Doom(brick, effects // 2),))


def all_orders(setup: Setup, runs_max: int = RUNS_MAX) -> OrderedRuns:
    """Run them, up to the bound."""
    first: tuple[Breach, ...] = ()
    broken = whole = cut = 0

    def run(clock: Callable[[Random], Clock]) -> None:
        nonlocal first, broken
        found = breaches(World(setup, channel=HeldChannel, clock=clock).run())
        first, broken = first or found, broken + bool(found)

    found = orders(run)
    for complete in itertools.islice(found, runs_max):
        whole, cut = whole + complete, cut + (not complete)
    left = next(found, None) is not None if whole + cut == runs_max else False
    return OrderedRuns(setup, whole, cut, not left, tuple(map(str, first)), broken)


def explore_orders(
    setups: Iterable[Setup], runs_max: int = RUNS_MAX, jobs: int = 1
) -> Generator[OrderedRuns, None, None]:
    """Every experiment, in order."""
    seconds_max = max(SECONDS_MAX, runs_max * RUN_SECONDS_MAX)
    judge = partial(all_orders, runs_max=runs_max)
    with closing(each(judge, setups, jobs, seconds_max=seconds_max)) as found:
        for _, _, one in found:
            yield one
