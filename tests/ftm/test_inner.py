"""What stands in the place of an outer Proceed: an entry that is an exit too, and a TakeOver that queues."""

import pytest
from samples import inspected, notes, sends

from aftbed.core.errors import PeerError
from aftbed.core.messages import Reply, Request, TakeOver
from aftbed.ftm.chain import Compute, InnerProtocol, PassBefore

REQUEST = Request(1, 7, b"what")
REPLY = Reply(1, 7, 1, b"that")


def busy() -> InnerProtocol:
    brick = InnerProtocol()
    brick.step("pxy2pro", REQUEST, 0)
    return brick


def handing_on() -> InnerProtocol:
    brick = InnerProtocol()
    brick.step("pxy2pro", TakeOver(2), 0)
    return brick


def test_a_request_goes_in_and_its_reply_comes_out() -> None:
    brick = InnerProtocol()
    assert brick.open_ports() == ("pxy2pro",) and brick.quiescent()
    effects = brick.step("pxy2pro", REQUEST, 0)
    assert sends(effects) == [("pro2bfr", REQUEST)] and notes(effects) == [], "the outer Protocol said it all"
    assert brick.open_ports() == ("aft2pro",) and not brick.quiescent()
    assert sends(brick.step("aft2pro", REPLY, 0)) == [("pro2pxy", REPLY)]
    assert brick.open_ports() == ("pxy2pro",) and brick.quiescent()


def test_the_same_request_may_come_again() -> None:
    """It keeps no log: what may be asked again is answered by the outer Protocol."""
    brick = busy()
    brick.step("aft2pro", REPLY, 0)
    assert sends(brick.step("pxy2pro", REQUEST, 0)) == [("pro2bfr", REQUEST)]


def test_it_serves_under_any_epoch() -> None:
    brick = busy()
    brick.step("aft2pro", REPLY, 0)
    later = Request(5, 8, b"what")
    assert sends(brick.step("pxy2pro", later, 0)) == [("pro2bfr", later)]


def test_a_reply_to_another_request_is_refused() -> None:
    brick = busy()
    before = inspected(brick)
    with pytest.raises(PeerError, match="reply to request 6, expected 7"):
        brick.step("aft2pro", Reply(1, 6, 1, b"that"), 0)
    assert inspected(brick) == before


def test_a_take_over_goes_through_like_a_request_and_nothing_beside_it() -> None:
    brick = InnerProtocol()
    assert sends(brick.step("pxy2pro", TakeOver(2), 0)) == [("pro2bfr", TakeOver(2))]
    assert brick.open_ports() == ("aft2pro",) and not brick.quiescent()
    assert sends(brick.step("aft2pro", TakeOver(2), 0)) == [("pro2pxy", TakeOver(2))]
    assert brick.open_ports() == ("pxy2pro",) and brick.quiescent()


def test_a_take_over_waits_while_a_request_is_inside() -> None:
    brick = busy()
    assert "pxy2pro" not in brick.open_ports()
    with pytest.raises(PeerError, match="TakeOver on pxy2pro while BUSY"):
        brick.step("pxy2pro", TakeOver(2), 0)


def test_another_take_over_than_the_one_inside_is_refused() -> None:
    brick = handing_on()
    before = inspected(brick)
    with pytest.raises(PeerError, match="take over under epoch 3, expected 2"):
        brick.step("aft2pro", TakeOver(3), 0)
    assert inspected(brick) == before


def test_the_simplest_bricks_hand_it_on() -> None:
    assert sends(PassBefore().step("pro2bfr", TakeOver(2), 0)) == [("bfr2prd", TakeOver(2))]
    proceed = Compute()
    assert sends(proceed.step("bfr2prd", TakeOver(2), 0)) == [("prd2aft", TakeOver(2))]
    assert proceed.open_ports() == ("bfr2prd",) and proceed.quiescent()
    proceed.step("bfr2prd", REQUEST, 0)
    with pytest.raises(PeerError, match="TakeOver on bfr2prd while COMPUTING"):
        proceed.step("bfr2prd", TakeOver(2), 0)
