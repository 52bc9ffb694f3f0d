"""LFR: forwarded before it is executed, notified before it is answered; a follower finishes, then leads."""

import hashlib

import pytest
from samples import inspected, notes, sends

from aftbed.core.brick import CONTROL, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    ChannelEnded,
    Notification,
    Promotion,
    Rebound,
    Reply,
    Request,
    StoreReply,
    TakeOver,
)
from aftbed.ftm.lfr import LfrAfter, LfrAfterState, LfrBefore, LfrBeforeState, digest

REQUEST = Request(1, 7, b"what")
REPLY = Reply(1, 7, 1, b"that")
OWN = Reply(1, 7, 2, b"that")
NOTIFICATION = Notification(1, 7, digest(b"that"))
STORED = ("aft2pro", StoreReply(1, 7, b"that"))


def leading_before(*, duplex: bool = True) -> LfrBefore:
    brick = LfrBefore(1, leads=True)
    assert brick.step(CONTROL, Rebound("bfr2bfr", duplex, 1), 0) == []
    return brick


def leading_after(*, duplex: bool = True) -> LfrAfter:
    brick = LfrAfter(1, leads=True)
    assert brick.step(CONTROL, Rebound("aft2aft", duplex, 1), 0) == []
    return brick


def following_before() -> LfrBefore:
    return LfrBefore(1, leads=False)


def following_after() -> LfrAfter:
    return LfrAfter(1, leads=False)


def holding() -> LfrAfter:
    brick = following_after()
    assert brick.step("prd2aft", OWN, 0) == []
    return brick


# -- the leader


def test_a_request_is_forwarded_before_it_is_passed_on() -> None:
    brick = leading_before()
    assert brick.step("pro2bfr", REQUEST, 0) == [
        Send("bfr2bfr", REQUEST),
        Note(Event.FOLLOWER_FORWARDED, 7),
        Note(Event.BEFORE_EXIT, 7),
        Send("bfr2prd", REQUEST),
    ]
    assert brick.open_ports() == ("pro2bfr",) and brick.quiescent()


def test_what_is_forwarded_is_the_very_request() -> None:
    """A host sends on the bytes that it got where the message is the same object."""
    forwarded, *_ = leading_before().step("pro2bfr", REQUEST, 0)
    assert isinstance(forwarded, Send) and forwarded.message is REQUEST


def test_without_a_follower_it_is_passed_on() -> None:
    effects = leading_before(duplex=False).step("pro2bfr", REQUEST, 0)
    assert effects == [Note(Event.BEFORE_EXIT, 7), Send("bfr2prd", REQUEST)]


def test_the_follower_is_notified_before_the_reply_goes_on() -> None:
    brick = leading_after()
    assert brick.step("prd2aft", REPLY, 0) == [
        Send("aft2aft", NOTIFICATION),
        Note(Event.FOLLOWER_NOTIFIED, 7),
        Send("aft2pro", REPLY),
    ]
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()


def test_without_a_follower_the_reply_goes_on() -> None:
    assert leading_after(duplex=False).step("prd2aft", REPLY, 0) == [Send("aft2pro", REPLY)]


def test_the_digest_is_of_the_payload() -> None:
    assert digest(b"that") == hashlib.blake2b(b"that", digest_size=16).digest() != digest(b"this")
    assert len(digest(bytes(60_000))) == 16


def test_only_its_own_channel_to_the_follower_matters() -> None:
    before, after = leading_before(), leading_after()
    before.step(CONTROL, Rebound("bfr2prd", False, 1), 0)
    after.step(CONTROL, Rebound("aft2pro", False, 1), 0)
    assert len(sends(before.step("pro2bfr", REQUEST, 0))) == len(sends(after.step("prd2aft", REPLY, 0))) == 2


# -- the follower


def test_a_follower_takes_what_is_forwarded_and_nothing_else() -> None:
    brick = following_before()
    assert brick.open_ports() == ("bfr2bfr",) and brick.quiescent()
    assert brick.step("bfr2bfr", REQUEST, 0) == [Note(Event.BEFORE_EXIT, 7), Send("bfr2prd", REQUEST)]


@pytest.mark.parametrize("epoch", [0, 2])
def test_what_is_forwarded_under_another_epoch_is_refused(epoch: int) -> None:
    brick = following_before()
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"request 7 under epoch {epoch}, expected 1"):
        brick.step("bfr2bfr", Request(epoch, 7, b"what"), 0)
    assert inspected(brick) == before


def test_its_own_reply_is_held_until_the_client_has_one() -> None:
    brick = following_after()
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()
    assert brick.step("prd2aft", OWN, 0) == []
    assert brick.open_ports() == ("aft2aft",) and not brick.quiescent()
    assert brick.step("aft2aft", NOTIFICATION, 0) == [Send(*STORED)]
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()


