"""The load of a classic CAN bus: the share of its time in which frames are on the wire, in percent.

A log has the frames but not their stuff bits, which depend on their CRCs, too. So there are two figures: with
as many stuff bits as a frame of its length can have at worst, and with none; the load lies between them
(`frame_bits`). It is measured over windows of `WINDOW_US` of bus time, from the first frame on. More than
100 % is more than a bus of this bitrate carries: the hub gives a frame no time on the wire.
"""

from collections.abc import Iterable
from typing import Final

import msgspec

from aftbed.vehicle.can.bus_model import frame_bits, unstuffed_bits
from aftbed.vehicle.can.frame import DATA_LENGTH_MAX

WINDOW_US: Final = 100_000
BITRATE_BPS: Final = 500_000  # of most buses in cars between ECUs
BITRATE_BPS_MIN, BITRATE_BPS_MAX = 10_000, 1_000_000

_WORST: Final = tuple(map(frame_bits, range(DATA_LENGTH_MAX + 1)))
_LEAST: Final = tuple(map(unstuffed_bits, range(DATA_LENGTH_MAX + 1)))


class BusLoad(msgspec.Struct, frozen=True):
    """Median and greatest load over all windows, with stuffing at its worst; `unstuffed_...` without any."""

    bitrate_bps: int
    windows: int
    p50_percent: float
    max_percent: float
    unstuffed_p50_percent: float
    unstuffed_max_percent: float


def logged_frame(line: bytes) -> tuple[int, int] | None:
    """Microseconds of bus time and bytes of data of a whole line of the hub's log; None of any other line."""
    try:
        t_us, length = int(line[1:11] + line[12:18]), len(line) - line.index(b"#") - 2 >> 1
    except ValueError:
        return None
    return (t_us, length) if 0 <= length <= DATA_LENGTH_MAX and line.endswith(b"\n") else None


def bus_load(lines: Iterable[bytes], bitrate_bps: int) -> BusLoad | None:
    """Of the lines of a hub's log, each with its newline; None of one that is shorter than a window."""
    worst: dict[int, int] = {}  # bits, by the number of the window; those without a frame are not in it
    least: dict[int, int] = {}
    first_us: int | None = None
    last_us = 0
    for found in map(logged_frame, lines):
        if found is None:
            continue
        t_us, length = found
        if first_us is None:
            first_us = last_us = t_us
        if t_us < last_us:  # no line of a hub
            continue
        last_us = t_us
        window = (t_us - first_us) // WINDOW_US
        worst[window] = worst.get(window, 0) + _WORST[length]
        least[window] = least.get(window, 0) + _LEAST[length]
    windows = (last_us - (first_us or 0)) // WINDOW_US  # whole ones
    if not windows:
        return None
    worst.pop(windows, None)
    least.pop(windows, None)
    most_bits = bitrate_bps * WINDOW_US / 1e6
    figures = [
        round(100 * bits / most_bits, 2) for by in (worst, least) for bits in _median_and_max(by, windows)
    ]
    return BusLoad(bitrate_bps, windows, *figures)


def load_percent(frames: Iterable[tuple[int, int]], since_us: int, until_us: int, bitrate_bps: int) -> float:
    """With stuffing at its worst, of the frames of that time; 0 if it is none."""
    bits = sum(_WORST[length] for _, length in frames)
    return 100 * bits * 1e6 / (bitrate_bps * (until_us - since_us)) if until_us > since_us else 0.0


def _median_and_max(bits: dict[int, int], windows: int) -> tuple[int, int]:
    filled = sorted(bits.values())
    place = (windows - 1) // 2 - (windows - len(filled))  # among the filled ones, which come behind the empty
    return (filled[place] if place >= 0 else 0), max(filled, default=0)
