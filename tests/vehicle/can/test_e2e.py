"""E2E profile 11: the CRC against an independent one, the states by table, the hole that time closes."""

import pytest
from e2e.crc import calculate_crc8
from hypothesis import given
from hypothesis import strategies as st

from aftbed.vehicle.can.e2e import P11, ChannelState, FrameStatus, Receiver, Supervision, intact, protect

ID = 0x1130
CYCLE_US = 20_000
WATCH = Supervision(P11(ID), CYCLE_US, 6 * CYCLE_US)


def crc8_j1850(data: bytes, start: int = 0xFF, end: int = 0xFF) -> int:
    """SAE J1850, bit by bit: the standard's polynomial 0x1D, most significant bit first."""
    crc = start
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ end


def frame(counter: int, payload: int = 0) -> bytes:
    return protect(bytes([0, payload & 0xF0, payload & 0xFF]) + bytes(5), ID, counter)


def test_check_value_of_the_standard() -> None:
    assert calculate_crc8(b"123456789") == crc8_j1850(b"123456789") == 0x4B


def test_vector_of_the_autosar_protocol_specification() -> None:
    assert protect(bytes(8), 0x123, 0).hex() == "cc00000000000000"


@given(st.binary(min_size=2, max_size=8), st.integers(0, 0xFFFF), st.integers(0, 14))
def test_the_crc_covers_data_id_and_all_bytes_but_its_own(data: bytes, data_id: int, counter: int) -> None:
    protected = protect(data, data_id, counter)
    covered = bytes([data_id & 0xFF, data_id >> 8]) + protected[1:]
    assert protected[0] == crc8_j1850(covered, start=0, end=0)
    assert protected[1] == data[1] & 0xF0 | counter
    assert protected[2:] == data[2:]
    assert intact(protected, data_id)


@given(st.integers(0, 14), st.integers(0, 63))
def test_any_one_bit_flipped_is_seen(counter: int, bit: int) -> None:
    damaged = bytearray(frame(counter, 0xA5))
    damaged[bit // 8] ^= 1 << bit % 8
    assert not intact(bytes(damaged), ID)


def test_counter_15_does_not_occur_whatever_its_crc() -> None:
    raw = bytes([0, 0x0F, 0, 0, 0, 0, 0, 0])
    crc = crc8_j1850(bytes([ID & 0xFF, ID >> 8]) + raw[1:], start=0, end=0)
    assert not intact(bytes([crc]) + raw[1:], ID)


def synchronised() -> Receiver:
    """A receiver that has seen counters 0 to 4 in time, and is VALID; the next frame is due at 100 ms."""
    receiver = Receiver(WATCH)
    for counter in range(5):
        receiver.check(frame(counter), counter * CYCLE_US)
    assert receiver.state is ChannelState.VALID
    return receiver


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (frame(5), FrameStatus.OK),
        (frame(6), FrameStatus.OK_SOMELOST),
        (frame(7), FrameStatus.OK_SOMELOST),
        (frame(8), FrameStatus.WRONGSEQUENCE),
        (frame(3), FrameStatus.WRONGSEQUENCE),
        (frame(4), FrameStatus.REPEATED),
        (protect(bytes(8), ID + 1, 5), FrameStatus.ERROR),  # masquerade: right, but another message's
        (frame(5)[:7], FrameStatus.ERROR),
        (frame(5) + b"\0", FrameStatus.ERROR),
        (protect(bytes(7), ID, 5), FrameStatus.ERROR),  # right, but of another length
        (b"", FrameStatus.ERROR),
    ],
)
def test_status_of_the_frame_after_counter_4(data: bytes, status: FrameStatus) -> None:
    assert synchronised().check(data, 5 * CYCLE_US) is status


def test_the_counter_goes_from_14_to_0() -> None:
    receiver = Receiver(WATCH)
    statuses = [receiver.check(frame(n % P11.counter_count), n * CYCLE_US) for n in range(40)]
    assert statuses == [FrameStatus.WRONGSEQUENCE] + [FrameStatus.OK] * 39


@pytest.mark.parametrize("lost", range(3, 40))
def test_no_loss_is_overlooked_however_the_counter_wraps(lost: int) -> None:
    """15 frames lost are one whole wrap: the counter says OK, so the timeout has to see it."""
    receiver = synchronised()
    gap_us = (lost + 1) * CYCLE_US
    status = receiver.check(frame((5 + lost) % P11.counter_count), 4 * CYCLE_US + gap_us)
    assert not receiver.usable(status)
    if gap_us > WATCH.timeout_us:
        assert (status, receiver.state) == (FrameStatus.WRONGSEQUENCE, ChannelState.INVALID)


