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
    HANG_FOREVER_MS,
    LATER,
    ONCE,
    SLOW_MS_MAX,
    Chance,
    Crash,
    Disturb,
    Every,
    Fault,
    Hang,
    How,
    Permanent,
    Persistence,
    Slow,
    Transient,
    Trigger,
    gap,
    mark,
    marked,
)
from aftbed.core.valuefault import (
    BIT_MAX,
    BITS_MAX,
    Bit,
    Bits,
    Burst,
    Byte,
    Flip,
    Pattern,
    Place,
    Stuck,
    changed,
    flipped,
    hit,
)
from aftbed.core.words import DURATION_MS_MAX
from aftbed.inject.words import KINDS, parse, read

durations = st.integers(1, DURATION_MS_MAX)
after = st.builds(Trigger, after_ms=durations)
triggers = st.one_of(
    st.just(Trigger()),
    st.builds(Trigger, st.sampled_from([e.label for e in Event]), st.integers(1, 10**9)),
    after,
)
bits = st.integers(0, BIT_MAX)
patterns = st.one_of(
    st.builds(Bit, st.none() | bits),
    st.builds(Bits, st.integers(1, BITS_MAX)),
    st.builds(Byte, st.none() | st.integers(0, BIT_MAX // 8)),
    st.builds(Burst, st.integers(1, BITS_MAX), st.none() | bits),
    st.builds(Stuck, bits, st.integers(0, 1)),
)
persistences = st.one_of(
    st.just(ONCE),
    st.just(Permanent()),
    st.builds(Every, st.integers(1, 10**6)),
    st.builds(Chance, st.integers(1, 10**6).map(lambda millionths: millionths / 1e6)),
)
disturbances = st.one_of(
    st.builds(Disturb, st.sampled_from(LATER), st.sampled_from(("pxy2pro", "aft2aft")), durations),
    st.builds(Disturb, st.sampled_from([how for how in How if how not in LATER]), st.just("aft2pro")),
)
fields = st.from_regex(r"[A-Za-z0-9_]{1,20}(\.[A-Za-z0-9_]{1,20})?", fullmatch=True)
replicas = st.sampled_from(("primary", "backup", "a", "b"))
faults = st.one_of(
    st.builds(Fault, st.just(Crash()), st.sampled_from(("primary", "b/after")), triggers),
    st.builds(Fault, st.builds(Hang, st.just(HANG_FOREVER_MS) | durations), st.just("backup"), triggers),
    st.builds(
        Fault,
        st.builds(Slow, st.integers(1, round(SLOW_MS_MAX)), st.just(0) | durations),
        st.just("a/server"),
        triggers,
    ),
    st.builds(
        Fault, disturbances, replicas, st.builds(Trigger, nth=st.integers(1, 10**9)) | after, persistences
    ),
    st.builds(Fault, st.builds(Flip, st.sampled_from(Place), patterns), replicas, triggers, persistences),
    st.builds(Fault, st.builds(Flip, st.just(Place.STATE), patterns, fields), replicas, triggers),
)


def bitflip(
    place: Place, bit: int | None = None, target: str = "primary", trigger: Trigger | None = None
) -> Fault:
    return Fault(Flip(place, Bit(bit)), target, trigger or Trigger())


@given(faults)
def test_a_fault_reads_back_as_it_was(fault: Fault) -> None:
    assert parse(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("crash primary", Fault(Crash(), "primary", Trigger())),
        ("  crash   b/after ", Fault(Crash(), "b/after", Trigger())),
        ("crash primary at checkpoint.sent", Fault(Crash(), "primary", Trigger("checkpoint.sent", 1))),
        (
            "crash primary at checkpoint.sent nth 100",
            Fault(Crash(), "primary", Trigger("checkpoint.sent", 100)),
        ),
        (
            "crash primary nth 100 at checkpoint.sent",
            Fault(Crash(), "primary", Trigger("checkpoint.sent", 100)),
        ),
        ("crash backup after 200ms", Fault(Crash(), "backup", Trigger(after_ms=200))),
        ("hang a/server", Fault(Hang(), "a/server", Trigger())),
        ("hang a/server for 50ms", Fault(Hang(50), "a/server", Trigger())),
        ("hang a/server after 1.5s for 2s", Fault(Hang(2000), "a/server", Trigger(after_ms=1500))),
        (
            "hang a/server for 50ms at server.exit nth 3",
            Fault(Hang(50), "a/server", Trigger("server.exit", 3)),
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
        ("bitflip state.ego_ms", Fault(Flip(Place.STATE, Bit(), "ego_ms"), "primary", Trigger())),
        (
            "bitflip state.track0.range_m bit 52 in b nth 7",
            Fault(Flip(Place.STATE, Bit(52), "track0.range_m"), "b", Trigger("server.exit", 7)),
        ),
        (
            "bitflip state.t_ms byte 1 after 20ms",
            Fault(Flip(Place.STATE, Byte(1), "t_ms"), "primary", Trigger(after_ms=20)),
        ),
        ("slow primary", Fault(Slow(2.0, 0), "primary", Trigger())),
        (
            "slow b/after for 500ms by 0.5ms at checkpoint.applied",
            Fault(Slow(0.5, 500), "b/after", Trigger("checkpoint.applied")),
        ),
        ("omission pxy2pro", Fault(Disturb(How.OMISSION, "pxy2pro"), "primary", Trigger())),
        ("delay aft2aft", Fault(Disturb(How.DELAY, "aft2aft", 20.0), "primary", Trigger())),
        (
            "delay aft2aft nth 3 by 5ms in b permanent",
            Fault(Disturb(How.DELAY, "aft2aft", 5.0), "b", Trigger(nth=3), Permanent()),
        ),
        (
            "duplicate pro2pxy after 2s intermittent p 0.25",
            Fault(Disturb(How.DUPLICATE, "pro2pxy"), "primary", Trigger(after_ms=2000), Chance(0.25)),
        ),
        (
            "reorder clt2pxy intermittent every 3",
            Fault(Disturb(How.REORDER, "clt2pxy", 20.0), "primary", Trigger(), Every(3)),
        ),
        ("bitflip request nth 2", bitflip(Place.REQUEST, trigger=Trigger("server.enter", 2))),
        ("bitflip checkpoint nth 2", bitflip(Place.CHECKPOINT, trigger=Trigger("checkpoint.sent", 2))),
        ("bitflip log nth 2", bitflip(Place.LOG, trigger=Trigger("reply.stored", 2))),
        ("bitflip result bits 3", Fault(Flip(Place.RESULT, Bits(3)), "primary", Trigger())),
        ("bitflip result byte", Fault(Flip(Place.RESULT, Byte()), "primary", Trigger())),
        ("bitflip result byte 4 in b", Fault(Flip(Place.RESULT, Byte(4)), "b", Trigger())),
        ("bitflip result burst 5", Fault(Flip(Place.RESULT, Burst(5)), "primary", Trigger())),
        ("bitflip result bit 9 burst 5", Fault(Flip(Place.RESULT, Burst(5, 9)), "primary", Trigger())),
        (
            "bitflip state permanent stuck 60=1",
            Fault(Flip(Place.STATE, Stuck(60, 1)), "primary", Trigger(), Permanent()),
        ),
    ],
)
def test_the_grammar(text: str, fault: Fault) -> None:
    assert parse(text) == fault


BAD: Final = {
    "": "fault '': expected crash|hang|slow TARGET",
    "crash": "fault 'crash': expected crash|hang|slow TARGET",
    "crush primary": "unknown fault 'crush'; did you mean 'crash'? (one of:",
    "crash primary when server.exit": "unknown word in fault 'crash primary when server.exit': 'when'",
    "crash primary att server.exit": "'att'; did you mean 'at'? (one of: after, at, for, nth)",
    "crash primary at": "'at' lacks its value",
    "crash primary at server.exit nth": "'nth' lacks its value",
    "crash primary at server.exit at server.exit": "'at' twice",
    "crash primary at server.exits": "unknown event 'server.exits'; did you mean 'server.exit'?",
    "crash primary for 50ms": "'for 50ms': a crash has no duration; a hang and a slow have",
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
    "bitflip": "fault 'bitflip': expected crash|hang|slow TARGET",
    "bitflip reslt": "unknown place of a bitflip 'reslt'; did you mean 'result'? (one of: checkpoint,",
    "bitflip result.ego_ms": "'result.ego_ms': only the state has fields, as state.ego_ms",
    "bitflip state.": "field '' of the state: letters, digits, _ and . are allowed, 60 at most",
    "bitflip state.a..b": "field 'a..b' of the state: letters, digits, _ and . are allowed, 60 at most",
    f"bitflip state.{61 * 'a'}": "of the state: letters, digits, _ and . are allowed, 60 at most",
    "bitflip state.a permanent": "'permanent': a bitflip of a field strikes once; that of a whole state",
    "bitflip state.a intermittent every 2": "'intermittent': a bitflip of a field strikes once",
    "bitflip result bitz 3": "'bitz'; did you mean 'bit",
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
    "crash primary permanent": "unknown word in fault 'crash primary permanent': 'permanent'",
    "hang primary by 3ms": "unknown word in fault 'hang primary by 3ms': 'by' (one of: after, at, for, nth)",
    "slow primary by 501ms": "'by 501ms': a step can be slower by 500ms at most",
    "slow primary by 2": "delay '2': a positive number with its unit is allowed",
    "omission pxy2pro by 3ms": "'by 3ms': omission holds nothing back; a delay and a reorder does",
    "delay pxy2pro by 3": "delay '3': a positive number with its unit is allowed",
    "delay pxy2pro at reply.sent": "unknown word in fault 'delay pxy2pro at reply.sent': 'at'",
    "delay pxy2pro nth 3 after 5ms": "'nth 3' and 'after 5ms': one of them is allowed",
    "delay pxy2pro nth 0": "nth '0': a whole number from 1 on is allowed",
    "delay pxy2pro intermittent": "'intermittent' lacks its value",
    "delay pxy2pro intermittent every": "'intermittent' lacks its value",
    "delay pxy2pro intermittent often 3": "unknown word behind 'intermittent': 'often' (one of: every, p)",
    "delay pxy2pro intermittent every 0": "every '0': a whole number from 1 to 999999999999 is allowed",
    "delay pxy2pro intermittent p 0": "p '0': a chance above 0 and up to 1 is allowed, as 0.1",
    "delay pxy2pro intermittent p 1.1": "p '1.1': a chance above 0 and up to 1 is allowed, as 0.1",
    "delay pxy2pro intermittent p nan": "p 'nan': a chance above 0 and up to 1 is allowed, as 0.1",
    "bitflip result permanent intermittent p 1": "'permanent' and 'intermittent p 1': one of them is allowed",
    "bitflip result bits 0": "bits '0': a whole number from 1 to 64 is allowed",
    "bitflip result bits 65": "bits '65': a whole number from 1 to 64 is allowed",
    "bitflip result burst 0": "burst '0': a whole number from 1 to 64 is allowed",
    "bitflip result byte 536870912": "byte '536870912': a whole number from 0 to 536870911 is allowed",
    "bitflip result byte -1": "byte '-1': a whole number from 0 to 536870911 is allowed",
    "bitflip result stuck 60": "stuck '60': a bit and its value are allowed, as 60=1",
    "bitflip result stuck 60=2": "stuck '60=2': a bit and its value are allowed, as 60=1",
    "bitflip result bits 3 bit 1": "'bits 3' and 'bit 1': one of them is allowed",
    "bitflip result stuck 1=1 byte": "'byte' and 'stuck 1=1': one of them is allowed",
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
    *KINDS,
    "result",
    "bit",
    "byte",
    "stuck",
    "3=1",
    "permanent",
    "intermittent",
    "every",
    "by",
    "in",
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


def test_words_that_were_told_apart_are_not_split_again() -> None:
    assert read(["crash", "primary", "after", "2s"]) == parse("crash primary after 2s")
    with pytest.raises(ConfigError, match="bit '1 permanent': a whole number"):
        read(["bitflip", "result", "bit", "1 permanent"])


# -- the value fault as a value


@pytest.mark.parametrize(
    ("fault", "event"),
    [
        (bitflip(Place.RESULT), "server.exit"),
        (bitflip(Place.STATE, trigger=Trigger("state.captured", 2)), "state.captured"),
        (bitflip(Place.RESULT, trigger=Trigger(after_ms=5)), "server.exit"),
        (Fault(Crash(), "primary", Trigger()), ""),
        (Fault(Crash(), "primary", Trigger("reply.sent")), "reply.sent"),
        (Fault(Disturb(How.DELAY, "aft2aft"), "primary", Trigger(nth=3)), ""),
    ],
)
def test_a_bitflip_waits_for_an_execution_at_least(fault: Fault, event: str) -> None:
    assert fault.event == event


@pytest.mark.parametrize(
    ("action", "trigger", "persistence", "message"),
    [
        (Crash(), Trigger(), Permanent(), "a crash strikes once"),
        (Slow(), Trigger(), Every(3), "a slow strikes once"),
        (Disturb(How.DELAY, "aft2aft"), Trigger("reply.sent"), ONCE, "waits for no event: reply.sent"),
    ],
)
def test_a_mixture_of_two_faults_is_none(
    action: Crash | Slow | Disturb, trigger: Trigger, persistence: Persistence, message: str
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


# -- which bits


@given(patterns, st.binary(max_size=80), st.integers(0, 2**63 - 1))
def test_a_pattern_and_a_draw_tell_the_bits(pattern: Pattern, data: bytes, draw: int) -> None:
    found = hit(pattern, data, draw)
    assert hit(pattern, data, draw) == found
    if found is None:
        return
    assert list(found) == sorted(set(found)) and all(0 <= bit < 8 * len(data) for bit in found)
    other = changed(data, found)
    match pattern:
        case Bit(at):
            assert len(found) == 1 and at in (None, *found)
        case Bits(count):
            assert len(found) == count
        case Byte(at):
            places = [i for i, (a, b) in enumerate(zip(data, other, strict=True)) if a != b]
            assert len(places) == 1 and at in (None, *places)
        case Burst(count, at):
            assert found == tuple(range(found[0], found[0] + count)) and at in (None, found[0])
        case Stuck(at, value):
            assert other[at // 8] >> at % 8 & 1 == value
            assert found == () or data != other


def test_a_byte_always_has_another_value_and_it_may_be_any() -> None:
    values = {changed(b"\x00\x55", hit(Byte(1), b"\x00\x55", draw) or ())[1] for draw in range(3000)}
    assert values == set(range(256)) - {0x55}


@pytest.mark.parametrize(
    ("pattern", "size"),
    [
        (Bit(16), 2),
        (Bit(), 0),
        (Bits(17), 2),
        (Byte(2), 2),
        (Byte(), 0),
        (Burst(17), 2),
        (Burst(2, 15), 2),
        (Stuck(16, 1), 2),
    ],
)
def test_where_there_are_no_such_bits_none_are_hit(pattern: Pattern, size: int) -> None:
    assert hit(pattern, bytes(size), 7) is None


def test_a_bit_that_is_stuck_at_what_it_is_changes_nothing() -> None:
    assert hit(Stuck(1, 1), b"\x02", 0) == () and hit(Stuck(1, 0), b"\x02", 0) == (1,)


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
