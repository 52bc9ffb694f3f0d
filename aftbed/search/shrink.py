"""Shrinking: out of an experiment that breaks a promise, the smallest that still does.

Greedy, as in delta debugging (Zeller and Hildebrandt, 2002): of all experiments that are simpler in one
respect, the first that still breaks it takes the place of the last, and it begins anew, until none does. What
is simpler, the most telling first:

| respect                | simpler                                                             |
|------------------------|---------------------------------------------------------------------|
| load                   | no car; fewer requests; a closed loop                               |
| faults, dooms          | one less; earlier (a smaller `nth`, `after_ms`, effect); shorter    |
| adaptations            | one less; earlier                                                   |
| all that is counted    | requests, `nth` and the request of an adaptation, by as much each   |
| mechanism, placement   | nothing inside, if no bit is flipped; `pbr`; one brick a node       |
| pages                  | of the common size                                                  |

An experiment stays one that something is promised of (see `swarm`): with fewer requests nothing is planned
behind the last of them, and what is aimed at a thing that the simpler graph does not have is not tried.

Limits: a minimum in each respect alone. Where two would have to change at once, and not by as much, it is not
found. A fault keeps its target.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Final, assert_never

from msgspec import json
from msgspec.structs import replace

from aftbed.core.errors import ConfigError
from aftbed.core.messages import Scheduled
from aftbed.ftm.compose import DUPLEX, build, parse, replication_of
from aftbed.ftm.pages import PAGE_BYTES
from aftbed.inject.model import Fault
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Doom, Setup, check
from aftbed.search.swarm import LAUNCH_MS, REQUEST_MS_MIN

TRIES_MAX: Final = 400
CAR_COUNT: Final = 100  # requests in the place of a car

Broken = Callable[[Setup], tuple[Breach, ...]]


def shrink(setup: Setup, broken: Broken, tries_max: int = TRIES_MAX) -> Setup:
    """The simplest that breaks what `setup` breaks first; `broken` is called `tries_max` times at most.

    The same for the same arguments, and always one for which `broken` has returned that.
    """
    first = broken(setup)
    assert first, f"nothing is broken by {setup}"
    check, tried = first[0].check, {json.encode(setup)}
    tries = 1
    while tries < tries_max:
        for simpler in _simpler(setup):
            key = json.encode(simpler)
            if key in tried:
                continue
            if tries == tries_max:
                break
            tries += 1
            tried.add(key)
            found = broken(simpler)
            if found and found[0].check == check:
                setup = simpler
                break
        else:
            break
    return setup


def _simpler(setup: Setup) -> Iterator[Setup]:
    """All that are simpler in one respect, and still make sense."""
    ways = (_fewer, _smaller_loads, _smaller_graphs, _earlier, _one_earlier)
    return filter(_makes_sense, map(_in_time, itertools.chain.from_iterable(way(setup) for way in ways)))


def _makes_sense(setup: Setup) -> bool:
    graph = build(setup.ftm, setup.placement)
    try:
        for fault in setup.faults:
            fault.check(graph)
            check(fault, setup.scenario)
    except ConfigError:
        return False
    return {doom.brick for doom in setup.dooms} <= {brick.name for brick in graph.bricks}


def _in_time(setup: Setup) -> Setup:
    """Nothing is planned for behind the last request."""
    if setup.scenario:
        return setup
    load_ms = max(LAUNCH_MS, (setup.count - 1) * (1e3 / setup.rate_hz if setup.rate_hz else REQUEST_MS_MIN))

    def timely(fault: Fault) -> Fault:
        trigger = fault.trigger
        if trigger.event or trigger.after_ms <= load_ms:
            return fault
        return replace(fault, trigger=replace(trigger, after_ms=round(load_ms, 3)))

    return replace(
        setup,
        faults=tuple(timely(f) for f in setup.faults),
        adaptations=tuple(replace(a, at_request=min(a.at_request, setup.count)) for a in setup.adaptations),
    )


# -- ways ------------------------------------------------------------------------------------------

LISTS: Final = ("faults", "adaptations", "dooms")


def _fewer(setup: Setup) -> Iterator[Setup]:
    for name in LISTS:
        items = getattr(setup, name)
        for at in range(len(items)):
            yield replace(setup, **{name: items[:at] + items[at + 1 :]})


def _smaller_loads(setup: Setup) -> Iterator[Setup]:
    if setup.scenario:
        yield replace(setup, scenario="", count=CAR_COUNT, rate_hz=0.0)
        return
    for count in _smaller(setup.count):
        yield replace(setup, count=count)
    if setup.rate_hz:
        yield replace(setup, rate_hz=0.0)


def _smaller_graphs(setup: Setup) -> Iterator[Setup]:
    """A duplex stays one, and where a bit is flipped TR stays."""
    names = parse(setup.ftm)
    flips = any(fault.action.alters_value for fault in setup.faults)
    if len(names) > 1 and not flips:
        yield replace(setup, ftm=names[0])
    if replication_of(setup.ftm) and names[0] != DUPLEX[0]:
        yield replace(setup, ftm="+".join((DUPLEX[0], *names[1:])))
    if setup.placement != "process":
        yield replace(setup, placement="process")
    if setup.page_bytes != PAGE_BYTES:
        yield replace(setup, page_bytes=PAGE_BYTES)


def _earlier(setup: Setup) -> Iterator[Setup]:
    """The way to the first thing that is counted becomes shorter; what comes after it keeps its distance."""
    counted = [f.trigger.nth for f in setup.faults if f.trigger.event]
    counted += [a.at_request for a in setup.adaptations if a.at_request]
    first = min((setup.count, *counted))
    for left in _smaller(first) if counted else ():
        yield _by(setup, first - left)


def _by(setup: Setup, gone: int) -> Setup:
    """`setup` without its first requests, `gone` of them."""

    def of(fault: Fault) -> Fault:
        nth = fault.trigger.nth - gone * bool(fault.trigger.event)
        return replace(fault, trigger=replace(fault.trigger, nth=nth))

    adaptations = (replace(a, at_request=a.at_request - gone * bool(a.at_request)) for a in setup.adaptations)
    faults = tuple(map(of, setup.faults))
    return replace(setup, count=setup.count - gone, faults=faults, adaptations=tuple(adaptations))


def _one_earlier(setup: Setup) -> Iterator[Setup]:
    """One fault, adaptation or doom earlier, or shorter."""
    for name in LISTS:
        items = getattr(setup, name)
        for at, item in enumerate(items):
            for other in _earlier_item(item):
                yield replace(setup, **{name: (*items[:at], other, *items[at + 1 :])})


def _earlier_item(item: Fault | Scheduled | Doom) -> Iterator[Fault | Scheduled | Doom]:
    match item:
        case Fault(trigger=trigger, action=action):
            for nth in _smaller(trigger.nth):
                yield replace(item, trigger=replace(trigger, nth=nth))
            for after_ms in _sooner(trigger.after_ms):
                yield replace(item, trigger=replace(trigger, after_ms=after_ms))
            for lasts_ms in _smaller(action.lasts_ms):
                yield replace(item, action=action.lasting(lasts_ms))
        case Scheduled():
            for at_request in _smaller(item.at_request):
                yield replace(item, at_request=at_request)
            for after_ms in _sooner(item.after_ms):
                yield replace(item, after_ms=after_ms)
        case Doom(brick=brick, effect=effect):
            for less in _smaller(effect, least=0):
                yield Doom(brick, less)
        case _:
            assert_never(item)


def _smaller(number: int, least: int = 1) -> Iterator[int]:
    """The smallest, the one half way, and the next: so the last step is to a minimum."""
    if number > least:
        yield from dict.fromkeys((least, (least + number) // 2, number - 1))


def _sooner(ms: float) -> Iterator[float]:
    """Half of it, or without what is behind the point; 0 means something else."""
    for found in (round(ms / 2, 3), float(int(ms))):
        if LAUNCH_MS <= found < ms:
            yield found
