"""The function with ballast: its state has the size in its name, and is all that it is."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench import ballast
from aftbed.core.application import Application
from aftbed.core.errors import ConfigError, PeerError
from aftbed.functions.load import OWN_CODE, load_application


def made(size_bytes: int, version: int = 1) -> Application:
    """As an update loads it."""
    return load_application(ballast.source_of(size_bytes, version), OWN_CODE)()


@pytest.mark.parametrize("size_bytes", [ballast.SIZE_BYTES_MIN, 100, 60_000, 10_000_000])
def test_the_state_has_the_size_that_was_asked_for(size_bytes: int) -> None:
    function = made(size_bytes)
    function.execute(b"request")
    assert len(function.capture()) == size_bytes


@given(st.lists(st.binary(max_size=40), max_size=5), st.binary(max_size=40))
def test_a_restored_one_goes_on_as_the_other(before: list[bytes], after: bytes) -> None:
    one, other = made(100), made(100)
    for request in before:
        one.execute(request)
    other.restore(one.capture())
    assert one.execute(after) == other.execute(after)
    assert one.capture() == other.capture()


def test_a_request_changes_the_state_and_the_next_reply() -> None:
    function = made(100)
    fresh = function.capture()
    first, second = function.execute(b"r"), function.execute(b"r")
    assert first != second and function.capture() != fresh
    assert function.acceptable(b"r", first) and not function.acceptable(b"r", b"")


@given(st.binary(max_size=200).filter(lambda state: len(state) != 100))
def test_a_state_of_another_size_is_refused_and_changes_nothing(state: bytes) -> None:
    function = made(100)
    before = function.capture()
    with pytest.raises(PeerError, match=f"state of {len(state)} bytes, expected 100"):
        function.restore(state)
    assert function.capture() == before


def test_the_next_version_takes_the_state_over_and_another_size_begins_anew() -> None:
    old = made(100, 1)
    old.execute(b"r")
    new, larger = made(100, 2), made(200)
    for taker in (new, larger):
        taker.migrate(old.capture())  # type: ignore[attr-defined]
    assert new.capture() == old.capture()
    assert larger.capture() == bytes(200)


@pytest.mark.parametrize("name", ["Ballast7v1", "Ballast100", "Ballast100v3", "Ballast99999999v1", "Stone"])
def test_what_is_no_size_is_no_class(name: str) -> None:
    with pytest.raises(ConfigError, match=f"has no class {name}"):
        load_application(f"aftbed.bench.ballast:{name}", OWN_CODE)
