"""The load of the bus: what is counted, over which windows, and what a log of a stranger does to it."""

from collections.abc import Iterable

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.vehicle.can.bus_load import BusLoad, bus_load, load_percent, logged_frame
from aftbed.vehicle.can.bus_model import frame_bits, unstuffed_bits
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame


def lines(frames: Iterable[tuple[int, int]]) -> list[bytes]:
    """Of frames with these times in microseconds and bytes of data."""
    return [log_line(Frame(t_us, 0x130, bytes(length)), "can0").encode() for t_us, length in frames]


def test_bits_are_those_of_the_standard() -> None:
    """ISO 11898-1: 108 bits for 8 bytes and 3 of intermission; Davis et al. 2007: at most 24 stuff bits."""
    assert (unstuffed_bits(8), frame_bits(8)) == (111, 135)
    assert (unstuffed_bits(0), frame_bits(0)) == (47, 55)
    bits = can.BitTiming.from_sample_point(f_clock=8_000_000, bitrate=500_000, sample_point=80.0).bitrate
    assert frame_bits(8) / bits == pytest.approx(270e-6)


def test_a_steady_bus_has_the_same_load_in_each_window() -> None:
    """Ten frames of 8 bytes in 100 ms at 500 kbit/s: 1350 of 50 000 bits."""
    found = bus_load(lines((5_000_000 + 10_000 * n, 8) for n in range(101)), 500_000)
    assert found == BusLoad(500_000, 10, 2.7, 2.7, 2.22, 2.22)
    assert bus_load(lines((10_000 * n, 8) for n in range(101)), 250_000) == BusLoad(
        250_000, 10, 5.4, 5.4, 4.44, 4.44
    )


def test_a_burst_is_the_greatest_load_and_empty_windows_count() -> None:
    burst = [(250_000, 8)] * 1000
    found = bus_load(lines([(0, 0), *burst, (1_000_000, 0)]), 500_000)
    assert found is not None
    assert (found.windows, found.p50_percent, found.max_percent) == (10, 0.0, 270.0)


def test_of_two_windows_the_lower_one_is_the_median() -> None:
    found = bus_load(lines([(0, 8), (0, 8), (100_000, 8), (200_000, 0)]), 500_000)
    assert found is not None
    assert (found.windows, found.p50_percent, found.max_percent) == (2, 0.27, 0.54)


def test_a_window_that_has_only_begun_does_not_count() -> None:
    found = bus_load(lines([(0, 8), *[(100_000, 8)] * 1000]), 500_000)
    assert found == BusLoad(500_000, 1, 0.27, 0.27, 0.22, 0.22)


@pytest.mark.parametrize("times", [[], [7], [0, 99_999]])
def test_a_log_shorter_than_a_window_has_no_load(times: list[int]) -> None:
    assert bus_load(lines((t_us, 8) for t_us in times), 500_000) is None


def test_the_load_of_a_stretch_of_time() -> None:
    assert load_percent([(50_000, 8)] * 10, 0, 100_000, 500_000) == pytest.approx(2.7)
    assert load_percent([], 100_000, 100_000, 500_000) == 0.0


@given(st.integers(0, 2**33), st.integers(0, 0x7FF), st.binary(max_size=8))
def test_each_line_of_a_hub_is_read(t_us: int, can_id: int, data: bytes) -> None:
    assert logged_frame(log_line(Frame(t_us, can_id, data), "can0").encode()) == (t_us, len(data))


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.builds(
                lambda t, rest: b"(%010d.%06d) can0 130#" % (t // 10**6, t % 10**6) + rest,
                st.integers(0, 10**16 - 1),
                st.sampled_from([b"\n", b"00\n", b"00", b"0\n", b"00" * 9 + b"\n", b"R\n", b"\xff\n"]),
            ),
        )
    )
)
def test_a_log_of_a_stranger_gives_a_load_or_none(log: list[bytes]) -> None:
    """Times that jump by centuries or back cost nothing, and no load is below 0."""
    found = bus_load(log, 500_000)
    assert found is None or (found.windows > 0 and 0 <= found.p50_percent <= found.max_percent)
