"""TR: one state, two trials or three, a vote on reply and state, and a stop where there is no majority."""

import pytest
from samples import STATE, inspected, notes, sends

from aftbed.core.brick import Halt, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    Again,
    CaptureState,
    Reply,
    Request,
    StateCaptured,
    TakeOver,
    Trial,
    Trials,
    Tried,
)
from aftbed.ftm.tr import UNDECIDED, TrAfter, TrBefore, TrProceed, TrProceedState

REQUEST = Request(2, 7, b"what")
TRIAL = Trial(2, 7, b"what", STATE, rerun=False)
RERUN = Trial(2, 7, b"what", STATE, rerun=True)


def tried(payload: bytes = b"that", state: bytes = b"then", number: int = 7) -> Tried:
    return Tried(2, number, 1, payload, state)


RIGHT = tried()
WRONG = (tried(payload=b"thaT"), tried(state=b"them"), tried(payload=b"", state=b""))


def trials(*found: Tried, number: int = 7) -> Trials:
    return Trials(2, number, found)


# -- Before


def test_the_state_is_captured_and_goes_with_the_request() -> None:
    brick = TrBefore()
    assert brick.open_ports() == ("pro2bfr",) and brick.quiescent()
    assert sends(brick.step("pro2bfr", REQUEST, 0)) == [("bfr2srv", CaptureState(2, 7))]
    assert brick.open_ports() == ("srv2bfr",) and not brick.quiescent()
    effects = brick.step("srv2bfr", StateCaptured(2, 7, STATE), 0)
    assert sends(effects) == [("bfr2prd", TRIAL)] and notes(effects) == [Event.BEFORE_EXIT]
    assert brick.open_ports() == ("pro2bfr",) and brick.quiescent()


def test_the_state_for_another_request_is_refused() -> None:
    brick = TrBefore()
    brick.step("pro2bfr", REQUEST, 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="state for request 6, expected 7"):
        brick.step("srv2bfr", StateCaptured(2, 6, STATE), 0)
    assert inspected(brick) == before


def test_before_hands_a_take_over_on_but_not_past_a_request() -> None:
    brick = TrBefore()
    assert sends(brick.step("pro2bfr", TakeOver(2), 0)) == [("bfr2prd", TakeOver(2))]
    brick.step("pro2bfr", REQUEST, 0)
    with pytest.raises(PeerError, match="TakeOver on pro2bfr while CAPTURING"):
        brick.step("pro2bfr", TakeOver(2), 0)


# -- Proceed


def voting(*found: Tried) -> TrProceed:
    brick = TrProceed()
    brick.step("bfr2prd", TRIAL, 0)
    for one in found:
        brick.step("srv2prd", one, 0)
    agree = found[0] == found[1]
    assert brick.state is (TrProceedState.IDLE if agree else TrProceedState.VOTING)
    return brick


def test_a_trial_is_run_and_then_run_again_from_the_same_state() -> None:
    brick = TrProceed()
    effects = brick.step("bfr2prd", TRIAL, 0)
    assert sends(effects) == [("prd2srv", TRIAL), ("prd2srv", RERUN)]
    assert notes(effects) == [Event.PROCEED_ENTER]
    assert brick.open_ports() == ("srv2prd",) and not brick.quiescent()
    assert sends(brick.step("srv2prd", RIGHT, 0)) == []
    assert brick.open_ports() == ("srv2prd",) and not brick.quiescent()
    assert sends(brick.step("srv2prd", WRONG[0], 0)) == [("prd2aft", trials(RIGHT, WRONG[0]))]


def test_asked_again_it_runs_it_once_more_and_is_done_with_it() -> None:
    brick = voting(RIGHT, WRONG[0])
    assert set(brick.open_ports()) == {"bfr2prd", "aft2prd"}
    assert sends(brick.step("aft2prd", Again(2, 7), 0)) == [("prd2srv", RERUN)]
    assert brick.open_ports() == ("srv2prd",) and not brick.quiescent()
    assert sends(brick.step("srv2prd", RIGHT, 0)) == [("prd2aft", trials(RIGHT))]
    assert brick.open_ports() == ("bfr2prd",) and brick.quiescent()


@pytest.mark.parametrize("second", [RIGHT, WRONG[0]])
def test_the_next_trial_may_come_without_a_third(second: Tried) -> None:
    brick = voting(RIGHT, second)
    later = Trial(2, 8, b"more", STATE, rerun=False)
    again = Trial(2, 8, b"more", STATE, rerun=True)
    assert sends(brick.step("bfr2prd", later, 0)) == [("prd2srv", later), ("prd2srv", again)]
    with pytest.raises(PeerError, match="trial of request 7, expected 8"):
        brick.step("srv2prd", RIGHT, 0)


