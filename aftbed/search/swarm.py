"""Swarm: a whole experiment out of one seed, so that combinations that no list has are tried too.

Explorers try all there is of one kind. A swarm draws of every kind at once: mechanism, placement, load,
faults, adaptations, and by the same seed the delays. As in swarm testing (Groce et al., 2012), a run leaves
out most of what there is: one with no adaptation, or with no fault, comes to where the others do not.

What is drawn is within what is promised, so that **every breach is a bug**:

| drawn                                   | but never                                                        |
|-----------------------------------------|------------------------------------------------------------------|
| a crash of any node or role             | under `none`, which replaces nothing that died                   |
| a hang for a time, of any node or role  | the same                                                         |
| a hang for good, of a role or a replica | of a node that no Watchdog watches                               |
| a slow node, a message that comes late  | so slow or late that the run cannot come to rest in time         |
| a bit flipped in an execution           | without TR from the start to the end; two within a few requests  |
| an adaptation, refused or not           | away from TR in a run with a flipped bit                         |
| both replicas in one node               | for a duplex: the run could not come to rest without redundancy  |
| a car                                   | with two faults, or one replica: it may lose its brakes          |

Every fault comes while requests are still to come: one that strikes behind the last would have to be waited
for. So the time of a fault is at most what the load takes at least (with the launch, which a fault must not
disturb), and an event is counted up to a part of the requests only.
"""

from collections.abc import Iterable, Iterator
from functools import lru_cache
from random import Random
from typing import Final

from aftbed.core.errors import ConfigError
from aftbed.core.events import REQUEST_EVENTS, Event
from aftbed.core.graph import PLACEMENTS, STAGED, Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.compose import EXPRESSIONS, NONE, build, replication_of, tolerates
from aftbed.ftm.registry import EMITTERS, MECHANISMS, server_emits
from aftbed.inject import targets
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.inject.slow import Slow
from aftbed.inject.value import EXECUTED, ValueFlip
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import STEPS
from aftbed.vehicle.scenarios.library import scenario_names

DUPLEX: Final = tuple(e for e in EXPRESSIONS if replication_of(e))
SIMPLEX: Final = tuple(e for e in EXPRESSIONS if not replication_of(e))
ALONE: Final = next(name for name, one in MECHANISMS.items() if name in SIMPLEX and one.suitability.tolerates)
DUPLEX_PART: Final = 0.85
NONE_PART: Final = 0.04
SINGLE_PART: Final = 0.3  # of those with one replica
CAR_PART: Final = 0.01
CLOSED_PART: Final = 0.4  # of the loads: the next request follows the reply
FLIPS_PART: Final = 0.5  # of the runs with TR and a fault
ADAPTED_PART: Final = 0.5

REQUESTS: Final = (20, 380)
RATE_HZ: Final = (200.0, 4000.0)
FAULTS_MAX: Final = 3
ADAPTATIONS_MAX: Final = 2
HANG_MS_MAX: Final = 400
LATE_PART: Final = 0.2  # of the faults: a channel or a node that is late
LATE_MS_MAX: Final = 10
SLOW_FOR_MS_MAX: Final = 100
NTH_PART: Final = 0.75  # of the requests: an event is counted so far at most
RARE_NTH_MAX: Final = 2  # of events that not every request brings
RARE_PART: Final = 0.15  # of the events that a fault waits for
STEPS_MAX: Final = 16  # of an adaptation
CAR_FAULTS_MAX: Final = 1
CAR_REQUESTS: Final = 40  # fewer than any scenario has
CAR_MS: Final = 1500.0  # less than any scenario lasts
REQUEST_MS_MIN: Final = 0.02  # what a request takes at least
LAUNCH_MS: Final = 0.6  # from the arming of a fault to the first request, at most: a launch must succeed
FLIPS_APART: Final = 50  # executions, so that no request sees two
BIT_DRAWN_MAX: Final = 4096


