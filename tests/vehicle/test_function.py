"""The protected function: what it refuses, what its state is, and when it brakes."""

import math
from collections import Counter
from collections.abc import Iterator
from random import Random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError
from aftbed.core.fault import flipped
from aftbed.vehicle.aebmessages import (
    SLOTS,
    STAGE_FULL,
    STAGE_NONE,
    STAGE_PARTIAL,
    STAGE_WARN,
    AebInput,
    AebOutput,
    AebTarget,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)
from aftbed.vehicle.function import (
    BLIND_MS,
    DEMAND_MS2,
    STATE_BYTES,
    AebFunction,
    default_application,
    sample_requests,
)
from aftbed.vehicle.threat import required_deceleration_ms2
from aftbed.vehicle.tracker import HITS_CONFIRMED, MISSES_MAX, Track

EGO_MS = 14.0
NEAR = AebTarget(3, 14.0, -EGO_MS)  # a standing car, one second ahead

targets = st.builds(
    AebTarget,
    st.integers(0, SLOTS - 1),
    st.floats(0, 200),
    st.floats(-60, 60),
    st.booleans(),
)
cycles = st.builds(
    AebInput,
    st.integers(0, 100_000),
    st.floats(0, 70),
    st.booleans(),
    st.booleans(),
    st.lists(targets, max_size=SLOTS, unique_by=lambda target: target.slot).map(tuple),
)


def ask(
    function: AebFunction, t_ms: int, *seen: AebTarget, ego: bool = True, radar: bool = True
) -> AebOutput:
    cycle = AebInput(t_ms, EGO_MS, ego, radar, seen)
    return decode_reply(function.execute(encode_request(cycle)))


def braking() -> tuple[AebFunction, int]:
    """A function in full braking, and the time of its last request."""
    function = AebFunction()
    for t_ms in range(0, 1000, 20):
        if ask(function, t_ms, NEAR).stage == STAGE_FULL:
            return function, t_ms
    raise AssertionError("never in full braking")


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
def test_random_bytes_are_no_reply_or_a_sound_one(data: bytes) -> None:
    try:
        output = decode_reply(data)
    except PeerError:
        return
    assert 0 <= output.counter < 15


# -- state


def test_the_state_has_one_size_in_the_range_that_was_asked_for() -> None:
    assert 200 <= STATE_BYTES <= 600
    assert len(AebFunction().capture()) == len(braking()[0].capture()) == STATE_BYTES


@given(st.lists(cycles, max_size=12), st.lists(cycles, max_size=4))
@settings(max_examples=60)
def test_a_restored_function_goes_on_bit_for_bit(before: list[AebInput], after: list[AebInput]) -> None:
    first, second = AebFunction(), AebFunction()
    for cycle in before:
        first.execute(encode_request(cycle))
    second.restore(first.capture())
    assert second.capture() == first.capture()
    for cycle in after:
        assert first.execute(encode_request(cycle)) == second.execute(encode_request(cycle))
        assert first.capture() == second.capture()


def test_a_captured_state_is_a_copy() -> None:
    function, t_ms = braking()
    state = function.capture()
    kept = bytes(state)
    ask(function, t_ms + 20)
    assert state == kept != function.capture()


@pytest.mark.parametrize(
    ("offset", "byte", "reason"),
    [
        (0, 2, "state of version 2, expected 1"),
        (1, 15, "counter 15"),
        (2, 4, "stage 4"),
        (3, 2, "started 2"),
        (11, 0x80, "ego speed -"),
        (19, 0x80, "time -"),
        (23, 0xFF, "timers"),
    ],
)
def test_a_state_that_no_execution_leaves_is_refused(offset: int, byte: int, reason: str) -> None:
    function, _ = braking()
    before = function.capture()
    damaged = bytearray(before)
    damaged[offset] = byte
    with pytest.raises(PeerError, match=reason):
        function.restore(bytes(damaged))
    assert function.capture() == before


@pytest.mark.parametrize("length", [0, STATE_BYTES - 1, STATE_BYTES + 1])
def test_a_state_of_another_size_is_refused(length: int) -> None:
    with pytest.raises(PeerError, match=f"state of {length} bytes, expected {STATE_BYTES}"):
        AebFunction().restore(bytes(length))


