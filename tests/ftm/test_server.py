"""Before, Proceed, Server: a request goes through once, and its result comes back."""

import pytest
from counting import Counting
from samples import STATE, inspected, notes, sends

from aftbed.core.brick import CONTROL, Effect, Halt, Note
from aftbed.core.errors import PeerError
from aftbed.core.events import RERUN, Event
from aftbed.core.messages import (
    CaptureState,
    Pages,
    Rebound,
    Reply,
    Request,
    RestoreState,
    StateCaptured,
    StateRestored,
    Trial,
    Tried,
)
from aftbed.ftm.chain import Compute, PassBefore
from aftbed.ftm.server import Server, ServerState

REQUEST = Request(2, 7, b"what")


def bound(*outputs: str, replica: int = 1) -> Server:
    """A Server whose outputs lead to Proceed, and to these."""
    brick = Server(Counting(), replica)
    for port in ("srv2prd", *outputs):
        assert brick.step(CONTROL, Rebound(port, True, 2), 0) == []
    return brick


def leader() -> Server:
    """Under pbr: After captures."""
    return bound("srv2aft")


def backup() -> Server:
    return bound("srv2aft", replica=2)


def trial(state: bytes, *, rerun: bool, number: int = 7) -> Trial:
    return Trial(2, number, b"what", state, rerun)


def details(effects: list[Effect]) -> list[int]:
    return [e.detail for e in effects if isinstance(e, Note)]


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


def test_a_server_whose_state_no_brick_captures_is_open_for_requests() -> None:
    brick = bound()
    for count in (1, 2):
        assert brick.open_ports() == ("prd2srv",) and brick.quiescent()
        assert sends(brick.step("prd2srv", REQUEST, 0)) == [("srv2prd", Reply(2, 7, 1, answer(count)))]


def test_a_backup_restores_and_leads_from_there() -> None:
    old, new = leader(), backup()
    old.step("prd2srv", REQUEST, 0)
    effects = new.step("aft2srv", RestoreState(2, 7, old.capture()), 0)
    assert sends(effects) == [("srv2aft", StateRestored(2, 7))] and notes(effects) == [Event.STATE_RESTORED]
    assert sends(new.step("prd2srv", REQUEST, 0)) == [("srv2prd", Reply(2, 7, 2, answer(2)))]


def test_a_checkpoint_whose_state_is_none_ends_the_backup() -> None:
    """It can follow no further: whoever is silent is replaced, whoever waits for an answer is not."""
    for data in (b"", b"\xc1", STATE + b"x"):
        effects = backup().step("aft2srv", RestoreState(1, 7, data), 0)
        assert notes(effects) == [Event.DETECTED_STOP] and sends(effects) == []
        assert isinstance(effects[-1], Halt)
        assert effects[-1].reason.startswith("the state after request 7 is refused: not a state")


def test_a_state_that_is_none_is_refused() -> None:
    brick = backup()
    brick.restore(STATE)
    before = inspected(brick)
    for data in (b"", b"\xc1", STATE + b"x"):
        with pytest.raises(PeerError, match="not a state"):
            brick.restore(data)
        assert inspected(brick) == before


# -- a large state


class Large(Counting):
    """Its state is four pages of 16 bytes; the count is in the first of them."""

    def capture(self) -> bytes:
        state = super().capture()
        return bytes([len(state), *state]).ljust(64, b"\0")

    def restore(self, state: bytes) -> None:
        super().restore(state[1 : 1 + state[0]])


def large(replica: int) -> Server:
    brick = Server(Large(), replica, page_bytes=16)
    brick.step(CONTROL, Rebound("srv2aft", True, 2), 0)
    return brick


def checkpoint(brick: Server, number: int, base: int) -> Pages:
    brick.step("prd2srv", Request(2, number, b"what"), 0)
    ((_, captured),) = sends(brick.step("aft2srv", CaptureState(2, number, base), 0))
    assert isinstance(captured, StateCaptured) and isinstance(captured.state, Pages)
    return captured.state


def test_of_a_large_state_the_changed_pages_go_to_the_backup() -> None:
    leads, follows = large(1), large(2)
    for number, numbers in ((7, ()), (8, (0,)), (9, (0,))):
        state = checkpoint(leads, number, number - 1)
        assert (state.base, state.numbers) == ((number - 1) * bool(numbers), numbers)
        effects = follows.step("aft2srv", RestoreState(2, number, state), 0)
        assert sends(effects) == [("srv2aft", StateRestored(2, number))]
        assert follows.capture() == leads.capture()


