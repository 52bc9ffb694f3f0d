"""Protocol: at most once, one request at a time, and a log that answers what was answered before."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import inspected, notes, sends

from aftbed.core.brick import CONTROL
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import Promoted, Reply, Request, StoreReply, TakeOver
from aftbed.ftm.chain import REPLIES_KEPT, Protocol, ProtocolState
from aftbed.ftm.client import BACKLOG_MAX


def leader(answered: int = 0) -> Protocol:
    """A leader under epoch 1 that has answered requests 1, 2, ..., `answered`."""
    brick = Protocol(1, 1, leads=True)
    for number in range(1, answered + 1):
        brick.step("pxy2pro", request(number), 0)
        brick.step("aft2pro", reply(number), 0)
    return brick


def request(number: int, epoch: int = 1) -> Request:
    return Request(epoch, number, b"request %d" % number)


def reply(number: int) -> Reply:
    return Reply(1, number, 1, b"reply %d" % number)


def test_a_new_request_is_admitted_and_passed_on() -> None:
    effects = leader().step("pxy2pro", request(1), 0)
    assert sends(effects) == [("pro2bfr", request(1))]
    assert notes(effects) == [Event.REQUEST_RECEIVED]


def test_while_one_is_inside_the_others_wait_in_their_channel() -> None:
    brick = leader()
    assert brick.open_ports() == ("pxy2pro",) and brick.quiescent()
    brick.step("pxy2pro", request(1), 0)
    assert brick.open_ports() == ("aft2pro",) and not brick.quiescent()
    brick.step("aft2pro", reply(1), 0)
    assert brick.open_ports() == ("pxy2pro",) and brick.quiescent()


def test_the_reply_is_stored_before_it_is_sent() -> None:
    brick = leader()
    brick.step("pxy2pro", request(1), 0)
    effects = brick.step("aft2pro", reply(1), 0)
    assert [type(e).__name__ for e in effects] == ["Note", "Send", "Note"]
    assert notes(effects) == [Event.REPLY_STORED, Event.REPLY_SENT]
    assert sends(effects) == [("pro2pxy", reply(1))]


def test_an_admitted_request_is_a_duplicate_before_its_reply_is_stored() -> None:
    brick = leader()
    brick.step("pxy2pro", request(1), 0)
    assert "pxy2pro" not in brick.open_ports()
    with pytest.raises(PeerError, match="Request on pxy2pro while BUSY"):
        brick.step("pxy2pro", request(1), 0)


def test_a_duplicate_is_answered_out_of_the_log_and_goes_no_further() -> None:
    brick = leader(answered=3)
    effects = brick.step("pxy2pro", request(2), 0)
    assert sends(effects) == [("pro2pxy", Reply(1, 2, 1, b"reply 2"))]
    assert notes(effects) == [Event.DEDUPE_HIT]
    assert brick.state is ProtocolState.IDLE


def test_the_log_is_bounded_and_what_is_older_is_refused() -> None:
    brick = leader(answered=REPLIES_KEPT + 1)
    assert len(brick.log) == REPLIES_KEPT
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"request 1 is older than the {REPLIES_KEPT} replies kept"):
        brick.step("pxy2pro", request(1), 0)
    assert inspected(brick) == before
    assert sends(brick.step("pxy2pro", request(2), 0)) == [("pro2pxy", reply(2))]


def test_what_can_be_asked_again_can_be_answered_again() -> None:
    assert REPLIES_KEPT >= BACKLOG_MAX


@pytest.mark.parametrize("epoch", [0, 2])
def test_a_request_of_another_epoch_is_refused(epoch: int) -> None:
    brick = leader(answered=1)
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"request 2 under epoch {epoch}, expected 1"):
        brick.step("pxy2pro", request(2, epoch), 0)
    assert inspected(brick) == before


def test_a_reply_to_another_request_is_refused() -> None:
    brick = leader()
    brick.step("pxy2pro", request(1), 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="reply to request 2, expected 1"):
        brick.step("aft2pro", reply(2), 0)
    assert inspected(brick) == before


def test_a_backup_takes_no_requests_and_fills_its_log() -> None:
    brick = Protocol(2, 1, leads=False)
    assert brick.open_ports() == ("aft2pro",)
    assert brick.step("aft2pro", StoreReply(1, 1, b"reply 1"), 0) == []
    assert brick.log == {1: b"reply 1"}


def test_what_took_over_leads_under_the_new_epoch_and_answers_for_its_predecessor() -> None:
    brick = Protocol(2, 1, leads=False)
    brick.step("aft2pro", StoreReply(1, 1, b"reply 1"), 0)
    effects = brick.step("aft2pro", TakeOver(2), 0)
    assert sends(effects) == [(CONTROL, Promoted(2))]
    assert notes(effects) == [Event.REPLICA_PROMOTED]
    assert brick.open_ports() == ("pxy2pro",)
    assert sends(brick.step("pxy2pro", request(1, epoch=2), 0)) == [("pro2pxy", Reply(2, 1, 2, b"reply 1"))]
    with pytest.raises(PeerError, match="under epoch 1, expected 2"):
        brick.step("pxy2pro", request(2, epoch=1), 0)


@pytest.mark.parametrize("epoch", [0, 1])
def test_a_take_over_under_an_epoch_that_does_not_grow_is_refused(epoch: int) -> None:
    brick = Protocol(2, 1, leads=False)
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"epoch {epoch} after 1"):
        brick.step("aft2pro", TakeOver(epoch), 0)
    assert inspected(brick) == before


def test_replies_grow_by_id_or_the_node_ends() -> None:
    brick = Protocol(2, 1, leads=False)
    brick.step("aft2pro", StoreReply(1, 2, b"reply 2"), 0)
    with pytest.raises(AssertionError, match="reply 2 stored after 2"):
        brick.step("aft2pro", StoreReply(1, 2, b"reply 2"), 0)


def test_the_log_goes_over_to_a_new_backup() -> None:
    old, new = leader(answered=REPLIES_KEPT + 7), Protocol(2, 1, leads=False)
    new.restore(old.capture())
    assert new.capture() == old.capture()
    assert (new.log, new.last_id) == (old.log, old.last_id)


@pytest.mark.parametrize(
    "items",
    [[(2, b"b"), (1, b"a")], [(1, b"a"), (1, b"a")], [(i, b"") for i in range(REPLIES_KEPT + 1)]],
)
def test_a_log_out_of_order_or_too_long_is_refused(items: list[tuple[int, bytes]]) -> None:
    brick = Protocol(2, 1, leads=False)
    before = inspected(brick)
    with pytest.raises(PeerError, match="a reply log of"):
        brick.restore(msgspec.msgpack.encode((items[-1][0], items)))
    assert inspected(brick) == before


def test_a_log_with_a_reply_newer_than_its_last_is_refused() -> None:
    brick = Protocol(2, 1, leads=False)
    before = inspected(brick)
    with pytest.raises(PeerError, match="a reply log of"):
        brick.restore(msgspec.msgpack.encode((1, [(5, b"reply 5")])))
    assert inspected(brick) == before


@given(st.binary(max_size=64))
def test_bytes_that_are_no_log_are_refused(data: bytes) -> None:
    brick = Protocol(2, 1, leads=False)
    before = inspected(brick)
    try:
        brick.restore(data)
    except PeerError:
        assert inspected(brick) == before
