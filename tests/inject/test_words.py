"""The words of a fault: what is good reads back as it was, what is wrong is named."""

import re
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.core.event import Event
from aftbed.core.fault import (
    BIT_MAX,
    HANG_FOREVER_MS,
    Act,
    Fault,
    Flip,
    Place,
    Trigger,
    flipped,
    mark,
    marked,
)
from aftbed.core.words import DURATION_MS_MAX
from aftbed.inject.words import build, build_flip, parse

durations = st.integers(1, DURATION_MS_MAX)
triggers = st.one_of(
    st.just(Trigger()),
    st.builds(Trigger, st.sampled_from([e.label for e in Event]), st.integers(1, 10**9)),
    st.builds(Trigger, after_ms=durations),
)
flips = st.builds(Flip, st.sampled_from(Place), st.none() | st.integers(0, BIT_MAX))
faults = st.one_of(
    st.builds(Fault, st.just(Act.CRASH), st.sampled_from(("primary", "b/after")), triggers),
    st.builds(Fault, st.just(Act.HANG), st.just("backup"), triggers, st.just(HANG_FOREVER_MS) | durations),
    st.builds(
        Fault,
        st.just(Act.BITFLIP),
        st.sampled_from(("primary", "backup", "a", "b")),
        triggers,
        st.just(HANG_FOREVER_MS),
        flips,
    ),
)


def bitflip(
    place: Place, bit: int | None = None, target: str = "primary", trigger: Trigger | None = None
) -> Fault:
    return Fault(Act.BITFLIP, target, trigger or Trigger(), flip=Flip(place, bit))


@given(faults)
def test_a_fault_reads_back_as_it_was(fault: Fault) -> None:
    assert parse(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("crash primary", Fault(Act.CRASH, "primary", Trigger())),
        ("  crash   b/after ", Fault(Act.CRASH, "b/after", Trigger())),
        ("crash primary at checkpoint.sent", Fault(Act.CRASH, "primary", Trigger("checkpoint.sent", 1))),
        (
            "crash primary at checkpoint.sent nth 100",
            Fault(Act.CRASH, "primary", Trigger("checkpoint.sent", 100)),
        ),
        (
            "crash primary nth 100 at checkpoint.sent",
            Fault(Act.CRASH, "primary", Trigger("checkpoint.sent", 100)),
        ),
        ("crash backup after 200ms", Fault(Act.CRASH, "backup", Trigger(after_ms=200))),
        ("hang a/server", Fault(Act.HANG, "a/server", Trigger())),
        ("hang a/server for 50ms", Fault(Act.HANG, "a/server", Trigger(), 50)),
        ("hang a/server after 1.5s for 2s", Fault(Act.HANG, "a/server", Trigger(after_ms=1500), 2000)),
        (
            "hang a/server for 50ms at server.exit nth 3",
            Fault(Act.HANG, "a/server", Trigger("server.exit", 3), 50),
        ),
        ("bitflip result", bitflip(Place.RESULT)),
        ("bitflip state bit 0", bitflip(Place.STATE, 0)),
        ("bitflip result in backup", bitflip(Place.RESULT, target="backup")),
        ("bitflip result nth 7", bitflip(Place.RESULT, trigger=Trigger("server.exit", 7))),
        ("bitflip result after 200ms", bitflip(Place.RESULT, trigger=Trigger(after_ms=200))),
        (
            "bitflip result bit 60 at server.exit nth 100",
            bitflip(Place.RESULT, 60, trigger=Trigger("server.exit", 100)),
        ),
        (
            "bitflip state in b nth 3 at state.restored bit 9",
            bitflip(Place.STATE, 9, "b", Trigger("state.restored", 3)),
        ),
    ],
)
def test_the_grammar(text: str, fault: Fault) -> None:
    assert parse(text) == fault


