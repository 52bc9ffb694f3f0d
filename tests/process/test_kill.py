"""SIGKILL of every process of a run, under load: the service goes on, and nothing is left (G1 to G7)."""

import contextlib
import ctypes
import io
import itertools
import os
import signal
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

import pytest
from liveruns import (
    ENDLESS,
    GONE_SECONDS_MAX,
    Command,
    Home,
    Outcome,
    Started,
    aftbed,
    ended,
    only_run,
    state_of,
    under_load,
    until,
)
from sampling import every

from aftbed.core.journal import LIFELINE_OFFSET, EntryKind
from aftbed.ftm.compose import build
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.options import LoadRun
from aftbed.vehicle.can.candump import LogCounts, Refusal, parse_lines

pytestmark = pytest.mark.process

NODES: Final = tuple(build("pbr", "process").nodes)
CHAIN: Final = ("protocol", "before", "proceed", "after", "server")
OUTSIDE: Final = tuple(n for n in NODES if n.rpartition("/")[2] not in CHAIN)
RATE_HZ: Final = 200.0
FUTEX_TID_MASK: Final = 0x3FFF_FFFF
PR_SET_CHILD_SUBREAPER: Final = 36
PTRACE_SEIZE: Final = 0x4206
WAIT_ALL: Final = 0x4000_0000  # __WALL: also for what is no child
STOPPED_MS: Final = 110  # longer than a replacement takes


def assert_served(outcome: Outcome, failovers: int) -> None:
    """Every promise held, over as many changes of master."""
    assert outcome.verdict.verdict == "pass", (outcome.verdict.reasons, outcome.events)
    requests = outcome.verdict.requests
    assert requests.sent == requests.answered > 0
    assert (requests.lost, requests.duplicated, requests.wrong) == (0, 0, 0)
    assert len(outcome.verdict.failovers) == failovers, outcome.events
    assert outcome.record.end is not None
    assert outcome.record.end.epoch == 1 + failovers


def in_state(pid: int, state: str) -> bool:
    return state_of(pid) == state


def pids_of(run: Started, name: str) -> set[int]:
    """The process called `name`, if there is one."""
    return {row.pid for row in run.rows() if row.name == name}


def holder_of_lifeline(run: Started, node: str) -> int:
    """The process whose death the kernel will mark in the journal of the first `node`, for its Watchdog."""
    journal = run.launched.record / "journal" / f"{node.replace('/', '.')}.1.journal"
    (word,) = struct.unpack_from("I", journal.read_bytes(), LIFELINE_OFFSET)
    return word & FUTEX_TID_MASK


