"""Which bits of some bytes a fault changes.

A pattern applies to any number of bytes. What it leaves open (which bit, which value) follows from the
*draw*, a number that the seed of the run gives to each fault. So pattern, bytes and draw determine the
bits, and a lasting fault hits the same place each time, as a broken cell does.

A stuck bit has a value: where the bit already has that value, nothing changes.
"""

import re
from collections.abc import Iterable
from typing import Final, assert_never

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.inject.grammar import BYTE, FaultWords, whole

BIT_MAX: Final = 2**32 - 1  # the largest state has 2**29 bits
BITS_MAX: Final = 64  # at a time: each has its record
BYTE_BITS: Final = 8
WORD: Final = 2**64
PATTERN_KEYS: Final = ("bits", BYTE, "burst", "stuck", "bit")  # `bit` also says where a burst begins
_STUCK: Final = re.compile(r"([0-9]{1,12})=([01])")


class Bit(msgspec.Struct, frozen=True, tag="bit"):
    """Bit `at`, counted from bit 0 of byte 0, is inverted; None: it is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "" if self.at is None else f"bit {self.at}"


class Bits(msgspec.Struct, frozen=True, tag="bits"):
    """`count` different bits, all drawn, are inverted."""

    count: int

    def __str__(self) -> str:
        return f"bits {self.count}"


class Byte(msgspec.Struct, frozen=True, tag="byte"):
    """Byte `at`, or a drawn one, gets another value, which is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "byte" if self.at is None else f"byte {self.at}"


class BitBurst(msgspec.Struct, frozen=True, tag="burst"):
    """`count` neighbouring bits are inverted, from bit `at` on, or from a drawn one."""

    count: int
    at: int | None = None

    def __str__(self) -> str:
        return f"burst {self.count}" + ("" if self.at is None else f" bit {self.at}")


class StuckBit(msgspec.Struct, frozen=True, tag="stuck"):
    """Bit `at` has `value`, 0 or 1, whatever it should be."""

    at: int
    value: int

    def __str__(self) -> str:
        return f"stuck {self.at}={self.value}"


BitPattern = Bit | Bits | Byte | BitBurst | StuckBit


def read_pattern(words: FaultWords) -> BitPattern:
    """The pattern in `words`. Raises ConfigError where two patterns are mixed."""
    named = [key for key in PATTERN_KEYS if key in words]
    if len(named) > 1 and named != ["burst", "bit"]:
        one, other = (f"{key} {words[key]}".strip() for key in named[:2])
        raise ConfigError(f"{one!r} and {other!r}: one of them is allowed")
    at = whole("bit", words["bit"], 0, BIT_MAX) if "bit" in words else None
    if "bits" in words:
        return Bits(whole("bits", words["bits"], 1, BITS_MAX))
    if BYTE in words:
        return Byte(whole("byte", words[BYTE], 0, BIT_MAX // 8) if words[BYTE] else None)
    if "burst" in words:
        return BitBurst(whole("burst", words["burst"], 1, BITS_MAX), at)
    if "stuck" in words:
        stuck = _STUCK.fullmatch(words["stuck"])
        if stuck is None or int(stuck[1]) > BIT_MAX:
            raise ConfigError(f"stuck {words['stuck'][:40]!r}: a bit and its value are allowed, as 60=1")
        return StuckBit(int(stuck[1]), int(stuck[2]))
    return Bit(at)


def check_pattern(pattern: BitPattern) -> None:
    """Raise ConfigError where a number is out of its range: a pattern need not come from words."""
    match pattern:
        case Bit(at) | BitBurst(_, at) if at is not None and not 0 <= at <= BIT_MAX:
            raise ConfigError(f"bit {at}: 0 to {BIT_MAX} are allowed")
        case Byte(at) if at is not None and not 0 <= at <= BIT_MAX // 8:
            raise ConfigError(f"byte {at}: 0 to {BIT_MAX // 8} are allowed")
        case Bits(count) | BitBurst(count, _) if not 1 <= count <= BITS_MAX:
            raise ConfigError(f"{count} bits: 1 to {BITS_MAX} are allowed")
        case StuckBit(at, value) if not 0 <= at <= BIT_MAX or value not in (0, 1):
            raise ConfigError(f"stuck {at}={value}: a bit from 0 to {BIT_MAX}, and 0 or 1, are allowed")
        case _:
            return


def bits_to_flip(pattern: BitPattern, data: bytes, draw: int) -> tuple[int, ...] | None:
    """The bits of `data` that change, in ascending order; None if `data` has no such bits.

    `()` where a bit is stuck at the value that it has.
    """
    size = 8 * len(data)
    match pattern:
        case Bit(at):
            bits: Iterable[int] = (draw % max(1, size) if at is None else at,)
        case Bits(count):
            bits = _different(count, size, draw)
        case Byte(at):
            byte = draw % max(1, len(data)) if at is None else at
            change = 1 + drawn(draw, 0) % 255
            bits = [8 * byte + bit for bit in range(8) if change >> bit & 1]
        case BitBurst(count, at):
            first = draw % max(1, size - count + 1) if at is None else at
            bits = range(first, first + count)
        case StuckBit(at, value):
            if at < size and data[at // 8] >> at % 8 & 1 == value:
                return ()
            bits = (at,)
        case _:
            assert_never(pattern)
    found = tuple(sorted(bits))
    return found if found and found[-1] < size else None


def _different(count: int, size: int, draw: int) -> list[int]:
    """`count` different numbers below `size`; none if there are not so many."""
    if count > size:
        return []
    found: dict[int, None] = {}
    for index in range(WORD):
        if len(found) == count:
            break
        found[drawn(draw, index) % size] = None
    return list(found)


def with_flipped(data: bytes, bits: Iterable[int]) -> bytes:
    """`data` with these bits inverted; `data` has them."""
    out = bytearray(data)
    for bit in bits:
        assert 0 <= bit < 8 * len(data), f"bit {bit} of {len(data)} bytes"
        out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


def bit_names(bits: Iterable[int]) -> str:
    """`bit 3`, or `bits 3, 17`."""
    found = list(bits)
    return f"bit{'s' * (len(found) > 1)} {', '.join(map(str, found))}"


def drawn(draw: int, index: int) -> int:
    """Number `index` of the sequence that `draw` begins: 64 bits (SplitMix64; Steele, Lea, Flood 2014)."""
    mixed = (draw + (index + 1) * 0x9E3779B97F4A7C15) % WORD
    mixed = (mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9 % WORD
    mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EB % WORD
    return mixed ^ mixed >> 31
