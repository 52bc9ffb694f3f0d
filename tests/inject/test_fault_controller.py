"""Where faults wait, and how they move when the roles or the graph change."""

import gc
import weakref
from pathlib import Path

import pytest
from faultrun import FIRST, Run, run

from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.runtime import control
from aftbed.runtime.tasks import death_of

__all__ = ["run"]  # a fixture

# -- where they wait


@pytest.mark.parametrize(
    ("text", "node", "itself"),
    [
        ("crash primary at checkpoint.sent nth 5", "a/after", True),
        ("crash backup at checkpoint.sent nth 5", "a/after", False),
        ("hang primary at checkpoint.sent nth 5", "a/after", False),
        ("bitflip result nth 5", "a/server", False),
        ("bitflip state in b at state.restored nth 5", "b/server", False),
        ("bitflip request nth 5 permanent", "a/server", False),
        ("bitflip checkpoint nth 5", "a/after", False),
        ("bitflip log nth 5", "a/protocol", False),
        ("omission pxy2pro nth 5", "proxy", False),
        ("delay aft2aft nth 5 intermittent p 0.5", "a/after", False),
        ("slow primary at before.exit nth 5", "a/before", False),
    ],
)
def test_a_fault_waits_where_its_event_is_emitted(run: Run, text: str, node: str, itself: bool) -> None:
    fault = run.arm(text)
    host, armed = run.last_armed()
    assert (host, armed.brick, armed.nth, armed.by_itself) == (node, node, 5, itself)
    assert (armed.fault, armed.action, armed.persistence) == (FIRST, fault.action, fault.persistence)
    assert run.reports() == [(str(fault), "armed", "")]


def test_a_bitflip_without_an_event_waits_for_the_next_execution(run: Run) -> None:
    run.arm("bitflip result bit 3")
    order = run.deployment.told[-1][1]
    assert isinstance(order, control.Arm) and order.event == "server.exit" and run.last_armed()[1].nth == 1


@pytest.mark.parametrize("live", [False, True])
def test_a_fault_that_nobody_can_wait_for_is_refused_and_stays_so(run: Run, *, live: bool) -> None:
    """One that came with the run has a receipt; of a live one, the command that asked is told."""
    run.deployment.backup = ""
    with pytest.raises(StepFailed, match=r"no process emits checkpoint\.applied now"):
        run.arm("crash backup at checkpoint.applied", live=live)
    run.deployment.backup = "b"
    run.do(run.faults.rearm())
    assert run.deployment.told == []
    assert [(words, receipt) for words, receipt, _ in run.reports()] == (
        [] if live else [("crash backup at checkpoint.applied nth 1", "not_activated")]
    )


def test_the_bit_that_is_not_named_hangs_on_the_seed_and_on_the_fault(tmp_path: Path) -> None:
    draws = []
    for name, seed in (("1", 1), ("2", 2), ("again", 1)):
        (tmp_path / name).mkdir()
        other = Run(tmp_path / name, seed=seed)
        for _ in range(2):
            other.arm("bitflip result")
            draws.append(other.last_armed()[1].draw)
    assert draws[:2] == draws[4:] and len(set(draws)) == 4


# -- how they move


def test_after_a_failover_a_fault_moves_to_the_new_leader_with_what_was_counted(run: Run) -> None:
    run.happened("a/server", Event.SERVER_EXIT, 500, t_ns=1)  # before
    run.arm("bitflip result nth 100")
    run.happened("a/server", Event.SERVER_EXIT, 40)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    node, armed = run.last_armed()
    assert (node, armed.brick, armed.nth) == ("b/server", "b/server", 60)
    run.happened("b/server", Event.SERVER_EXIT, 25)
    run.deployment.renew("b/server")  # another process takes the place: an adaptation
    run.do(run.faults.rearm())
    assert run.last_armed()[1].nth == 35


