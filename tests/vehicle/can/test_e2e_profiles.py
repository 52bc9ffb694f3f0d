"""The E2E profiles: published vectors, an independent CRC, every flipped bit, and what only time can see."""

from itertools import combinations

import pytest
from e2e.crc import calculate_crc8, calculate_crc8_h2f, calculate_crc16
from hypothesis import given
from hypothesis import strategies as st

from aftbed.vehicle.can.e2e import (
    P01,
    P02,
    P05,
    P11,
    FrameStatus,
    Profile,
    Receiver,
    Supervision,
)

CYCLE_US = 20_000
LIST = bytes([0x3C, 0x91, 0x07, 0xE2, 0x5D, 0xA8, 0x14, 0xFB, 0x66, 0xC9, 0x20, 0x8E, 0x73, 0xD5, 0x4A, 0xB1])
PROFILES: list[Profile] = [
    *(P01(0x123, mode, offset) for mode in ("both", "alt", "low", "nibble") for offset in (0, 6)),
    P02(LIST),
    P05(0x1234),
    P05(0x1234, offset=5),
    *(P11(0x123, mode, offset) for mode in ("both", "nibble") for offset in (0, 3)),
]
MARKED = [pytest.param(profile, id=repr(profile)) for profile in PROFILES]


def crc(data: bytes, polynomial: int, width: int, start: int, end: int) -> int:
    """Any CRC whose most significant bit comes first, bit by bit."""
    top, mask, found = 1 << (width - 1), (1 << width) - 1, start
    for byte in data:
        found ^= byte << (width - 8)
        for _ in range(8):
            found = ((found << 1) ^ polynomial) & mask if found & top else found << 1
    return found ^ end


def test_check_values_of_the_standards() -> None:
    """Of "123456789": what every description of a CRC gives to compare with."""
    nine = b"123456789"
    assert calculate_crc8(nine) == crc(nine, 0x1D, 8, 0xFF, 0xFF) == 0x4B
    assert calculate_crc8_h2f(nine) == crc(nine, 0x2F, 8, 0xFF, 0xFF) == 0xDF
    assert calculate_crc16(nine) == crc(nine, 0x1021, 16, 0xFFFF, 0) == 0x29B1


@pytest.mark.parametrize(
    ("profile", "length", "counter", "expected"),
    [
        # AUTOSAR PRS E2E R20-11, 6.3.5, "Profile 1 Protocol Examples": data id 0x123, header at byte 0.
        (P01(0x123, "both"), 8, 0, "cc00000000000000"),
        (P01(0x123, "both"), 8, 1, "9101000000000000"),
        (P01(0x123, "alt"), 8, 0, "ce00000000000000"),
        (P01(0x123, "alt"), 8, 1, "0201000000000000"),
        (P01(0x123, "low"), 8, 0, "ce00000000000000"),
        (P01(0x123, "low"), 8, 1, "9301000000000000"),
        (P01(0x123, "nibble"), 8, 0, "2a10000000000000"),
        (P01(0x123, "nibble"), 8, 1, "7711000000000000"),
        # In frames of eight bytes profile 11 is what P01 is: the data id is in the CRC in the same way.
        (P11(0x123, "both"), 8, 0, "cc00000000000000"),
        (P11(0x123, "both"), 8, 1, "9101000000000000"),
        (P11(0x123, "nibble"), 8, 0, "2a10000000000000"),
        (P11(0x123, "nibble"), 8, 1, "7711000000000000"),
        # PRS E2E R20-11, 6.6.5, tables 6.47 and 6.48: data id 0x1234, header at byte 0 and at byte 8.
        (P05(0x1234), 8, 0, "1cca000000000000"),
        (P05(0x1234, offset=8), 16, 0, "00000000000000002891000000000000"),
        # The library's own tests: the counter 1; and P02, with sixteen zeros for data ids.
        (P05(0x1234), 8, 1, "cf8d010000000000"),
        (P05(0x1234, offset=8), 16, 1, "0000000000000000fbd6010000000000"),
        (P02(bytes(16)), 8, 1, "4501000000000000"),
    ],
)
def test_published_vectors(profile: Profile, length: int, counter: int, expected: str) -> None:
    assert profile.protect(bytes(length), counter).hex() == expected
    assert profile.is_intact(bytes.fromhex(expected))


@pytest.mark.parametrize(("counter", "expected"), [(1, "6101020304050607"), (2, "bc02020304050607")])
def test_vectors_of_profile_2_with_a_list_of_its_own(counter: int, expected: str) -> None:
    """The library's tests: the data are 0 to 7, the data ids 0 to 15."""
    assert P02(bytes(range(16))).protect(bytes(range(8)), counter).hex() == expected


