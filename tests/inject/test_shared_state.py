"""A function in a cell: what others change there is what it goes on with, or refuses, and says so."""

import re
import struct
from collections.abc import Callable
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.application import Application, Characteristics, Field, Width, field_named, fields_of
from aftbed.core.errors import ConfigError, PeerError
from aftbed.ftm.compose import build
from aftbed.inject.grammar import Bit, BitBurst, BitPattern, Bits, Byte, StuckBit, with_flipped
from aftbed.inject.model import parse
from aftbed.inject.shared_state import SHARED_BYTES, SharedFunction, differing_bits, field_with_bits
from aftbed.inject.targets import Roles
from aftbed.vehicle.aeb.function import STATE_BYTES, AebFunction, sample_requests
from aftbed.vehicle.aeb.messages import decode_reply, decode_request
from aftbed.vehicle.aeb.variants import Cautious, NonDeterministic, WithoutStateAccess

REQUESTS: Final = sample_requests(3, 40)
FORMATS: Final[dict[Width, str]] = {"u8": "<B", "u32": "<I", "i64": "<q", "u64": "<Q", "f64": "<d"}
bits = st.integers(0, 8 * STATE_BYTES - 1)


class Kept:
    """A function in a cell, and what it was found to have taken over or refused."""

    def __init__(self) -> None:
        self.memory = memoryview(bytearray(SHARED_BYTES))
        self.found: list[tuple[list[int], PeerError | None]] = []
        self.application = SharedFunction(
            AebFunction(), self.memory, lambda b, error: self.found.append((b, error))
        )

    def flip(self, bit: int) -> None:
        self.memory[bit // 8] ^= 1 << bit % 8


def served(count: int) -> tuple[AebFunction, Kept]:
    """The bare function and one in a cell, after the same requests."""
    bare, kept = AebFunction(), Kept()
    for request in REQUESTS[:count]:
        assert bare.execute(request) == kept.application.execute(request)
    return bare, kept


def value(field: Field, state: bytes) -> float:
    found: float = struct.unpack_from(FORMATS[field.kind], state, field.offset_bytes)[0]
    return found


# -- what the function declares -------------------------------------------------------------------


def test_the_fields_are_the_state_but_for_its_version() -> None:
    taken = [
        byte
        for field in fields_of(AebFunction)
        for byte in range(field.offset_bytes, field.offset_bytes + field.size_bits // 8)
    ]
    assert sorted(taken) == list(range(1, STATE_BYTES))


@pytest.mark.parametrize("make", [AebFunction, NonDeterministic, Cautious])
def test_a_field_is_what_its_name_says(make: Callable[[], Application]) -> None:
    function = make()
    reply = decode_reply([function.execute(request) for request in REQUESTS][-1])
    cycle, state = decode_request(REQUESTS[-1]), function.capture()
    found = {field.name: value(field, state) for field in fields_of(function)}
    assert found["t_ms"] == cycle.t_ms and found["ego_ms"] == cycle.ego_speed_ms
    assert found["counter"] == reply.counter + 1 and found["stage"] == reply.stage
    assert found["started"] == 1 and found["blind_ms"] == found["still_ms"] == 0
    for target in cycle.targets:
        assert found[f"track{target.slot}.hits"] >= 3
        assert abs(found[f"track{target.slot}.range_m"] - target.range_m) < 3
        assert abs(found[f"track{target.slot}.speed_ms"] - cycle.ego_speed_ms - target.rel_speed_ms) < 3


@pytest.mark.parametrize(
    ("pattern", "name", "message"),
    [
        (Bit(64), "ego_ms", "bit 64 of state.ego_ms: it is f64, and has bits 0 to 63"),
        (Bit(8), "stage", "bit 8 of state.stage: it is u8, and has bits 0 to 7"),
        (Byte(4), "warned_ms", "byte 4 of state.warned_ms: it is u32, and has bytes 0 to 3"),
        (Bits(9), "track3.hits", "bits 9 of state.track3.hits: it is u8, and has bits 0 to 7"),
        (BitBurst(2, 63), "t_ms", "burst 2 bit 63 of state.t_ms: it is i64, and has bits 0 to 63"),
        (StuckBit(8, 0), "stage", "stuck 8=0 of state.stage: it is u8, and has bits 0 to 7"),
        (Bit(), "ego", "unknown field of the state 'ego'; did you mean 'ego_ms'? (one of: blind_ms, "),
        (Bit(), "track3.range", "did you mean 'trackN.range_m'?"),
    ],
)
def test_what_is_no_part_of_a_field_is_refused_with_what_is(
    pattern: BitPattern, name: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        field_with_bits(name, pattern, fields_of(AebFunction))


def test_a_function_that_declares_nothing_has_no_fields() -> None:
    with pytest.raises(
        ConfigError, match=r"state\.ego_ms: the function declares no fields; state is allowed"
    ):
        field_named("ego_ms", fields_of(WithoutStateAccess()))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bitflip state.ego_ms bit 64", "bit 64 of state.ego_ms: it is f64"),
        ("bitflip state.ego", "unknown field of the state 'ego'"),
        ("bitflip state.ego_ms in c", "unknown replica 'c'"),
        ("bitflip state.ego_ms at node.died", "event 'node.died' cannot trigger a fault under --ftm pbr"),
    ],
)
def test_what_cannot_be_flipped_is_refused_before_the_run(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(text).check(build("pbr", "process"))


def test_a_flip_in_memory_waits_for_any_event_at_whoever_emits_it() -> None:
    graph = build("pbr", "process")
    fault = parse("bitflip state.ego_ms in backup at checkpoint.sent nth 3")
    fault.check(graph)
    assert fault.action.waits_in(fault, Roles(graph, "a", "b")) == "a/after"


# -- living in a cell -----------------------------------------------------------------------------


def test_in_a_cell_that_nobody_touches_nothing_changes() -> None:
    bare, kept = served(20)
    assert kept.application.capture() == bare.capture() == kept.application.peek()
    kept.application.restore(AebFunction().capture())
    assert kept.application.peek() == AebFunction().capture()
    assert kept.application.characteristics == Characteristics() and not kept.found


@given(bits)
def test_the_function_goes_on_with_what_it_finds_or_refuses_it(bit: int) -> None:
    bare, kept = served(20)
    wrong = with_flipped(bare.capture(), [bit])
    kept.flip(bit)
    assert kept.application.peek() == wrong, "to look at it is no use of it"
    assert not kept.found
    try:
        bare.restore(wrong)
    except PeerError:
        kept.application.capture()
        assert [(b, type(error)) for b, error in kept.found] == [([bit], PeerError)]
        return
    assert kept.application.execute(REQUESTS[20]) == bare.execute(REQUESTS[20])
    assert kept.found == [([bit], None)]
    assert kept.application.capture() == bare.capture()
    assert len(kept.found) == 1, "it is told once"


def test_a_state_that_is_replaced_covers_up_what_was_flipped() -> None:
    bare, kept = served(20)
    kept.flip(8)
    kept.application.restore(bare.capture())
    assert kept.application.execute(REQUESTS[20]) == bare.execute(REQUESTS[20])
    assert not kept.found


@given(st.binary(min_size=1, max_size=20), st.sets(st.integers(0, 159), max_size=5))
def test_the_bits_that_differ_are_those_that_were_flipped(data: bytes, bits: set[int]) -> None:
    there, wanted = data, sorted(bit for bit in bits if bit < 8 * len(data))
    for bit in wanted:
        there = with_flipped(there, [bit])
    assert differing_bits(there, data) == wanted
