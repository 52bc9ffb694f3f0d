"""AUTOSAR E2E profiles 1, 2, 5 and 11: where CRC and counter stand, and how they are put in and checked.

After the E2E Protocol Specification (AUTOSAR PRS). The CRC is the `autosar-e2e` library's. A profile
protects one message by a CRC, a counter, and a data id that is in the CRC and, but for a nibble, not in
the frame: so a right frame of another message has a wrong CRC.

    profile  CRC                       counter              data id
    P01      8 bit, SAE J1850, 0x1D    low nibble, 0 to 14  16 bits; into the CRC go, by `mode`, `both` bytes,
                                                            the `low` one, one by turns (`alt`: low where the
                                                            counter is even), or the low one and a 0, with the
                                                            low `nibble` of the high byte sent in the frame
    P02      8 bit, H2F, 0x2F          low nibble, 0 to 15  sixteen bytes; the counter's goes into the CRC
    P05      16 bit, CCITT, 0x1021     a byte, 0 to 255     16 bits, both bytes
    P11      as P01                    low nibble, 0 to 14  as P01, `both` or `nibble`

The header (CRC, then the counter in the next byte) is at byte `offset` of the data; in P02 at the start.

Limits: P01 and P11 may, by the specification, have CRC and counter apart; the library has them side by
side, so we do. And in two profiles a flipped bit of the counter changes which byte of the data id is
meant as well: for one pair of bytes in 256 the two errors cancel out (`ambiguous`). In all others every
single flipped bit is found.
"""

from itertools import combinations
from typing import Final, Literal, assert_never

import msgspec
from e2e.p01 import (
    E2E_P01_DATAID_ALT,
    E2E_P01_DATAID_BOTH,
    E2E_P01_DATAID_LOW,
    E2E_P01_DATAID_NIBBLE,
    e2e_p01_check,
    e2e_p01_protect,
)
from e2e.p02 import e2e_p02_check, e2e_p02_protect
from e2e.p05 import e2e_p05_check, e2e_p05_protect
from e2e.p11 import E2E_P11_DATAID_BOTH, E2E_P11_DATAID_NIBBLE, e2e_p11_check, e2e_p11_protect

P01Mode = Literal["both", "alt", "low", "nibble"]
P11Mode = Literal["both", "nibble"]

DATA_ID_MAX: Final = 0xFFFF
NIBBLE_ID_MAX: Final = 0x0FFF  # the high nibble would be neither sent nor in the CRC
LIST_IDS: Final = 16  # of P02: one for each value of the counter
LIST_ID_MAX: Final = 0xFF

_P01_MODES: Final = {
    "both": E2E_P01_DATAID_BOTH,
    "alt": E2E_P01_DATAID_ALT,
    "low": E2E_P01_DATAID_LOW,
    "nibble": E2E_P01_DATAID_NIBBLE,
}
_P11_MODES: Final = {"both": E2E_P11_DATAID_BOTH, "nibble": E2E_P11_DATAID_NIBBLE}


class P01(msgspec.Struct, frozen=True):
    """Profile 1. `offset`, of the header, is in bytes."""

    data_id: int
    mode: P01Mode = "both"
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= (NIBBLE_ID_MAX if self.mode == "nibble" else DATA_ID_MAX)
        assert self.offset >= 0


class P02(msgspec.Struct, frozen=True):
    """Profile 2, with the list of sixteen data ids of a byte each."""

    data_ids: bytes

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert len(self.data_ids) == LIST_IDS


class P05(msgspec.Struct, frozen=True):
    """Profile 5. `offset`, of the header, is in bytes."""

    data_id: int
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= DATA_ID_MAX
        assert self.offset >= 0


class P11(msgspec.Struct, frozen=True):
    """Profile 11. `offset`, of the header, is in bytes."""

    data_id: int
    mode: P11Mode = "both"
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= (NIBBLE_ID_MAX if self.mode == "nibble" else DATA_ID_MAX)
        assert self.offset >= 0


