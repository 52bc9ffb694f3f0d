"""After of PBR: checkpoint before reply; a backup drains what was sent to it before it leads."""

import pytest
from samples import STATE, inspected, notes, sends

from aftbed.core.brick import CONTROL, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    CaptureState,
    ChannelEnded,
    Checkpoint,
    Pages,
    Promotion,
    Rebound,
    Reply,
    RestoreState,
    StateCaptured,
    StateRestored,
    StoreReply,
    TakeOver,
)
from aftbed.ftm.pages import sealed
from aftbed.ftm.pbr import PbrAfter, PbrAfterState

REPLY = Reply(1, 7, 1, b"that")
CHECKPOINT = Checkpoint(1, 7, b"that", STATE)


def primary(*, duplex: bool = True) -> PbrAfter:
    brick = PbrAfter(1, leads=True)
    assert brick.step(CONTROL, Rebound("aft2aft", duplex, 1), 0) == []
    return brick


def backup() -> PbrAfter:
    return PbrAfter(1, leads=False)


# -- the primary


def test_the_result_makes_the_primary_capture_the_state() -> None:
    brick = primary()
    assert sends(brick.step("prd2aft", REPLY, 0)) == [("aft2srv", CaptureState(1, 7))]
    assert brick.open_ports() == ("srv2aft",) and not brick.quiescent()


def test_the_checkpoint_is_sent_before_the_reply() -> None:
    brick = primary()
    brick.step("prd2aft", REPLY, 0)
    assert brick.step("srv2aft", StateCaptured(1, 7, STATE), 0) == [
        Send("aft2aft", CHECKPOINT),
        Note(Event.CHECKPOINT_SENT, 7),
        Send("aft2pro", REPLY),
    ]
    assert brick.open_ports() == ("prd2aft",) and brick.quiescent()


def test_without_a_backup_the_primary_serves_alone() -> None:
    brick = primary(duplex=False)
    brick.step("prd2aft", REPLY, 0)
    assert brick.step("srv2aft", StateCaptured(1, 7, STATE), 0) == [Send("aft2pro", REPLY)]


def test_a_backup_lost_while_the_state_is_captured_gets_nothing() -> None:
    brick = primary()
    brick.step("prd2aft", REPLY, 0)
    brick.step(CONTROL, Rebound("aft2aft", False, 1), 0)
    assert sends(brick.step("srv2aft", StateCaptured(1, 7, STATE), 0)) == [("aft2pro", REPLY)]


def test_a_backup_found_while_the_state_is_captured_gets_it() -> None:
    brick = primary(duplex=False)
    brick.step("prd2aft", REPLY, 0)
    brick.step(CONTROL, Rebound("aft2aft", True, 1), 0)
    ports = [port for port, _ in sends(brick.step("srv2aft", StateCaptured(1, 7, STATE), 0))]
    assert ports == ["aft2aft", "aft2pro"]


def test_only_its_own_channel_to_the_backup_matters() -> None:
    brick = primary()
    brick.step(CONTROL, Rebound("aft2pro", False, 1), 0)
    brick.step("prd2aft", REPLY, 0)
    assert len(sends(brick.step("srv2aft", StateCaptured(1, 7, STATE), 0))) == 2


def test_the_state_after_another_request_is_refused() -> None:
    brick = primary()
    brick.step("prd2aft", REPLY, 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="state of request 6, expected 7"):
        brick.step("srv2aft", StateCaptured(1, 6, STATE), 0)
    assert inspected(brick) == before


@pytest.mark.parametrize("capturing", [False, True])
def test_who_leads_is_not_promoted(capturing: bool) -> None:
    brick = primary()
    if capturing:
        brick.step("prd2aft", REPLY, 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="Promotion on control while"):
        brick.step(CONTROL, Promotion(2), 0)
    assert inspected(brick) == before


def asked(brick: PbrAfter, number: int) -> int:
    """The base on which it asks the Server for the state after that request, which it then sends."""
    ((_, ask),) = sends(brick.step("prd2aft", Reply(brick.epoch, number, 1, b"that"), 0))
    assert isinstance(ask, CaptureState)
    brick.step("srv2aft", StateCaptured(brick.epoch, number, STATE), 0)
    return ask.base


def test_what_has_changed_since_the_last_checkpoint_that_was_sent_is_enough() -> None:
    brick = primary()
    assert [asked(brick, number) for number in (7, 8, 12)] == [0, 7, 8]


def test_a_new_backup_needs_the_whole_state() -> None:
    brick = primary()
    asked(brick, 7)
    brick.step(CONTROL, Rebound("aft2aft", True, 1), 0)
    assert [asked(brick, number) for number in (8, 9)] == [0, 8]


def test_what_was_captured_without_a_backup_is_no_base() -> None:
    brick = primary()
    asked(brick, 7)
    brick.step(CONTROL, Rebound("aft2aft", False, 1), 0)
    assert [asked(brick, number) for number in (8, 9)] == [0, 0]
    brick.step(CONTROL, Rebound("aft2aft", True, 1), 0)
    assert [asked(brick, number) for number in (10, 11)] == [0, 10]


