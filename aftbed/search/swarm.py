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

What is drawn can also happen, so that **a run proves something about it**:

| drawn                    | within                                                                          |
|--------------------------|---------------------------------------------------------------------------------|
| the nth of an event      | a part of the requests during which the mechanism that then runs emits it       |
| a time                   | what the load takes at least, with the launch, which a fault must not disturb   |
| an event of a failover   | a run in which an earlier fault causes one                                      |
| a step of an adaptation  | the script of that adaptation                                                   |
| a target                 | what is there in every graph that has run by then                               |
| a bit                    | those that the function does not refuse                                         |
| an adaptation            | ways from what then runs; the one before it has time to end                     |

In half of the runs pages are small: checkpoints travel as those of a large state do.

The rest is drawn on purpose (NEVER_PART): a trigger beyond the run, an event that nothing causes, an
adaptation to what runs, or while another is under way. `intended` says which these are, by the setup alone,
and `contradictions` finds what happened in spite of it. What was drawn to happen may still be prevented, by
another fault: a swarm of enough runs is therefore judged by shares (`tally`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from random import Random
from typing import Final, NamedTuple, TypeVar

from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import REQUEST_EVENTS, Event
from aftbed.core.graph import PLACEMENTS, STAGED, Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm import pages
from aftbed.ftm.compose import EXPRESSIONS, NONE, replication_of, tolerates
from aftbed.ftm.registry import EMITTERS, MECHANISMS, server_emits
from aftbed.inject import targets
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger, with_flipped
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, FaultAction
from aftbed.inject.receipts import ReceiptState
from aftbed.inject.slow import Slow
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.judge.verdict import Breach
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.world import Run, Setup, graph_of, requests_of
from aftbed.search import explore
from aftbed.search.explore import STEPS, ScriptSteps, attempt, steps_of
from aftbed.search.tally import AdaptationEnd, Intended, Intent, happened_in
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.scenarios.library import scenario_names

T = TypeVar("T")

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
ADAPTATION_MS: Final = 130.0  # from its begin to its end: mostly the observation
HANG_MS_MAX: Final = 400
BRIEF_HANG_MS: Final = 30  # shorter than what a Watchdog takes for a hang
LATE_PART: Final = 0.2  # of the faults: a channel or a node that is late
LATE_MS_MAX: Final = 10
SLOW_FOR_MS_MAX: Final = 100
STEP_PART: Final = 0.3  # of the faults beside an adaptation: at one of its steps
STAGED_PART: Final = 0.2  # of those: in a process that is being prepared
NTH_PART: Final = 0.75  # of the requests: an event is counted so far at most
RARE_PART: Final = 0.15  # of the events that a fault waits for: not every request brings it
CAR_FAULTS_MAX: Final = 1
CAR_REQUESTS: Final = 40  # fewer than any scenario has
CAR_MS: Final = 1500.0  # less than any scenario lasts
REQUEST_MS_MIN: Final = 0.02  # what a request takes at least
LAUNCH_MS: Final = 0.6  # from the arming of a fault to the first request, at most: a launch must succeed
EXECUTIONS: Final = 2  # of a request, by TR, at least
FLIPS_APART: Final = 50  # executions, so that no request sees two
SAMPLES: Final = (1, 16, 64, 128, 256)  # requests behind which a bit of the state must not be refused
BIT_TRIES: Final = 100

NEVER_PART: Final = 0.04  # of the faults and of the adapted runs: drawn on purpose not to happen
NEVER_NTH: Final = 1_000_000  # no event of a run has so many
NEVER_MS: Final = 600_000.0  # no run lasts so long
UNCAUSED: Final = (Event.FOLLOWER_DIVERGED, Event.DETECTED_STOP)  # where no bit is flipped
FAILOVER: Final = (Event.WATCHDOG_SUSPECT, Event.RECOVERY_ENTER, Event.RECOVERY_EXIT, Event.BACKUP_READY)
RESENT: Final = Event.DEDUPE_HIT  # a request that was done already comes again
RESENDERS: Final = ("client", "proxy")  # what dies there was under way
ALARM: Final = "wdg2rec"  # the channel of a Watchdog
ON_DEMAND: Final = (ALARM, "aft2prd")  # channels on which nothing is sent where nothing goes wrong
_STEP_LABELS: Final = frozenset(event.label for event in STEPS)
DRAWN: Final = "drawn"  # beside the checks: what was drawn not to happen is reported as such
ON_FAILURE: Final = ("recovery", "engine")  # they have no step where nothing fails or is adapted


def drawn(seed: int) -> Setup:
    """The experiment of `seed`, which is whole: nothing but it has a part in the run."""
    return _Draw(seed).setup()


def experiments(seeds: Iterable[int]) -> Iterator[Setup]:
    """Those of `seeds`, in their order."""
    return map(drawn, seeds)


# -- what was drawn not to happen -------------------------------------------------------------------


def intended(setup: Setup) -> Intended:
    """What was meant by each fault and adaptation of `setup`, which a swarm has drawn."""
    flipped = any(fault.action.alters_value for fault in setup.faults)
    faults = [
        Intent.HAPPEN if _can_strike(fault, flipped=flipped) else Intent.NEVER for fault in setup.faults
    ]
    steps = {fault.trigger.nth for fault in setup.faults if fault.trigger.event in _STEP_LABELS}
    adaptations, running, before = [], setup.ftm, 0
    for at, adaptation in enumerate(setup.adaptations):
        if not _can_begin(setup, at):
            adaptations.append(Intent.NEVER)
            continue
        last = before + steps_of(running, adaptation.goal.expression, setup.placement).total
        struck = any(before < step <= last for step in steps)
        adaptations.append(Intent.STRUCK if struck else Intent.HAPPEN)
        running, before = adaptation.goal.expression, last
    return Intended(tuple(faults), tuple(adaptations))


def _can_strike(fault: Fault, *, flipped: bool) -> bool:
    trigger = fault.trigger
    uncaused = not flipped and trigger.event in {event.label for event in UNCAUSED}
    return not (uncaused or trigger.nth >= NEVER_NTH or trigger.after_ms >= NEVER_MS)


def _can_begin(setup: Setup, at: int) -> bool:
    """Neither to what runs at first, nor together with the one before it, nor behind the run."""
    one, before = setup.adaptations[at], setup.adaptations[at - 1] if at else None
    if setup.ftm == NONE or one.after_ms >= NEVER_MS:
        return False
    if before is None:
        return one.goal.expression != setup.ftm
    return one.at_request != before.at_request


def contradictions(run: Run) -> tuple[Breach, ...]:
    """What was drawn not to happen, and is not told so: the run, its report or the draw is wrong."""
    meant, happened = intended(run.setup), happened_in(run)
    found = [
        f"{fault} cannot strike, and is reported as {receipt.value}"
        for fault, receipt, intent in zip(run.setup.faults, happened.faults, meant.faults, strict=True)
        if intent is Intent.NEVER and receipt is not ReceiptState.ARMED
    ]
    asked = zip(run.setup.adaptations, happened.adaptations, meant.adaptations, strict=True)
    found += [
        f"the adaptation to {one.goal.expression} cannot be carried out, and is reported as {end.value}"
        for one, end, intent in asked
        if intent is Intent.NEVER and end not in (AdaptationEnd.REFUSED, AdaptationEnd.NOT_BEGUN)
    ]
    return tuple(Breach(DRAWN, reason, "G8") for reason in found)


def attempt_drawn(setup: Setup) -> tuple[Run | None, tuple[Breach, ...]]:
    """As `explore.attempt`, of a setup that a swarm has drawn: the `contradictions` are breaches too."""
    run, broken = attempt(setup)
    return run, broken if run is None else (*broken, *contradictions(run))


# -- what there is to draw from ---------------------------------------------------------------------


@lru_cache(maxsize=128)
def _events(ftm: str, placement: str) -> tuple[Event, ...]:
    """What a fault can wait for where `ftm` runs."""
    graph = graph_of(ftm, placement)
    return tuple(e for e in EMITTERS if _possible(Fault(Crash(), targets.PRIMARY, Trigger(e.label)), graph))


@lru_cache(maxsize=128)
def _request_events(ftm: str, placement: str) -> tuple[Event, ...]:
    """Those of them that every request brings."""
    return tuple(e for e in _events(ftm, placement) if e in REQUEST_EVENTS)


@lru_cache(maxsize=128)
def _channels(ftm: str, placement: str) -> tuple[str, ...]:
    """Those on which the replica that leads sends at each request, but those to the backup.

    What is held back there dies with its sender, when the reply has gone: two faults, and two replicas
    that differ.
    """
    graph = graph_of(ftm, placement)
    left_out = {port for _, port in replication_of(ftm)}
    names = sorted({link.name for link in graph.links} - left_out - set(ON_DEMAND))
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


class _Samples(NamedTuple):
    """States of the protected function, and the bits of its shortest reply."""

    states: tuple[bytes, ...]
    reply_bits: int


@lru_cache(maxsize=1)
def _samples() -> _Samples:
    function, states, reply_bits = default_application(), [], []
    for number, request in enumerate(requests_of(0)[: max(SAMPLES)], 1):
        reply_bits.append(8 * len(function.execute(request)))
        if number in SAMPLES:
            states.append(function.capture())
    return _Samples(tuple(states), min(reply_bits))


def _is_taken(bit: int) -> bool:
    """Whether the function restores each sample with `bit` flipped, and keeps the flip."""
    function = default_application()
    for state in _samples().states:
        flipped = with_flipped(state, (bit,))
        try:
            function.restore(flipped)
        except PeerError:
            return False
        if function.capture() != flipped:
            return False
    return True


class _Period(NamedTuple):
    """`graph` runs from request `first` on; before that, it may be on its way."""

    first: int
    graph: Graph


class _Draw:
    """One draw: each part from what the parts before it allow."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._chance = chance = Random(f"swarm/{seed}")
        self._scenario = chance.choice(scenario_names()) if chance.random() < CAR_PART else ""
        self._ftm = self._draw_ftm()
        self._placement = self._draw_placement()
        self._graph = graph_of(self._ftm, self._placement)
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
        self._periods = [_Period(1, self._graph)]
        self._scripts: list[tuple[Graph, ScriptSteps]] = []  # of the adaptations, with what they start from
        self._last_step: Fault | None = None

    def setup(self) -> Setup:
        """All of it."""
        adaptations = self._draw_adaptations()
        faults = self._draw_faults()
        return Setup(
            self._ftm,
            self._placement,
            self._seed,
            self._count,
            self._rate_hz,
            faults,
            adaptations,
            scenario=self._scenario,
            page_bytes=self._chance.choice((explore.PAGE_BYTES, pages.PAGE_BYTES)),
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

    def _requests(self) -> int:
        """How many there will be at least."""
        return CAR_REQUESTS if self._scenario else self._count

    def _period_ms(self) -> float:
        """What a request takes at least, with the wait for the next one."""
        if self._scenario:
            return CAR_MS / CAR_REQUESTS
        return 1e3 / self._rate_hz if self._rate_hz else REQUEST_MS_MIN

    def _load_ms(self) -> float:
        """What the load takes at least."""
        return (self._requests() - 1) * self._period_ms()

    # -- adaptations --------------------------------------------------------------------------

    def _draw_adaptations(self) -> tuple[Scheduled, ...]:
        chance = self._chance
        if chance.random() >= ADAPTED_PART:
            return ()
        never = chance.random() < NEVER_PART
        if self._ftm == NONE:
            return (
                (self._adaptation(chance.choice(self._ways()), chance.randint(1, self._requests())),)
                if never
                else ()
            )
        wanted = chance.randint(1, ADAPTATIONS_MAX)
        found = self._draw_possible(wanted - never)
        return self._with_impossible(found) if never else tuple(found)

    def _draw_possible(self, wanted: int) -> list[Scheduled]:
        """One after the other, each from what runs by then; as many as there is time for."""
        apart = math.ceil(ADAPTATION_MS / self._period_ms())
        wanted = min(wanted, 1 + (self._requests() - 1) // apart)
        room = self._requests() - apart * (wanted - 1)
        requests = sorted(self._chance.randint(1, room) for _ in range(wanted))
        found: list[Scheduled] = []
        for index, request in enumerate(requests):
            old = self._periods[-1].graph
            ways = [way for way in self._ways() if way not in {p.graph.ftm for p in self._periods}]
            if ways:
                at, way = request + apart * index, self._chance.choice(ways)
                self._scripts.append((old, steps_of(old.ftm, way, self._placement)))
                self._periods.append(_Period(at, graph_of(way, self._placement)))
                found.append(self._adaptation(way, at))
        return found

    def _with_impossible(self, found: list[Scheduled]) -> tuple[Scheduled, ...]:
        """And one that is refused, or that the run does not come to."""
        chance = self._chance
        way = chance.choice(self._ways())
        which, room = chance.randrange(3), found[0].at_request - 1 if found else self._requests()
        if which == 0 and found:  # while the other is under way
            return (*found, self._adaptation(way, found[-1].at_request))
        if which == 1 and room:
            return (self._adaptation(self._ftm, chance.randint(1, room)), *found)  # to what runs
        return (*found, Scheduled(Goal(expression=way), 0, NEVER_MS))

    @staticmethod
    def _adaptation(way: str, at_request: int) -> Scheduled:
        return Scheduled(Goal(expression=way), at_request)

    def _ways(self) -> list[str]:
        """All to which an adaptation may lead in this run."""
        ways = DUPLEX if self._scenario else SIMPLEX if self._placement == "single" else EXPRESSIONS
        return [e for e in ways if e != NONE and (tolerates(e, "value") or not self._flips)]

    # -- what is there when a fault strikes -----------------------------------------------------

    def _graphs(self, request: int) -> list[Graph]:
        """All that may have run when `request` is sent."""
        return [period.graph for period in self._periods if period.first <= request]

    def _reach(self, there: Callable[[str, str], tuple[T, ...]]) -> dict[T, int]:
        """For each of what is `there` at first, by FTM and placement: how many requests it outlasts."""
        found = {}
        for one in there(self._ftm, self._placement):
            gone = (p.first - 1 for p in self._periods if one not in there(p.graph.ftm, self._placement))
            found[one] = next(gone, self._requests())
        return {one: requests for one, requests in found.items() if requests}

    def _request_at(self, after_ms: float) -> int:
        """That which is sent at that time, or one behind it."""
        return 1 + math.ceil(after_ms / self._period_ms())

    def _nodes(self, graphs: Sequence[Graph]) -> list[str]:
        return [node for node in self._graph.nodes if all(node in graph.nodes for graph in graphs)]

    # -- faults -------------------------------------------------------------------------------

    def _draw_faults(self) -> tuple[Fault, ...]:
        wanted = self._faults_wanted
        found = self._draw_flips(self._chance.randint(1, wanted)) if self._flips else []
        while len(found) < wanted:
            found += self._draw_some(wanted - len(found))
        return tuple(found)

    def _draw_some(self, room: int) -> list[Fault]:
        """One fault; or two, if there is room, where the second takes the first."""
        chance = self._chance
        if chance.random() < NEVER_PART:
            return [self._draw_impossible()]
        if chance.random() < LATE_PART:
            return [self._draw_late()]
        if self._scripts and chance.random() < STEP_PART:
            return [self._draw_at_step()]
        if chance.random() < 0.3:
            return [self._draw_timed()]
        if room > 1 and chance.random() < RARE_PART:
            return self._draw_pair()
        return [self._draw_at_request()]

    def _draw_flips(self, most: int) -> list[Fault]:
        """All in one role, and far enough from each other; as many as the run has room for."""
        chance = self._chance
        graphs = [period.graph for period in self._periods]
        executes = all(server_emits(graph, Event.SERVER_EXIT, backs_up=True) for graph in graphs)
        role = chance.choice(targets.ROLES if executes else targets.ROLES[:1])  # the backup, too
        nth_max = _part_of(EXECUTIONS * self._requests())
        found: list[Fault] = []
        nth = chance.randint(1, max(1, nth_max - (most - 1) * FLIPS_APART))
        while len(found) < most and nth <= nth_max:
            flip = self._draw_flip()
            found.append(Fault(flip, role, Trigger(Event.SERVER_EXIT.label, nth)))
            nth += FLIPS_APART + chance.randrange(FLIPS_APART)
        return found

    def _draw_flip(self) -> ValueFlip:
        chance = self._chance
        place = chance.choice(EXECUTED)
        if place is ValuePlace.STATE:
            bits = 8 * len(_samples().states[0])
            for _ in range(BIT_TRIES):
                if _is_taken(bit := chance.randrange(bits)):
                    return ValueFlip(place, Bit(bit))
        return ValueFlip(
            ValuePlace.RESULT, Bit(chance.choice((None, chance.randrange(_samples().reply_bits))))
        )

    def _draw_impossible(self) -> Fault:
        """A fault that never comes to its point."""
        chance = self._chance
        event = chance.choice(_request_events(self._ftm, self._placement))
        trigger = Trigger(event.label, NEVER_NTH)
        uncaused = [e for e in _events(self._ftm, self._placement) if e in UNCAUSED and not self._flips]
        which = chance.randrange(3)
        if which == 0 and uncaused:
            trigger = Trigger(chance.choice(uncaused).label)
        elif which == 1:
            trigger = Trigger(after_ms=NEVER_MS)
        return Fault(Crash(), self._draw_target([self._graph], self._graph), trigger)

    def _draw_late(self) -> Fault:
        """A slow node or channel. It may be taken for dead; then its messages must not be accepted."""
        chance = self._chance
        by_ms = chance.randint(1, LATE_MS_MAX)
        if chance.random() < 0.5:
            after_ms = self._draw_ms()
            least_ms = min(SLOW_FOR_MS_MAX, by_ms + math.ceil(2 * self._period_ms()))  # a step falls into it
            slow = Slow(by_ms, chance.randint(least_ms, SLOW_FOR_MS_MAX))
            nodes = [n for n in self._nodes(self._graphs(self._request_at(after_ms))) if n not in ON_FAILURE]
            return Fault(slow, chance.choice(nodes), Trigger(after_ms=after_ms))
        reach = self._reach(_channels)
        channel = chance.choice(list(reach))
        firsts = [*(period.first for period in self._periods), self._requests() + 1]
        longest = max(later - first for first, later in pairwise(firsts))  # a new sender counts anew
        return Fault(
            ChannelFault(Disturbance.DELAY, channel, by_ms),
            targets.PRIMARY,
            Trigger(nth=chance.randint(1, _part_of(min(reach[channel], longest)))),
        )

    def _draw_at_step(self) -> Fault:
        """At a step of an adaptation. A second one comes later only if the first lets the script go on."""
        chance, last = self._chance, self._last_step
        total = sum(steps.total for _, steps in self._scripts)
        if last is None or (_is_brief(last.action) and last.trigger.nth < total):
            first = last.trigger.nth + 1 if last is not None else 1
            trigger = Trigger(chance.choice(STEPS).label, chance.randint(first, total))
        else:
            trigger = last.trigger
        old, steps, before = self._script_at(trigger.nth)
        if trigger.nth > before + len(steps.staged) and steps.staged and chance.random() < STAGED_PART:
            fault = Fault(Crash(), f"{chance.choice(steps.staged)}{STAGED}", trigger)
        else:
            fault = self._strike(self._draw_target([self._graph, old], old), trigger)
        self._last_step = fault
        return fault

    def _script_at(self, step: int) -> tuple[Graph, ScriptSteps, int]:
        """The adaptation whose script has that step: its old graph, its steps, those before it."""
        before = 0
        for old, steps in self._scripts:
            if step <= before + steps.total:
                return old, steps, before
            before += steps.total
        raise AssertionError(f"step {step} of {before}")

    def _draw_timed(self) -> Fault:
        after_ms = self._draw_ms()
        graphs = self._graphs(self._request_at(after_ms))
        return self._strike(self._draw_target(graphs, self._graph), Trigger(after_ms=after_ms))

    def _draw_at_request(self) -> Fault:
        """At an event that every request brings."""
        trigger = self._draw_request_trigger()
        return self._strike(self._draw_target(self._graphs(trigger.nth), self._graph), trigger)

    def _draw_pair(self) -> list[Fault]:
        """A fault, and one that waits for what the first brings about."""
        chance, trigger = self._chance, self._draw_request_trigger()
        duplex = all(replication_of(period.graph.ftm) for period in self._periods)
        events = [e for e in _events(self._ftm, self._placement) if e is RESENT or (duplex and e in FAILOVER)]
        event, nodes = chance.choice(events), self._nodes(self._graphs(self._requests()))
        if event is RESENT:
            cause = Fault(Crash(), chance.choice(RESENDERS), trigger)
        else:
            roles = targets.ROLES[:1] if event is Event.WATCHDOG_SUSPECT else targets.ROLES
            cause = Fault(chance.choice((Crash(), Hang())), chance.choice(roles), trigger)
            struck = targets.role_assignments(self._graph)[0].replica(cause.target)
            nodes = [node for node in nodes if replica_of(node) != struck]
            if cause.target == targets.PRIMARY and chance.random() < LATE_PART:
                alarm = ChannelFault(Disturbance.DELAY, ALARM, chance.randint(1, LATE_MS_MAX))
                return [cause, Fault(alarm, targets.PRIMARY, Trigger())]
        return [cause, self._strike(chance.choice(nodes), Trigger(event.label))]

    def _strike(self, target: str, trigger: Trigger) -> Fault:
        """A crash or a hang."""
        chance = self._chance
        if chance.random() < 0.6:
            return Fault(Crash(), target, trigger)
        watched = target in targets.ROLES or replica_of(target)
        hang_ms = 0 if watched and chance.random() < 0.4 else chance.randint(1, HANG_MS_MAX)
        return Fault(Hang(hang_ms), target, trigger)

    def _draw_target(self, graphs: Sequence[Graph], names: Graph) -> str:
        """A role or a node of `names` that is in all of `graphs`."""
        chance = self._chance
        if chance.random() < 0.4:
            return chance.choice([r for r in targets.ROLES if all(r in targets.roles_in(g) for g in graphs)])
        return chance.choice([node for node in names.nodes if all(node in g.nodes for g in graphs)])

    def _draw_ms(self) -> float:
        return round(LAUNCH_MS + self._load_ms() * self._chance.random(), 3)

    def _draw_request_trigger(self) -> Trigger:
        """The nth time of an event that every request brings."""
        reach = self._reach(_request_events)
        event = self._chance.choice(list(reach))
        return Trigger(event.label, self._chance.randint(1, _part_of(reach[event])))


def _part_of(requests: int) -> int:
    return max(1, round(requests * NTH_PART))


def _is_brief(action: FaultAction) -> bool:
    """Whether an adaptation goes on after it."""
    return isinstance(action, Hang) and 0 < action.for_ms <= BRIEF_HANG_MS
