"""Faults on a condition of the car, a share of a CPU, and bits of any memory, on real processes.

What each fault does under each mechanism is simulated: `tests/sim/test_conditions`, `test_shares`.
"""

import re
from pathlib import Path
from typing import Final

import pytest
from liveruns import ENDLESS, Home, Started, aftbed, under_load, until

from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.inject.model import FaultReport, parse
from aftbed.inject.receipts import ReceiptState
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.runtime.unix import control_client, process_memory, run_directory
from aftbed.runtime.unix.options import CarRun, LoadRun

pytestmark = pytest.mark.process

SCENARIO: Final = "ccrs-20"
DRIVE: Final = ("--scenario", SCENARIO, "--pace", "max", "--json")
NEVER: Final = "crash proxy when gap < 0.1"
WORDS: Final = (
    "delay clt2pxy by 3ms when ttc < 2.5",
    "slow backup share 20% for 20ms when ttc < 2.2",
    "crash primary when ttc < 1.995",
    NEVER,
)
_WHERE: Final = re.compile(
    r"bit ([0-7]) of byte 0x([0-9a-f]+) of (\[heap\]|anonymous memory) [0-9a-f]+-[0-9a-f]+ in a/server"
    r" \(pid (\d+)\): 0x(..) to 0x(..), read back"
)


# -- conditions -----------------------------------------------------------------------------------


def test_in_lockstep_faults_begin_at_the_very_steps_of_the_simulator() -> None:
    arguments = [word for text in WORDS for word in ("--inject", text)]
    done = aftbed("run", *DRIVE, *arguments)
    assert done.code == 3, done.out + done.err
    run = simulate(Setup(scenario=SCENARIO, faults=tuple(map(parse, WORDS))))
    assert done.verdict().faults == list(run.faults)
    delayed, slowed, crashed, never = done.verdict().faults
    assert delayed.detail == "a message of client about request 76; ttc < 2.5 at 1.500000 s"
    assert slowed.detail == "ttc < 2.2 at 1.800000 s"
    assert crashed.detail == "ttc < 1.995 at 2.005000 s" and crashed.receipt.value == "activated"
    unmet = "gap < 0.1 never held"
    assert never == FaultReport(NEVER, ReceiptState.NOT_ACTIVATED, unmet, number=3)


def test_in_real_time_the_car_drives_on_and_the_receipt_says_how_far_behind_the_effect_was(
    home: Home,
) -> None:
    faults = (parse("crash primary when gap < 15"),)
    with Started(home, CarRun(SCENARIO, 4.0, "latch"), faults=faults) as run:
        outcome = run.finish()
    (found,) = outcome.verdict.faults
    lag = re.fullmatch(r"gap < 15 at 1\.3\d+ s, (\d+\.\d\d) ms before", found.detail)
    assert found.receipt.value == "activated" and lag is not None and 0 < float(lag[1]) < 1000, found
    assert len(outcome.verdict.failovers) == 1


def test_a_live_run_is_given_one_from_a_second_command(home: Home) -> None:
    with Started(home, CarRun("ccrs-50", 1.0, "latch")) as run:
        run.wait_for("started")
        done = aftbed("inject", "hang", "primary", "--for", "20ms", "--when", "speed>5")
        assert done.code == 0 and "hang primary for 20ms when speed > 5" in done.err, done.err
        run.wait_for("met")
        (found,) = run.stop().verdict.faults
    assert found.receipt.value == "activated" and "speed > 5 at " in found.detail


def test_a_load_has_no_car(home: Home) -> None:
    done = aftbed("run", "--load", "10", "--inject", "crash primary when ttc < 1")
    assert done.code == 2 and "'when' looks at the car, and a run of --load has none" in done.err
    with under_load(home, ENDLESS):
        done = aftbed("inject", "crash", "primary", "--when", "ttc < 1")
        assert done.code == 2 and "a run of --load has none" in done.err


# -- a share of a CPU -----------------------------------------------------------------------------