def drawn(seed: int) -> Setup:
    """The experiment of `seed`, which is whole: nothing but it has a part in the run."""
    return _Draw(seed).setup()


def experiments(seeds: Iterable[int]) -> Iterator[Setup]:
    """Those of `seeds`, in their order."""
    return map(drawn, seeds)


@lru_cache(maxsize=128)
def _events(ftm: str, placement: str) -> tuple[Event, ...]:
    """What a fault can wait for where `ftm` runs."""
    graph = build(ftm, placement)
    return tuple(e for e in EMITTERS if _possible(Fault(Crash(), targets.PRIMARY, Trigger(e.label)), graph))


@lru_cache(maxsize=128)
def _channels(ftm: str, placement: str) -> tuple[str, ...]:
    """Those on which the replica that leads sends, but that from After to the backup.

    What is held back there dies with its sender, when the reply has gone: two faults, and two replicas
    that differ.
    """
    graph = build(ftm, placement)
    to_backup = {port for part, port in replication_of(ftm) if part == "after"}
    names = sorted({link.name for link in graph.links} - to_backup)
    faults = {
        name: Fault(ChannelFault(Disturbance.DELAY, name), targets.PRIMARY, Trigger()) for name in names
    }
    return tuple(name for name, fault in faults.items() if _possible(fault, graph))


def _possible(fault: Fault, graph: Graph) -> bool:
    try:
        fault.check(graph)
    except ConfigError:
        return False
    return True