def test_a_reply_that_differs_is_reported_and_kept() -> None:
    effects = holding().step("aft2aft", Notification(1, 7, digest(b"this")), 0)
    assert notes(effects) == [Event.FOLLOWER_DIVERGED] and sends(effects) == [STORED]
    assert isinstance(effects[0], Note), "said before it goes on"


@pytest.mark.parametrize("notification", [Notification(1, 6, b""), Notification(2, 7, NOTIFICATION.digest)])
def test_the_notification_of_something_else_is_refused(notification: Notification) -> None:
    brick = holding()
    before = inspected(brick)
    with pytest.raises(PeerError, match=r"notified of request . under epoch ., expected 7 under 1"):
        brick.step("aft2aft", notification, 0)
    assert inspected(brick) == before


def test_when_the_leader_is_gone_what_is_held_and_what_comes_is_stored() -> None:
    brick = holding()
    assert sends(brick.step("aft2aft", ChannelEnded(), 0)) == [STORED]
    assert sends(brick.step("prd2aft", Reply(1, 8, 2, b"more"), 0)) == [
        ("aft2pro", StoreReply(1, 8, b"more"))
    ]
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()


# -- taking over


def test_promoted_it_works_off_what_was_forwarded_before_it_leads() -> None:
    brick = following_before()
    assert brick.step(CONTROL, Promotion(2), 0) == []
    assert brick.open_ports() == ("bfr2bfr",)
    assert [type(m) for _, m in sends(brick.step("bfr2bfr", REQUEST, 0))] == [Request]
    assert brick.step("bfr2bfr", ChannelEnded(), 0) == [Send("bfr2prd", TakeOver(2))]
    assert (brick.state, brick.epoch, brick.open_ports()) == (LfrBeforeState.LEADING, 2, ("pro2bfr",))


def test_the_channel_may_end_before_the_promotion() -> None:
    brick = following_before()
    assert brick.step("bfr2bfr", ChannelEnded(), 0) == []
    assert brick.state is LfrBeforeState.ENDED
    assert brick.step(CONTROL, Promotion(2), 0) == [Send("bfr2prd", TakeOver(2))]


@pytest.mark.parametrize("epoch", [0, 1])
def test_a_promotion_to_an_epoch_that_does_not_grow_is_refused(epoch: int) -> None:
    brick = following_before()
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"promoted to epoch {epoch} while FOLLOWING in epoch 1"):
        brick.step(CONTROL, Promotion(epoch), 0)
    assert inspected(brick) == before


def test_who_leads_is_not_promoted() -> None:
    brick = leading_before()
    with pytest.raises(PeerError, match="Promotion on control while LEADING"):
        brick.step(CONTROL, Promotion(2), 0)


def test_after_leads_behind_all_replies_and_says_so() -> None:
    brick = holding()
    with pytest.raises(PeerError, match="TakeOver on prd2aft while HOLDING"):
        brick.step("prd2aft", TakeOver(2), 0)
    brick.step("aft2aft", NOTIFICATION, 0)
    assert brick.step("prd2aft", TakeOver(2), 0) == [Send("aft2pro", TakeOver(2))]
    assert (brick.state, brick.epoch) == (LfrAfterState.LEADING, 2)
    reply = Reply(2, 8, 2, b"more")
    assert brick.step("prd2aft", reply, 0) == [Send("aft2pro", reply)], "held no more"


@pytest.mark.parametrize("epoch", [0, 1])
def test_a_take_over_under_an_epoch_that_does_not_grow_is_refused(epoch: int) -> None:
    brick = following_after()
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"take over under epoch {epoch} after 1"):
        brick.step("prd2aft", TakeOver(epoch), 0)
    assert inspected(brick) == before


def test_who_took_over_serves_alone_until_it_is_given_a_follower() -> None:
    before, after = following_before(), following_after()
    before.step(CONTROL, Rebound("bfr2bfr", True, 1), 0)  # of their time as followers: it counts no more
    after.step(CONTROL, Rebound("aft2aft", True, 1), 0)
    before.step("bfr2bfr", ChannelEnded(), 0)
    before.step(CONTROL, Promotion(2), 0)
    after.step("prd2aft", TakeOver(2), 0)
    request, reply = Request(2, 8, b"what"), Reply(2, 8, 2, b"more")
    assert sends(before.step("pro2bfr", request, 0)) == [("bfr2prd", request)]
    assert sends(after.step("prd2aft", reply, 0)) == [("aft2pro", reply)]
    before.step(CONTROL, Rebound("bfr2bfr", True, 2), 0)
    after.step(CONTROL, Rebound("aft2aft", True, 2), 0)
    assert sends(before.step("pro2bfr", request, 0))[0] == ("bfr2bfr", request)
    assert sends(after.step("prd2aft", reply, 0))[0] == ("aft2aft", Notification(2, 8, digest(b"more")))
