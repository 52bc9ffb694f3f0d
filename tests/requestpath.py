"""The events of one request under PBR, in their order."""

from typing import Final

from aftbed.core.events import Event

REQUEST_PATH: Final = (
    Event.REQUEST_SENT,
    Event.REQUEST_RECEIVED,
    Event.BEFORE_EXIT,
    Event.PROCEED_ENTER,
    Event.SERVER_ENTER,
    Event.SERVER_EXIT,
    Event.STATE_CAPTURED,
    Event.CHECKPOINT_SENT,
    Event.REPLY_STORED,
    Event.REPLY_SENT,
    Event.REPLY_DELIVERED,
)
