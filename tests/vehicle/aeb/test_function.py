"""The protected function: which requests it refuses, and when it brakes."""

import math

import msgspec
import pytest
from aebcycles import EGO_MS, NEAR, ask, braking, cycles
from hypothesis import example, given
from hypothesis import strategies as st

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.function import (
    BLIND_MS,
    HITS_CONFIRMED,
    MISSES_MAX,
    AebFunction,
    Track,
    default_application,
    required_deceleration_ms2,
    sample_requests,
)
from aftbed.vehicle.aeb.messages import (
    FIXED_REPLY,
    STAGE_FULL,
    STAGE_NONE,
    STAGE_PARTIAL,
    STAGE_WARN,
    AebInput,
    AebTarget,
    decode_reply,
    decode_request,
    encode_request,
)

# -- requests


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (b"", "not a radar cycle: Input data was truncated"),
        (b"\x93\x00", "not a radar cycle"),
        (encode_request(AebInput(0, 0.0, True, True, ())) + b"\0", "not a radar cycle: .*trailing"),
        (msgspec.msgpack.encode([0, 0.0, True, True, [], 9]), "not a radar cycle: .*at most length 5"),
        (msgspec.msgpack.encode({"t_ms": 0}), "not a radar cycle: Expected `array`, got `object`"),
        (msgspec.msgpack.encode([0, 0.0, 1, True, []]), "not a radar cycle: Expected `bool`, got `int`"),
        (bytes(1025), "request of 1025 bytes, allowed are 1024"),
        (encode_request(AebInput(-1, 0.0, True, True, ())), "t_ms -1, allowed is 0 to"),
        (encode_request(AebInput(0, -0.1, True, True, ())), "ego_speed_ms -0.1, allowed is 0 to 150"),
        (encode_request(AebInput(0, math.nan, True, True, ())), "ego_speed_ms nan"),
        (encode_request(AebInput(0, 1.0, True, True, (AebTarget(16, 1, 0),))), "slot 16, allowed is 0 to 15"),
        (encode_request(AebInput(0, 1.0, True, True, (NEAR, NEAR))), "slot 3, .*each once"),
        (encode_request(AebInput(0, 1.0, True, True, (AebTarget(0, -1, 0),))), "range_m -1.0"),
        (encode_request(AebInput(0, 1.0, True, True, (AebTarget(0, math.inf, 0),))), "range_m inf"),
        (encode_request(AebInput(0, 1.0, True, True, (AebTarget(0, 1, math.nan),))), "rel_speed_ms nan"),
    ],
)
def test_a_request_that_is_none_is_refused_and_changes_nothing(request_: bytes, reason: str) -> None:
    function, _ = braking()
    before = function.capture()
    with pytest.raises(PeerError, match=reason):
        function.execute(request_)
    assert function.capture() == before


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_are_a_request(data: bytes) -> None:
    function = AebFunction()
    before = function.capture()
    try:
        decode_reply(function.execute(data))
    except PeerError:
        assert function.capture() == before


@given(cycles, st.data())
def test_a_damaged_request_is_refused_or_is_a_request(cycle: AebInput, data: st.DataObject) -> None:
    damaged = bytearray(encode_request(cycle))
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    function = AebFunction()
    before = function.capture()
    try:
        decode_reply(function.execute(bytes(damaged)))
    except PeerError:
        assert function.capture() == before


@given(st.binary(max_size=80))
@example(bytes(FIXED_REPLY.size))
def test_random_bytes_are_no_reply_or_a_sound_one(data: bytes) -> None:
    try:
        output = decode_reply(data)
    except PeerError:
        return
    if len(data) == FIXED_REPLY.size:
        assert output.counter is None  # the gateway counts
    else:
        assert output.counter is not None and 0 <= output.counter < 15


# -- tracks


@pytest.mark.parametrize("hits", [HITS_CONFIRMED - 1, HITS_CONFIRMED])
def test_a_track_counts_from_its_third_hit(hits: int) -> None:
    function = AebFunction()
    outputs = [ask(function, 20 * n, NEAR) for n in range(hits)]
    assert (outputs[-1].stage > STAGE_NONE) == (hits == HITS_CONFIRMED)
    assert outputs[-1].slot == (3 if hits == HITS_CONFIRMED else None)