Profile = P01 | P02 | P05 | P11


def counter_count(profile: Profile) -> int:
    """How many values the counter has, from 0: after so many frames it is as it was."""
    match profile:
        case P01() | P11():
            return 15  # 15 is never sent
        case P02():
            return 16
        case P05():
            return 256
        case _:
            assert_never(profile)


def counter_place(profile: Profile) -> int:
    """The byte of the data that has the counter: all of it in P05, else in its low nibble."""
    match profile:
        case P01() | P11():
            return profile.offset + 1
        case P02():
            return 1
        case P05():
            return profile.offset + 2
        case _:
            assert_never(profile)


def bytes_min(profile: Profile) -> int:
    """The least number of data bytes in which the header has its place: it ends with the counter."""
    return counter_place(profile) + 1


def counter_of(profile: Profile, data: bytes) -> int:
    """The counter in `data`, which is long enough; right or wrong."""
    byte = data[counter_place(profile)]
    return byte if isinstance(profile, P05) else byte & 0x0F


def with_e2e(profile: Profile, data: bytes, counter: int) -> bytes:
    """`data` with the header in its place; its other bits stay as they are."""
    assert 0 <= counter < counter_count(profile)
    assert len(data) >= bytes_min(profile)
    frame = bytearray(_with_counter(profile, data, counter))
    match profile:
        case P01(data_id, mode, at):
            e2e_p01_protect(frame, data_id, data_id_mode=_P01_MODES[mode], offset=at, increment_counter=False)
        case P02(data_ids):
            e2e_p02_protect(frame, data_ids, increment_counter=False)
        case P05(data_id, at):
            e2e_p05_protect(frame, data_id, offset=at, increment_counter=False)
        case P11(data_id, mode, at):
            e2e_p11_protect(frame, data_id, data_id_mode=_P11_MODES[mode], offset=at, increment_counter=False)
        case _:
            assert_never(profile)
    return bytes(frame)


def is_intact(profile: Profile, data: bytes) -> bool:
    """True if the CRC, the counter's value and a sent nibble are right; says nothing about the sequence."""
    if len(data) < bytes_min(profile):
        return False
    frame = bytearray(data)  # the library wants to be able to write, and does not
    match profile:
        case P01(data_id, mode, at):
            return e2e_p01_check(frame, data_id, data_id_mode=_P01_MODES[mode], offset=at)
        case P02(data_ids):
            return e2e_p02_check(frame, data_ids)
        case P05(data_id, at):
            return e2e_p05_check(frame, data_id, offset=at)
        case P11(data_id, mode, at):
            return e2e_p11_check(frame, data_id, data_id_mode=_P11_MODES[mode], offset=at)
        case _:
            assert_never(profile)


def ambiguous(profile: Profile, length: int) -> list[tuple[int, int]]:
    """Pairs of counters one bit apart that these data ids do not tell apart in frames of `length` bytes.

    A frame with one of a pair whose counter becomes the other on its way is still taken for whole. Its
    other bits are as they were sent, so what remains is that a frame seems lost or repeated. A CRC is
    linear, so what is true of one content is true of all. Only `alt` of P01 and P02 can have such pairs.
    """
    counters = range(counter_count(profile))
    frames = [with_e2e(profile, bytes(length), counter) for counter in counters]
    return [
        (one, other)
        for one, other in combinations(counters, 2)
        if (one ^ other).bit_count() == 1 and is_intact(profile, _with_counter(profile, frames[one], other))
    ]


def _with_counter(profile: Profile, data: bytes, counter: int) -> bytes:
    """`data` with another counter, and the CRC as it was."""
    place = counter_place(profile)
    byte = counter if isinstance(profile, P05) else (data[place] & 0xF0) | counter
    return data[:place] + bytes([byte]) + data[place + 1 :]
