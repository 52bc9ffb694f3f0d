"""Random faults at random points of random interleavings: the promises hold in every history.

The bricks run in memory (see `harness`); between any two micro-steps, also between two effects of one
step, a replica or one node of it may crash, or be accused while it lives, and whatever belongs to no
replica may be replaced. One replica is left alone until the other is sound again: G2 presupposes it.

Where the mechanism tolerates value faults (`tr`), one strikes an execution of many requests; where it only
detects them (`assert`), one is as good as a crash of the replica, and counts as one.
"""

from random import Random
from typing import Final

import pytest
from counting import Counting
from harness import SUPERVISOR, Choose, World
from hypothesis import given, settings
from hypothesis import strategies as st
from spoiling import Hit

from aftbed.core import check
from aftbed.core.check import History
from aftbed.core.event import Event
from aftbed.core.fault import Place
from aftbed.ftm.mechanism import EXPRESSIONS, REPLICAS, build, chain, parse, replication_of

REPLACEABLE: Final = ("proxy", "recovery", "a/watchdog", "b/watchdog")
DUPLEX: Final = (*(e for e in EXPRESSIONS if replication_of(e)), "pbr+assert+tr", "lfr+assert+tr")
VOTING: Final = (*(e for e in EXPRESSIONS if "tr" in parse(e)), "pbr+assert+tr", "lfr+assert+tr")
pytestmark = pytest.mark.timeout(900)  # in profile `deep`; seconds in the others
CHANCE_OF_FAULT: Final = 0.04
CHANCE_OF_REQUEST: Final = 0.1
CHANCE_OF_FLIP: Final = 0.3
WEIGHT_OF_SLOW: Final = 0.01
SEEN: Final = 6  # the highest bit that shows: it makes a digit none

targets = st.sampled_from(("leader", "other"))
faults = st.lists(
    st.one_of(
        st.tuples(st.just("crash"), targets),
        st.tuples(st.just("crash"), st.tuples(targets, st.integers(0, 99))),  # that brick of the chain
        st.tuples(st.just("accuse"), targets),
        st.tuples(st.just("replace"), st.sampled_from(REPLACEABLE)),
        st.tuples(st.just("flip"), targets),
    ),
    max_size=6,
)


def uneven(random: Random, expression: str) -> Choose:
    """A scheduler under which some bricks hardly get to run: mail piles up before them, and scripts wait."""
    names = sorted({spec.name for spec in build(expression, "process").bricks} | {SUPERVISOR})
    weights = {name: random.choice((1.0, 1.0, WEIGHT_OF_SLOW)) for name in names}
    return lambda moves: random.choices(moves, [weights[name] for _, name in moves])[0]