class _Draw:
    """One draw: each part from what the parts before it allow."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._chance = chance = Random(f"swarm/{seed}")
        self._scenario = chance.choice(scenario_names()) if chance.random() < CAR_PART else ""
        self._ftm = self._draw_ftm()
        self._placement = self._draw_placement()
        self._count = round(chance.triangular(*REQUESTS))
        self._rate_hz = 0.0
        if chance.random() >= CLOSED_PART:
            low, high = RATE_HZ
            self._rate_hz = float(round(low * (high / low) ** chance.random()))
        faults_max = 0 if self._ftm == NONE else CAR_FAULTS_MAX if self._scenario else FAULTS_MAX
        self._faults_wanted = chance.randint(0, faults_max)
        self._flips = (
            tolerates(self._ftm, "value") and self._faults_wanted > 0 and chance.random() < FLIPS_PART
        )

    def setup(self) -> Setup:
        """All of it."""
        adaptations = self._draw_adaptations()
        faults = self._draw_faults(adapted=bool(adaptations))
        return Setup(
            self._ftm,
            self._placement,
            self._seed,
            self._count,
            self._rate_hz,
            faults,
            adaptations,
            scenario=self._scenario,
        )

    # -- what runs ----------------------------------------------------------------------------

    def _draw_ftm(self) -> str:
        which = self._chance.random()
        if which < DUPLEX_PART or self._scenario:
            return self._chance.choice(DUPLEX)
        return NONE if which > 1 - NONE_PART else ALONE

    def _draw_placement(self) -> str:
        if not replication_of(self._ftm) and self._chance.random() < SINGLE_PART:
            return "single"
        return self._chance.choice([p for p in PLACEMENTS if p != "single"])

    def _draw_adaptations(self) -> tuple[Scheduled, ...]:
        chance = self._chance
        if chance.random() >= ADAPTED_PART:
            return ()
        ways = DUPLEX if self._scenario else SIMPLEX if self._placement == "single" else EXPRESSIONS
        ways = tuple(e for e in ways if e != NONE and (tolerates(e, "value") or not self._flips))
        found = [
            Scheduled(Goal(expression=chance.choice(ways)), chance.randint(1, self._requests()))
            for _ in range(chance.randint(1, ADAPTATIONS_MAX))
        ]
        return tuple(sorted(found, key=lambda scheduled: scheduled.at_request))

    def _requests(self) -> int:
        """How many there will be at least."""
        return CAR_REQUESTS if self._scenario else self._count

    # -- what goes wrong ----------------------------------------------------------------------

    def _draw_faults(self, *, adapted: bool) -> tuple[Fault, ...]:
        wanted = self._faults_wanted
        flips = self._draw_flips(self._chance.randint(1, wanted)) if self._flips else []
        others = [self._draw_fault(adapted) for _ in range(wanted - len(flips))]
        return (*flips, *others)

    def _draw_flips(self, count: int) -> list[Fault]:
        """All in one role, and far enough from each other."""
        chance = self._chance
        graph = build(self._ftm, self._placement)
        executes = server_emits(graph, Event.SERVER_EXIT, backs_up=True)  # the backup, too
        role = chance.choice(targets.ROLES if executes else targets.ROLES[:1])
        found = []
        nth = chance.randint(1, self._nth_max())
        for _ in range(count):
            bit = chance.choice((None, chance.randrange(BIT_DRAWN_MAX)))
            flip = ValueFlip(chance.choice(EXECUTED), Bit(bit))
            found.append(Fault(flip, role, Trigger(Event.SERVER_EXIT.label, nth)))
            nth += FLIPS_APART + chance.randrange(FLIPS_APART)
        return found

    def _draw_fault(self, adapted: bool) -> Fault:
        chance = self._chance
        if chance.random() < LATE_PART:
            return self._draw_late()
        trigger = self._draw_trigger(adapted)
        steps = trigger.event in {event.label for event in STEPS}
        target = self._draw_target(staged=steps)
        if chance.random() < 0.6 or target.endswith(STAGED):
            return Fault(Crash(), target, trigger)
        watched = target in targets.ROLES or replica_of(target)
        hang_ms = 0 if watched and chance.random() < 0.4 else chance.randint(1, HANG_MS_MAX)
        return Fault(Hang(hang_ms), target, trigger)

    def _draw_late(self) -> Fault:
        """A slow node or channel. It may be taken for dead; then its messages must not be accepted."""
        chance, graph = self._chance, build(self._ftm, self._placement)
        by_ms = chance.randint(1, LATE_MS_MAX)
        if chance.random() < 0.5:
            slow = Slow(by_ms, chance.randint(1, SLOW_FOR_MS_MAX))
            node = chance.choice(list(graph.nodes))
            return Fault(
                slow, node, Trigger(after_ms=round(LAUNCH_MS + self._load_ms() * chance.random(), 3))
            )
        channel = chance.choice(_channels(self._ftm, self._placement))
        return Fault(
            ChannelFault(Disturbance.DELAY, channel, by_ms),
            targets.PRIMARY,
            Trigger(nth=chance.randint(1, self._nth_max())),
        )

    def _draw_target(self, *, staged: bool) -> str:
        chance, graph = self._chance, build(self._ftm, self._placement)
        if chance.random() < 0.4:
            return chance.choice(targets.roles_in(graph))
        node = chance.choice(list(graph.nodes))
        return f"{node}{STAGED}" if staged and replica_of(node) and chance.random() < 0.3 else node

    def _draw_trigger(self, adapted: bool) -> Trigger:
        chance = self._chance
        if adapted and chance.random() < 0.5:
            return Trigger(chance.choice(STEPS).label, chance.randint(1, STEPS_MAX))
        if chance.random() < 0.3:
            return Trigger(after_ms=round(LAUNCH_MS + self._load_ms() * chance.random(), 3))
        often = chance.random() >= RARE_PART
        event = chance.choice(
            [e for e in _events(self._ftm, self._placement) if (e in REQUEST_EVENTS) is often]
        )
        return Trigger(event.label, chance.randint(1, self._nth_max() if often else RARE_NTH_MAX))

    def _nth_max(self) -> int:
        return max(1, round(self._requests() * NTH_PART))

    def _load_ms(self) -> float:
        """What the load takes at least."""
        if self._scenario:
            return CAR_MS
        period_ms = 1e3 / self._rate_hz if self._rate_hz else REQUEST_MS_MIN
        return (self._count - 1) * period_ms
