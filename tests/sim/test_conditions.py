"""Faults that wait for a condition of the car, in virtual time: at that very step, under every mechanism."""

from typing import Final

import pytest
from sampling import sampled

from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.inject.model import FaultReport, parse
from aftbed.inject.receipts import ReceiptState
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Run, Setup, World, simulate
from aftbed.search.shrink import shrink

pytestmark = pytest.mark.simulation

DRIVE: Final = "ccrs-20"
HELD_US: Final = 2_000_000  # ttc < 2 in this drive: at 20 km/h, 11.1 m before the obstacle
SOON_NS: Final = 600_000  # from the step to a death that was ordered at it
CYCLE_NS: Final = 20_000_000


def drive(*faults: str, ftm: str = "pbr", placement: str = "process", scenario: str = DRIVE) -> Run:
    return simulate(Setup(ftm, placement, seed=1, scenario=scenario, faults=tuple(map(parse, faults))))


def began_ns(run: Run) -> int:
    """When the drive began: a request comes with each cycle of the radar, the first with the launch."""
    sent = [e for e in run.history.dialogue if e.kind is EntryKind.SENT]
    return sent[50].t_ns - 50 * CYCLE_NS


@pytest.mark.parametrize(("ftm", "placement"), sampled(("pbr", "lfr", "pbr+tr"), ("process", "replica")))
def test_a_crash_strikes_at_the_step_of_its_condition(ftm: str, placement: str) -> None:
    run = drive("crash primary when ttc < 2", ftm=ftm, placement=placement)
    words = FaultReport("crash primary when ttc < 2", ReceiptState.ACTIVATED, "ttc < 2 at 2.000000 s")
    assert run.faults == (words,)
    died_ns = {one.t_ns for one in run.struck}
    step_ns = began_ns(run) + HELD_US * 1000
    assert step_ns < min(died_ns) <= max(died_ns) < step_ns + SOON_NS
    assert run.rest.leader == "b" and run.rest.why_not == ()
    assert run.vehicle is not None and not run.vehicle.collision


def test_a_step_between_two_cycles_of_the_radar_is_met_as_well() -> None:
    """Frames come each 20 ms, and no other event advances the car meanwhile."""
    (fault,) = drive("crash primary when ttc < 1.995").faults
    assert fault.detail == "ttc < 1.995 at 2.005000 s"


@pytest.mark.parametrize(
    ("words", "struck"),
    [
        ("hang primary for 10ms when ttc < 2", 0),
        ("slow primary by 1ms for 50ms when ttc < 2", 0),
        ("slow primary share 5% for 50ms when ttc < 2", 0),
        ("delay pxy2pro by 3ms when ttc < 2", 101),
        ("delay pxy2pro by 3ms nth 4 when ttc < 2", 104),
        ("bitflip result bit 60 when ttc < 2", 101),
        ("bitflip result bit 60 nth 4 when ttc < 2", 104),
        ("bitflip state.counter bit 0 when ttc < 2", 0),
        ("crash primary at reply.sent nth 4 when ttc < 2", 0),
    ],
)
def test_every_fault_can_wait_for_one(words: str, struck: int) -> None:
    run = drive(words)
    (fault,) = run.faults
    assert fault.receipt.value == "activated" and fault.detail.endswith("ttc < 2 at 2.000000 s"), fault
    applied = run.history.events(Event.FAULT_APPLIED)
    requests = [r.request_id for r in applied if r.request_id]
    assert requests[:1] == ([struck] if struck else []), "counted from the step on"
    assert min(r.t_ns for r in applied) >= began_ns(run) + HELD_US * 1000


def test_a_condition_that_holds_from_the_start_is_met_at_once() -> None:
    (fault,) = drive("delay pxy2pro by 3ms when speed > 1").faults
    assert fault.receipt.value == "activated"
    assert fault.detail == "a message of proxy about request 1; speed > 1 at 0.000000 s"


@pytest.mark.parametrize(
    "words",
    [
        "crash primary when gap < 0.1",
        "bitflip result when speed > 90",
        "omission bus AEB_REQ when ttc < 0.01",
    ],
)
def test_a_condition_that_never_holds_activates_nothing(words: str) -> None:
    run = drive(words)
    assert run.faults == (
        FaultReport(str(parse(words)), ReceiptState.NOT_ACTIVATED, f"{words.split(' when ')[1]} never held"),
    )
    assert run.history.dialogue == drive().history.dialogue, "to be looked at is nothing to the car"


def test_who_drives_on_without_a_client_is_looked_at_too() -> None:
    run = drive("crash client when ttc < 2", "crash primary when ttc < 1.999")
    assert [fault.detail for fault in run.faults] == ["ttc < 2 at 2.000000 s", "ttc < 1.999 at 2.001000 s"]
    assert run.rest.why_not == ()


def test_a_live_run_is_struck_at_its_step() -> None:
    world = World(Setup(seed=1, scenario=DRIVE))
    world.start()
    world.advance(world.loop.ns + 1_234_567_890)
    world.inject(parse("crash primary when ttc < 2"))
    world.end()
    (fault,) = world.outcome().faults
    assert fault.detail == "ttc < 2 at 2.000000 s" and fault.receipt.value == "activated"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("crash primary when ttc < 2", "'when' looks at the car, and without a scenario there is none"),
        ("omission bus AEB_REQ", "without a scenario there is no bus"),
        ("bitflip memory", "simulated processes have no memory of their own"),
    ],
)
def test_what_is_not_there_is_refused(words: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        drive(words, scenario="")
    world = World(Setup(seed=1))
    world.start()
    with pytest.raises(ConfigError, match=says):
        world.inject(parse(words))


def test_a_failure_that_needs_a_car_is_not_shrunk_to_one_without() -> None:
    tried: list[Setup] = []

    def broken(setup: Setup) -> tuple[Breach, ...]:
        tried.append(setup)
        return (Breach("", ""),) if len(tried) == 1 else ()

    shrink(Setup("pbr", scenario=DRIVE, faults=(parse("crash primary when ttc < 2"),)), broken)
    assert len(tried) > 1 and all(setup.scenario for setup in tried if setup.faults)
