"""Faults of the bus and the radar in simulated runs: the same words and receipts, under every mechanism."""

from typing import Final

import pytest
from sampling import sampled

from aftbed.inject.model import FaultReport, parse
from aftbed.inject.receipts import BusTimes, ReceiptState
from aftbed.judge.intervals import intervals
from aftbed.judge.simulated import evidence_of_run
from aftbed.runtime.sim.world import Run, Setup, World, simulate

pytestmark = pytest.mark.simulation

DRIVE: Final = "ccrs-20"


def drive(*faults: str, ftm: str = "pbr", seed: int = 1) -> Run:
    return simulate(Setup(ftm=ftm, seed=seed, scenario=DRIVE, faults=tuple(map(parse, faults))))


STRUCK: Final = (  # a fault, its receipt, and its times
    (
        "corrupt bus RADAR_TRACK bit 21 nth 50",
        "1 frame, at 0.980000 s, id 130; noticed by gateway (checksum)",
        BusTimes(980_000, 980_000, 1_000_000),
    ),
    (
        "stuck-counter bus RADAR_TRACK nth 50",
        "1 frame, at 0.980000 s, id 130; noticed by gateway (repeated)",
        BusTimes(980_000, 980_000, 1_000_000),
    ),
    (
        "corrupt bus RADAR_TRACK signal LATERAL_OFFSET=9 crc good nth 50",
        "1 frame, at 0.980000 s, id 130; believed by gateway",
        BusTimes(980_000, believed=True),
    ),
)


@pytest.mark.parametrize(("struck", "ftm"), sampled(STRUCK, ("none", "pbr", "lfr+tr")))
def test_a_frame_is_struck_and_who_noticed_is_said(struck: tuple[str, str, BusTimes], ftm: str) -> None:
    words, noticed, times = struck
    run = drive(words, ftm=ftm)
    assert run.faults == (FaultReport(words, ReceiptState.ACTIVATED, noticed, bus=times),)
    assert run.rest.why_not == ()
    assert run.vehicle is not None and not run.vehicle.collision


HANDLED: Final = (  # a fault, its FDTI, FRTI and FHTI, and the reaction
    ("omission bus RADAR_TRACK nth 50", 12.0, 9.0, 21.0, "operational"),  # the brakes miss the reply first
    ("omission bus EGO_STATE nth 50", 10.0, 0.0, 10.0, "operational"),  # by the counter of the next one
    ("corrupt bus EGO_STATE bit 20 nth 50", 0.0, 10.0, 10.0, "operational"),
    ("masquerade bus RADAR_TRACK as EGO_STATE nth 50", 0.0, 20.0, 20.0, "operational"),
    ("delay bus EGO_STATE by 3ms nth 50", None, None, 3.0, "operational"),  # late, and right
    ("corrupt bus RADAR_TRACK signal LATERAL_OFFSET=9 crc good nth 50", None, None, None, "none"),
    ("corrupt bus BRAKE_STATUS bit 40 nth 50", None, None, None, "none"),  # of no use to any receiver
    ("bus-off gateway after 1000ms permanent", 12.0, 30.0, 42.0, "safe"),  # the brakes hold for 60 ms
    ("babbling radar after 1000ms for 30ms", 12.0, 19.0, 31.0, "operational"),
)


@pytest.mark.parametrize("expected", HANDLED, ids=lambda row: row[0])
def test_how_long_a_fault_of_the_bus_takes(expected: tuple[str, float, float, float, str]) -> None:
    (found,) = intervals(evidence_of_run(drive(expected[0], ftm="none")))
    assert found.in_bus_time
    assert (found.fault, found.fdti_ms, found.frti_ms, found.fhti_ms, found.reaction.value) == expected


def test_the_same_seed_is_the_same_run() -> None:
    words = ("omission bus from radar intermittent p 0.1", "crash primary at reply.sent nth 60")
    first, again, other = drive(*words), drive(*words), drive(*words, seed=2)
    assert first.faults == again.faults and first.vehicle == again.vehicle
    assert first.history.dialogue == again.history.dialogue
    assert first.faults != other.faults


def test_a_held_back_track_makes_its_request_when_it_comes() -> None:
    run = drive("delay bus RADAR_TRACK by 7ms for 1s")
    sent = [e.t_ns for e in run.history.dialogue if e.kind.name == "SENT"]
    offsets = {round((t_ns - sent[-1]) / 1e6) % 20 for t_ns in sent}
    assert offsets == {0, 7}
    assert run.faults[0].receipt.value == "activated"


def test_a_bus_that_is_cut_for_a_while_leaves_a_run_that_comes_to_rest() -> None:
    run = drive("bus-off gateway after 1s for 300ms", "partition radar|gateway after 2s for 300ms")
    assert [fault.receipt.value for fault in run.faults] == ["activated", "activated"]
    assert run.rest.why_not == () and run.vehicle is not None and not run.vehicle.collision


@pytest.mark.parametrize("ftm", ["none", "lfr+tr"])
def test_a_missed_target_is_a_wrong_input_that_no_mechanism_corrects(ftm: str) -> None:
    run = drive("radar missed when ttc < 2", ftm=ftm)
    (fault,) = run.faults
    assert fault.receipt is ReceiptState.ACTIVATED
    assert fault.detail.endswith("s; answered")
    assert run.vehicle is not None and run.vehicle.collision
    assert run.rest.why_not == ()


def test_a_fault_of_the_radar_that_changes_nothing_is_not_activated() -> None:
    (fault,) = drive("radar ghost range 149 speed -50 for 500ms").faults
    assert fault.receipt is ReceiptState.NOT_ACTIVATED and fault.detail == "it changed none of 25 tracks"


def test_a_radar_that_waits_in_vain_says_for_what() -> None:
    (fault,) = drive("radar missed when gap > 1000").faults
    assert (fault.receipt, fault.detail) == (ReceiptState.NOT_ACTIVATED, "gap > 1000 never held")


def test_a_live_run_gets_a_ghost() -> None:
    world = World(Setup(seed=1, scenario=DRIVE))
    world.start()
    world.advance(world.loop.ns + 1_000_000_000)
    world.inject(parse("radar ghost range 3 speed 1 for 100ms"))
    world.end()
    (fault,) = world.outcome().faults
    assert fault.receipt.value == "activated" and fault.detail.startswith("5 tracks, the first at 1.0")


def test_a_live_run_is_disturbed() -> None:
    world = World(Setup(seed=1, scenario=DRIVE))
    world.start()
    world.advance(world.loop.ns + 1_000_000_000)
    world.inject(parse("omission bus AEB_REQ for 100ms"))
    world.end()
    (fault,) = world.outcome().faults
    assert fault.receipt.value == "activated" and fault.detail.startswith("5 frames")


def test_a_fault_that_is_never_due_stays_armed() -> None:
    (fault,) = drive("omission bus RADAR_TRACK nth 100000").faults
    assert fault.receipt.value in ("armed", "not_activated")