BAD: Final = {
    "": "fault '': expected crash|hang TARGET",
    "crash": "fault 'crash': expected crash|hang TARGET",
    "crush primary": "unknown fault 'crush'; did you mean 'crash'? (one of: bitflip, crash, hang)",
    "crash primary when server.exit": "unknown word in fault 'crash primary when server.exit': 'when'",
    "crash primary att server.exit": "'att'; did you mean 'at'? (one of: after, at, for, nth)",
    "crash primary at": "'at' lacks its value",
    "crash primary at server.exit nth": "'nth' lacks its value",
    "crash primary at server.exit at server.exit": "'at' twice",
    "crash primary at server.exits": "unknown event 'server.exits'; did you mean 'server.exit'?",
    "crash primary for 50ms": "'for 50ms': a crash has no duration; only a hang has",
    "crash primary at server.exit after 5ms": "'at server.exit' and 'after 5ms': one of them is allowed",
    "crash primary nth 3": "'nth 3' counts an event: 'at EVENT nth 3' is allowed",
    "crash primary nth 3 after 5ms": "'nth 3' counts an event",
    "crash primary at server.exit nth 0": "nth '0': a whole number from 1 on is allowed",
    "crash primary at server.exit nth -1": "nth '-1': a whole number from 1 on is allowed",
    "crash primary at server.exit nth 1.5": "nth '1.5': a whole number from 1 on is allowed",
    "crash primary at server.exit nth two": "nth 'two': a whole number from 1 on is allowed",
    "crash primary at server.exit nth ²": "nth '²': a whole number from 1 on is allowed",
    "crash primary after ²ms": "duration '²ms': a positive number",
    "crash primary after 200": "duration '200': a positive number with its unit is allowed, as 50ms or 2s",
    "crash primary after ms": "duration 'ms': a positive number",
    "crash primary after -5ms": "duration '-5ms': a positive number",
    "crash primary after 0ms": "duration '0ms': a positive number",
    "crash primary after 0.0ms": "duration '0.0ms': a positive number",
    "crash primary after 5m": "duration '5m': a positive number",
    "crash primary after 1e3ms": "duration '1e3ms': a positive number",
    "crash primary after 3601s": "duration '3601s': a positive number",
    "hang primary for ever": "duration 'ever': a positive number",
    "hang primary for nanms": "duration 'nanms': a positive number",
    "bitflip": "fault 'bitflip': expected crash|hang TARGET",
    "bitflip reslt": "unknown place of a bitflip 'reslt'; did you mean 'result'? (one of: result, state)",
    "bitflip result bits 3": "'bits'; did you mean 'bit'? (one of: after, at, bit, in, nth)",
    "bitflip result for 5ms": "unknown word in fault 'bitflip result for 5ms': 'for'",
    "bitflip result bit": "'bit' lacks its value",
    "bitflip result bit 1 bit 2": "'bit' twice",
    "bitflip result bit -1": "bit '-1': a whole number from 0 to 4294967295 is allowed",
    "bitflip result bit 4294967296": "bit '4294967296': a whole number from 0 to 4294967295 is allowed",
    "bitflip result bit ²": "bit '²': a whole number from 0",
    "bitflip result nth 0": "nth '0': a whole number from 1 on is allowed",
    "bitflip result nth 3 after 5ms": "'nth 3' and 'after 5ms': one of them is allowed",
    "bitflip result at server.exit after 5ms": "'at server.exit' and 'after 5ms': one of them is allowed",
    "bitflip result at server.exits": "unknown event 'server.exits'; did you mean 'server.exit'?",
    "crash primary bit 3": "unknown word in fault 'crash primary bit 3': 'bit' (one of: after, at, for, nth)",
}


@pytest.mark.parametrize("text", BAD)
def test_each_wrong_word_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(BAD[text])):
        parse(text)


@pytest.mark.parametrize(
    ("words", "digits", "unit"), [("after", 400, "s"), ("after", 11, "ms"), ("at server.exit nth", 5000, "")]
)
def test_a_number_of_any_length_is_named_but_not_in_full(words: str, digits: int, unit: str) -> None:
    number = "9" * digits + unit
    with pytest.raises(ConfigError, match=rf"'{number[:40]}': a .* is allowed"):
        parse(f"crash primary {words} {number}")


@given(st.text(max_size=30))
def test_any_text_is_a_fault_or_a_config_error(text: str) -> None:
    try:
        found = parse(text)
    except ConfigError:
        return
    assert parse(str(found)) == found


