"""The executable assertion: what cannot be right does not leave."""

import pytest
from counting import Counting
from samples import inspected, notes, sends

from aftbed.core.brick import Halt, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import Reply, Request, TakeOver
from aftbed.ftm.assertion import AssertAfter, AssertBefore

REQUEST = Request(2, 7, b"what")
SOUND = Reply(2, 7, 1, b"1:0123abcd")


def holding(reply: Reply = SOUND) -> AssertAfter:
    brick = AssertAfter(Counting().acceptable)
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()
    assert brick.step("prd2aft", reply, 0) == []
    assert brick.open_ports() == ("bfr2aft",) and not brick.quiescent()
    return brick


def test_after_gets_the_request_before_it_is_computed() -> None:
    brick = AssertBefore()
    effects = brick.step("pro2bfr", REQUEST, 0)
    assert sends(effects) == [("bfr2aft", REQUEST), ("bfr2prd", REQUEST)]
    assert notes(effects) == [Event.BEFORE_EXIT]
    assert brick.open_ports() == ("pro2bfr",) and brick.quiescent()


def test_an_acceptable_reply_goes_on() -> None:
    brick = holding()
    assert brick.step("bfr2aft", REQUEST, 0) == [Send("aft2pro", SOUND)]
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()


def test_one_that_is_not_stops_the_replica() -> None:
    assert holding(Reply(2, 7, 1, b"1:0123abc")).step("bfr2aft", REQUEST, 0) == [
        Note(Event.DETECTED_STOP, 7),
        Halt("reply to request 7 is not acceptable"),
    ]


def test_the_check_is_asked_with_the_request_and_the_reply() -> None:
    asked = []

    def acceptable(request: bytes, reply: bytes) -> bool:
        asked.append((request, reply))
        return True

    brick = AssertAfter(acceptable)
    brick.step("prd2aft", SOUND, 0)
    brick.step("bfr2aft", REQUEST, 0)
    assert asked == [(b"what", b"1:0123abcd")]


def test_an_empty_reply_says_that_the_request_was_refused_and_goes_on() -> None:
    refused = Reply(2, 7, 1, b"")
    assert holding(refused).step("bfr2aft", REQUEST, 0) == [Send("aft2pro", refused)]


def test_another_request_than_the_replys_is_refused() -> None:
    brick = holding()
    before = inspected(brick)
    with pytest.raises(PeerError, match="request 6 beside the reply to 7"):
        brick.step("bfr2aft", Request(2, 6, b"what"), 0)
    assert inspected(brick) == before


def test_a_take_over_goes_one_way_behind_the_replies() -> None:
    assert sends(AssertBefore().step("pro2bfr", TakeOver(2), 0)) == [("bfr2prd", TakeOver(2))]
    brick = AssertAfter(Counting().acceptable)
    assert sends(brick.step("prd2aft", TakeOver(2), 0)) == [("aft2pro", TakeOver(2))]
    with pytest.raises(PeerError, match="TakeOver on prd2aft while HOLDING"):
        holding().step("prd2aft", TakeOver(2), 0)
