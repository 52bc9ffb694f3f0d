"""SIGSTOP of every process: a hang is found by a deadline, and what wakes up later is not believed.

The short tests stop a node until it is replaced, the deep ones for ten seconds, with SIGCONT at the end.
"""

import os
import signal
import time
from typing import Final

import pytest
from liveruns import ENDLESS, Home, Outcome, Started, ended, state_of, under_load, until
from sampling import every

from aftbed.core.events import Event
from aftbed.ftm.compose import build
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

NODES: Final = tuple(build("pbr", "process").nodes)
CHAIN: Final = ("protocol", "before", "proceed", "after", "server")
RATE_HZ: Final = 200.0
LONG_SECONDS: Final = 10.0


def failovers_of(name: str) -> int:
    """How many changes of master a hang of `name` must bring."""
    return 1 if name in {f"a/{part}" for part in CHAIN} else 0


def assert_promises(outcome: Outcome, failovers: int) -> None:
    """G1, G2, G3, G6: checked by the verdict, and counted here."""
    assert outcome.verdict.verdict == "pass", (outcome.verdict.reasons, outcome.events)
    requests = outcome.verdict.requests
    assert requests.sent == requests.answered
    assert (requests.lost, requests.duplicated, requests.wrong) == (0, 0, 0)
    assert len(outcome.verdict.failovers) == failovers, outcome.events


def wait_until_replaced(run: Started, name: str, seen: int) -> None:
    """Until another process has the place of `name`, and a backup stands."""
    if "/" in name and name.rpartition("/")[2] in CHAIN:
        run.wait_for("script.done", "new backup", after=seen)
    else:
        run.wait_for("hangs", name, after=seen)
        run.wait_for("replaced", name, after=seen)


def served_on(run: Started) -> Outcome:
    """The run, stopped after some more requests have been answered."""
    run.wait_for_answers(run.answered() + 20)
    return run.stop()


@pytest.mark.parametrize(
    "name",
    every(3, ["a/server", "a/protocol", "b/after", "b/server", "client", "recovery", "proxy", "a/watchdog"]),
)
def test_a_stopped_node_is_replaced_and_does_not_come_back(home: Home, name: str) -> None:
    with under_load(home, ENDLESS, RATE_HZ) as run:
        seen = len(run.events)
        pid = run.strike(name, signal.SIGSTOP)
        wait_until_replaced(run, name, seen)
        assert ended(pid), "the stopped process is fenced, then killed"
        assert run.pid(name) != pid
        assert_promises(served_on(run), failovers_of(name))


@pytest.mark.parametrize("name", ["a", "b"])
def test_a_stopped_replica_in_one_node_is_replaced(home: Home, name: str) -> None:
    with under_load(home, ENDLESS, RATE_HZ, placement="replica") as run:
        seen = len(run.events)
        pid = run.strike(name, signal.SIGSTOP)
        run.wait_for("script.done", "new backup", after=seen)
        assert ended(pid)
        assert_promises(served_on(run), failovers=1 if name == "a" else 0)


def test_the_service_does_not_need_the_supervisor(home: Home) -> None:
    """It is not on the way of a request: while it is stopped, requests are answered."""
    with under_load(home, ENDLESS, RATE_HZ) as run:
        pid = run.strike("supervisor", signal.SIGSTOP)
        before = run.answered()
        until(lambda: run.answered() > before + 100, "replies while the supervisor is stopped")
        assert state_of(pid) == "T"
        run.strike("supervisor", signal.SIGCONT)
        assert_promises(run.stop(), failovers=0)


def test_a_death_while_the_supervisor_is_stopped_is_dealt_with_afterwards(home: Home) -> None:
    with under_load(home, ENDLESS, RATE_HZ) as run:
        primary = run.pid("a/server")
        run.strike("supervisor", signal.SIGSTOP)
        os.kill(primary, signal.SIGKILL)
        assert ended(primary)
        run.strike("supervisor", signal.SIGCONT)
        run.wait_for("script.done", "new backup")
        assert_promises(served_on(run), failovers=1)


def test_a_short_pause_of_a_replica_is_not_a_failover(home: Home) -> None:
    """Below the deadline nothing may happen; what was stopped goes on by itself."""
    with under_load(home, ENDLESS, RATE_HZ) as run:
        control_client.ask(run.private, control_client.InjectCommand(Fault(Hang(10), "primary", Trigger())))
        outcome = served_on(run)
    assert [fault.receipt.value for fault in outcome.verdict.faults] == ["activated"]
    assert_promises(outcome, failovers=0)


def test_a_hang_that_ends_by_itself_is_not_believed(home: Home) -> None:
    """The primary is stopped, replaced, and told to go on: no reply of the old epoch is accepted."""
    fault = Fault(Hang(500), "primary", Trigger("server.enter", 60))
    with Started(home, LoadRun(ENDLESS, RATE_HZ), faults=(fault,)) as run:
        run.wait_for("script.done", "new backup")
        outcome = served_on(run)
    assert_promises(outcome, failovers=1)
    accepted = outcome.record.history.events(Event.REPLY_ACCEPTED)
    epochs = [record.detail >> 8 for record in accepted]
    assert epochs == sorted(epochs)
    assert set(epochs) == {1, 2}


@pytest.mark.deep
@pytest.mark.parametrize("name", ["supervisor", *NODES])
def test_a_long_stop_of_any_process_breaks_no_promise(home: Home, name: str) -> None:
    """Ten seconds, then SIGCONT; by then a node of the graph is long replaced."""
    with under_load(home, round((LONG_SECONDS + 2) * RATE_HZ), RATE_HZ) as run:
        pid = run.strike(name, signal.SIGSTOP)
        until_ns = time.monotonic_ns() + round(LONG_SECONDS * 1e9)
        until(lambda: time.monotonic_ns() > until_ns, "ten seconds to pass", LONG_SECONDS + 5)
        if name != "supervisor":
            assert ended(pid)
        else:
            os.kill(pid, signal.SIGCONT)
        assert_promises(run.finish(), failovers_of(name))