def test_the_counter_alone_would_overlook_one_wrap() -> None:
    """The reason for the timeout, and proof that the test above can fail."""
    receiver = synchronised()
    assert receiver.check(frame((5 + 15) % P11.counter_count), 5 * CYCLE_US) is FrameStatus.OK


def test_after_a_silence_the_second_frame_is_believed_again() -> None:
    receiver = synchronised()
    late_us = 50 * CYCLE_US
    assert not receiver.usable(receiver.check(frame(9), late_us))
    assert receiver.usable(receiver.check(frame(10), late_us + CYCLE_US))


def test_the_timeout_has_its_edge_where_it_is_set() -> None:
    for beyond_us, expected in ((0, FrameStatus.OK), (1, FrameStatus.WRONGSEQUENCE)):
        receiver = synchronised()
        assert receiver.check(frame(5), 4 * CYCLE_US + WATCH.timeout_us + beyond_us) is expected


@pytest.mark.parametrize(
    ("story", "state"),
    [
        ("", ChannelState.NODATA),
        ("EEEE", ChannelState.NODATA),
        ("N", ChannelState.NODATA),
        ("F", ChannelState.INIT),
        ("FEE", ChannelState.INIT),
        ("FO", ChannelState.INIT),
        ("FOO", ChannelState.VALID),
        ("FEEE", ChannelState.INVALID),
        ("FOOEE", ChannelState.VALID),
        ("FOOEEE", ChannelState.INVALID),
        ("FOOEEEOO", ChannelState.INVALID),
        ("FOOEEEOOO", ChannelState.VALID),
        ("FOORRR", ChannelState.VALID),
        ("FOORRRR", ChannelState.INVALID),
        ("FOONNN", ChannelState.VALID),
        ("FOONNNN", ChannelState.INVALID),
        ("FOOFFFF", ChannelState.INVALID),
    ],
)
def test_window_state_machine(story: str, state: ChannelState) -> None:
    """Window of 5, at least 2 good, at most 2 errors; the timeout is out of the way.

    A letter is a cycle: Error, Far counter, Ok, Repeated, No new data.
    """
    receiver = Receiver(Supervision(P11(ID), CYCLE_US, 14 * CYCLE_US, window_size=5, ok_min=2, errors_max=2))
    counter = 0
    for number, letter in enumerate(story):
        now_us = (number + 1) * CYCLE_US
        if letter == "N":
            assert receiver.poll(now_us) is FrameStatus.NONEWDATA
            continue
        counter += {"E": 0, "F": 7, "O": 1, "R": 0}[letter]
        receiver.check(bytes(8) if letter == "E" else frame(counter % P11.counter_count), now_us)
    assert receiver.state is state


def test_poll_counts_each_missed_cycle_once() -> None:
    receiver = synchronised()
    last_us = 4 * CYCLE_US
    assert receiver.poll(last_us + CYCLE_US - 1) is None
    assert receiver.poll(last_us + CYCLE_US) is FrameStatus.NONEWDATA
    assert receiver.poll(last_us + CYCLE_US + 1) is None
    assert receiver.poll(last_us + 4 * CYCLE_US) is FrameStatus.NONEWDATA
    assert _state_after_poll(receiver, last_us + 4 * CYCLE_US) is ChannelState.VALID
    assert _state_after_poll(receiver, last_us + 5 * CYCLE_US) is ChannelState.INVALID


def _state_after_poll(receiver: Receiver, now_us: int) -> ChannelState:
    receiver.poll(now_us)
    return receiver.state


def test_poll_sees_the_timeout_without_a_frame() -> None:
    receiver = synchronised()
    assert not receiver.timed_out(4 * CYCLE_US + WATCH.timeout_us)
    receiver.poll(4 * CYCLE_US + WATCH.timeout_us + 1)
    assert receiver.timed_out(4 * CYCLE_US + WATCH.timeout_us + 1)
    assert receiver.state is ChannelState.INVALID


@given(st.lists(st.tuples(st.binary(max_size=10), st.integers(0, 10**6)), max_size=30))
def test_noise_is_an_error_unless_it_is_whole_by_chance(noise: list[tuple[bytes, int]]) -> None:
    """Random bytes pass an 8-bit CRC once in 256 times; whatever comes, nothing is raised."""
    receiver = Receiver(WATCH)
    now_us = 0
    for data, gap_us in noise:
        now_us += gap_us
        status = receiver.check(data, now_us)
        assert (status is FrameStatus.ERROR) == (len(data) != 8 or not intact(data, ID))


def test_supervision_refuses_a_timeout_in_which_the_counter_can_wrap() -> None:
    with pytest.raises(AssertionError):
        Supervision(P11(ID), CYCLE_US, 15 * CYCLE_US)