@given(st.integers(0, STATE_BYTES * 8 - 1), cycles)
@settings(max_examples=200)
def test_a_flipped_bit_is_refused_or_gives_a_function_that_works(bit: int, cycle: AebInput) -> None:
    function, _ = braking()
    before = function.capture()
    damaged = bytearray(before)
    damaged[bit // 8] ^= 1 << bit % 8
    try:
        function.restore(bytes(damaged))
    except PeerError:
        assert function.capture() == before
        return
    assert function.capture() == bytes(damaged)
    decode_reply(function.execute(encode_request(cycle)))
    AebFunction().restore(function.capture())


@pytest.mark.parametrize("byte", [0x01, 0x80])  # 0x80 at the end of a double is -0.0
@pytest.mark.parametrize("offset", range(1, 26))
def test_a_free_slot_is_zero_to_the_bit(offset: int, byte: int) -> None:
    function, _ = braking()
    damaged = bytearray(function.capture())
    damaged[STATE_BYTES - 26 + offset] = byte
    with pytest.raises(PeerError, match=r"state with Track\(hits=0, .* in slot 15"):
        function.restore(bytes(damaged))


def test_a_state_does_not_tell_in_which_order_its_targets_came() -> None:
    near = [AebTarget(slot, 30.0 + slot, -EGO_MS) for slot in range(SLOTS)]
    functions = AebFunction(), AebFunction()
    for function, seen in zip(functions, (near, near[::-1]), strict=True):
        for n in range(4):
            ask(function, 20 * n, *seen)
    assert functions[0].capture() == functions[1].capture()
    assert functions[0].capture()[-26] == 4


def test_the_transmit_counter_is_state() -> None:
    function = AebFunction()
    counters = [ask(function, t_ms).counter for t_ms in range(0, 400, 20)]
    assert counters == [n % 15 for n in range(20)]
    other = AebFunction()
    other.restore(function.capture())
    assert ask(other, 400).counter == 5


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


# -- the executable assertion


def rough(seed: int, count: int) -> Iterator[AebInput]:
    """A sample drive with all that can come between: blindness, lost and strange targets, gaps in time."""
    random, late_ms = Random(seed), 0
    for request in sample_requests(seed, count):
        cycle = decode_request(request)
        if random.random() < 0.02:
            late_ms += random.choice((1, 200, 600))
        yield AebInput(
            cycle.t_ms + late_ms,
            cycle.ego_speed_ms * (random.random() > 0.01),
            random.random() > 0.05,
            random.random() > 0.05,
            tuple(strange(random, target) for target in cycle.targets if random.random() > 0.1),
        )


def strange(random: Random, target: AebTarget) -> AebTarget:
    """`target`, at times with a noise of up to beyond what a track takes for the same one."""
    size = random.choice((0.0, 0.0, 1.0, 5.0))
    return AebTarget(
        target.slot,
        max(0.0, target.range_m + random.uniform(-1.1, 1.1) * size),
        target.rel_speed_ms + random.uniform(-1.1, 1.1) * size,
        random.random() < 0.02,
    )


@given(st.integers(0, 2**32))
@settings(max_examples=3 * settings.default.max_examples)
def test_every_reply_of_the_function_is_acceptable_in_a_rough_drive(seed: int) -> None:
    function = AebFunction()
    for cycle in rough(seed, 300):
        request = encode_request(cycle)
        assert function.acceptable(request, function.execute(request))


@given(st.lists(cycles, max_size=12), st.booleans())
def test_every_reply_of_the_function_is_acceptable_whatever_is_asked(
    asked: list[AebInput], in_order: bool
) -> None:
    function = AebFunction()
    for n, cycle in enumerate(asked):
        at = msgspec.structs.replace(cycle, t_ms=20 * n) if in_order else cycle
        request = encode_request(at)
        assert function.acceptable(request, function.execute(request))


def test_a_rough_drive_shows_every_stage_and_coasting_threats() -> None:
    """The tests above are worth as much as what happens in them."""
    seen: Counter[str] = Counter()
    for seed in range(10):
        function = AebFunction()
        for cycle in rough(seed, 300):
            output = decode_reply(function.execute(encode_request(cycle)))
            measured = cycle.ego_valid and cycle.radar_valid
            seen[f"stage {output.stage}"] += 1
            seen["no ttc"] += output.slot is not None and output.ttc_s is None
            seen["blind"] += output.slot is not None and not measured
            slots = {target.slot for target in cycle.targets}
            seen["coasting"] += measured and output.slot is not None and output.slot not in slots
    wanted = {"stage 0", "stage 1", "stage 2", "stage 3", "no ttc", "blind", "coasting"}
    assert {what for what, count in seen.items() if count > 5} >= wanted, seen


def test_flipped_bits_are_noticed_as_often_as_is_said_and_always_in_the_demand() -> None:
    noticed = {threat: Counter[bool]() for threat in (False, True)}
    for seed in range(5):
        function = AebFunction()
        for request in sample_requests(seed, 1500)[::7]:
            reply = function.execute(request)
            output = decode_reply(reply)
            for bit in range(8 * len(reply)):
                found = not function.acceptable(request, flipped(reply, bit))
                noticed[output.slot is not None][found] += 1
                if not found:
                    changed = decode_reply(flipped(reply, bit))
                    assert changed.deceleration_ms2 == output.deceleration_ms2
    shares = {threat: round(100 * n[True] / n.total()) for threat, n in noticed.items()}
    said = AebFunction.acceptable.__doc__
    assert said is not None and f"{shares[False]} % flipped where there is no threat" in said, shares
    assert f"{shares[True]} % where" in said, shares


NEARING = AebInput(1000, EGO_MS, True, True, (AebTarget(3, 28.0, -EGO_MS),))  # 2 s ahead


def answering(**fields: object) -> bytes:
    """A sound reply to NEARING, with some fields replaced."""
    sound = AebOutput(STAGE_PARTIAL, DEMAND_MS2[STAGE_PARTIAL], 2.0, 3, 7)
    return encode_reply(msgspec.structs.replace(sound, **fields))


@pytest.mark.parametrize(
    ("reply", "acceptable"),
    [
        (answering(), True),
        (answering(counter=8), True),
        (answering(stage=STAGE_WARN, deceleration_ms2=0.0), True),
        (answering(slot=4, ttc_s=0.1), True),  # a track that is coasting
        (answering(slot=None, ttc_s=None), True),  # the stage is held
        (b"", False),
        (answering() + b"\0", False),
        (answering(stage=4), False),
        (answering(stage=STAGE_FULL), False),
        (answering(deceleration_ms2=9.0), False),
        (answering(deceleration_ms2=-0.0, stage=STAGE_WARN), False),
        (answering(stage=STAGE_NONE, deceleration_ms2=0.0), False),  # at 2 s, with a stage of NONE
        (answering(slot=None), False),
        (answering(ttc_s=None), False),  # it closes at 14 m/s
        (answering(ttc_s=(28.0 - 2.5) / (14.0 + 3.5) + 0.001), True),
        (answering(ttc_s=(28.0 - 2.5) / (14.0 + 3.5) - 0.001), False),
        (answering(ttc_s=(28.0 + 2.5) / (14.0 - 3.5) - 0.001), True),
        (answering(ttc_s=(28.0 + 2.5) / (14.0 - 3.5) + 0.001), False),
    ],
)
def test_what_is_acceptable(reply: bytes, acceptable: bool) -> None:
    assert AebFunction().acceptable(encode_request(NEARING), reply) == acceptable


@pytest.mark.parametrize(
    ("fields", "reply", "acceptable"),
    [
        (
            {"radar_valid": False},
            answering(stage=STAGE_NONE, deceleration_ms2=0.0),
            True,
        ),  # it decides nothing
        ({"ego_valid": False}, answering(ttc_s=9.0), True),
        ({"ego_speed_ms": 0.0}, answering(stage=STAGE_NONE, deceleration_ms2=0.0), True),
        ({"targets": (AebTarget(3, 28.0, -EGO_MS, True),)}, answering(), False),  # not confirmed by now
        ({"targets": (AebTarget(3, 28.0, 3.4),)}, answering(ttc_s=999.0), True),
        ({"targets": (AebTarget(3, 28.0, 3.6),)}, answering(ttc_s=999.0), False),  # it moves away
        ({"targets": (AebTarget(3, 28.0, 3.6),)}, answering(ttc_s=None), True),
        ({"t_ms": -1}, answering(), False),  # such a request has one answer
        ({"t_ms": -1}, b"", True),
    ],
)
def test_what_is_acceptable_depends_on_the_request(
    fields: dict[str, object], reply: bytes, acceptable: bool
) -> None:
    request = encode_request(msgspec.structs.replace(NEARING, **fields))
    assert AebFunction().acceptable(request, reply) == acceptable


def test_to_judge_a_reply_changes_nothing() -> None:
    function, _ = braking()
    before = function.capture()
    assert function.acceptable(encode_request(NEARING), answering())
    assert not function.acceptable(encode_request(NEARING), answering(stage=4))
    assert function.capture() == before


def test_the_function_is_deterministic_and_opens_its_state() -> None:
    assert AebFunction.characteristics == Characteristics(deterministic=True, state_access=True)


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