def test_what_two_bricks_of_a_node_emit_is_counted_once(tmp_path: Path) -> None:
    run = Run(tmp_path, "pbr+tr", placement="replica")
    run.arm("crash proxy at before.exit nth 100")
    assert (run.last_armed()[0], run.last_armed()[1].brick) == ("a", "a/before")
    run.happened("a", Event.BEFORE_EXIT, 80)  # of 40 requests
    run.deployment.nodes["a"].kill()
    run.deployment.leader, run.deployment.backup = "b", ""
    run.do(run.faults.rearm())
    assert (run.last_armed()[0], run.last_armed()[1].brick, run.last_armed()[1].nth) == ("b", "b/before", 60)


def test_what_has_not_changed_stays_where_it_is(run: Run) -> None:
    run.arm("bitflip result nth 100")
    told = len(run.deployment.told)
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told


def test_a_backup_that_leads_is_no_longer_hit_as_a_backup(tmp_path: Path) -> None:
    run = Run(tmp_path, "lfr")
    run.arm("bitflip result in backup nth 100")
    assert run.last_armed()[0] == "b/server"
    run.happened("b/server", Event.SERVER_EXIT, 10)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    node, armed = run.last_armed()
    assert (node, armed.nth) == ("b/server", 0), "it does not wait there any more"
    run.deployment.renew(*(n for n in run.deployment.graph.nodes if n.startswith("a/")))
    run.deployment.backup = "a"
    run.do(run.faults.rearm())
    node, armed = run.last_armed()
    assert (node, armed.brick, armed.nth) == ("a/server", "a/server", 90)


# -- what an adaptation comes through


def test_at_a_step_of_an_adaptation_the_target_is_dead_before_it_goes_on(run: Run) -> None:
    fault = run.arm("crash backup at adapt.step.enter nth 3")
    assert run.deployment.told == [], "no node is asked: the supervisor counts"
    for _ in range(2):
        assert run.do(run.faults.at(Event.ADAPT_STEP_ENTER)) == []
    assert run.do(run.faults.at(Event.ADAPT_STEP_EXIT)) == [], "that is another event"
    victims = run.deployment.slots["b"].nodes
    assert all(map(run.deployment.lives, victims))
    (wait,) = run.do(run.faults.at(Event.ADAPT_STEP_ENTER))
    assert wait.keys == {death_of(run.deployment.nodes[name].pid) for name in victims}
    assert not any(map(run.deployment.lives, victims))
    assert run.reports() == [(str(fault), "activated", "")]
    assert run.do(run.faults.at(Event.ADAPT_STEP_ENTER)) == [], "once"


def test_while_a_step_is_under_way_the_death_is_not_waited_for(run: Run) -> None:
    run.arm("crash b/server at adapt.step.act")
    assert run.do(run.faults.at(Event.ADAPT_STEP_ACT)) == []
    assert not run.deployment.lives("b/server")


def test_each_fault_at_the_same_step_strikes(run: Run) -> None:
    run.arm("crash engine at adapt.commit")
    run.arm("crash proxy at adapt.commit")
    run.do(run.faults.at(Event.ADAPT_COMMIT))
    assert not run.deployment.lives("engine") and not run.deployment.lives("proxy")


def test_an_adaptation_that_never_comes_activates_nothing(run: Run) -> None:
    fault = run.arm("crash engine at adapt.commit")
    run.do(run.faults.rearm())
    assert run.reports() == [(str(fault), "armed", "")]


def test_a_crash_keeps_no_process_that_is_dead(run: Run) -> None:
    """A long run has thousands."""
    fault = run.arm("crash proxy at adapt.commit")
    dead = weakref.ref(run.deployment.nodes["proxy"])
    run.do(run.faults.at(Event.ADAPT_COMMIT))
    run.deployment.renew("proxy")
    gc.collect()
    assert dead() is None
    assert run.reports() == [(str(fault), "activated", "")]
