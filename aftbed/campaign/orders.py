"""`explore order`: every order in which messages can arrive, for a few requests, with and without a crash.

What is run, and which orders are left out since they equal another: `runtime.sim.interleaving`. An
experiment ends when all its orders have been run, or at a bound on the runs, which is part of the result:
"complete" is said only of those that came to their end.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from random import Random
from typing import Final

import msgspec

from aftbed.campaign.simulated import Breach, breaches
from aftbed.campaign.workers import SECONDS_MAX, each
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.interleaving import HeldChannel, orders
from aftbed.runtime.sim.world import Doom, Setup, World, simulate

RUN_SECONDS_MAX: Final = 1.0  # on a busy machine
RUNS_MAX: Final = 2_000  # per experiment, unless another bound is given
CRASHED: Final = ("protocol", "before", "proceed", "after", "server")  # parts whose death is a crash here


class Ordered(msgspec.Struct, frozen=True):
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
            yield Setup(ftm, placement, count=count)
        one = Setup(ftm, placement, count=1)
        for brick, effects in sorted(simulate(one).effects.items()):
            if brick.rpartition("/")[2] in CRASHED and effects > 1:
                yield msgspec.structs.replace(one, dooms=(Doom(brick, effects // 2),))


def all_orders(setup: Setup, runs_max: int = RUNS_MAX) -> Ordered:
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
    return Ordered(setup, whole, cut, not left, tuple(map(str, first)), broken)


def explore_orders(setups: Iterable[Setup], runs_max: int = RUNS_MAX, jobs: int = 1) -> Iterator[Ordered]:
    """Every experiment, in order."""
    seconds_max = max(SECONDS_MAX, runs_max * RUN_SECONDS_MAX)
    judge = partial(all_orders, runs_max=runs_max)
    for _, _, found in each(judge, setups, jobs, seconds_max=seconds_max):
        yield found
