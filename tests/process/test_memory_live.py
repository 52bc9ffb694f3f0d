"""A field of the state, flipped in shared memory of real processes. The matrix is simulated."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from liveruns import ENDLESS, Home, Outcome, Started, aftbed, under_load, until

from aftbed.core.events import Event
from aftbed.inject.model import parse
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.options import LoadRun
from aftbed.runtime.unix.transport import MEMORY_NAME

pytestmark = pytest.mark.process

COUNT: Final = 80
RATE_HZ: Final = 400.0
HIT: Final = 32  # the counter is odd then, and not its last
FLIP: Final = "bitflip state.counter bit 0"
REFUSED: Final = "bitflip state.counter bit 7"  # no state has such a counter
NEVER: Final = "nth 1000000"
_CELL: Final = re.compile(rf" (\d+) +/memfd:{MEMORY_NAME}")


def ran(home: Home, ftm: str, *texts: str, placement: str = "process") -> Outcome:
    faults = tuple(map(parse, texts))
    with Started(home, LoadRun(COUNT, RATE_HZ), ftm=ftm, placement=placement, faults=faults) as run:
        return run.finish()


def receipts(outcome: Outcome) -> list[str]:
    return [fault.receipt.value for fault in outcome.verdict.faults]


def cells(pid: int) -> set[str]:
    """The inodes of the cells that the process `pid` has mapped."""
    return set(_CELL.findall(Path(f"/proc/{pid}/maps").read_text()))


def held(run: Started) -> dict[str, set[str]]:
    """By name, who of the run has a cell, the supervisor aside."""
    found = {row.name: cells(row.pid) for row in run.rows() if row.pid and row.name != "supervisor"}
    return {name: inodes for name, inodes in found.items() if inodes}


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_under_pbr_it_is_wrong_from_there_on(home: Home, placement: str) -> None:
    outcome = ran(home, "pbr", f"{FLIP} at request.received nth {HIT}", placement=placement)
    assert receipts(outcome) == ["activated"]
    assert outcome.verdict.faults[0].detail == "bit 0 of state.counter in a/server, taken over"
    assert outcome.verdict.requests.wrong == COUNT - HIT + 1
    assert outcome.verdict.checks["value"] == "fail" and outcome.verdict.failovers == []


def test_under_pbr_and_tr_it_is_outvoted(home: Home) -> None:
    """The state is captured twice a request: before the first execution, and for the checkpoint."""
    outcome = ran(home, "pbr+tr", f"{FLIP} at state.captured nth {2 * HIT - 1}")
    assert receipts(outcome) == ["activated"]
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert len(outcome.record.history.events(Event.SERVER_EXIT)) == 2 * COUNT + 1


def test_a_state_that_is_refused_ends_its_node_and_the_backup_takes_over(home: Home) -> None:
    outcome = ran(home, "pbr", f"{REFUSED} at reply.sent nth {HIT}")
    assert receipts(outcome) == ["activated"]
    assert "refused: its node has ended itself" in outcome.verdict.faults[0].detail
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert len(outcome.verdict.failovers) == 1
    assert len(outcome.record.history.events(Event.DETECTED_STOP)) == 1


def test_what_is_not_read_any_more_is_latent(home: Home) -> None:
    outcome = ran(home, "pbr", f"{FLIP} at reply.delivered nth {COUNT}")
    assert receipts(outcome) == ["applied"] and outcome.verdict.verdict == "pass"
    assert outcome.record.end is not None
    states = outcome.record.end.states
    assert isinstance(states, dict) and states["a"] != states["b"], "seen at the end, and not by looking"


def test_it_is_memory_of_that_process_and_of_no_other(home: Home) -> None:
    """Without a fault there is none; a replica that takes the place of a dead one gets a fresh one."""
    with under_load(home, ENDLESS, RATE_HZ) as run:
        assert not held(run)
        control_client.ask(
            run.private, control_client.InjectCommand(parse(f"{FLIP} in a at request.received {NEVER}"))
        )
        old = cells(run.pid("a/server"))
        assert len(old) == 1 and old == cells(run.launched.supervisor)
        assert held(run) == {"a/server": old}

        control_client.ask(run.private, control_client.InjectCommand(parse("crash a/server")))
        until(lambda: run.status()["leader"] == "b" and run.redundant(), "a new backup")
        assert not held(run) and not cells(run.launched.supervisor), "no process has the dead one's"
        control_client.ask(
            run.private, control_client.InjectCommand(parse(f"{FLIP} in a at request.received {NEVER}"))
        )
        fresh = cells(run.pid("a/server"))
        assert len(fresh) == 1 and not fresh & old and held(run) == {"a/server": fresh}
        assert cells(run.launched.supervisor) == fresh
        assert run.stop().verdict.requests.wrong == 0


def test_a_bit_is_flipped_from_outside(home: Home) -> None:
    with under_load(home, ENDLESS, RATE_HZ) as run:
        done = aftbed("inject", "bitflip", "state.ego", "--bit", "52")
        assert done.code == 2 and "unknown field of the state 'ego'; did you mean 'ego_ms'?" in done.err
        done = aftbed("inject", "bitflip", "state.counter", "--bit", "8")
        assert done.code == 2 and "bit 8 of state.counter: it is u8, and has bits 0 to 7" in done.err
        flip = ("inject", "bitflip", "state.counter", "--bit", "7", "--at", "request.received")
        assert aftbed(*flip).code == 0  # any counter is refused then, whatever it is at this moment
        until(lambda: run.status()["leader"] == "b" and run.redundant(), "a new backup")
        outcome = run.stop()
    assert receipts(outcome) == ["activated"]
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert len(outcome.verdict.failovers) == 1


WARM: Final = """
import sys
stderr = open(sys.argv[1], "w+")  # as a test runner has it: no descriptor 2
sys.stderr = stderr
from aftbed.inject.model import parse
from aftbed.judge.record import read_record
from aftbed.judge.verdict import judge
from aftbed.runtime.interface import LIGHT
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.supervisor_process import warm_up
from aftbed.runtime.unix.options import LoadRun
warm_up(LIGHT)
fault = parse(sys.argv[2])
launched = launch(*options_for(ftm="pbr", placement="process", work=LoadRun(80, 200.0), faults=(fault,)))
for _ in launched.reports():
    pass
launched.wait()
verdict = judge(read_record(launched.record))
print(verdict.verdict, len(verdict.failovers), (launched.record / "processes.log").read_text())
launched.remove()
"""


def test_what_nodes_of_a_warm_run_print_gets_into_no_journal(home: Home, tmp_path: Path) -> None:
    """Their process is a fork of one whose `sys.stderr` has a descriptor that is closed in the fork."""
    words = [sys.executable, "-c", WARM, str(tmp_path / "stderr"), f"{REFUSED} at reply.sent nth {HIT}"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr + (tmp_path / "stderr").read_text()
    assert done.stdout.startswith("pass 1 ") and ": detected stop: " in done.stdout, done.stdout
    assert (tmp_path / "stderr").read_text() == ""