@pytest.mark.parametrize("wrong", WRONG)
def test_while_a_trial_may_come_back_a_request_is_inside(wrong: Tried) -> None:
    assert voting(RIGHT, RIGHT).quiescent() and voting(RIGHT, RIGHT).open_ports() == ("bfr2prd",)
    assert not voting(RIGHT, wrong).quiescent()


@pytest.mark.parametrize(
    "sent",
    [
        ("srv2prd", tried(number=6), ()),
        ("srv2prd", tried(number=6), (RIGHT,)),
        ("aft2prd", Again(2, 6), (RIGHT, WRONG[0])),
    ],
)
def test_what_is_about_another_request_is_refused(
    sent: tuple[str, Tried | Again, tuple[Tried, ...]],
) -> None:
    port, message, found = sent
    brick = TrProceed()
    brick.step("bfr2prd", TRIAL, 0)
    for one in found:
        brick.step("srv2prd", one, 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="trial of request 6, expected 7"):
        brick.step(port, message, 0)
    assert inspected(brick) == before


def test_proceed_hands_a_take_over_on_but_not_past_a_trial() -> None:
    for brick in (TrProceed(), voting(RIGHT, RIGHT), voting(RIGHT, WRONG[0])):
        assert sends(brick.step("bfr2prd", TakeOver(2), 0)) == [("prd2aft", TakeOver(2))]
    brick = TrProceed()
    brick.step("bfr2prd", TRIAL, 0)
    with pytest.raises(PeerError, match="TakeOver on bfr2prd while FIRST"):
        brick.step("bfr2prd", TakeOver(2), 0)


# -- After


def asked(*found: Tried) -> TrAfter:
    brick = TrAfter()
    effects = brick.step("prd2aft", trials(*found), 0)
    assert effects == [Send("aft2prd", Again(2, 7))]
    assert not brick.quiescent() and brick.open_ports() == ("prd2aft",)
    return brick


def test_two_that_are_equal_settle_it() -> None:
    brick = TrAfter()
    assert brick.step("prd2aft", trials(RIGHT, RIGHT), 0) == [
        Note(Event.VOTE_COMPARED, 7, 2),
        Send("aft2pro", Reply(2, 7, 1, b"that")),
    ]
    assert brick.quiescent()


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("first", [True, False])
def test_if_two_differ_in_reply_or_state_the_third_tells_which_is_right(wrong: Tried, first: bool) -> None:
    brick = asked(wrong, RIGHT) if first else asked(RIGHT, wrong)
    assert brick.step("prd2aft", trials(RIGHT), 0) == [
        Note(Event.VOTE_COMPARED, 7, 3),
        Send("aft2pro", Reply(2, 7, 1, b"that")),
    ]
    assert brick.quiescent()
    assert sends(brick.step("prd2aft", trials(tried(number=8), tried(number=8), number=8), 0)) != []


@pytest.mark.parametrize("third", [WRONG[1], WRONG[2], tried(payload=b"thaT", state=b"them")])
def test_without_a_majority_the_replica_stops(third: Tried) -> None:
    """The last of these agrees with each of the two in one thing, and with none in both."""
    effects = asked(WRONG[0], RIGHT).step("prd2aft", trials(third), 0)
    assert effects == [
        Note(Event.VOTE_COMPARED, 7, UNDECIDED),
        Note(Event.DETECTED_STOP, 7),
        Halt("no majority for request 7: three trials, no two of them equal"),
    ]
    assert sends(effects) == []


@pytest.mark.parametrize("found", [(), (RIGHT,), (RIGHT, RIGHT, RIGHT), (RIGHT, tried(number=6))])
def test_a_vote_begins_with_two_of_the_same_request(found: tuple[Tried, ...]) -> None:
    brick = TrAfter()
    before = inspected(brick)
    with pytest.raises(PeerError, match=rf"{len(found)} trials of requests \[.*7\] while IDLE"):
        brick.step("prd2aft", trials(*found), 0)
    assert inspected(brick) == before


@pytest.mark.parametrize("found", [(), (RIGHT, RIGHT), (tried(number=6),)])
def test_a_vote_ends_with_a_third_of_the_same_request(found: tuple[Tried, ...]) -> None:
    brick = asked(RIGHT, WRONG[0])
    before = inspected(brick)
    with pytest.raises(PeerError, match=rf"{len(found)} trials of requests \[.*7\] while ASKED"):
        brick.step("prd2aft", trials(*found), 0)
    assert inspected(brick) == before


def test_after_hands_a_take_over_on_but_not_past_a_vote() -> None:
    assert sends(TrAfter().step("prd2aft", TakeOver(2), 0)) == [("aft2pro", TakeOver(2))]
    with pytest.raises(PeerError, match="TakeOver on prd2aft while ASKED"):
        asked(RIGHT, WRONG[0]).step("prd2aft", TakeOver(2), 0)