@contextlib.contextmanager
def traced(pid: int) -> Iterator[None]:
    """Killed, `pid` stays until its tracer has waited for it (ptrace(2)): here, until the end.

    Meanwhile this process adopts orphans, so that nobody else has to reap it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p)
    libc.prctl(PR_SET_CHILD_SUBREAPER, 1)
    try:
        assert libc.ptrace(PTRACE_SEIZE, pid, None, None) == 0, os.strerror(ctypes.get_errno())
        yield
        os.waitpid(pid, WAIT_ALL)
    finally:
        libc.prctl(PR_SET_CHILD_SUBREAPER, 0)


def served_on(run: Started) -> Outcome:
    """The run, stopped after some more requests have been answered."""
    run.wait_for_answers(run.answered() + 20)
    return run.stop()


def load_over_a_kill(home: Home, name: str, placement: str = "process") -> Outcome:
    """A run under load in which the process called `name` is killed, and replaced."""
    with under_load(home, ENDLESS, RATE_HZ, placement=placement) as run:
        seen = len(run.events)
        pid = run.strike(name, signal.SIGKILL)
        assert ended(pid)
        if name in OUTSIDE:
            run.wait_for("replaced", f"{name}:", after=seen)
        else:
            run.wait_for("script.done", "new backup", after=seen)
        return served_on(run)


def test_there_are_the_seventeen_processes_of_the_paper(home: Home) -> None:
    with under_load(home, ENDLESS, RATE_HZ) as run:
        rows = run.rows()
        assert [row.name for row in rows if row.node] == ["supervisor", *NODES]
        assert len({row.pid for row in rows}) == len(rows)
        assert len([row for row in rows if row.node]) == 17
        nodes = {row.name: row.pid for row in rows if row.name in NODES}
        assert {name: holder_of_lifeline(run, name) for name in nodes} == nodes
        assert_served(run.stop(), failovers=0)


@pytest.mark.parametrize("part", every(2, CHAIN))
def test_the_death_of_any_node_of_the_primary_is_one_failover(home: Home, part: str) -> None:
    outcome = load_over_a_kill(home, f"a/{part}")
    assert_served(outcome, failovers=1)
    assert outcome.record.end is not None
    assert (outcome.record.end.leader, outcome.record.end.backup) == ("b", "a")


@pytest.mark.parametrize("part", every(2, CHAIN))
def test_the_death_of_any_node_of_the_backup_costs_nothing(home: Home, part: str) -> None:
    outcome = load_over_a_kill(home, f"b/{part}")
    assert_served(outcome, failovers=0)
    assert outcome.record.end is not None
    assert (outcome.record.end.leader, outcome.record.end.backup) == ("a", "b")


@pytest.mark.parametrize("name", every(2, OUTSIDE))
def test_the_death_of_a_node_beside_the_replicas_is_no_failover(home: Home, name: str) -> None:
    outcome = load_over_a_kill(home, name)
    assert_served(outcome, failovers=0)
    assert outcome.told("script") == []


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_death_of_a_replica_in_one_node(home: Home, name: str) -> None:
    assert_served(load_over_a_kill(home, name, "replica"), failovers=1 if name == "a" else 0)


def test_the_death_of_the_zygote_is_no_failover(home: Home) -> None:
    with under_load(home, ENDLESS, RATE_HZ) as run:
        pid = run.strike("zygote", signal.SIGKILL)
        assert ended(pid)
        run.wait_for("died", "zygote")
        until(lambda: run.pid("zygote") != pid, "a new zygote")
        assert_served(served_on(run), failovers=0)


def test_after_the_death_of_the_zygote_a_replica_can_be_replaced(home: Home) -> None:
    """The spares that the dead zygote parked are enough for one; the next ones are the new zygote's."""
    with under_load(home, ENDLESS, RATE_HZ) as run:
        run.strike("zygote", signal.SIGKILL)
        run.wait_for("died", "zygote")
        for _ in range(2):
            seen = len(run.events)
            run.strike(f"{run.status()['leader']}/server", signal.SIGKILL)
            run.wait_for("script.done", "new backup", after=seen)
        assert_served(served_on(run), failovers=2)


@pytest.mark.parametrize("name", every(2, ["proxy", "client", "recovery", "b/watchdog", "a/watchdog"]))
def test_a_node_beside_the_replicas_may_die_again_and_again(home: Home, name: str) -> None:
    """Under many requests each death meets another moment of a request."""
    with under_load(home, ENDLESS, 1000.0) as run:
        for _ in range(5):
            seen = len(run.events)
            run.strike(name, signal.SIGKILL)
            run.wait_for("replaced", name, after=seen)
        assert_served(served_on(run), failovers=0)


@pytest.mark.parametrize(("node", "neighbour"), every(7, list(itertools.permutations(OUTSIDE, 2))))
def test_a_replacement_that_dies_beside_a_stopped_neighbour_is_replaced(
    home: Home, node: str, neighbour: str
) -> None:
    """While others are bound to the new process, one of them does not answer; then the new one dies too."""
    with under_load(home, ENDLESS, RATE_HZ) as run:
        hang = Fault(Hang(STOPPED_MS), neighbour, Trigger())
        control_client.ask(run.private, control_client.InjectCommand(hang))
        first = run.strike(node, signal.SIGKILL)
        second = until(lambda: next(iter(pids_of(run, node) - {first}), 0), f"a new {node}")
        os.kill(second, signal.SIGKILL)
        until(lambda: pids_of(run, node) - {first, second}, f"another new {node}")
        assert_served(served_on(run), failovers=0)


def test_the_death_of_the_supervisor_ends_everything_and_is_inconclusive(home: Home) -> None:
    with Command("--load", "100000@200") as command:
        command.started()
        pid = next(row.pid for row in control_client.processes(only_run()) if row.name == "supervisor")
        os.kill(pid, signal.SIGKILL)
        assert ended(pid)
        done = command.done()
    assert done.code == 3, done.out + done.err
    assert "verdict: inconclusive" in done.out
    assert "the supervisor did not live to end the run" in done.out
    assert home.seconds_to_clean() < GONE_SECONDS_MAX