@pytest.mark.parametrize("misses", [MISSES_MAX, MISSES_MAX + 1])
def test_a_track_is_dropped_on_its_sixth_miss(misses: int) -> None:
    function = AebFunction()
    far = AebTarget(3, 100.0, -10.0)
    for n in range(5):
        ask(function, 20 * n, far)
    outputs = [ask(function, 100 + 20 * n) for n in range(misses)]
    assert (outputs[-1].slot is None) == (misses == MISSES_MAX + 1)


@pytest.mark.parametrize(
    "other", [AebTarget(3, 7.0, -14.0), AebTarget(3, 14.0, -7.0), msgspec.structs.replace(NEAR, new=True)]
)
def test_another_target_in_the_slot_starts_anew(other: AebTarget) -> None:
    function = AebFunction()
    for n in range(3):
        ask(function, 20 * n, AebTarget(3, 14.0, -14.0))
    assert ask(function, 60, other).slot is None


def test_a_track_follows_a_moving_target() -> None:
    track = Track(1, 0, 0.0, 0.0)
    for n in range(200):
        track.hit(AebTarget(0, 60.0 - 5.0 * 0.02 * n, -5.0), EGO_MS, 0.02)
    assert track.range_m == pytest.approx(60.0 - 5.0 * 0.02 * 199, abs=0.01)
    assert (track.speed_ms, track.acceleration_ms2) == pytest.approx((EGO_MS - 5.0, 0.0), abs=0.01)


def test_a_track_sees_a_car_brake_within_half_a_second() -> None:
    track = Track(1, 0, 0.0, 0.0)
    for n in range(50):
        braked_s = max(0.0, (n - 25) * 0.02)
        track.hit(AebTarget(0, 30.0 - 3.0 * braked_s**2, -6.0 * braked_s), EGO_MS, 0.02)
    assert track.acceleration_ms2 == pytest.approx(-6.0, abs=0.5)


# -- threat: (range, speed over ground, acceleration) at 20 m/s, with margin 1.5 m and 0.2 s of reaction


@pytest.mark.parametrize(
    ("track", "required_ms2"),
    [
        (Track(9, 0, 45.5, 0.0), 20.0**2 / (2 * 40.0)),  # stands
        (Track(9, 0, 23.5, 10.0), 10.0**2 / (2 * 20.0)),  # drives at 10
        (Track(9, 0, 23.5, 10.0, -0.9), 10.0**2 / (2 * 20.0)),  # slows, not counted as braking
        (Track(9, 0, 31.5, 20.0, -5.0), 20.0**2 / (2 * (30.0 + 40.0))),  # brakes, we stop after it
        (Track(9, 0, 3.5, 20.0, -5.0), 20.0**2 / (2 * (2.0 + 40.0))),
        (Track(9, 0, 5.5, 10.0, -1.0), 1.0 + 10.0**2 / (2 * 2.0)),  # brakes gently, we stop before it
        (Track(9, 0, 50.0, 20.0), 0.0),
        (Track(9, 0, 50.0, 25.0), 0.0),
        (Track(9, 0, 0.5, 0.0), 99.0),  # no room left: the most that is ever said
    ],
)
def test_required_deceleration(track: Track, required_ms2: float) -> None:
    assert required_deceleration_ms2(track, 20.0) == pytest.approx(required_ms2)


def test_of_equal_threats_the_lowest_slot_is_named() -> None:
    function = AebFunction()
    for n in range(3):
        output = ask(function, 20 * n, *(AebTarget(slot, 1.0, -EGO_MS) for slot in (5, 2, 9)))
    assert output.slot == 2


# -- stages


def test_an_obstacle_too_near_to_warn_of_is_braked_for_at_once() -> None:
    function = AebFunction()
    stages = [ask(function, 20 * n, AebTarget(0, 12.0, -EGO_MS)).stage for n in range(3)]
    assert stages == [STAGE_NONE, STAGE_NONE, STAGE_FULL]