def test_pages_on_a_base_that_it_does_not_have_end_the_backup() -> None:
    leads, follows = large(1), large(2)
    checkpoint(leads, 7, 6)
    effects = follows.step("aft2srv", RestoreState(2, 8, checkpoint(leads, 8, 7)), 0)
    assert notes(effects) == [Event.DETECTED_STOP] and sends(effects) == []
    assert effects[-1] == Halt(
        "the state after request 8 is refused: it is based on checkpoint 7, found is none"
    )


@pytest.mark.parametrize("what", ["rebound", "restored", "migrated", "another base", "no base"])
def test_after_any_doubt_the_state_is_whole(what: str) -> None:
    brick = large(1)
    checkpoint(brick, 7, 6)
    if what == "rebound":
        brick.step(CONTROL, Rebound("srv2aft", True, 2), 0)
    elif what == "restored":
        brick.restore(brick.capture())
    elif what == "migrated":
        brick.migrate(brick.capture())
    state = checkpoint(brick, 8, {"another base": 6, "no base": 0}.get(what, 7))
    assert (state.base, state.data) == (0, brick.capture())


def test_the_state_before_a_request_is_whole_and_no_base() -> None:
    brick = large(1)
    brick.step(CONTROL, Rebound("srv2bfr", True, 2), 0)
    for number in (7, 8):
        effects = brick.step("bfr2srv", CaptureState(2, number), 0)
        state = brick.capture()
        assert sends(effects) == [("srv2bfr", StateCaptured(2, number, state))]
        for rerun in (False, True):
            brick.step("prd2srv", trial(state, rerun=rerun, number=number), 0)
        ((_, captured),) = sends(brick.step("aft2srv", CaptureState(2, number, number - 1), 0))
        assert isinstance(captured, StateCaptured) and isinstance(captured.state, Pages)
        assert captured.state.numbers == (() if number == 7 else (0,))


def test_state_goes_over_to_a_new_backup() -> None:
    old, new = leader(), backup()
    old.step("prd2srv", REQUEST, 0)
    new.restore(old.capture())
    assert new.capture() == old.capture()


# -- under another mechanism, and from one to the next


@pytest.mark.parametrize(
    ("outputs", "ports"),
    [
        ((), {"prd2srv"}),
        (("srv2aft",), {"prd2srv", "aft2srv"}),
        (("srv2bfr",), {"prd2srv", "bfr2srv"}),
        (("srv2aft", "srv2bfr"), {"prd2srv", "aft2srv", "bfr2srv"}),
    ],
)
def test_the_first_request_decides_whether_it_leads(outputs: tuple[str, ...], ports: set[str]) -> None:
    assert set(bound(*outputs).open_ports()) == ports


def test_under_pbr_one_port_is_open_at_a_time() -> None:
    brick = bound("srv2aft")
    for number in (7, 8):
        brick.step("prd2srv", Request(2, number, b"x"), 0)
        assert brick.open_ports() == ("aft2srv",) and not brick.quiescent()
        brick.step("aft2srv", CaptureState(2, number), 0)
        assert brick.open_ports() == ("prd2srv",) and brick.quiescent()


def test_under_tr_only_after_a_rerun_it_is_not_known_what_comes() -> None:
    brick = bound("srv2aft", "srv2bfr")
    assert brick.open_ports() == ("aft2srv", "bfr2srv", "prd2srv") and brick.quiescent()
    for number in (7, 8):
        brick.step("bfr2srv", CaptureState(2, number), 0)
        assert brick.open_ports() == ("prd2srv",) and not brick.quiescent()
        brick.step("prd2srv", trial(STATE, rerun=False, number=number), 0)
        assert brick.open_ports() == ("prd2srv",) and not brick.quiescent()
        for _ in range(2):  # After may ask for a third trial
            brick.step("prd2srv", trial(STATE, rerun=True, number=number), 0)
            assert brick.open_ports() == ("aft2srv", "prd2srv") and not brick.quiescent()
        brick.step("aft2srv", CaptureState(2, number), 0)
        assert brick.open_ports() == ("bfr2srv",) and brick.quiescent()


def test_a_follower_becomes_a_backup_and_a_follower_again() -> None:
    brick = bound(replica=2)
    brick.step("prd2srv", REQUEST, 0)
    assert brick.state is ServerState.READY
    brick.step(CONTROL, Rebound("srv2aft", True, 2), 0)
    assert set(brick.open_ports()) == {"aft2srv", "prd2srv"}
    effects = brick.step("aft2srv", RestoreState(2, 8, STATE), 0)
    assert sends(effects) == [("srv2aft", StateRestored(2, 8))]
    brick.step(CONTROL, Rebound("srv2aft", False, 2), 0)
    assert brick.open_ports() == ("prd2srv",)
    brick.step("prd2srv", REQUEST, 0)
    assert brick.open_ports() == ("prd2srv",) and brick.quiescent()


