"""Proxy: one way in, one master, one answer."""

import pytest
from samples import inspected, notes, sends

from aftbed.core.brick import CONTROL
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import Rebound, Reply, Request
from aftbed.ftm.client import Proxy


def bound(epoch: int = 1) -> Proxy:
    brick = Proxy()
    assert brick.step(CONTROL, Rebound("pxy2pro", True, epoch), 0) == []
    return brick


def waiting(number: int = 1, epoch: int = 1) -> Proxy:
    brick = bound(epoch)
    brick.step("clt2pxy", Request(0, number, b"what"), 0)
    return brick


def test_without_a_leader_requests_wait_in_their_channel() -> None:
    assert "clt2pxy" not in Proxy().open_ports()


def test_a_request_is_passed_on_under_the_epoch_of_the_leader() -> None:
    effects = bound(epoch=3).step("clt2pxy", Request(0, 1, b"what"), 0)
    assert sends(effects) == [("pxy2pro", Request(3, 1, b"what"))]


def test_one_request_is_under_way_the_others_wait_in_their_channel() -> None:
    brick = waiting()
    assert brick.open_ports() == ("pro2pxy",) and not brick.quiescent()
    brick.step("pro2pxy", Reply(1, 1, 1, b"that"), 0)
    assert "clt2pxy" in brick.open_ports() and brick.quiescent()


def test_a_reply_is_accepted_and_names_its_replica() -> None:
    effects = waiting(epoch=3).step("pro2pxy", Reply(3, 1, 2, b"that"), 0)
    assert sends(effects) == [("pxy2clt", Reply(3, 1, 2, b"that"))]
    assert notes(effects) == [Event.REPLY_ACCEPTED]
    assert effects[0].detail == 3 << 8 | 2  # type: ignore[union-attr]


@pytest.mark.parametrize("epoch", [1, 3])
def test_a_reply_of_another_epoch_is_refused_whoever_sent_it(epoch: int) -> None:
    brick = waiting(epoch=2)
    before = inspected(brick)
    effects = brick.step("pro2pxy", Reply(epoch, 1, 1, b"that"), 0)
    assert sends(effects) == [] and notes(effects) == [Event.REPLY_REFUSED]
    assert inspected(brick) == before


def test_a_reply_that_was_given_before_is_swallowed() -> None:
    brick = waiting(number=2)
    before = inspected(brick)
    assert brick.step("pro2pxy", Reply(1, 1, 1, b"that"), 0) == []
    assert inspected(brick) == before


def test_a_new_leader_is_asked_what_is_unanswered_under_its_epoch() -> None:
    brick = waiting()
    effects = brick.step(CONTROL, Rebound("pxy2pro", True, 2), 0)
    assert sends(effects) == [("pxy2pro", Request(2, 1, b"what"))]
    assert brick.step("pro2pxy", Reply(1, 1, 1, b"of the old one"), 0)[0].event is Event.REPLY_REFUSED  # type: ignore[union-attr]
    assert len(sends(brick.step("pro2pxy", Reply(2, 1, 2, b"of the new one"), 0))) == 1


def test_what_is_unanswered_survives_a_time_without_a_leader() -> None:
    brick = waiting()
    assert brick.step(CONTROL, Rebound("pxy2pro", False, 1), 0) == []
    assert "clt2pxy" not in brick.open_ports() and not brick.quiescent()
    effects = brick.step(CONTROL, Rebound("pxy2pro", True, 2), 0)
    assert sends(effects) == [("pxy2pro", Request(2, 1, b"what"))]


def test_a_new_channel_to_the_same_leader_is_asked_again() -> None:
    """The Protocol was not replaced: it knows the request, and answers once or out of its log."""
    effects = waiting().step(CONTROL, Rebound("pxy2pro", True, 1), 0)
    assert sends(effects) == [("pxy2pro", Request(1, 1, b"what"))]


def test_an_older_epoch_than_the_present_one_is_refused() -> None:
    brick = waiting(epoch=2)
    before = inspected(brick)
    with pytest.raises(PeerError, match="bound under epoch 1 after 2"):
        brick.step(CONTROL, Rebound("pxy2pro", True, 1), 0)
    assert inspected(brick) == before


def test_a_new_way_to_the_client_changes_nothing() -> None:
    brick = waiting()
    before = inspected(brick)
    assert brick.step(CONTROL, Rebound("pxy2clt", True, 1), 0) == []
    assert inspected(brick) == before