def test_full_braking_waits_for_the_warning_where_there_is_time() -> None:
    """Ego at 14 m/s, a standing car with 14 m of room: 7 m/s2 are required at once, and go on to be."""
    function = AebFunction()
    outputs = [
        ask(function, 20 * n, AebTarget(0, 14.0 + 1.5 + 14.0 * 0.2, -EGO_MS, n == 0)) for n in range(3)
    ]
    assert outputs[-1].stage == STAGE_PARTIAL
    for n in range(3, 100):
        output = ask(function, 20 * n, AebTarget(0, 18.3 + 0.28, -EGO_MS))  # what the filter takes off
        if output.stage == STAGE_FULL:
            break
    assert 20 * (n - 2) == 800


def test_the_demand_belongs_to_the_stage() -> None:
    demands = {STAGE_NONE: 0.0, STAGE_WARN: 0.0, STAGE_PARTIAL: 4.0, STAGE_FULL: 9.0}
    function = AebFunction()
    seen = {}
    for n in range(200):
        output = ask(function, 20 * n, AebTarget(0, max(0.0, 56.0 - 0.28 * n), -EGO_MS))
        seen[output.stage] = output.deceleration_ms2
    assert seen == demands


def test_braking_outlives_a_lost_track_but_not_a_track_that_is_no_threat_any_more() -> None:
    for seen, held_ms in (((), 600), ((AebTarget(3, 30.0, 2.0),), 100)):
        function, t_ms = braking()
        stages = []
        for n in range(1, 60):
            stages.append(ask(function, t_ms + 20 * n, *seen).stage)
        released_ms = 20 * (stages.index(STAGE_NONE) + 1)
        assert held_ms < released_ms <= held_ms + 20 * (MISSES_MAX + HITS_CONFIRMED + 1)


def test_the_brakes_are_held_at_standstill_and_then_released() -> None:
    function, t_ms = braking()
    stages = []
    for n in range(1, 130):
        cycle = AebInput(t_ms + 20 * n, 0.0, True, True, (AebTarget(3, 3.0, 0.0),))
        stages.append(decode_reply(function.execute(encode_request(cycle))).stage)
    assert stages[:99] == [STAGE_FULL] * 99
    assert stages[-1] == STAGE_NONE


@pytest.mark.parametrize("blind", ["ego", "radar"])
def test_blindness_neither_starts_nor_ends_a_braking_before_its_time(blind: str) -> None:
    ego, radar = blind != "ego", blind != "radar"
    idle = AebFunction()
    assert all(ask(idle, 20 * n, NEAR, ego=ego, radar=radar).stage == STAGE_NONE for n in range(50))
    function, t_ms = braking()
    for n in range(1, BLIND_MS // 20 + 1):
        assert ask(function, t_ms + 20 * n, ego=ego, radar=radar).stage == STAGE_FULL
    assert ask(function, t_ms + BLIND_MS + 20, ego=ego, radar=radar).stage == STAGE_NONE


@pytest.mark.parametrize(("jump_ms", "kept"), [(-1, False), (0, True), (500, True), (501, False)])
def test_a_jump_in_time_starts_all_tracks_anew(jump_ms: int, kept: bool) -> None:
    function = AebFunction()
    for n in range(5):
        output = ask(function, 1000 + 20 * n, AebTarget(3, 60.0 - 0.2 * n, -10.0))
        assert (output.slot is None) == (n < HITS_CONFIRMED - 1)
    there = AebTarget(3, 59.2 - jump_ms / 100, -10.0)
    assert (ask(function, 1080 + jump_ms, there).slot is not None) == kept


def test_the_function_is_deterministic_and_opens_its_state() -> None:
    assert AebFunction.characteristics == Characteristics()


# -- samples


def test_samples_are_reproducible_valid_and_move_the_function_through_all_stages() -> None:
    requests = sample_requests(7, 3000)
    assert requests == sample_requests(7, 3000) != sample_requests(8, 3000)
    assert requests[:10] == sample_requests(7, 10)
    application = default_application()
    stages = [decode_reply(application.execute(request)).stage for request in requests]
    assert set(stages) == {STAGE_NONE, STAGE_WARN, STAGE_PARTIAL, STAGE_FULL}
    times_ms = [decode_request(request).t_ms for request in requests]
    assert times_ms == list(range(0, 60_000, 20))
