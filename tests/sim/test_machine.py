"""A run that is interfered with: time passes, nodes die and hang, bits flip, it adapts, as hypothesis likes.

A swarm draws a whole experiment and looks at its end. Here each act is drawn where the run has come to, a
breach is looked for after each, and in profile `deep` what is found is shrunk to the fewest acts. When the
acts are over, the run must come to rest, and every promise is judged, as for any other run.

What is drawn is within what is promised: a node that no Watchdog watches never hangs for good, and bits flip
only where TR is there from the start to the end, none within a few requests of another.
"""

from typing import Final

import pytest
from counting import Counting
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal, NodeDied
from aftbed.ftm.compose import EXPRESSIONS, NONE, parse, replication_of
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.inject.targets import roles_in
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.judge.simulated import breaches
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.processes import SimProcess
from aftbed.runtime.sim.world import Setup, StruckNode, World

REQUESTS: Final = 96
RATES_HZ: Final = (500.0, 2000.0)
PASSED_MS_MAX: Final = 12.0
HANG_MS_MAX: Final = 150  # longer than a Watchdog waits
FLIPS_APART: Final = 8  # requests
STATE_BITS: Final = 8 * 3  # of `Counting`, at least
RESULT_BITS: Final = 8 * 10
DUPLEX: Final = tuple(e for e in EXPRESSIONS if replication_of(e))
SOUND: Final = tuple(e for e in EXPRESSIONS if e != NONE)
PAYLOADS: Final = [b"d=%d" % number for number in range(1, REQUESTS + 1)]

any_node = st.integers(0, 99)


class Interference(RuleBasedStateMachine):
    """One run."""

    @initialize(
        ftm=st.sampled_from(DUPLEX),
        placement=st.sampled_from(("process", "replica")),
        rate_hz=st.sampled_from(RATES_HZ),
        seed=st.integers(0, 2**16),
    )
    def begin(self, ftm: str, placement: str, rate_hz: float, seed: int) -> None:
        setup = Setup(ftm, placement, seed, REQUESTS, rate_hz)
        self.world = World(setup, function=Counting, requests=PAYLOADS)
        self.world.start()
        self._votes = "tr" in parse(ftm)
        self._flipped_at = -FLIPS_APART
        self._bare = Counting()
        self._expected: dict[int, bytes] = {}
        self._answered: set[int] = set()
        self._epoch = 0
        self._read = 0

    def _node(self, number: int) -> str:
        nodes = list(self.world.controller.deployment.graph.nodes)
        return nodes[number % len(nodes)]

    def _sent(self) -> int:
        return len(self._expected)

    # -- what is done to it --------------------------------------------------------------------

    @rule(ms=st.floats(0.01, PASSED_MS_MAX))
    def time_passes(self, ms: float) -> None:
        self.world.advance(self.world.loop.ns + round(ms * 1e6))

    @rule(node=any_node)
    def a_node_dies(self, node: int) -> None:
        self.world.inject(Fault(Crash(), self._node(node), Trigger()))

    @rule(first=any_node, second=any_node)
    def two_nodes_die(self, first: int, second: int) -> None:
        self.a_node_dies(first)
        self.a_node_dies(second)

    @rule(event=st.sampled_from((Event.SERVER_EXIT, Event.REPLY_SENT, Event.STATE_CAPTURED)))
    def the_primary_will_die(self, event: Event) -> None:
        try:
            self.world.inject(Fault(Crash(), "primary", Trigger(event.label)))
        except ConfigError:  # no brick emits it under this mechanism
            return

    @rule(node=any_node, ms=st.integers(1, HANG_MS_MAX))
    def a_node_hangs(self, node: int, ms: int) -> None:
        self.world.inject(Fault(Hang(ms), self._node(node), Trigger()))

    @rule(role=st.sampled_from(("primary", "backup")))
    def a_replica_hangs_for_good(self, role: str) -> None:
        if role in roles_in(self.world.controller.deployment.graph):
            self.world.inject(Fault(Hang(), role, Trigger()))

    @rule(node=any_node)
    def a_watchdog_is_mistaken(self, node: int) -> None:
        """It takes a node of its replica for dead, which lives, and will be fenced."""
        name = self._node(node)
        replica = replica_of(name)
        watchdog = self.world.controller.deployment.nodes.get(f"{replica}/watchdog")
        if not replica or not isinstance(watchdog, SimProcess) or watchdog.dead or watchdog.node is None:
            return
        self.world.struck.append(StruckNode(self.world.loop.ns, name))  # as good as
        watchdog.node.step(watchdog.node.bricks[watchdog.name], "sense", NodeDied(name))

    @precondition(lambda self: self._votes and self._sent() - self._flipped_at >= FLIPS_APART)
    @rule(place=st.sampled_from(EXECUTED), bit=st.integers(0, RESULT_BITS - 1))
    def a_bit_flips(self, place: ValuePlace, bit: int) -> None:
        self._flipped_at = self._sent()
        flip = ValueFlip(place, Bit(bit % STATE_BITS if place is ValuePlace.STATE else bit))
        self.world.inject(Fault(flip, "primary", Trigger()))

    @rule(expression=st.sampled_from(SOUND))
    def it_is_adapted(self, expression: str) -> None:
        if self._votes and "tr" not in parse(expression):
            return
        try:
            self.world.adapt(Goal(expression=expression))
        except ConfigError:  # another one is under way, or no replica is left to adapt
            return

    # -- what must hold all the time -----------------------------------------------------------

    @invariant()
    def no_reply_is_wrong_doubled_or_of_an_old_master(self) -> None:
        for entry in self.world.dialogue[self._read :]:
            number = entry.request_id
            if entry.kind is EntryKind.SENT:
                assert number == self._sent() + 1, "the ids are 1, 2, 3, ..."
                self._expected[number] = self._bare.execute(entry.payload)
            else:
                assert number not in self._answered, f"two replies to {number}"
                assert entry.payload == self._expected[number], f"a wrong reply to {number}"
                assert entry.epoch >= self._epoch, f"epoch {entry.epoch} after {self._epoch}"
                self._answered.add(number)
                self._epoch = entry.epoch
        self._read = len(self.world.dialogue)
        assert self.world.failures == [], "an assert has failed in a node"

    def teardown(self) -> None:
        """The acts are over: it must come to rest."""
        self.world.end()
        self.no_reply_is_wrong_doubled_or_of_an_old_master()
        broken = breaches(self.world.outcome(), function=Counting)
        assert not broken, "; ".join(map(str, broken))


DEEP: Final = settings.default.max_examples >= 1000
PHASES: Final = (Phase.explicit, Phase.reuse, Phase.generate, *((Phase.shrink,) if DEEP else ()))  # minutes

TestInterference = Interference.TestCase
TestInterference.settings = settings(
    max_examples=settings.default.max_examples, stateful_step_count=20, phases=PHASES
)
TestInterference.pytestmark = [
    pytest.mark.timeout(900),  # in profile `deep`; seconds in the others
]
