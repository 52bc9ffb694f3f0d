"""Before, Proceed, Server: a request goes through once, and its result comes back."""

import pytest
from counting import Counting
from samples import STATE, inspected, notes, sends

from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import CaptureState, Reply, Request, RestoreState, StateCaptured, StateRestored
from aftbed.ftm.before import PassBefore
from aftbed.ftm.engine import AdaptationEngine
from aftbed.ftm.proceed import Compute
from aftbed.ftm.server import Server

REQUEST = Request(2, 7, b"what")


def leader() -> Server:
    return Server(Counting(), 1, leads=True, captured=True)


def backup() -> Server:
    return Server(Counting(), 2, leads=False, captured=True)


def answer(count: int) -> bytes:
    """The reply of the bare application to its `count`th request."""
    bare = Counting()
    return [bare.execute(b"what") for _ in range(count)][-1]


def test_before_passes_the_very_request_on() -> None:
    brick = PassBefore()
    effects = brick.step("pro2bfr", REQUEST, 0)
    assert sends(effects) == [("bfr2prd", REQUEST)] and notes(effects) == [Event.BEFORE_EXIT]
    assert brick.open_ports() == ("pro2bfr",) and brick.quiescent()


def test_proceed_has_it_computed_and_hands_the_result_to_after() -> None:
    brick = Compute()
    effects = brick.step("bfr2prd", REQUEST, 0)
    assert sends(effects) == [("prd2srv", REQUEST)] and notes(effects) == [Event.PROCEED_ENTER]
    assert brick.open_ports() == ("srv2prd",) and not brick.quiescent()
    reply = Reply(2, 7, 1, b"that")
    assert sends(brick.step("srv2prd", reply, 0)) == [("prd2aft", reply)]
    assert brick.open_ports() == ("bfr2prd",) and brick.quiescent()


def test_the_server_executes_and_marks_whose_reply_it_is() -> None:
    effects = leader().step("prd2srv", REQUEST, 0)
    assert sends(effects) == [("srv2prd", Reply(2, 7, 1, answer(1)))]
    assert notes(effects) == [Event.SERVER_ENTER, Event.SERVER_EXIT]


def test_a_request_that_the_function_refuses_is_answered_with_nothing() -> None:
    brick = leader()
    state = brick.capture()
    effects = brick.step("prd2srv", Request(2, 7, b""), 0)
    assert sends(effects) == [("srv2prd", Reply(2, 7, 1, b""))]
    assert notes(effects) == [Event.SERVER_ENTER, Event.SERVER_EXIT]
    assert sends(brick.step("aft2srv", CaptureState(2, 7), 0)) == [("srv2aft", StateCaptured(2, 7, state))]
    assert sends(brick.step("prd2srv", REQUEST, 0)) == [("srv2prd", Reply(2, 7, 1, answer(1)))]


def test_the_state_is_captured_after_exactly_the_request() -> None:
    brick = leader()
    brick.step("prd2srv", REQUEST, 0)
    assert brick.open_ports() == ("aft2srv",) and not brick.quiescent()
    effects = brick.step("aft2srv", CaptureState(2, 7), 0)
    assert sends(effects) == [("srv2aft", StateCaptured(2, 7, brick.capture()))]
    assert notes(effects) == [Event.STATE_CAPTURED]
    assert brick.open_ports() == ("prd2srv",) and brick.quiescent()


def test_a_bare_server_is_asked_for_no_state() -> None:
    brick = Server(Counting(), 1, leads=True, captured=False)
    for count in (1, 2):
        assert sends(brick.step("prd2srv", REQUEST, 0)) == [("srv2prd", Reply(2, 7, 1, answer(count)))]


def test_a_backup_restores_and_leads_from_there() -> None:
    old, new = leader(), backup()
    old.step("prd2srv", REQUEST, 0)
    effects = new.step("aft2srv", RestoreState(2, 7, old.capture()), 0)
    assert sends(effects) == [("srv2aft", StateRestored(2, 7))] and notes(effects) == [Event.STATE_RESTORED]
    assert sends(new.step("prd2srv", REQUEST, 0)) == [("srv2prd", Reply(2, 7, 2, answer(2)))]


def test_a_state_that_is_none_is_refused() -> None:
    brick = backup()
    brick.restore(STATE)
    before = inspected(brick)
    for data in (b"", b"\xc1", STATE + b"x"):
        with pytest.raises(PeerError, match="not a state"):
            brick.step("aft2srv", RestoreState(1, 1, data), 0)
        with pytest.raises(PeerError, match="not a state"):
            brick.restore(data)
        assert inspected(brick) == before


def test_state_goes_over_to_a_new_backup() -> None:
    old, new = leader(), backup()
    old.step("prd2srv", REQUEST, 0)
    new.restore(old.capture())
    assert new.capture() == old.capture()


@pytest.mark.parametrize(
    "brick", [PassBefore(), Compute(), AdaptationEngine()], ids=lambda b: type(b).__name__
)
def test_a_brick_without_state_restores_nothing_else(brick: PassBefore | Compute | AdaptationEngine) -> None:
    assert brick.capture() == b""
    brick.restore(b"")
    with pytest.raises(PeerError, match=f"{type(brick).__name__} has no state to restore, given 1 bytes"):
        brick.restore(b"x")


def test_a_brick_without_a_deadline_is_not_woken() -> None:
    assert Compute().deadline_ns() is None
    with pytest.raises(AssertionError, match="Compute has no deadline"):
        Compute().wake(1)