def expected_header(profile: Profile, frame: bytes) -> bytes:
    """The CRC of `frame` by the text of the specification, as bytes."""
    counter = profile.counter_of(frame)
    if isinstance(profile, P05):
        covered = frame[: profile.offset] + frame[profile.offset + 2 :]
        covered += profile.data_id.to_bytes(2, "little")
        return crc(covered, 0x1021, 16, 0xFFFF, 0).to_bytes(2, "little")
    if isinstance(profile, P02):
        return bytes([crc(frame[1:] + profile.data_ids[counter : counter + 1], 0x2F, 8, 0xFF, 0xFF)])
    low, high = profile.data_id & 0xFF, profile.data_id >> 8
    ids = {"both": [low, high], "low": [low], "nibble": [low, 0], "alt": [high if counter % 2 else low]}
    covered = bytes(ids[profile.mode]) + frame[: profile.offset] + frame[profile.offset + 1 :]
    return bytes([crc(covered, 0x1D, 8, 0, 0)])


@pytest.mark.parametrize("profile", MARKED)
@given(data=st.binary(min_size=8, max_size=8), chosen=st.integers(0, 255))
def test_a_frame_is_what_the_specification_says(profile: Profile, data: bytes, chosen: int) -> None:
    counter = chosen % profile.counter_count
    frame = profile.protect(data, counter)
    start = 0 if isinstance(profile, P02) else profile.offset
    header = expected_header(profile, frame)
    assert frame[start : start + len(header)] == header
    assert profile.is_intact(frame)
    assert profile.counter_of(frame) == counter
    assert frame[:start] == data[:start]
    assert frame[profile.bytes_min :] == data[profile.bytes_min :]
    if getattr(profile, "mode", "") == "nibble":
        assert frame[start + 1] == 0x10 | counter
    elif not isinstance(profile, P05):
        assert frame[start + 1] == data[start + 1] & 0xF0 | counter


