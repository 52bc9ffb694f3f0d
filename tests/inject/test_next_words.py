"""What a shell is told to offer behind the words of a fault is what the readers of faults take."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.ftm.compose import build
from aftbed.inject.bus import NODES
from aftbed.inject.model import KINDS, NAMES, next_words, parse

PBR = build("pbr", "process")
NOT_TOGETHER = (
    "sends nothing on ",
    "has bits 0 to ",
    "event for a bit of",
    "the Server of a backup executes nothing",
    "backup has none",
)


def after(text: str) -> Sequence[str]:
    return next_words(text.split(), PBR)


@pytest.mark.parametrize(
    "text, expected",
    [
        ("", NAMES),
        ("omission bus from", NODES),
        ("crash primary", ("at", "after", "when")),
        ("crash leader at server.exit nth 3", ("when",)),
        ("crash primary when", ("ttc", "gap", "speed")),
        ("crash primary when ttc", ("<", ">")),
        ("crash primary after 2s", ()),
        ("bitflip result bit 3 in", ("primary", "backup", "a", "b")),
        ("radar latency by", ("2ms", "20ms")),
        ("radar bias by", ("-5", "2")),
        ("explode primary", ()),
        ("radar nonsense", ()),
    ],
)
def test_what_may_follow(text: str, expected: Sequence[str]) -> None:
    assert tuple(after(text)) == tuple(expected)


def test_the_nodes_and_events_are_those_of_the_graph() -> None:
    assert {"primary", "b/server", "hub"} <= set(after("crash"))
    assert "aft2aft" in after("omission") and "aft2aft" not in next_words(
        ["omission"], build("tr", "process")
    )
    assert "checkpoint.sent" in after("crash primary at")
    assert "checkpoint.sent" not in next_words(["crash", "primary", "at"], build("lfr", "process"))


@given(st.data())
def test_whatever_is_chosen_is_never_refused_where_nothing_more_is_offered(data: st.DataObject) -> None:
    words = list[str]()
    while offered := next_words(words, PBR):
        words.append(data.draw(st.sampled_from(offered)))
    try:
        parse(" ".join(words)).check(PBR)
    except ConfigError as error:  # each word is right, but this subject is not there, or has fewer bits
        assert any(why in str(error) for why in NOT_TOGETHER)


@given(st.lists(st.text(max_size=12), max_size=6))
def test_any_words_at_all_have_an_answer(words: list[str]) -> None:
    assert isinstance(next_words(words, PBR), list)


@pytest.mark.parametrize("name", NAMES)
def test_every_fault_can_be_begun(name: str) -> None:
    assert next_words([name], PBR), [kind for kind in KINDS if name in kind.NAMES]