def test_a_leader_that_is_given_an_after_that_captures_is_captured_from_then_on() -> None:
    brick = bound()
    brick.step("prd2srv", REQUEST, 0)
    brick.step(CONTROL, Rebound("srv2aft", True, 2), 0)
    brick.step("prd2srv", REQUEST, 0)
    assert brick.open_ports() == ("aft2srv",) and not brick.quiescent()


def test_where_a_request_goes_when_it_is_done_changes_nothing() -> None:
    brick = leader()
    brick.step("prd2srv", REQUEST, 0)
    before = inspected(brick)
    assert brick.step(CONTROL, Rebound("srv2prd", True, 2), 0) == []
    assert inspected(brick) == before


# -- trials


@pytest.mark.parametrize(
    ("asked", "answered", "executed"), [("aft2srv", "srv2aft", True), ("bfr2srv", "srv2bfr", False)]
)
def test_who_asks_for_the_state_is_who_gets_it(asked: str, answered: str, executed: bool) -> None:
    brick = bound("srv2aft", "srv2bfr")
    if executed:
        brick.step("prd2srv", trial(STATE, rerun=False), 0)
        brick.step("prd2srv", trial(STATE, rerun=True), 0)
    effects = brick.step(asked, CaptureState(2, 7), 0)
    assert sends(effects) == [(answered, StateCaptured(2, 7, brick.capture()))]
    assert notes(effects) == [Event.STATE_CAPTURED]


def test_a_trial_is_executed_from_where_the_server_is() -> None:
    brick = bound("srv2bfr")
    brick.step("prd2srv", trial(STATE, rerun=False), 0)  # that state is for a rerun only
    effects = brick.step("prd2srv", trial(STATE, rerun=False, number=8), 0)
    assert sends(effects) == [("srv2prd", Tried(2, 8, 1, answer(2), brick.capture()))]
    assert notes(effects) == [Event.SERVER_ENTER, Event.SERVER_EXIT] and details(effects) == [0, 0]


def test_a_rerun_starts_from_the_state_of_before() -> None:
    brick = bound("srv2bfr")
    state = brick.capture()
    first = sends(brick.step("prd2srv", trial(state, rerun=False), 0))
    for _ in range(2):
        effects = brick.step("prd2srv", trial(state, rerun=True), 0)
        assert sends(effects) == first
        assert notes(effects) == [Event.SERVER_ENTER, Event.SERVER_EXIT]
        assert details(effects) == [RERUN, RERUN]


def test_a_trial_that_the_function_refuses_is_answered_with_nothing() -> None:
    brick = bound("srv2bfr")
    state = brick.capture()
    effects = brick.step("prd2srv", Trial(2, 7, b"", state, rerun=False), 0)
    assert sends(effects) == [("srv2prd", Tried(2, 7, 1, b"", state))]


def test_a_rerun_from_what_is_no_state_is_refused() -> None:
    brick = bound("srv2bfr")
    brick.step("prd2srv", trial(STATE, rerun=False), 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="not a state"):
        brick.step("prd2srv", trial(b"", rerun=True), 0)
    assert inspected(brick) == before


def test_the_next_trial_waits_until_after_has_the_state() -> None:
    brick = bound("srv2aft", "srv2bfr")
    brick.step("prd2srv", trial(STATE, rerun=False), 0)
    brick.step("prd2srv", trial(STATE, rerun=True), 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="Trial on prd2srv while EXECUTED"):
        brick.step("prd2srv", trial(STATE, rerun=False, number=8), 0)
    with pytest.raises(PeerError, match="CaptureState on bfr2srv while EXECUTED"):
        brick.step("bfr2srv", CaptureState(2, 8), 0)
    assert inspected(brick) == before


@pytest.mark.parametrize("brick", [PassBefore(), Compute()], ids=lambda b: type(b).__name__)
def test_a_brick_without_state_restores_nothing_else(brick: PassBefore | Compute) -> None:
    assert brick.capture() == b""
    brick.restore(b"")
    with pytest.raises(PeerError, match=f"{type(brick).__name__} has no state to restore, given 1 bytes"):
        brick.restore(b"x")


def test_a_brick_without_a_deadline_is_not_woken() -> None:
    assert Compute().deadline_ns() is None
    with pytest.raises(AssertionError, match="Compute has no deadline"):
        Compute().wake(1)
