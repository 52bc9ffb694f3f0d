"""Exhaustive explorers: not "some", but all there are, with a count that is exact.

    crash    a death before each effect of each brick, and after its last, over a few requests
    adapt    a death before, during and after each step of each adaptation, of each node that takes part
    pairs    each first fault of a few, followed by each second one, after each delay of a grid

Every case is one simulated run of its own, judged by all checkers. An experiment is a value (`Setup`), so
that a broken one is repeated by its number.
"""

import itertools
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.plan import plan, target
from aftbed.campaign.simulated import Breach, breaches
from aftbed.core.event import Event
from aftbed.core.fault import Act, Fault, Flip, Place, Trigger
from aftbed.core.message import Goal, Scheduled
from aftbed.core.script import Stage, flat
from aftbed.ftm.mechanism import build
from aftbed.runtime.sim.world import Doom, Run, Setup, simulate
from aftbed.runtime.targets import STAGED

DUPLEX: Final = ("pbr", "lfr", "pbr+tr", "lfr+tr", "pbr+assert", "lfr+assert")
ADAPTABLE: Final = ("pbr", "lfr", "pbr+tr", "lfr+tr")
PLACEMENTS: Final = ("process", "replica")
WHEN: Final = (Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_ACT, Event.ADAPT_STEP_EXIT)
ELSEWHERE: Final = ("client", "a/watchdog", "b/watchdog")  # take no part in an adaptation
ADAPT_REQUESTS: Final = 40
ADAPT_RATE_HZ: Final = 400.0
ADAPT_AT: Final = 4  # the request at which the adaptation begins
CHUNK: Final = 16  # experiments handed to a worker at once


class Strike(NamedTuple):
    """Who dies at which step of an adaptation, and on which side of it."""

    old: str
    new: str
    node: str
    when: Event
    step: int


def strikes(old: str, new: str, placement: str) -> Iterator[Strike]:
    """All of one way: each node that takes part, and each process that is staged, as soon as it is."""
    start = build(old, placement)
    script = plan(start, target(start, new)).script
    staged = [v.node for v in flat(script.prepare) if isinstance(v, Stage)]
    steps = range(1, len(staged) + len(script.commit) + 1)
    for node, when, step in itertools.product(start.nodes, WHEN, steps):
        if node not in ELSEWHERE:
            yield Strike(old, new, node, when, step)
    for node, when, step in itertools.product(staged, WHEN, steps):
        if when is Event.ADAPT_STEP_EXIT or (step, WHEN.index(when)) > (len(staged), 0):  # all are staged
            yield Strike(old, new, f"{node}{STAGED}", when, step)


# -- what there is to explore ---------------------------------------------------------------------


def crashes(ftms: Iterable[str], placements: Iterable[str], requests: int) -> Iterator[Setup]:
    """A death at each effect of each brick."""
    for ftm, placement in itertools.product(ftms, placements):
        clean = Setup(ftm, placement, count=requests)
        for brick, count in sorted(simulate(clean).effects.items()):
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
                faults=(Fault(Act.CRASH, struck.node, Trigger(struck.when.label, struck.step)),),
                adaptations=(Scheduled(Goal(expression=new), ADAPT_AT),),
            )


FIRST_EVENTS: Final = (  # where the first fault of a pair strikes the leader's side
    Event.REQUEST_RECEIVED,
    Event.BEFORE_EXIT,
    Event.SERVER_EXIT,
    Event.REPLY_STORED,
    Event.REPLY_SENT,
)
DELAYS_MS: Final = (0.05, 0.15, 0.25, 0.35, 0.5, 0.8, 1.2, 2.0, 3.0, 4.0, 6.0, 9.0)  # to the second
PAIR_REQUESTS: Final = 40


def pairs(ftms: Iterable[str], placements: Iterable[str]) -> Iterator[Setup]:
    """Each second fault while the first one is being recovered from, and some time after."""
    for ftm, placement in itertools.product(ftms, placements):
        nodes = list(build(ftm, placement).nodes)
        firsts = [
            Fault(act, "primary", Trigger(event.label, 3))
            for act, event in itertools.product((Act.CRASH, Act.HANG), FIRST_EVENTS)
        ]
        if "tr" in ftm.split("+"):
            places = itertools.product(Place, (0, 100))
            firsts += [
                Fault(Act.BITFLIP, "primary", Trigger(Event.SERVER_EXIT.label, 3), flip=Flip(place, bit))
                for place, bit in places
            ]
        for first, node, delay_ms in itertools.product(firsts, nodes, DELAYS_MS):
            second = Fault(Act.CRASH, node, Trigger(after_ms=FIRST_MS + delay_ms))
            yield Setup(ftm, placement, count=PAIR_REQUESTS, rate_hz=PAIR_RATE_HZ, faults=(first, second))


PAIR_RATE_HZ: Final = 2000.0
FIRST_MS: Final = 1.0  # from the start of the load to the first fault, about


# -- exploring ------------------------------------------------------------------------------------


class Broken(msgspec.Struct, frozen=True):
    """An experiment that broke a promise."""

    number: int
    setup: str
    breaches: tuple[str, ...]


class Explored(msgspec.Struct, frozen=True):
    """`unavailable` of those that survived: a fault had struck each replica."""

    explored: int
    survived: int
    unavailable: int
    broken: tuple[Broken, ...]


def judged(setup: Setup) -> tuple[bool, tuple[Breach, ...]]:
    """Whether the service was lost, and what was broken."""
    run: Run = simulate(setup)
    return run.rest.lost, breaches(run)


def explore(setups: Iterable[Setup], jobs: int = 1) -> Iterator[tuple[int, Setup, bool, tuple[Breach, ...]]]:
    """Every experiment with its number and what came of it, in order."""
    first, second = itertools.tee(setups)
    if jobs == 1:
        for number, setup in enumerate(first):
            yield number, setup, *judged(setup)
        return
    with ProcessPoolExecutor(jobs) as pool:
        found = pool.map(judged, first, chunksize=CHUNK)
        for number, (setup, (lost, broken)) in enumerate(zip(second, found, strict=True)):
            yield number, setup, lost, broken