def test_a_killed_command_leaves_nothing_but_its_record(home: Home, tmp_path: Path) -> None:
    record = tmp_path / "record"
    with Command("--scenario", "free-drive", "--record", record) as command:
        command.started()
        command.wait_for_line("km/h")
        until(lambda: _frames(record).frames > 100, "frames in the log")
        command.kill()
        assert home.seconds_to_clean() < GONE_SECONDS_MAX
    assert_readable_to_the_last_line(record)
    done = aftbed("check", record)
    assert done.code == 3, done.out + done.err
    assert "verdict: inconclusive" in done.out


def test_command_and_supervisor_killed_at_once_leave_nothing_but_the_record(
    home: Home, tmp_path: Path
) -> None:
    record = tmp_path / "record"
    with Command("--scenario", "free-drive", "--record", record) as command:
        command.started()
        until(lambda: _frames(record).frames > 100, "frames in the log")
        supervisor = next(row.pid for row in control_client.processes(only_run()) if row.name == "supervisor")
        os.kill(command.pid, signal.SIGKILL)
        os.kill(supervisor, signal.SIGKILL)
        command.wait()
        assert home.seconds_to_clean() < GONE_SECONDS_MAX
    assert_readable_to_the_last_line(record)
    assert aftbed("check", record).code == 3


@pytest.mark.parametrize("warden", ["lives", "stopped", "killed"])
@pytest.mark.parametrize("supervisor", ["lives", "stopped", "killed"])
def test_a_killed_command_leaves_nothing_whatever_its_keepers_suffer(
    home: Home, supervisor: str, warden: str
) -> None:
    """One of the two is enough, and goes on if it was stopped. Without both only the directory stays."""
    with Command("--load", "100000@200") as command:
        command.started()
        pids = {m.name: m.pid for m in run_directory.members() if m.run == str(only_run())}
        keepers = {pids["aftbed-warden"]: warden, pids["aftbed-supervis"]: supervisor}
        for pid in (pid for pid, fate in keepers.items() if fate == "stopped"):
            os.kill(pid, signal.SIGSTOP)
            until(partial(in_state, pid, "T"), "the process to stop")
        for pid in (pid for pid, fate in keepers.items() if fate == "killed"):
            os.kill(pid, signal.SIGKILL)
        command.kill()
        if supervisor == warden == "killed":
            until(lambda: not home.processes(), "the end of all processes", GONE_SECONDS_MAX)
            assert aftbed("doctor", "--clean").code == 0
        assert home.seconds_to_clean() < GONE_SECONDS_MAX


def test_what_does_not_end_in_time_is_named(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        pid = run.pid("zygote")
        with traced(pid):
            outcome = run.stop()
    assert outcome.verdict.verdict == "fail"
    assert outcome.verdict.reasons == [f"clean_exit: left behind: ['zygote ({pid}), state Z']"]


def test_the_record_of_a_killed_run_holds_every_reply_that_was_given(home: Home) -> None:
    with Started(home, LoadRun(100_000, 0.0)) as run:
        run.wait_for("started")
        run.wait_for_answers(500)
        given = run.answered()
        run.strike("supervisor", signal.SIGKILL)
        outcome = run.finish()
    assert outcome.verdict.verdict == "inconclusive", outcome.verdict.reasons
    assert outcome.verdict.checks["at_most_once"] == "pass"
    assert outcome.verdict.checks["one_history"] == "pass"
    dialogue = outcome.record.history.dialogue
    assert sum(entry.kind is EntryKind.ANSWERED for entry in dialogue) >= given


@pytest.mark.parametrize("size", [0, 1 << 20])
def test_a_journal_that_was_just_being_made_spoils_no_record(home: Home, tmp_path: Path, size: int) -> None:
    """A node may be killed between the creation of its file and the header in it."""
    record = tmp_path / "record"
    assert aftbed("run", "--load", "50", "--record", record).code == 0
    with (record / "journal" / "a.server.2.journal").open("wb") as journal:
        journal.truncate(size)
    done = aftbed("check", record)
    assert done.code == 0, done.out + done.err


def _frames(record: Path) -> LogCounts:
    counts = LogCounts()
    log = record / "bus.log"
    content = log.read_bytes() if log.exists() else b""
    for _ in parse_lines(io.BytesIO(content), counts):
        pass
    return counts


def assert_readable_to_the_last_line(record: Path) -> None:
    """Nothing in the bus log is refused, but for what was being written."""
    counts = _frames(record)
    assert counts.frames > 100
    assert set(counts.refused) <= {Refusal.TORN}, counts
