"""Faults of the radar in a driving car, over real sockets and in virtual time; what they do to the drive."""

from functools import cache
from pathlib import Path

import pytest
from disturbed import Disturbed, real, virtual
from puredrive import CODEC
from sampling import every

TRACK = CODEC.can_id("RADAR_TRACK")
FIRST = {"sequence": 2}  # what every gateway refuses: the first frame of each of its two

ALIKE = [
    "radar ghost range 30 speed 10 after 1s for 200ms",
    "radar ghost range 60 speed 20 when gap < 50",
    "radar missed intermittent p 0.3",
    "radar bias by -4 when ttc < 3 for 1s",
    "radar drift by 3 after 500ms",
    "radar latency by 137ms after 1003ms",
    "radar fov range 25 angle 30",
]


@cache
def drive(*radar: str) -> Disturbed:
    return virtual(radar=radar)


def gap_m(found: Disturbed) -> float:
    assert found.result.stop_gap_m is not None
    return found.result.stop_gap_m


@pytest.mark.process
@pytest.mark.parametrize("words", every(3, ALIKE))
def test_a_real_bus_in_lockstep_and_virtual_time_are_alike(words: str, tmp_path: Path) -> None:
    """Each frame to the last bit, the car, and the receipt."""
    over_hub, in_virtual_time = real(tmp_path / "bus.log", radar=(words,)), drive(words)
    for can_id in sorted(over_hub.ids | in_virtual_time.ids):
        assert over_hub.of(can_id) == in_virtual_time.of(can_id), hex(can_id)
    assert over_hub.result == in_virtual_time.result
    assert over_hub.radar == in_virtual_time.radar
    assert over_hub.radar[0].receipt.state.value == "activated"


@pytest.mark.simulation
@pytest.mark.parametrize("words", ALIKE)
def test_no_receiver_can_notice(words: str) -> None:
    """The frames are right: the E2E checks of the gateway refuse no more than without a fault."""
    found = drive(words)
    assert found.refused == FIRST
    assert found.radar[0].receipt.state.value == "activated"
    assert found.of(TRACK) != drive().of(TRACK)


def test_how_often_the_car_is_advanced_makes_no_difference() -> None:
    words = "radar ghost range 60 speed 20 when gap < 50"
    assert virtual(radar=(words,), tick_ns=1_000_000) == drive(words)


def test_a_fault_that_never_begins_leaves_every_frame_as_it_was() -> None:
    found, sound = drive("radar missed after 1000s"), drive()
    assert (found.frames, found.result) == (sound.frames, sound.result)
    assert found.radar[0].receipt.state.value == "armed"


@pytest.mark.simulation
def test_a_car_that_is_missed_is_hit() -> None:
    assert drive("radar missed when ttc < 2").result.collision
    assert drive("radar fov range 5").result.collision
    assert not drive("radar missed for 500ms").result.collision


@pytest.mark.simulation
@pytest.mark.parametrize(
    "rising",
    [
        ("radar bias by 1", "radar bias by 3"),
        ("radar latency by 200ms", "radar latency by 300ms", "radar latency by 500ms"),
        ("radar drift by 0.5", "radar drift by 1"),
    ],
)
def test_the_more_a_target_seems_too_far_the_nearer_the_car_stops(rising: tuple[str, ...]) -> None:
    gaps = [gap_m(drive()), *(gap_m(drive(words)) for words in rising)]
    assert gaps == sorted(gaps, reverse=True) and gaps[0] > gaps[-1] + 1.0, gaps


def test_a_range_that_is_too_short_has_it_stop_earlier() -> None:
    assert gap_m(drive("radar bias by -3")) > gap_m(drive()) + 1.0


def test_a_ghost_is_a_track_of_its_own_that_begins_anew() -> None:
    tracks = [CODEC.decode("RADAR_TRACK", f.data) for f in drive(ALIKE[0]).of(TRACK)]
    ids = [int(track["TRACK_ID"]) for track in tracks]
    assert [n for n, track_id in enumerate(ids) if track_id == 1] == list(range(50, 60))
    assert [n for n, track in enumerate(tracks) if track["NEW_TRACK"]] == [0, 50, 60]
    assert abs(tracks[50]["RANGE"] - 30.0) < 0.11 and abs(tracks[59]["RANGE"] - 28.2) < 0.11
