"""The words of a fault: what is good reads back as it was, what is wrong is named."""

import re
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.core.event import Event
from aftbed.core.fault import HANG_FOREVER_MS, Act, Fault, Trigger
from aftbed.inject.words import DURATION_MS_MAX, build, milliseconds, parse

durations = st.integers(1, DURATION_MS_MAX)
triggers = st.one_of(
    st.just(Trigger()),
    st.builds(Trigger, st.sampled_from([e.label for e in Event]), st.integers(1, 10**9)),
    st.builds(Trigger, after_ms=durations),
)
faults = st.one_of(
    st.builds(Fault, st.just(Act.CRASH), st.sampled_from(("primary", "b/after")), triggers),
    st.builds(Fault, st.just(Act.HANG), st.just("backup"), triggers, st.just(HANG_FOREVER_MS) | durations),
)


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
    ],
)
def test_the_grammar(text: str, fault: Fault) -> None:
    assert parse(text) == fault


BAD: Final = {
    "": "fault '': expected crash|hang TARGET",
    "crash": "fault 'crash': expected crash|hang TARGET",
    "crush primary": "unknown fault 'crush'; did you mean 'crash'? (one of: crash, hang)",
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
    "crash primary after 0.2ms": "duration '0.2ms': a positive number",
    "crash primary after 5m": "duration '5m': a positive number",
    "crash primary after 1e3ms": "duration '1e3ms': a positive number",
    "crash primary after 3601s": "duration '3601s': a positive number",
    "hang primary for ever": "duration 'ever': a positive number",
    "hang primary for nanms": "duration 'nanms': a positive number",
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


@pytest.mark.parametrize(
    ("text", "ms"), [("1ms", 1), ("50ms", 50), ("2s", 2000), ("0.5s", 500), ("3600s", DURATION_MS_MAX)]
)
def test_durations(text: str, ms: int) -> None:
    assert milliseconds(text) == ms


@given(st.text(max_size=30))
def test_any_text_is_a_fault_or_a_config_error(text: str) -> None:
    try:
        found = parse(text)
    except ConfigError:
        return
    assert parse(str(found)) == found


SOME_WORDS: Final = (
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
