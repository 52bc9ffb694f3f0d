"""A value fault as a value: which bits are hit, and how often; and what no fault can be."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from somefaults import faults, patterns

from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import (
    BIT_MAX,
    ONCE,
    Bit,
    BitBurst,
    BitPattern,
    Bits,
    Byte,
    Chance,
    Every,
    Permanent,
    Persistence,
    StuckBit,
    Transient,
    Trigger,
    bits_to_flip,
    gap,
    with_flipped,
)
from aftbed.inject.model import Fault
from aftbed.inject.receipts import fault_and_bits, record_detail
from aftbed.inject.slow import Slow
from aftbed.inject.value import ValueFlip, ValuePlace


@pytest.mark.parametrize(
    ("fault", "event"),
    [
        (Fault(ValueFlip(ValuePlace.RESULT), "primary", Trigger()), "server.exit"),
        (Fault(ValueFlip(ValuePlace.STATE), "primary", Trigger("state.captured", 2)), "state.captured"),
        (Fault(ValueFlip(ValuePlace.RESULT), "primary", Trigger(after_ms=5)), "server.exit"),
        (Fault(Crash(), "primary", Trigger()), ""),
        (Fault(Crash(), "primary", Trigger("reply.sent")), "reply.sent"),
        (Fault(ChannelFault(Disturbance.DELAY, "aft2aft"), "primary", Trigger(nth=3)), ""),
    ],
)
def test_a_bitflip_waits_for_an_execution_at_least(fault: Fault, event: str) -> None:
    assert fault.event == event


@pytest.mark.parametrize(
    ("action", "trigger", "persistence", "message"),
    [
        (Crash(), Trigger(), Permanent(), "a crash strikes once"),
        (Slow(), Trigger(), Every(3), "a slow strikes once"),
        (
            ChannelFault(Disturbance.DELAY, "aft2aft"),
            Trigger("reply.sent"),
            ONCE,
            "waits for no event: reply.sent",
        ),
    ],
)
def test_a_mixture_of_two_faults_is_none(
    action: Crash | Slow | ChannelFault, trigger: Trigger, persistence: Persistence, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Fault(action, "primary", trigger, persistence)
    parts = {"action": action, "target": "primary", "trigger": trigger, "persistence": persistence}
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.msgpack.decode(msgspec.msgpack.encode(parts), type=Fault)


@given(faults)
def test_a_fault_travels_as_it_is(fault: Fault) -> None:
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(fault), type=Fault) == fault


def test_bits_count_from_bit_0_of_byte_0() -> None:
    assert with_flipped(b"\x00\x00", [0]) == b"\x01\x00"
    assert with_flipped(b"\x00\x00", [7]) == b"\x80\x00"
    assert with_flipped(b"\x00\x00", [8]) == b"\x00\x01"
    assert with_flipped(b"\xff\xff", [15]) == b"\xff\x7f"


@given(st.binary(min_size=1, max_size=40), st.data())
def test_a_flip_changes_one_bit_and_a_second_one_undoes_it(data: bytes, more: st.DataObject) -> None:
    bit = more.draw(st.integers(0, 8 * len(data) - 1))
    other = with_flipped(data, [bit])
    assert int.from_bytes(data, "little") ^ int.from_bytes(other, "little") == 1 << bit
    assert len(other) == len(data) and with_flipped(other, [bit]) == data


@pytest.mark.parametrize("bit", [16, -1])
def test_a_bit_that_is_not_there_is_our_mistake(bit: int) -> None:
    with pytest.raises(AssertionError):
        with_flipped(b"\x00\x00", [bit])


@given(st.integers(0, 2**32 - 1), st.integers(0, BIT_MAX))
def test_a_mark_keeps_both_its_numbers(number: int, bits: int) -> None:
    assert fault_and_bits(record_detail(number, bits)) == (number, bits)
    assert 0 <= record_detail(number, bits) < 2**64


# -- which bits


@given(patterns, st.binary(max_size=80), st.integers(0, 2**63 - 1))
def test_a_pattern_and_a_draw_tell_the_bits(pattern: BitPattern, data: bytes, draw: int) -> None:
    found = bits_to_flip(pattern, data, draw)
    assert bits_to_flip(pattern, data, draw) == found
    if found is None:
        return
    assert list(found) == sorted(set(found)) and all(0 <= bit < 8 * len(data) for bit in found)
    other = with_flipped(data, found)
    match pattern:
        case Bit(at):
            assert len(found) == 1 and at in (None, *found)
        case Bits(count):
            assert len(found) == count
        case Byte(at):
            places = [i for i, (a, b) in enumerate(zip(data, other, strict=True)) if a != b]
            assert len(places) == 1 and at in (None, *places)
        case BitBurst(count, at):
            assert found == tuple(range(found[0], found[0] + count)) and at in (None, found[0])
        case StuckBit(at, value):
            assert other[at // 8] >> at % 8 & 1 == value
            assert found == () or data != other


def test_a_byte_always_has_another_value_and_it_may_be_any() -> None:
    values = {
        with_flipped(b"\x00\x55", bits_to_flip(Byte(1), b"\x00\x55", draw) or ())[1] for draw in range(3000)
    }
    assert values == set(range(256)) - {0x55}


@pytest.mark.parametrize(
    ("pattern", "size"),
    [
        (Bit(16), 2),
        (Bit(), 0),
        (Bits(17), 2),
        (Byte(2), 2),
        (Byte(), 0),
        (BitBurst(17), 2),
        (BitBurst(2, 15), 2),
        (StuckBit(16, 1), 2),
    ],
)
def test_where_there_are_no_such_bits_none_are_hit(pattern: BitPattern, size: int) -> None:
    assert bits_to_flip(pattern, bytes(size), 7) is None


def test_a_bit_that_is_stuck_at_what_it_is_changes_nothing() -> None:
    assert bits_to_flip(StuckBit(1, 1), b"\x02", 0) == () and bits_to_flip(StuckBit(1, 0), b"\x02", 0) == (1,)


# -- how often


@pytest.mark.parametrize(("persistence", "gaps"), [(Transient(), 0), (Permanent(), 1), (Every(7), 7)])
def test_the_next_strike_is_so_far_away(persistence: Persistence, gaps: int) -> None:
    assert {gap(persistence, 5, struck) for struck in range(1, 9)} == {gaps}


@pytest.mark.parametrize("p", [1.0, 0.5, 0.1, 0.01])
def test_a_chance_strikes_so_often(p: float) -> None:
    """The mean of a geometric distribution is 1/p, its deviation less than that."""
    gaps = [gap(Chance(p), 5, struck) for struck in range(1, 4001)]
    assert min(gaps) == 1
    assert abs(sum(gaps) / len(gaps) * p - 1) < 5 / 4000**0.5
    assert p == 1.0 or gaps != [gap(Chance(p), 6, struck) for struck in range(1, 4001)]
