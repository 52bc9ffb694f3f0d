"""The bound of a fault of the bus: above all that is simulated, and near to it."""

from typing import Final

import msgspec
import pytest
from sampling import every

from aftbed.ftm.compose import build
from aftbed.inject.bus import read_bus_fault
from aftbed.inject.model import parse
from aftbed.judge.bus_bound import _refused_behind, bus_bound_ms
from aftbed.judge.checks import Evidence
from aftbed.judge.intervals import intervals
from aftbed.judge.simulated import evidence_of_run
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.runtime.unix.options import CarRun
from aftbed.vehicle.can.e2e import P11, Receiver, Supervision

CYCLE_US: Final = 20_000
SUPERVISION: Final = Supervision(P11(0x123), CYCLE_US, 6 * CYCLE_US)
FRAME: Final = bytes(8)
LATE_US: Final = 2_000_000

ROWS: Final = [
    (f"{words} bus {message}{more}", message == "EGO_STATE" or not lasts)
    for message, other in (("RADAR_TRACK", "EGO_STATE"), ("EGO_STATE", "AEB_REQ"), ("AEB_REQ", "EGO_STATE"))
    for words, more, lasts in (
        ("omission", " nth 50", False),
        ("corrupt", " bit 21 nth 51", False),
        ("stuck-counter", " nth 52", False),
        ("masquerade", f" as {other} nth 53", False),
        ("duplicate", " nth 54 for 200ms", False),
        ("delay", " by 7ms nth 55", False),
        ("delay", " by 33ms nth 56", False),
        ("delay", f" by {21 if message != 'EGO_STATE' else 14}ms nth 60", False),
        ("omission", " nth 57 for 65ms", True),
        ("corrupt", " bit 21 nth 58 for 150ms", True),
        ("stuck-counter", " nth 59 for 70ms", True),
    )
]


@pytest.mark.simulation
@pytest.mark.parametrize(("words", "bounded"), every(4, ROWS))
def test_what_is_simulated_stays_below_the_bound_and_near_to_it(words: str, bounded: bool) -> None:
    (found,) = intervals(
        evidence_of_run(simulate(Setup("lfr+tr", scenario="ccrs-20", faults=(parse(words),))))
    )
    assert found.in_bus_time and found.fhti_ms is not None
    assert (found.bound_ms is not None) is bounded
    if found.bound_ms is not None:
        assert found.fhti_ms <= found.bound_ms
        assert found.fhti_ms >= 0.8 * found.bound_ms - 1.0, "a step of the plant"


@pytest.mark.parametrize("how", ["missing", "refused", "repeated"])
@pytest.mark.parametrize("struck", range(1, 25))
def test_so_many_sound_frames_are_refused_behind_those_that_were_struck(struck: int, how: str) -> None:
    """Asked of the supervision itself."""
    receiver, counter, t_us = Receiver(SUPERVISION), 0, 0

    def used(data: bytes) -> bool:
        return receiver.usable(receiver.check(data, t_us))

    for number in range(30 + struck + SUPERVISION.window_size):
        counter, t_us = number % 15, number * CYCLE_US
        sound = SUPERVISION.profile.protect(FRAME, counter)
        if not 20 <= number < 20 + struck:
            refused = number - 20 - struck
            if used(sound) and refused >= 0:
                break
        elif how == "refused":
            assert not used(bytes([sound[0] ^ 1, *sound[1:]]))
        elif how == "repeated":
            assert not used(SUPERVISION.profile.protect(FRAME, 19 % 15))
    bound = _refused_behind(struck, SUPERVISION)
    assert refused <= bound
    if how == "refused" and struck * CYCLE_US < SUPERVISION.timeout_us:  # behind that, the window is empty
        assert refused == bound, "it is not larger than it has to be"


@pytest.mark.parametrize(
    "words",
    [
        "omission bus RADAR_TRACK nth 50 for 50ms",  # the brakes may latch
        "omission bus AEB_REQ nth 50 for 50ms",
        "omission bus EGO_STATE permanent",
        "omission bus EGO_STATE nth 50 intermittent every 3",
        "reorder bus EGO_STATE nth 50 for 100ms",
        "delay bus EGO_STATE by 5ms nth 50 for 100ms",
        "corrupt bus EGO_STATE signal SPEED=3 crc good nth 50",  # believed
        "omission bus BRAKE_STATUS nth 50",  # no node evaluates it
        "omission bus from radar nth 50",
        "bus-off radar after 1s for 30ms",
        "partition brake|gateway after 1s for 30ms",
        "babbling radar after 1s for 30ms",
    ],
)
def test_other_faults_have_none(words: str) -> None:
    assert bus_bound_ms(read_bus_fault(words), LATE_US, build("pbr", "process"), simulated=True) is None


def test_a_supervision_that_has_not_settled_has_none() -> None:
    fault, graph = read_bus_fault("omission bus EGO_STATE nth 5"), build("pbr", "process")
    assert bus_bound_ms(fault, 99_000, graph, simulated=True) is None
    assert bus_bound_ms(fault, 100_000, graph, simulated=True) is not None


def test_a_reply_takes_no_bus_time_in_lockstep() -> None:
    fault = read_bus_fault("omission bus RADAR_TRACK nth 50")
    small, large = build("none", "process"), build("lfr+tr", "process")
    assert bus_bound_ms(fault, LATE_US, large, simulated=False) == 21.0
    simulated = [bus_bound_ms(fault, LATE_US, graph, simulated=True) or 0 for graph in (small, large)]
    assert 21.0 < simulated[0] < simulated[1]


@pytest.mark.parametrize(("pace", "bound_ms"), [(None, 11.0), (1.0, None)])
def test_only_a_drive_in_lockstep_has_a_bound(pace: float | None, bound_ms: float | None) -> None:
    fault = parse("omission bus EGO_STATE nth 50")
    told = evidence_of_run(simulate(Setup("none", scenario="ccrs-20", faults=(fault,))))
    options = msgspec.structs.replace(told.record.options, work=CarRun("ccrs-20", pace, "latch"))
    real = msgspec.structs.replace(told.record, options=options, excuses=None)
    (found,) = intervals(Evidence(real, told.reference))
    assert found.bound_ms == bound_ms