@pytest.mark.parametrize("profile", MARKED)
def test_every_single_flipped_bit_is_found(profile: Profile) -> None:
    """All 64 bits, with all counters, in frames of two contents: a CRC is linear, more add nothing."""
    for payload in (bytes(8), bytes.fromhex("a53c0ff0c3695a96")):
        for counter in range(profile.counter_count):
            frame = profile.protect(payload, counter)
            for bit in range(64):
                damaged = bytearray(frame)
                damaged[bit // 8] ^= 1 << bit % 8
                assert not profile.is_intact(bytes(damaged)), (counter, bit)


def ambiguous(profile: Profile, length: int) -> list[tuple[int, int]]:
    """Pairs of counters one bit apart that these data ids do not tell apart in frames of `length` bytes.

    A frame with one of a pair whose counter becomes the other on its way is still taken for intact. A CRC is
    linear, so what is true of one content is true of all. Only `alt` of P01 and P02 can have such pairs.
    """
    found = []
    for one, other in combinations(range(profile.counter_count), 2):
        if (one ^ other).bit_count() == 1:
            frame = bytearray(profile.protect(bytes(length), one))
            frame[profile.counter_place] ^= one ^ other
            if profile.is_intact(bytes(frame)):
                found.append((one, other))
    return found


@pytest.mark.parametrize("profile", MARKED)
def test_no_data_ids_here_are_ambiguous(profile: Profile) -> None:
    assert ambiguous(profile, 8) == []


def test_of_data_ids_that_alternate_one_pair_in_256_hides_a_flip_of_the_counter() -> None:
    weak = [high for high in range(256) if ambiguous(P01(high << 8, "alt"), 8)]
    assert weak == [0x83]
    assert (0, 1) in ambiguous(P01(0x8300, "alt"), 8)
    assert all(ambiguous(P01(0x8300, mode), 8) == [] for mode in ("both", "low"))


def test_a_list_of_data_ids_can_hide_a_flip_of_the_counter_too() -> None:
    weak = {ids: ambiguous(P02(bytes([0, ids, *range(100, 114)])), 8) for ids in range(256)}
    hidden = [ids for ids, pairs in weak.items() if (0, 1) in pairs]
    assert len(hidden) == 1
    frame = bytearray(P02(bytes([0, hidden[0], *range(100, 114)])).protect(bytes(8), 0))
    frame[1] ^= 1
    assert P02(bytes([0, hidden[0], *range(100, 114)])).is_intact(bytes(frame))


@pytest.mark.parametrize(
    ("own", "other"),
    [
        (P01(0x123), P01(0x124)),
        (P01(0x123), P01(0x223)),
        (P01(0x123, "nibble"), P01(0x223, "nibble")),
        (P02(LIST), P02(LIST[::-1])),
        (P05(0x1234), P05(0x1235)),
        (P11(0x123), P11(0x124)),
        (P11(0x123, "nibble"), P11(0x223, "nibble")),
        (P01(0x123), P05(0x123)),
        (P01(0x123), P02(LIST)),
    ],
)
def test_a_frame_of_another_message_is_found(own: Profile, other: Profile) -> None:
    for counter in range(15):
        assert not own.is_intact(other.protect(bytes(range(8)), counter))


@pytest.mark.parametrize("profile", [P01(0x123), P11(0x123), P01(0x123, "nibble")])
def test_counter_15_does_not_occur_whatever_its_crc(profile: P01 | P11) -> None:
    frame = bytearray(profile.protect(bytes(8), 0))
    frame[1] |= 0x0F
    frame[:1] = expected_header(profile, bytes(frame))
    assert not profile.is_intact(bytes(frame))


@pytest.mark.parametrize("profile", MARKED)
def test_a_frame_too_short_for_its_header_is_an_error_and_no_more(profile: Profile) -> None:
    for length in range(profile.bytes_min):
        assert not profile.is_intact(bytes(length))


@pytest.mark.parametrize("profile", MARKED)
@given(data=st.binary(max_size=12))
def test_whatever_comes_is_judged(profile: Profile, data: bytes) -> None:
    assert profile.is_intact(data) in (True, False)


# -- what the counter cannot see -----------------------------------------------------------------


def after_a_loss(profile: Profile, lost: int, gap_us: int) -> tuple[Receiver, FrameStatus]:
    """A receiver in sequence that misses `lost` frames, and what it says of the next, `gap_us` later."""
    cycles = min(6, profile.counter_count - 1)
    receiver = Receiver(Supervision(profile, CYCLE_US, cycles * CYCLE_US))
    for number in range(5):
        receiver.check(profile.protect(bytes(8), number), number * CYCLE_US)
    following = profile.protect(bytes(8), (5 + lost) % profile.counter_count)
    return receiver, receiver.check(following, 4 * CYCLE_US + gap_us)


ALIASED = [(P01(0x123), 15), (P11(0x123), 15), (P02(LIST), 16), (P05(0x1234), 256)]


@pytest.mark.parametrize(("profile", "lost"), ALIASED)
def test_the_loss_of_a_whole_turn_of_the_counter_is_seen_by_the_timeout_alone(
    profile: Profile, lost: int
) -> None:
    receiver, status = after_a_loss(profile, lost, CYCLE_US)  # had no time passed
    assert (status, receiver.usable(status)) == (FrameStatus.OK, True)  # then the counter is content
    receiver, status = after_a_loss(profile, lost, (lost + 1) * CYCLE_US)
    assert (status, receiver.usable(status)) == (FrameStatus.WRONGSEQUENCE, False)


@pytest.mark.parametrize(("profile", "wrap"), ALIASED)
def test_the_loss_of_one_frame_less_or_more_is_seen_by_the_counter(profile: Profile, wrap: int) -> None:
    for lost, expected in ((wrap - 1, FrameStatus.REPEATED), (wrap + 1, FrameStatus.OK_SOMELOST)):
        assert after_a_loss(profile, lost, CYCLE_US)[1] is expected


@pytest.mark.parametrize(("profile", "wrap"), ALIASED)
def test_a_timeout_in_which_the_counter_can_turn_is_refused(profile: Profile, wrap: int) -> None:
    Supervision(profile, CYCLE_US, wrap * CYCLE_US - 1)
    with pytest.raises(AssertionError):
        Supervision(profile, CYCLE_US, wrap * CYCLE_US)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (P05(7).protect(bytes(8), 5), None),
        (P05(7).protect(bytes(7), 5), "length"),
        (P05(8).protect(bytes(8), 5), "checksum"),
        (P05(7).protect(bytes(8), 4), "repeated"),
        (P05(7).protect(bytes(8), 9), "sequence"),
    ],
)
def test_why_a_frame_is_refused(data: bytes, reason: str | None) -> None:
    receiver = Receiver(Supervision(P05(7), CYCLE_US, 6 * CYCLE_US))
    for number in range(5):
        receiver.check(P05(7).protect(bytes(8), number), number * CYCLE_US)
    assert receiver.refusal(data, receiver.check(data, 5 * CYCLE_US)) == reason
