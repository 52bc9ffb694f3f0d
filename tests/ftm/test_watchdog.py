"""Watchdog: a death at once, a hang by its deadline, one suspicion each, no false alarm on a busy machine."""

from typing import Final

import pytest
from samples import notes, sends

from aftbed.core.brick import CONTROL, Effect
from aftbed.core.events import Event
from aftbed.core.messages import Loss, NodeDied, Rebound, SeenAlive, Suspect, Watch
from aftbed.ftm.failover import HANG_DEADLINE_NS, LATE_NS_MAX, Watchdog
from aftbed.runtime.devices import LOOK_NS

NODES: Final = ("a/protocol", "a/server")
START_NS: Final = 10**12


class Watched:
    """A Watchdog whose host looks at the nodes."""

    def __init__(self) -> None:
        self.brick, self.now_ns = Watchdog(), START_NS
        self.watch(generation=1)

    def watch(self, generation: int) -> None:
        self.brick.step(CONTROL, Watch("a", generation, NODES), self.now_ns)

    def after(self, passed_ns: int, late_ns: int = 0, **silent_since_ns: int) -> list[Effect]:
        """A look `passed_ns` later; all nodes are alive except the named ones (`server=...`)."""
        self.now_ns += passed_ns
        seen = {n: silent_since_ns.get(n.partition("/")[2], self.now_ns) for n in NODES}
        return self.brick.step("sense", SeenAlive(self.now_ns, seen, late_ns), self.now_ns)

    def on_time(self, passed_ns: int, **silent_since_ns: int) -> list[Effect]:
        """The same, but with all the looks between, each on time; what came of them."""
        effects: list[Effect] = []
        for _ in range(passed_ns // LOOK_NS):
            effects += self.after(LOOK_NS, 0, **silent_since_ns)
        return effects


def test_a_death_is_told_at_once() -> None:
    watched = Watched()
    effects = watched.brick.step("sense", NodeDied("a/server"), START_NS + 5)
    assert sends(effects) == [("wdg2rec", Suspect("a", 1, "a/server", Loss.CRASH, START_NS + 5))]
    assert notes(effects) == [Event.WATCHDOG_SUSPECT]


def test_the_death_of_what_is_not_watched_is_ignored() -> None:
    assert Watched().brick.step("sense", NodeDied("b/server"), START_NS) == []
    assert Watchdog().step("sense", NodeDied("a/server"), START_NS) == []


def test_one_suspicion_per_generation_is_enough() -> None:
    watched = Watched()
    watched.brick.step("sense", NodeDied("a/server"), START_NS)
    assert watched.brick.step("sense", NodeDied("a/protocol"), START_NS) == []
    assert watched.on_time(10 * HANG_DEADLINE_NS, server=START_NS) == []
    watched.watch(generation=2)
    effects = watched.brick.step("sense", NodeDied("a/server"), START_NS)
    assert [m for _, m in sends(effects)] == [Suspect("a", 2, "a/server", Loss.CRASH, START_NS)]


def test_a_node_that_is_silent_past_the_deadline_hangs() -> None:
    watched = Watched()
    watched.on_time(2 * HANG_DEADLINE_NS)
    silent_ns = watched.now_ns
    assert watched.on_time(HANG_DEADLINE_NS - LOOK_NS, server=silent_ns) == []
    assert watched.after(LOOK_NS - 1, server=silent_ns) == []
    effects = watched.after(1, server=silent_ns)
    assert [m for _, m in sends(effects)] == [Suspect("a", 1, "a/server", Loss.HANG, watched.now_ns)]


def test_a_node_that_is_seen_alive_does_not_hang() -> None:
    assert Watched().on_time(100 * HANG_DEADLINE_NS) == []


def test_a_new_generation_has_the_whole_deadline_to_begin() -> None:
    watched = Watched()
    assert watched.on_time(HANG_DEADLINE_NS - LOOK_NS, server=0) == []
    assert len(sends(watched.on_time(LOOK_NS, server=0))) == 1


def test_a_late_look_gives_all_nodes_the_whole_deadline_again() -> None:
    watched = Watched()
    watched.on_time(2 * HANG_DEADLINE_NS)
    silent_ns = watched.now_ns
    late_ns = 10 * HANG_DEADLINE_NS
    assert watched.after(LOOK_NS + late_ns, late_ns, server=silent_ns) == [], "the machine was stalled"
    assert watched.on_time(HANG_DEADLINE_NS - LOOK_NS, server=silent_ns) == []
    assert len(sends(watched.on_time(LOOK_NS, server=silent_ns))) == 1


@pytest.mark.parametrize(("late_ns", "alarms"), [(LATE_NS_MAX, 1), (LATE_NS_MAX + 1, 0)])
def test_how_late_is_late(late_ns: int, alarms: int) -> None:
    watched = Watched()
    watched.on_time(2 * HANG_DEADLINE_NS)
    effects = watched.after(LOOK_NS + late_ns, late_ns, server=watched.now_ns - HANG_DEADLINE_NS)
    assert len(sends(effects)) == alarms


def test_a_watchdog_that_is_preempted_between_the_look_and_its_step_suspects_no_node() -> None:
    watched = Watched()
    watched.on_time(2 * HANG_DEADLINE_NS)
    looked_ns = watched.now_ns
    seen = SeenAlive(looked_ns, dict.fromkeys(NODES, looked_ns), 0)
    assert watched.brick.step("sense", seen, looked_ns + 10 * HANG_DEADLINE_NS) == []


def test_a_node_that_was_not_looked_at_yet_does_not_hang() -> None:
    watched = Watched()
    watched.on_time(2 * HANG_DEADLINE_NS)
    assert watched.brick.step("sense", SeenAlive(watched.now_ns, {}, 0), watched.now_ns) == []


def test_a_new_recovery_is_told_what_the_old_one_was() -> None:
    watched = Watched()
    (alarm,) = sends(watched.brick.step("sense", NodeDied("a/server"), START_NS))
    effects = watched.brick.step(CONTROL, Rebound("wdg2rec", True, 1), START_NS + 9)
    assert sends(effects) == [alarm] and notes(effects) == [], "said again, not suspected again"


def test_a_new_recovery_is_told_nothing_where_nothing_is_wrong() -> None:
    watched = Watched()
    assert watched.brick.step(CONTROL, Rebound("wdg2rec", True, 1), START_NS) == []
    watched.brick.step("sense", NodeDied("a/server"), START_NS)
    watched.watch(generation=2)
    assert watched.brick.step(CONTROL, Rebound("wdg2rec", True, 1), START_NS) == []
    watched.brick.step("sense", NodeDied("a/server"), START_NS)
    assert watched.brick.step(CONTROL, Rebound("wdg2rec", False, 1), START_NS) == []