def test_pages_of_a_state_go_to_the_backup_and_its_server_as_they_are() -> None:
    pages = sealed(Pages(100, 6, 16, (1,), bytes(16), 0))
    brick = primary()
    brick.step("prd2aft", REPLY, 0)
    sent = sends(brick.step("srv2aft", StateCaptured(1, 7, pages), 0))[0][1]
    assert sent == Checkpoint(1, 7, b"that", pages)
    assert sends(backup().step("aft2aft", sent, 0)) == [("aft2srv", RestoreState(1, 7, pages))]


# -- the backup


def test_a_checkpoint_is_restored_then_its_reply_is_stored() -> None:
    brick = backup()
    assert sends(brick.step("aft2aft", CHECKPOINT, 0)) == [("aft2srv", RestoreState(1, 7, STATE))]
    effects = brick.step("srv2aft", StateRestored(1, 7), 0)
    assert effects == [Note(Event.CHECKPOINT_APPLIED, 7), Send("aft2pro", StoreReply(1, 7, b"that"))]


def test_one_checkpoint_at_a_time_the_next_waits_in_the_channel() -> None:
    brick = backup()
    assert brick.open_ports() == ("aft2aft",)
    brick.step("aft2aft", CHECKPOINT, 0)
    assert brick.open_ports() == ("srv2aft",) and not brick.quiescent()
    with pytest.raises(PeerError, match="Checkpoint on aft2aft while APPLYING"):
        brick.step("aft2aft", CHECKPOINT, 0)
    brick.step("srv2aft", StateRestored(1, 7), 0)
    assert brick.open_ports() == ("aft2aft",) and brick.quiescent()


@pytest.mark.parametrize("epoch", [0, 2])
def test_a_checkpoint_of_another_epoch_is_refused(epoch: int) -> None:
    brick = backup()
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"checkpoint 7 under epoch {epoch}, expected 1"):
        brick.step("aft2aft", Checkpoint(epoch, 7, b"that", STATE), 0)
    assert inspected(brick) == before


def test_the_restoring_of_another_request_is_refused() -> None:
    brick = backup()
    brick.step("aft2aft", CHECKPOINT, 0)
    before = inspected(brick)
    with pytest.raises(PeerError, match="restored 6, expected 7"):
        brick.step("srv2aft", StateRestored(1, 6), 0)
    assert inspected(brick) == before


# -- taking over


def test_promoted_it_drains_its_channel_to_the_end_before_it_leads() -> None:
    brick = backup()
    assert brick.step(CONTROL, Promotion(2), 0) == []
    assert brick.state is PbrAfterState.PROMOTED and brick.open_ports() == ("aft2aft",)
    brick.step("aft2aft", CHECKPOINT, 0)  # was still in the channel
    stored = brick.step("srv2aft", StateRestored(1, 7), 0)
    assert [type(m) for _, m in sends(stored)] == [StoreReply]
    assert brick.step("aft2aft", ChannelEnded(), 0) == [Send("aft2pro", TakeOver(2))]
    assert (brick.state, brick.epoch) == (PbrAfterState.IDLE, 2)


def test_the_channel_may_end_before_the_promotion() -> None:
    brick = backup()
    assert brick.step("aft2aft", ChannelEnded(), 0) == []
    assert brick.state is PbrAfterState.ENDED
    assert brick.step(CONTROL, Promotion(2), 0) == [Send("aft2pro", TakeOver(2))]


def test_promoted_while_it_applies_a_checkpoint_it_waits_for_that_and_for_the_end() -> None:
    brick = backup()
    brick.step("aft2aft", CHECKPOINT, 0)
    assert brick.step(CONTROL, Promotion(2), 0) == []
    applied = brick.step("srv2aft", StateRestored(1, 7), 0)
    assert notes(applied) == [Event.CHECKPOINT_APPLIED]
    assert brick.state is PbrAfterState.PROMOTED
    assert brick.step("aft2aft", ChannelEnded(), 0) == [Send("aft2pro", TakeOver(2))]


@pytest.mark.parametrize("epoch", [0, 1])
def test_a_promotion_to_an_epoch_that_does_not_grow_is_refused(epoch: int) -> None:
    brick = backup()
    before = inspected(brick)
    with pytest.raises(PeerError, match=f"promoted to epoch {epoch} while STANDBY in epoch 1"):
        brick.step(CONTROL, Promotion(epoch), 0)
    assert inspected(brick) == before


def test_it_leads_once() -> None:
    brick = backup()
    brick.step("aft2aft", ChannelEnded(), 0)
    brick.step(CONTROL, Promotion(2), 0)
    with pytest.raises(PeerError, match="Promotion on control while IDLE"):
        brick.step(CONTROL, Promotion(3), 0)


def test_who_took_over_serves_alone_until_it_is_given_a_backup() -> None:
    brick = backup()
    brick.step(CONTROL, Rebound("aft2aft", True, 1), 0)  # of its time as a backup: it counts no more
    brick.step("aft2aft", ChannelEnded(), 0)
    brick.step(CONTROL, Promotion(2), 0)
    reply = Reply(2, 8, 2, b"more")
    brick.step("prd2aft", reply, 0)
    assert sends(brick.step("srv2aft", StateCaptured(2, 8, STATE), 0)) == [("aft2pro", reply)]
    brick.step(CONTROL, Rebound("aft2aft", True, 2), 0)
    brick.step("prd2aft", reply, 0)
    assert sends(brick.step("srv2aft", StateCaptured(2, 8, STATE), 0))[0] == (
        "aft2aft",
        Checkpoint(2, 8, b"more", STATE),
    )
