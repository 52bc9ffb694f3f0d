"""Client: ids 1, 2, 3, ..., asked again in their order, each answered once."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import inspected, notes, sends

from aftbed.core.brick import CONTROL
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import HoldAt, Rebound, Release, Reply, Request, RequestHeld, Submit
from aftbed.ftm.client import BACKLOG_MAX, Client


def client(submitted: int = 0) -> Client:
    brick = Client()
    for number in range(1, submitted + 1):
        brick.step("submit", Submit(b"%d" % number), 0)
    return brick


def test_requests_are_numbered_from_1_on() -> None:
    brick = Client()
    for number in (1, 2, 3):
        effects = brick.step("submit", Submit(b"what"), 0)
        assert sends(effects) == [("clt2pxy", Request(0, number, b"what"))]
        assert notes(effects) == [Event.REQUEST_SENT]


def test_a_reply_is_delivered() -> None:
    effects = client(1).step("pxy2clt", Reply(1, 1, 2, b"that"), 0)
    assert sends(effects) == [("deliver", Reply(1, 1, 2, b"that"))]
    assert notes(effects) == [Event.REPLY_DELIVERED]


@pytest.mark.parametrize("number", [1, 3])
def test_a_reply_to_nothing_or_a_second_one_is_refused(number: int) -> None:
    brick = client(2)
    brick.step("pxy2clt", Reply(1, 1, 1, b"that"), 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"reply to request {number}, which is not unanswered"):
        brick.step("pxy2clt", Reply(1, number, 1, b"that"), 0)
    assert inspected(brick) == before


def test_a_full_backlog_closes_the_port_until_an_answer_comes() -> None:
    brick = client(BACKLOG_MAX - 1)
    assert "submit" in brick.open_ports()
    brick.step("submit", Submit(b"what"), 0)
    assert brick.open_ports() == ("pxy2clt",)
    brick.step("pxy2clt", Reply(1, 1, 1, b"that"), 0)
    assert "submit" in brick.open_ports()


def test_a_client_with_a_full_backlog_refuses_one_more() -> None:
    brick = client(BACKLOG_MAX)
    before = inspected(brick)
    with pytest.raises(PeerError, match="Submit on submit"):
        brick.step("submit", Submit(b"what"), 0)
    assert inspected(brick) == before


def test_a_new_proxy_is_asked_what_is_unanswered_in_the_order_of_ids() -> None:
    brick = client(5)
    for number in (4, 2):
        brick.step("pxy2clt", Reply(1, number, 1, b"that"), 0)
    effects = brick.step(CONTROL, Rebound("clt2pxy", True, 1), 0)
    assert sends(effects) == [("clt2pxy", Request(0, n, b"%d" % n)) for n in (1, 3, 5)]
    assert notes(effects) == [], "asked again is not sent anew"


def test_another_client_goes_on_where_one_ended() -> None:
    old, new = client(3), Client()
    old.step("pxy2clt", Reply(1, 2, 1, b"that"), 0)
    new.restore(old.capture())
    assert inspected(new) == inspected(old)
    assert new.step("submit", Submit(b"next"), 0) == old.step("submit", Submit(b"next"), 0)


@given(st.binary(max_size=64))
def test_bytes_that_are_no_state_are_refused(data: bytes) -> None:
    brick = client(2)
    before = inspected(brick)
    try:
        brick.restore(data)
    except PeerError:
        assert inspected(brick) == before


def test_a_request_at_which_it_is_to_hold_is_reported_and_sent_when_released() -> None:
    brick = client(1)
    assert brick.step(CONTROL, HoldAt((2, 5)), 0) == []
    effects = brick.step("submit", Submit(b"2"), 0)
    assert sends(effects) == [(CONTROL, RequestHeld(2))] and notes(effects) == [Event.REQUEST_SENT]
    assert "submit" not in brick.open_ports() and not brick.quiescent()
    assert brick.step(CONTROL, Release(1), 0) == []
    assert sends(brick.step(CONTROL, Release(2), 0)) == [("clt2pxy", Request(0, 2, b"2"))]
    assert brick.step(CONTROL, Release(2), 0) == []
    assert sends(brick.step("submit", Submit(b"3"), 0)) == [("clt2pxy", Request(0, 3, b"3"))]


def test_a_held_request_is_not_sent_to_a_new_proxy() -> None:
    brick = client(1)
    brick.step(CONTROL, HoldAt((2,)), 0)
    brick.step("submit", Submit(b"2"), 0)
    assert sends(brick.step(CONTROL, Rebound("clt2pxy", True, 1), 0)) == [("clt2pxy", Request(0, 1, b"1"))]


def test_requests_that_a_predecessor_has_come_to_are_reported_at_once() -> None:
    brick = client(3)
    effects = brick.step(CONTROL, HoldAt((2, 4, 9)), 0)
    assert sends(effects) == [(CONTROL, RequestHeld(2))]
    assert sends(brick.step("submit", Submit(b"4"), 0)) == [(CONTROL, RequestHeld(4))], "the next one is held"
