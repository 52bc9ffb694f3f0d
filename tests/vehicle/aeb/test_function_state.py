"""The state of the protected function: what it holds, and which states it refuses."""

import pytest
from aebcycles import EGO_MS, ask, braking, cycles
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.function import STATE_BYTES, AebFunction
from aftbed.vehicle.aeb.messages import SLOTS, AebInput, AebTarget, decode_reply, encode_request


def test_the_state_has_one_size_in_the_range_that_was_asked_for() -> None:
    assert 200 <= STATE_BYTES <= 600
    assert len(AebFunction().capture()) == len(braking()[0].capture()) == STATE_BYTES


@given(st.lists(cycles, max_size=12), st.lists(cycles, max_size=4))
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
@settings(max_examples=4 * settings.default.max_examples)
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
