"""One message of each type, all about request 1 under epoch 1; and looks into a brick from outside."""

import copy
from typing import Final, get_args

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.events import Event
from aftbed.core.messages import (
    Adapt,
    Again,
    AnyMessage,
    CaptureState,
    ChannelEnded,
    Checkpoint,
    HoldAt,
    Loss,
    Message,
    NodeDied,
    Notification,
    Progress,
    Promoted,
    Promotion,
    Rebound,
    Redundancy,
    Release,
    Reply,
    Request,
    RestoreState,
    SeenAlive,
    Situation,
    StateCaptured,
    StateRestored,
    StoreReply,
    Submit,
    Suspect,
    TakeOver,
    TakeUp,
    Trial,
    Trials,
    Tried,
    Watch,
)
from aftbed.core.script import Phase, Script
from aftbed.ftm.lfr import digest
from aftbed.ftm.pages import CheckpointBase

STATE: Final = b"\x92\x01\x02"  # of `Counting`: one request, checksum 2

TRIED: Final = Tried(1, 1, 1, b"that", STATE)

SAMPLES: Final[dict[type, AnyMessage]] = {
    type(message): message
    for message in (
        Request(1, 1, b"what"),
        Reply(1, 1, 1, b"that"),
        CaptureState(1, 1),
        StateCaptured(1, 1, STATE),
        Checkpoint(1, 1, b"that", STATE),
        RestoreState(1, 1, STATE),
        StateRestored(1, 1),
        StoreReply(1, 1, b"that"),
        TakeOver(2),
        Notification(1, 1, digest(b"that")),
        Trial(1, 1, b"what", STATE, False),
        TRIED,
        Trials(1, 1, (TRIED, TRIED)),
        Again(1, 1),
        Suspect("a", 1, "a/after", Loss.CRASH, 5),
        Promotion(2),
        Promoted(2),
        Rebound("elsewhere", True, 1),
        ChannelEnded(),
        Submit(b"what"),
        Watch("a", 1, ("a/after",)),
        NodeDied("a/after"),
        SeenAlive(0, {"a/after": 0}, 0),
        Situation("a", 1, "b", 1, 1, (), False),
        Adapt(1, Script("pbr to lfr", "", (), ())),
        Progress(1, Phase.PREPARE, ""),
        TakeUp(1, Script("pbr to lfr", "", (), ()), Phase.COMMIT, False, ""),
        HoldAt((1,)),
        Release(1),
        Redundancy(2, alone=True),
    )
}
assert set(SAMPLES) == set(get_args(AnyMessage)), "one sample of each type"


def inspected(brick: Brick) -> dict[str, object]:
    """All that a brick is, inside and outside, as a value."""
    strangers = ("application", "_acceptable")
    parts = {k: vars(v) if isinstance(v, CheckpointBase) else v for k, v in vars(brick).items()}
    inside = {k: copy.deepcopy(v) for k, v in parts.items() if k not in strangers}
    outside = (brick.open_ports(), brick.quiescent(), brick.deadline_ns(), brick.capture())
    return inside | {"outside": outside}


def sends(effects: list[Effect]) -> list[tuple[str, Message]]:
    """What is put where."""
    return [(e.port, e.message) for e in effects if isinstance(e, Send)]


def notes(effects: list[Effect]) -> list[Event]:
    """The events, in order."""
    return [e.event for e in effects if isinstance(e, Note)]