class Transient:
    """At most one value fault per request and replica: what a vote is there for."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self._struck: set[tuple[str, int]] = set()
        self.count = 0

    def __call__(self, replica: str, request_id: int) -> Hit | None:
        if (replica, request_id) in self._struck or self._random.random() >= CHANCE_OF_FLIP:
            return None
        self._struck.add((replica, request_id))
        self.count += 1
        return Hit(self._random.choice(tuple(Place)), self._random.randrange(SEEN + 1))


class Drive:
    """One history: `count` requests, the faults in their order, all at points that `random` chooses."""

    def __init__(self, random: Random, expression: str, count: int, plan: list[tuple[str, object]]) -> None:
        self.random, self.count = random, count
        self.world = World(expression=expression)
        self.world.choose = uneven(random, expression)
        names = parse(expression)
        detects = "assert" in names and "tr" not in names
        self.plan = [(act, whom) for act, whom in plan if act != "flip" or detects]
        self.world.spoil = Transient(random) if "tr" in names else self._spoil
        self._doomed: set[tuple[str, int]] = set()  # generations that will stop, but have not yet

    def run(self) -> World:
        """Until all is submitted, every fault has happened, and nothing is left to do."""
        submitted = 0
        while True:
            if submitted < self.count and self.random.random() < CHANCE_OF_REQUEST:
                submitted += 1
                self.world.submit(b"request %d" % submitted)
            if self.plan and self.random.random() < CHANCE_OF_FAULT:
                self._strike()
            if not self.world.step() and submitted == self.count:
                if not self.plan or all(act == "flip" for act, _ in self.plan):
                    return self.world  # nothing is executed any more: there is nothing to flip
                assert self._strike(), "nothing is left to do, and redundancy is not back"

    def _strike(self) -> bool:
        """The next fault, if the other replica can bear it; else it waits. A flip waits for an execution."""
        acts = [act for act, _ in self.plan]
        at = next((n for n, act in enumerate(acts) if act != "flip"), None)
        if at is None:
            return False
        act, target = self.plan[at]
        world = self.world
        if act == "replace":
            world.replace(str(target))
            del self.plan[at]
            return True
        role, part = target if isinstance(target, tuple) else (target, None)
        victim = self._victim(str(role))
        if victim is None:
            return False
        del self.plan[at]
        if act == "accuse":
            world.accuse(f"{victim}/server")
        else:
            parts = world.parts[victim]
            world.crash(victim if part is None else parts[part % len(parts)])
        return True

    def _victim(self, role: str) -> str | None:
        """Who is meant, if the other one can go on alone."""
        world = self.world
        if not world.leader:
            return None
        other = next(r for r in REPLICAS if r != world.leader)
        victim, survivor = (world.leader, other) if role == "leader" else (other, world.leader)
        return victim if self._is_sound(survivor) and world.chain(victim) else None

    def _is_sound(self, replica: str) -> bool:
        world = self.world
        whole = all(map(world.seems_alive, world.parts[replica]))
        doomed = (replica, world.generation[replica]) in self._doomed
        return replica in (world.leader, world.backup) and whole and not doomed

    def _spoil(self, replica: str, request_id: int) -> Hit | None:
        """A flip that is planned for this replica, if the other one can bear it."""
        role = "leader" if replica == self.world.leader else "other"
        if ("flip", role) not in self.plan or self._victim(role) != replica or not self._is_sound(replica):
            return None
        self.plan.remove(("flip", role))
        self._doomed.add((replica, self.world.generation[replica]))
        return Hit(Place.RESULT, SEEN)


def one_master(history: History) -> list[str]:
    """Accepted epochs never fall, each is one replica's, and nobody is promoted beside an unfenced master."""
    found = []
    epochs = [r.detail >> 8 for r in history.events(Event.REPLY_ACCEPTED)]
    if epochs != sorted(epochs):
        found.append(f"epochs of accepted replies: {epochs}")
    masters = {(r.detail >> 8, r.detail & 0xFF) for r in history.events(Event.REPLY_ACCEPTED)}
    if len(masters) != len(set(epochs)):
        found.append(f"an epoch with two masters: {masters}")
    leader = 1
    for record in history.events(Event.REPLICA_PROMOTED):
        fenced = [f.detail & 0xFF for f in history.events(Event.REPLICA_FENCED) if f.t_ns < record.t_ns]
        if leader not in fenced:
            found.append(f"{record.node} promoted, {leader} not fenced")
        leader = REPLICAS.index(record.node[0]) + 1
    return found


def assert_promises(world: World, count: int) -> None:
    """G1, G2, G3, G6, and that both replicas are in the state of a bare server that did the same."""
    history = world.history()
    assert check.at_most_once(history) == check.Check("pass")
    assert check.exactly_one_answer(history) == check.Check("pass")
    assert check.one_history(history, Counting()) == check.Check("pass")
    assert one_master(history) == []
    assert history.events(Event.FOLLOWER_DIVERGED) == []
    bare = Counting()
    assert [r.payload for r in sorted(world.replies, key=lambda r: r.request_id)] == [
        bare.execute(b"request %d" % i) for i in range(1, count + 1)
    ]
    assert all(host.brick.quiescent() for host in world.hosts.values()), "nothing is left inside"
    states = {name: world.hosts[name].brick.capture() for name in world.hosts if name.endswith("/server")}
    assert states == dict.fromkeys(states, bare.capture())


@pytest.mark.parametrize("expression", DUPLEX)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8), plan=faults)
def test_the_promises_hold_wherever_a_fault_strikes(
    expression: str, seed: int, count: int, plan: list[tuple[str, object]]
) -> None:
    world = Drive(Random(seed), expression, count, plan).run()
    assert_promises(world, count)
    assert world.leader and world.backup, "redundancy is back"


