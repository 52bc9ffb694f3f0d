"""The words of a fault: what is good reads back as it was, what is wrong is named."""

import re
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from somefaults import faults

from aftbed.core.errors import ConfigError
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, BitBurst, Bits, Byte, Chance, Every, Permanent, StuckBit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.memory import MemoryFlip
from aftbed.inject.model import NAMES, Fault, parse, read
from aftbed.inject.slow import Slow
from aftbed.inject.state import StateFlip
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.vehicle.condition import Condition

TTC: Final = Condition("ttc", True, 1.2)


def bitflip(
    place: ValuePlace, bit: int | None = None, target: str = "primary", trigger: Trigger | None = None
) -> Fault:
    return Fault(ValueFlip(place, Bit(bit)), target, trigger or Trigger())


@given(faults)
def test_a_fault_reads_back_as_it_was(fault: Fault) -> None:
    assert parse(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("crash primary", Fault(Crash(), "primary", Trigger())),
        ("crash primary when ttc < 1.2", Fault(Crash(), "primary", Trigger(when=TTC))),
        ("hang backup for 50ms when ttc < 1.2", Fault(Hang(50), "backup", Trigger(when=TTC))),
        (
            "crash primary when ttc < 1.2 at reply.sent nth 3",
            Fault(Crash(), "primary", Trigger("reply.sent", 3, when=TTC)),
        ),
        (
            "omission pxy2pro when gap > 30 nth 2",
            Fault(
                ChannelFault(Disturbance.OMISSION, "pxy2pro"),
                "primary",
                Trigger(nth=2, when=Condition("gap", False, 30)),
            ),
        ),
        ("bitflip result when ttc < 1.2", bitflip(ValuePlace.RESULT, trigger=Trigger(when=TTC))),
        ("slow primary share 25%", Fault(Slow(0.0, 0, 0.25), "primary", Trigger())),
        ("slow a/server share 2.5% for 1s", Fault(Slow(0.0, 1000, 0.025), "a/server", Trigger())),
        ("bitflip memory", Fault(MemoryFlip(), "primary", Trigger())),
        (
            "bitflip memory bit 3 address 0x7f00 in a/server at reply.sent",
            Fault(MemoryFlip(3, 0x7F00), "a/server", Trigger("reply.sent")),
        ),
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
        ("bitflip result", bitflip(ValuePlace.RESULT)),
        ("bitflip state bit 0", bitflip(ValuePlace.STATE, 0)),
        ("bitflip result in backup", bitflip(ValuePlace.RESULT, target="backup")),
        ("bitflip result nth 7", bitflip(ValuePlace.RESULT, trigger=Trigger("server.exit", 7))),
        ("bitflip result after 200ms", bitflip(ValuePlace.RESULT, trigger=Trigger(after_ms=200))),
        (
            "bitflip result bit 60 at server.exit nth 100",
            bitflip(ValuePlace.RESULT, 60, trigger=Trigger("server.exit", 100)),
        ),
        (
            "bitflip state in b nth 3 at state.restored bit 9",
            bitflip(ValuePlace.STATE, 9, "b", Trigger("state.restored", 3)),
        ),
        ("bitflip state.ego_ms", Fault(StateFlip("ego_ms"), "primary", Trigger())),
        (
            "bitflip state.track0.range_m bit 52 in b nth 7",
            Fault(StateFlip("track0.range_m", Bit(52)), "b", Trigger("server.exit", 7)),
        ),
        (
            "bitflip state.t_ms byte 1 after 20ms",
            Fault(StateFlip("t_ms", Byte(1)), "primary", Trigger(after_ms=20)),
        ),
        ("slow primary", Fault(Slow(2.0, 0), "primary", Trigger())),
        (
            "slow b/after for 500ms by 0.5ms at checkpoint.applied",
            Fault(Slow(0.5, 500), "b/after", Trigger("checkpoint.applied")),
        ),
        ("omission pxy2pro", Fault(ChannelFault(Disturbance.OMISSION, "pxy2pro"), "primary", Trigger())),
        ("delay aft2aft", Fault(ChannelFault(Disturbance.DELAY, "aft2aft", 20.0), "primary", Trigger())),
        (
            "delay aft2aft nth 3 by 5ms in b permanent",
            Fault(ChannelFault(Disturbance.DELAY, "aft2aft", 5.0), "b", Trigger(nth=3), Permanent()),
        ),
        (
            "duplicate pro2pxy after 2s intermittent p 0.25",
            Fault(
                ChannelFault(Disturbance.DUPLICATE, "pro2pxy"),
                "primary",
                Trigger(after_ms=2000),
                Chance(0.25),
            ),
        ),
        (
            "reorder clt2pxy intermittent every 3",
            Fault(ChannelFault(Disturbance.REORDER, "clt2pxy", 20.0), "primary", Trigger(), Every(3)),
        ),
        ("bitflip request nth 2", bitflip(ValuePlace.REQUEST, trigger=Trigger("server.enter", 2))),
        ("bitflip checkpoint nth 2", bitflip(ValuePlace.CHECKPOINT, trigger=Trigger("checkpoint.sent", 2))),
        ("bitflip log nth 2", bitflip(ValuePlace.LOG, trigger=Trigger("reply.stored", 2))),
        ("bitflip result bits 3", Fault(ValueFlip(ValuePlace.RESULT, Bits(3)), "primary", Trigger())),
        ("bitflip result byte", Fault(ValueFlip(ValuePlace.RESULT, Byte()), "primary", Trigger())),
        ("bitflip result byte 4 in b", Fault(ValueFlip(ValuePlace.RESULT, Byte(4)), "b", Trigger())),
        ("bitflip result burst 5", Fault(ValueFlip(ValuePlace.RESULT, BitBurst(5)), "primary", Trigger())),
        (
            "bitflip result bit 9 burst 5",
            Fault(ValueFlip(ValuePlace.RESULT, BitBurst(5, 9)), "primary", Trigger()),
        ),
        (
            "bitflip state permanent stuck 60=1",
            Fault(ValueFlip(ValuePlace.STATE, StuckBit(60, 1)), "primary", Trigger(), Permanent()),
        ),
    ],
)
def test_the_grammar(text: str, fault: Fault) -> None:
    assert parse(text) == fault


