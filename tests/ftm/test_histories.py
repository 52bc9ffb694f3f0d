"""Random crashes at random points of random interleavings: the promises hold in every history.

The bricks run in memory (see `harness`); between any two micro-steps, also between two effects of one
step, a replica or one node of it may crash, or be accused while it lives, and whatever belongs to no
replica may be replaced. One replica is left alone until the other is sound again: G2 presupposes it.
"""

from random import Random
from typing import Final

import pytest
from counting import Counting
from harness import SUPERVISOR, Choose, World
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.core import check
from aftbed.core.check import History
from aftbed.core.event import Event
from aftbed.ftm.mechanism import CHAIN_PARTS, REPLICAS, build

REPLACEABLE: Final = ("proxy", "recovery", "a/watchdog", "b/watchdog")
pytestmark = pytest.mark.timeout(900)  # in profile `deep`; seconds in the others
CHANCE_OF_FAULT: Final = 0.02
CHANCE_OF_REQUEST: Final = 0.05
WEIGHT_OF_SLOW: Final = 0.01

faults = st.lists(
    st.one_of(
        st.tuples(st.just("crash"), st.sampled_from(("leader", "other"))),
        st.tuples(
            st.just("crash"), st.tuples(st.sampled_from(("leader", "other")), st.sampled_from(CHAIN_PARTS))
        ),
        st.tuples(st.just("accuse"), st.sampled_from(("leader", "other"))),
        st.tuples(st.just("replace"), st.sampled_from(REPLACEABLE)),
    ),
    max_size=6,
)


def uneven(random: Random) -> Choose:
    """A scheduler under which some bricks hardly get to run: mail piles up before them, and scripts wait."""
    names = sorted({spec.name for spec in build("pbr", "process").bricks} | {SUPERVISOR})
    weights = {name: random.choice((1.0, 1.0, WEIGHT_OF_SLOW)) for name in names}
    return lambda moves: random.choices(moves, [weights[name] for _, name in moves])[0]


class Drive:
    """One history: `count` requests, the faults in their order, all at points that `random` chooses."""

    def __init__(self, random: Random, count: int, plan: list[tuple[str, object]]) -> None:
        self.random, self.count, self.plan = random, count, list(plan)
        self.world = World()
        self.world.choose = uneven(random)

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
                if not self.plan:
                    return self.world
                assert self._strike(), "nothing is left to do, and redundancy is not back"

    def _strike(self) -> bool:
        """The next fault, if the other replica can bear it; else it waits."""
        act, target = self.plan[0]
        world = self.world
        if act == "replace":
            world.replace(str(target))
            self.plan.pop(0)
            return True
        role, part = target if isinstance(target, tuple) else (target, "")
        if not world.leader:
            return False
        other = next(r for r in REPLICAS if r != world.leader)
        victim, survivor = (world.leader, other) if role == "leader" else (other, world.leader)
        if not self._is_sound(survivor) or not world.chain(victim):
            return False
        self.plan.pop(0)
        if act == "accuse":
            world.accuse(f"{victim}/server")
        else:
            world.crash(f"{victim}/{part}" if part else victim)
        return True

    def _is_sound(self, replica: str) -> bool:
        nodes = [f"{replica}/{part}" for part in CHAIN_PARTS]
        return replica in (self.world.leader, self.world.backup) and all(map(self.world.seems_alive, nodes))


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


@settings(max_examples=4 * settings.default.max_examples)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 8), plan=faults)
def test_the_promises_hold_wherever_a_fault_strikes(
    seed: int, count: int, plan: list[tuple[str, object]]
) -> None:
    world = Drive(Random(seed), count, plan).run()
    history = world.history()
    assert check.at_most_once(history) == check.Check("pass")
    assert check.exactly_one_answer(history) == check.Check("pass")
    assert check.one_history(history, Counting()) == check.Check("pass")
    assert one_master(history) == []
    bare = Counting()
    assert [r.payload for r in sorted(world.replies, key=lambda r: r.request_id)] == [
        bare.execute(b"request %d" % i) for i in range(1, count + 1)
    ]
    assert world.leader and world.backup, "redundancy is back"
    assert all(host.brick.quiescent() for host in world.hosts.values()), "nothing is left inside"


def test_a_request_that_the_function_refuses_does_not_stand_in_the_way_of_the_next() -> None:
    world = World()
    for payload in (b"before", b"", b"after"):
        world.submit(payload)
    world.run()
    assert [(r.request_id, bool(r.payload)) for r in world.replies] == [(1, True), (2, False), (3, True)]
    assert check.exactly_one_answer(world.history()) == check.Check("pass")
    assert check.one_history(world.history(), Counting()) == check.Check("pass")


@given(
    seed=st.integers(0, 2**32), at=st.integers(0, 60), whole=st.booleans(), part=st.sampled_from(CHAIN_PARTS)
)
def test_the_leader_may_die_at_any_micro_step(seed: int, at: int, whole: bool, part: str) -> None:
    random = Random(seed)
    world = World()
    world.choose = uneven(random)
    for number in (1, 2, 3):
        world.submit(b"request %d" % number)
    for _ in range(at):
        world.step()
    world.crash("a" if whole else f"a/{part}")
    world.run()
    history = world.history()
    assert check.at_most_once(history) == check.Check("pass")
    assert check.exactly_one_answer(history) == check.Check("pass")
    assert check.one_history(history, Counting()) == check.Check("pass")
    assert one_master(history) == []
    assert (world.leader, world.backup, world.epoch) == ("b", "a", 2)
