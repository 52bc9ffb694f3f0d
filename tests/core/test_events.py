"""Events: one closed enumeration, found by code in a journal and by name in the words of a user."""

import pytest
from requestpath import REQUEST_PATH

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import BY_CODE, BY_LABEL, Event, event_named


def test_a_code_fits_into_a_record_and_is_not_that_of_no_record() -> None:
    assert 0 not in BY_CODE
    assert all(code < 2**32 for code in BY_CODE)


def test_each_event_has_its_own_code() -> None:
    assert sorted(BY_CODE) == sorted(event.code for event in Event)


def test_each_event_has_its_own_name() -> None:
    assert len(BY_LABEL) == len(Event)
    assert all(event_named(str(event)) is event for event in Event)


def test_the_request_path_is_the_designs() -> None:
    assert [str(event) for event in REQUEST_PATH] == [
        "request.sent",
        "request.received",
        "before.exit",
        "proceed.enter",
        "server.enter",
        "server.exit",
        "state.captured",
        "checkpoint.sent",
        "reply.stored",
        "reply.sent",
        "reply.delivered",
    ]


def test_an_unknown_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(
        ConfigError, match=r"unknown event 'checkpoint.send'; did you mean 'checkpoint.sent'\?"
    ):
        event_named("checkpoint.send")


def test_an_unknown_name_without_a_near_one_lists_what_exists() -> None:
    message = str(unknown("colour", "xyzzy", ["red", "blue"]))
    assert message == "unknown colour 'xyzzy' (one of: blue, red)"