def test_a_replica_with_a_small_share_takes_longer_and_then_no_longer(home: Home) -> None:
    count, first, last = 150, 20, 120
    fault = parse(f"slow primary share 2% for 200ms at request.received nth {first}")
    with Started(home, LoadRun(count, 200.0), faults=(fault,)) as run:
        outcome = run.finish()
    dialogue = outcome.record.history.dialogue
    sent = {e.request_id: e.t_ns for e in dialogue if e.kind is EntryKind.SENT}
    took = {e.request_id: e.t_ns - sent[e.request_id] for e in dialogue if e.kind is EntryKind.ANSWERED}
    calm = sorted(took[n] for n in range(1, first))[first // 2]
    slow = sorted(took[n] for n in range(first + 5, first + 15))[5]
    healed = sorted(took[n] for n in range(last, count + 1))[10]
    assert slow > 3 * calm and healed < slow / 2, (calm, slow, healed)
    assert outcome.verdict.faults[0].receipt.value == "activated"
    assert outcome.verdict.requests.answered == count
    assert not outcome.record.history.events(Event.WATCHDOG_SUSPECT)


# -- memory ---------------------------------------------------------------------------------------


def flipped(run: Started, text: str) -> re.Match[str]:
    """What the run says of the bit that it has flipped."""
    control_client.ask(run.private, control_client.InjectCommand(parse(text)))
    said = str(run.wait_for("fault", "bitflip memory")["text"])
    found = _WHERE.search(said)
    assert found is not None, said
    return found


def test_a_bit_of_a_nodes_memory_is_another_one_and_of_no_other_node(home: Home) -> None:
    """An address that the node does not use: it holds a node's bits for as long as the run lasts."""
    with under_load(home, ENDLESS) as run:
        pid, private = run.pid("a/server"), run.private
        owner = process_memory.Owner("a/server", pid, private)
        address = unused(owner)
        before = process_memory.peek(owner, address)
        found = flipped(run, f"bitflip memory bit 5 address {address:#x} in a/server")
        assert (found[1], int(found[2], 16), int(found[4])) == ("5", address, pid)
        assert (int(found[5], 16), int(found[6], 16)) == (before, before ^ 0x20)
        assert process_memory.peek(owner, address) == before ^ 0x20
        other = process_memory.Owner("b/server", run.pid("b/server"), private)
        assert process_memory.peek(other, address) == before, (
            "forked from the same zygote, and not the same memory"
        )
        outcome = run.stop()
    assert outcome.verdict.faults[0].receipt.value == "applied"


def unused(owner: process_memory.Owner) -> int:
    """The last byte of the heap: malloc gives it to somebody only where the heap grows."""
    heap = next(one for one in process_memory.mappings(owner.pid) if one.name == process_memory.HEAP)
    return heap.end - 1


def test_a_byte_that_is_drawn_is_one_that_the_process_can_write(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        mapped = process_memory.mappings(run.pid("a/server"))
        found = flipped(run, "bitflip memory in a/server")
        assert any(one.start <= int(found[2], 16) < one.end for one in mapped)
        assert int(found[5], 16) ^ int(found[6], 16) == 1 << int(found[1])
        run.stop()


def test_what_is_no_memory_of_the_process_is_the_injectors_failure(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        code = next(
            line
            for line in Path(f"/proc/{run.pid('a/server')}/maps").read_text().splitlines()
            if " r-xp " in line
        )
        first = int(code.partition("-")[0], 16)
        control_client.ask(
            run.private, control_client.InjectCommand(parse(f"bitflip memory address {first:#x} in a/server"))
        )
        said = str(run.wait_for("fault", "inject_error")["text"])
        assert f"address {first:#x}: in no private memory that a/server (pid" in said
        assert run.stop().verdict.faults[0].receipt.value == "inject_error"


def test_a_process_of_another_run_is_not_struck(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        owner = process_memory.Owner("a/server", run.pid("a/server"), run_directory.root() / "000000")
        with pytest.raises(StepFailed, match=r"a/server \(pid \d+\) is no process of this run"):
            process_memory.flip(owner, None, None, 1)
        run.stop()


def test_memory_is_struck_from_a_second_command(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        done = aftbed("inject", "bitflip", "backup", "--level", "memory", "--unsafe-memory", "--bit", "0")
        assert done.code == 0 and "bitflip memory bit 0 in backup" in done.err
        until(lambda: any("bit 0 of byte" in str(e["text"]) for e in run.heard()), "the flip")
        (found,) = run.stop().verdict.faults
    assert found.receipt.value == "applied" and " in b/" in found.detail
