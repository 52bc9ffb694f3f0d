"""Radars of other makes, by the shipped maps, in made-up drives: it brakes where it must, else never."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from random import Random

import msgspec
import pytest
from buslog import read_log
from hypothesis import given
from hypothesis import strategies as st
from puredrive import CODEC
from radarlogs import EGO_MS, FAR, RADARS, STANDING, Car, ars408, codec, drive, write
from sampling import sampled

from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import (
    STAGE_FULL,
    AebInput,
    AebOutput,
    AebTarget,
    decode_reply,
    decode_request,
)
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import bind, find_dbc, find_map
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

pytestmark = pytest.mark.simulation

APPROACH = (STANDING, *FAR)


def gateway_of(radar: str) -> MappedGateway:
    return MappedGateway(CODEC, bind(find_map(radar), find_dbc(radar)))


def cycles(gateway: MappedGateway, frames: Sequence[Frame]) -> list[AebInput]:
    """The requests that the frames make."""
    return [decode_request(made) for frame in frames if (made := gateway.on_frame(frame)) is not None]


def decisions(gateway: MappedGateway, frames: Sequence[Frame]) -> list[tuple[float, AebOutput]]:
    """When, in seconds, the function decided what."""
    function = AebFunction()
    found = ((frame.t_us / 1e6, gateway.on_frame(frame)) for frame in frames)
    return [(t_s, decode_reply(function.execute(made))) for t_s, made in found if made is not None]


@pytest.mark.parametrize("radar", RADARS)
def test_it_brakes_for_a_standing_car_and_not_too_early(radar: str) -> None:
    gateway = gateway_of(radar)
    found = decisions(gateway, drive(radar, APPROACH, 4.0))
    assert gateway.counts.refused == {}
    assert gateway.counts.ignored == 0
    braking_s = next(t_s for t_s, output in found if output.deceleration_ms2 > 0.0)
    full_s = next(t_s for t_s, output in found if output.stage == STAGE_FULL)
    contact_s = STANDING.ahead_m / EGO_MS
    assert 1.2 < contact_s - full_s < contact_s - braking_s < 2.0


@pytest.mark.parametrize("radar", RADARS)
def test_traffic_that_is_far_or_beside_our_path_is_never_braked_for(radar: str) -> None:
    found = decisions(gateway_of(radar), drive(radar, FAR, 14.0))
    assert len(found) > 180
    assert {output.stage for _, output in found} == {0}


@pytest.mark.parametrize(("radar", "beside_m"), sampled(tuple(RADARS), (0.0, 1.3, -1.3, 2.0, -2.0)))
def test_the_side_on_which_something_stands_makes_no_difference(radar: str, beside_m: float) -> None:
    found = decisions(gateway_of(radar), drive(radar, (Car(60.0, 0.0, beside_m),), 4.0))
    assert any(output.deceleration_ms2 > 0.0 for _, output in found) is (abs(beside_m) < 1.5)


@pytest.mark.parametrize("radar", RADARS)
def test_it_brakes_although_every_tenth_frame_is_lost(radar: str) -> None:
    chance = Random(3)
    frames = [frame for frame in drive(radar, APPROACH, 4.2) if chance.random() > 0.1]
    assert any(output.stage == STAGE_FULL for _, output in decisions(gateway_of(radar), frames))
    frames = [frame for frame in drive(radar, FAR, 14.0) if chance.random() > 0.1]
    assert {output.stage for _, output in decisions(gateway_of(radar), frames)} == {0}


# -- 64 tracks in polar coordinates --------------------------------------------------------------


def test_polar_tracks_are_where_they_are() -> None:
    cars = (Car(40.0, EGO_MS - 5.0, 1.0), Car(40.0, EGO_MS, 3.0))
    first = cycles(gateway_of("esr-like"), drive("esr-like", cars, 0.05))[0]
    assert first.ego_speed_ms == pytest.approx(EGO_MS, abs=0.04)
    (target,) = first.targets
    assert target.new
    assert target.range_m == pytest.approx(40.0, abs=0.1)
    assert target.rel_speed_ms == pytest.approx(-5.0, abs=0.02)


def test_the_status_marks_what_is_valid_and_what_is_new() -> None:
    names = codec("esr-like").signal_names("ESR_Track01")
    base = dict.fromkeys(names, 0.0) | {"CAN_TX_TRACK_RANGE": 50.0}
    gateway = gateway_of("esr-like")
    found: dict[int, tuple[bool, ...]] = {}
    for status in range(8):
        data = codec("esr-like").encode("ESR_Track01", base | {"CAN_TX_TRACK_STATUS": status})
        end = codec("esr-like").encode("ESR_Track64", dict.fromkeys(names, 0.0))
        times = (8000 * status, 8000 * status + 10)
        frames = [Frame(times[0], 0x500, data), Frame(times[1], 0x53F, end)]
        found[status] = tuple(target.new for target in cycles(gateway, frames)[0].targets)
    new, known = (True,), (False,)
    assert found == {0: (), 1: new, 2: known, 3: known, 4: known, 5: known, 6: (), 7: known}


# -- objects that are announced ------------------------------------------------------------------

AT = {"Obj_VrelLat": 0, "Obj_DynProp": 0, "Obj_RCS": 0, "Obj_DistLat": 0.0}


def status(t_us: int, count: int) -> Frame:
    """An announcement; its counter is its time."""
    signals = {"Obj_NofObjects": count, "Obj_MeasCounter": t_us % 65536, "Obj_InterfaceVersion": 1}
    return Frame(t_us, 0x60A, codec("ars408-like").encode("Obj_0_Status", signals))


def thing(t_us: int, number: int, range_m: float = 50.0, speed_ms: float = -5.0) -> Frame:
    signals = AT | {"Obj_ID": number, "Obj_DistLong": range_m, "Obj_VrelLong": speed_ms}
    return Frame(t_us, 0x60B, codec("ars408-like").encode("Obj_1_General", signals))


def made(gateway: MappedGateway, *frames: Frame) -> list[tuple[int, tuple[float, ...] | None]]:
    """Which of the frames made a request, by number, and with what ranges; None if the radar is unknown."""
    found = []
    for number, frame in enumerate(frames):
        request = gateway.on_frame(frame)
        if request is not None:
            cycle = decode_request(request)
            ranges = tuple(round(target.range_m, 1) for target in cycle.targets)
            found.append((number, ranges if cycle.radar_valid else None))
    return found


def test_the_last_announced_object_ends_the_cycle() -> None:
    frames = (status(0, 2), thing(1, 9, 40.0), thing(2, 3, 60.0))
    assert made(gateway_of("ars408-like"), *frames) == [(2, (40.0, 60.0))]


def test_an_empty_cycle_ends_at_once_and_is_known_to_be_empty() -> None:
    assert made(gateway_of("ars408-like"), status(0, 0), status(75_000, 0)) == [(0, ()), (1, ())]


def test_a_cycle_that_lacks_an_object_ends_with_the_next_announcement() -> None:
    frames = (status(0, 2), thing(1, 9, 40.0), status(75_000, 1), thing(75_001, 9, 39.6))
    assert made(gateway_of("ars408-like"), *frames) == [(2, (40.0,)), (3, (39.6,))]


def test_a_cycle_that_lacks_all_objects_is_unknown_and_not_empty() -> None:
    frames = (status(0, 2), status(75_000, 1), thing(75_001, 9))
    assert made(gateway_of("ars408-like"), *frames) == [(1, None), (2, (50.0,))]


def test_an_object_that_comes_twice_stands_for_no_other() -> None:
    frames = (status(0, 2), thing(1, 9), thing(2, 9, 49.0), thing(3, 4, 60.0))
    assert made(gateway_of("ars408-like"), *frames) == [(3, (49.0, 60.0))]


def test_what_comes_without_an_announcement_makes_no_request() -> None:
    gateway = gateway_of("ars408-like")
    assert made(gateway, thing(0, 1), thing(1, 2)) == []
    assert made(gateway, status(10, 1), thing(11, 5), thing(12, 6)) == [(1, (50.0,))]
    assert made(gateway, status(20, 1), thing(21, 7, 60.0)) == [(1, (60.0,))]


def test_an_announcement_that_is_repeated_is_refused() -> None:
    gateway = gateway_of("ars408-like")
    again = msgspec.structs.replace(status(0, 2), t_us=5)
    assert made(gateway, status(0, 2), thing(1, 9), again, thing(6, 8)) == [(3, (50.0, 50.0))]
    assert gateway.counts.refused == {"repeated": 1}


def test_objects_keep_their_slots_and_the_nearest_sixteen_have_one() -> None:
    gateway = gateway_of("ars408-like")
    far = [thing(number, 200 - number, 20.0 + 2 * number) for number in range(1, 31)]
    (first,) = cycles(gateway, [status(0, 30), *far])
    assert len(first.targets) == 16
    assert max(target.range_m for target in first.targets) == pytest.approx(52.0)
    assert all(target.new for target in first.targets)
    later = [Frame(75_000 + frame.t_us, frame.can_id, frame.data) for frame in reversed(far)]
    second = cycles(gateway, [status(75_000, 30), *reversed(later)])
    assert second[0].targets == tuple(
        AebTarget(target.slot, target.range_m, target.rel_speed_ms) for target in first.targets
    )


# -- whatever comes ------------------------------------------------------------------------------

IDS = {"ars408-like": (0x300, 0x60A, 0x60B, 0x60C), "esr-like": (0x4F0, 0x500, 0x520, 0x53F, 0x540)}


@cache
def shared(radar: str) -> tuple[MappedGateway, AebFunction]:
    """One for all examples: a DBC takes a while to load, and whatever came before is nothing to rely on."""
    return gateway_of(radar), AebFunction()


@pytest.mark.parametrize("radar", RADARS)
@given(data=st.data())
def test_any_frames_are_accepted_or_refused_and_what_they_make_is_a_request(
    radar: str, data: st.DataObject
) -> None:
    (gateway, function), seen = shared(radar), 0
    before = _counted(gateway)
    frame = st.tuples(st.integers(-500, 60_000), st.sampled_from(IDS[radar]), st.binary(max_size=8))
    for step_us, can_id, content in data.draw(st.lists(frame, max_size=40)):
        request = gateway.on_frame(Frame(max(0, gateway._t_us + step_us), can_id, content))
        seen += 1
        if request is not None:
            decode_reply(function.execute(request))
    assert _counted(gateway) - before == seen


def _counted(gateway: MappedGateway) -> int:
    counts = gateway.counts
    return counts.accepted + counts.ignored + sum(counts.refused.values())


@pytest.mark.parametrize("radar", RADARS)
def test_damaged_drives_are_counted_frame_by_frame(radar: str) -> None:
    """Any bit of any frame, and shortened frames: without a checksum much is believed, but all is counted."""
    chance, gateway, function = Random(11), gateway_of(radar), AebFunction()
    frames = drive(radar, APPROACH, 3.0)
    for frame in frames:
        content = bytearray(frame.data)
        if chance.random() < 0.3:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        if chance.random() < 0.05:
            del content[chance.randrange(len(content)) :]
        request = gateway.on_frame(Frame(frame.t_us, frame.can_id, bytes(content)))
        if request is not None:
            function.execute(request)
    assert gateway.counts.accepted + sum(gateway.counts.refused.values()) == len(frames)
    assert gateway.counts.refused["length"] > 0


# -- real processes ------------------------------------------------------------------------------


@pytest.mark.process
@pytest.mark.parametrize(("radar", "braked"), sampled(tuple(RADARS), (True, False)))
def test_a_replay_by_the_mechanism_brakes_or_does_not(radar: str, braked: bool, tmp_path: Path) -> None:
    log = write(tmp_path / "drive.log", drive(radar, APPROACH if braked else FAR, 3.2))
    command = ["run", "--replay", str(log), "--dbc", radar, "--map", radar, "--pace", "max", "--json"]
    with tempfile.TemporaryDirectory(prefix="aft-", dir="/tmp") as home:  # a socket's path may be 108 bytes
        done = subprocess.run(
            [sys.executable, "-m", "aftbed", *command],
            env=os.environ | {"XDG_RUNTIME_DIR": home},
            capture_output=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    found = msgspec.json.decode(done.stdout)
    played, counted = found["replay"]["played"], found["replay"]["gateway"]
    assert counted["refused"] == {}
    assert counted["accepted"] == played["sent"] == len(read_log(log)[0])
    assert found["requests"]["sent"] == found["requests"]["answered"] == played["cycles"] > 40
    assert (played["stage_max"] == STAGE_FULL) is braked
    assert (played["deceleration_ms2_max"] > 0.0) is braked


def test_the_made_up_logs_are_logs(tmp_path: Path) -> None:
    frames = drive("ars408-like", APPROACH, 1.0)
    assert [entry.frame for entry in read_log(write(tmp_path / "drive.log", frames))[0]] == list(frames)
    assert len(list(ars408(0, 0, APPROACH))) < len(frames)