SOME_WORDS: Final = (
    "bitflip",
    "result",
    "bit",
    "in",
    "crash",
    "hang",
    "primary",
    "at",
    "nth",
    "for",
    "after",
    "5ms",
    "2s",
    "server.exit",
    "3",
    "x",
)


@given(st.lists(st.sampled_from(SOME_WORDS), max_size=9))
def test_any_order_of_words_is_a_fault_or_a_config_error(words: list[str]) -> None:
    try:
        found = parse(" ".join(words))
    except ConfigError:
        return
    assert parse(str(found)) == found


def test_a_fault_out_of_options_is_the_one_out_of_words() -> None:
    built = build(Act.HANG, "a/server", "50ms", "server.exit", "3", None)
    assert built == parse("hang a/server for 50ms at server.exit nth 3")
    assert build(Act.CRASH, "primary", None, None, None, "2s") == parse("crash primary after 2s")
    flip = build_flip("state", "9", "b", "state.restored", "3", None)
    assert flip == parse("bitflip state bit 9 in b at state.restored nth 3")
    assert build_flip("result", None, None, None, None, "2s") == parse("bitflip result after 2s")


# -- the value fault as a value


@pytest.mark.parametrize(
    ("fault", "event"),
    [
        (bitflip(Place.RESULT), "server.exit"),
        (bitflip(Place.STATE, trigger=Trigger("state.captured", 2)), "state.captured"),
        (bitflip(Place.RESULT, trigger=Trigger(after_ms=5)), "server.exit"),
        (Fault(Act.CRASH, "primary", Trigger()), ""),
        (Fault(Act.CRASH, "primary", Trigger("reply.sent")), "reply.sent"),
    ],
)
def test_a_bitflip_waits_for_an_execution_at_least(fault: Fault, event: str) -> None:
    assert fault.event == event


@pytest.mark.parametrize(
    ("act", "flip", "message"),
    [
        (Act.BITFLIP, None, "a bitflip without a bit to flip"),
        (Act.CRASH, Flip(Place.STATE), "a crash with a bit to flip"),
        (Act.HANG, Flip(Place.RESULT, 3), "a hang with a bit to flip"),
    ],
)
def test_a_mixture_of_two_faults_is_none(act: Act, flip: Flip | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Fault(act, "primary", Trigger(), flip=flip)
    packet = msgspec.msgpack.encode(
        {"act": act, "target": "primary", "trigger": Trigger(), "flip": msgspec.to_builtins(flip)}
    )
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.msgpack.decode(packet, type=Fault)


@given(faults)
def test_a_fault_travels_as_it_is(fault: Fault) -> None:
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(fault), type=Fault) == fault


def test_bits_count_from_bit_0_of_byte_0() -> None:
    assert flipped(b"\x00\x00", 0) == b"\x01\x00"
    assert flipped(b"\x00\x00", 7) == b"\x80\x00"
    assert flipped(b"\x00\x00", 8) == b"\x00\x01"
    assert flipped(b"\xff\xff", 15) == b"\xff\x7f"


@given(st.binary(min_size=1, max_size=40), st.data())
def test_a_flip_changes_one_bit_and_a_second_one_undoes_it(data: bytes, more: st.DataObject) -> None:
    bit = more.draw(st.integers(0, 8 * len(data) - 1))
    changed = flipped(data, bit)
    assert int.from_bytes(data, "little") ^ int.from_bytes(changed, "little") == 1 << bit
    assert len(changed) == len(data) and flipped(changed, bit) == data


@pytest.mark.parametrize("bit", [16, -1])
def test_a_bit_that_is_not_there_is_our_mistake(bit: int) -> None:
    with pytest.raises(AssertionError):
        flipped(b"\x00\x00", bit)


@given(st.integers(0, 2**32 - 1), st.integers(0, BIT_MAX))
def test_a_mark_keeps_both_its_numbers(number: int, bits: int) -> None:
    assert marked(mark(number, bits)) == (number, bits)
    assert 0 <= mark(number, bits) < 2**64