@pytest.mark.parametrize("expression", VOTING)
@settings(max_examples=settings.default.max_examples // 2)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8))
def test_one_value_fault_per_request_never_reaches_the_client(expression: str, seed: int, count: int) -> None:
    """G4, and it is corrected: nobody stops."""
    drive = Drive(Random(seed), expression, count, [])
    world = drive.run()
    assert_promises(world, count)
    assert world.history().events(Event.DETECTED_STOP) == [] and world.epoch == 1
    votes = [r.detail for r in world.history().events(Event.VOTE_COMPARED)]
    assert isinstance(world.spoil, Transient)
    assert (votes.count(3), votes.count(2)) == (world.spoil.count, len(votes) - world.spoil.count)


@pytest.mark.parametrize("expression", [e for e in DUPLEX if "assert" in parse(e) and "tr" not in parse(e)])
@settings(max_examples=settings.default.max_examples // 2)
@given(seed=st.integers(0, 2**32), role=targets)
def test_what_an_assertion_finds_stops_one_replica_and_the_other_goes_on(
    expression: str, seed: int, role: str
) -> None:
    drive = Drive(Random(seed), expression, 4, [("flip", role)])
    world = drive.run()
    assert_promises(world, 4)
    executes = role == "leader" or expression.startswith("lfr")
    assert len(world.history().events(Event.DETECTED_STOP)) == executes
    assert world.leader == ("b" if role == "leader" else "a")


@pytest.mark.parametrize("expression", ["none", "pbr", "lfr"])
def test_without_a_mechanism_against_it_a_value_fault_reaches_the_client(expression: str) -> None:
    """What the tests above do is done: where nothing is there to find it, it is found by the check."""
    world = World(expression=expression)
    world.spoil = lambda replica, request_id: Hit(Place.RESULT, 0) if request_id == 2 else None
    for number in (1, 2, 3):
        world.submit(b"request %d" % number)
    world.run()
    assert check.wrong_replies(world.history(), Counting()) == [2]


@pytest.mark.parametrize("expression", (*EXPRESSIONS, "pbr+assert+tr"))
def test_a_request_that_the_function_refuses_does_not_stand_in_the_way_of_the_next(expression: str) -> None:
    world = World(expression=expression)
    for payload in (b"before", b"", b"after"):
        world.submit(payload)
    world.run()
    assert [(r.request_id, bool(r.payload)) for r in world.replies] == [(1, True), (2, False), (3, True)]
    assert check.exactly_one_answer(world.history()) == check.Check("pass")
    assert check.one_history(world.history(), Counting()) == check.Check("pass")


@pytest.mark.parametrize("expression", DUPLEX)
@settings(max_examples=settings.default.max_examples // 2)
@given(seed=st.integers(0, 2**32), at=st.integers(0, 200), whole=st.booleans(), part=st.integers(0, 99))
def test_the_leader_may_die_at_any_micro_step(
    expression: str, seed: int, at: int, whole: bool, part: int
) -> None:
    random = Random(seed)
    world = World(expression=expression)
    world.choose = uneven(random, expression)
    for number in (1, 2, 3):
        world.submit(b"request %d" % number)
    for _ in range(at):
        world.step()
    parts = chain(world.graph, "a")
    world.crash("a" if whole else parts[part % len(parts)])
    world.run()
    assert_promises(world, 3)
    assert (world.leader, world.backup, world.epoch) == ("b", "a", 2)


@pytest.mark.parametrize("expression", [e for e in EXPRESSIONS if e != "none" and e not in DUPLEX])
def test_with_one_replica_a_crash_ends_the_service_and_nothing_else_is_tried(expression: str) -> None:
    world = World(expression=expression)
    world.submit(b"request 1")
    world.run()
    world.crash("a/proceed" if "a/proceed" in world.hosts else "a/tr.proceed")
    world.submit(b"request 2")
    world.run()
    assert [r.request_id for r in world.replies] == [1]
    assert len(world.history().events(Event.WATCHDOG_SUSPECT)) == 1
    assert world.history().events(Event.RECOVERY_ENTER, Event.REPLICA_FENCED) == []