BAD: Final = {
    "crash primary when ttc < soon": "ttc < 'soon': a number is allowed (ttc in s, gap in m, speed in m/s)",
    "crash primary when ttc = 1": "found '=' where '<' or '>' is expected",
    "crash primary when tcc < 1": "unknown quantity of the car 'tcc'; did you mean 'ttc'?",
    "crash primary when ttc < 1 after 2s": "'after 2s' and 'when ttc < 1': one of them is allowed",
    "slow primary share 25": "share '25': 1% to 99% of a CPU are allowed, as 25%",
    "slow primary share 100%": "share '100%': 1% to 99% of a CPU are allowed, as 25%",
    "slow primary share 0%": "share '0%': 1% to 99% of a CPU are allowed, as 25%",
    "slow primary by 2ms share 25%": "'by 2ms' and 'share 25%': one of them is allowed",
    "hang primary share 25%": "unknown word in fault 'hang primary share 25%': 'share'",
    "bitflip memory bit 8": "bit '8': a whole number from 0 to 7 is allowed",
    "bitflip memory byte 3": "'byte': of memory one bit is flipped, once: 'bit 0' to 'bit 7' of a byte",
    "bitflip memory permanent": "'permanent': of memory one bit is flipped, once",
    "bitflip memory nth 3": "'nth 3' counts an event: 'at EVENT nth 3' is allowed",
    "bitflip memory address 4096": "address '4096': a hexadecimal number is allowed, as 0x7f0012345678",
    "bitflip result address 0x10": "'address 0x10': only memory has addresses: 'bitflip memory'",
    "": "fault '': expected crash|hang|slow TARGET",
    "crash": "fault 'crash': expected crash|hang|slow TARGET",
    "crush primary": "unknown fault 'crush'; did you mean 'crash'? (one of:",
    "crash primary when server.exit": "fault 'crash primary when server.exit': 'when' lacks its value",
    "crash primary att server.exit": "'att'; did you mean 'at'? (one of: after, at, for, nth, when)",
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
    "hang primary by 3ms": "unknown word in fault 'hang primary by 3ms': 'by' (one of: after, at,",
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
    "crash primary bit 3": "unknown word in fault 'crash primary bit 3': 'bit' (one of: after, at,",
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
    *NAMES,
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
    "when",
    "ttc",
    "<",
    "share",
    "25%",
    "memory",
    "address",
    "0x7f",
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
