"""The catalog: every kind of brick with its ports, and how to make one.

A mechanism that is written later adds rows here and in `mechanism`, and nothing else.
"""

from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.core.application import Application
from aftbed.core.brick import Brick
from aftbed.core.events import Event
from aftbed.core.graph import Kind
from aftbed.ftm.assertion import AssertAfter, AssertBefore
from aftbed.ftm.chain import Compute, InnerProtocol, PassBefore, Protocol
from aftbed.ftm.client import Client, Proxy
from aftbed.ftm.failover import Recovery, Watchdog
from aftbed.ftm.lfr import LfrAfter, LfrBefore
from aftbed.ftm.pbr import PbrAfter
from aftbed.ftm.server import Server
from aftbed.ftm.tr import TrAfter, TrBefore, TrProceed


class Setting(msgspec.Struct, frozen=True):
    """What a brick is made for: which replica (1, 2; 0 for none), which epoch, leading or not."""

    replica: int
    epoch: int
    leads: bool
    application: Callable[[], Application]


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("client", ("pxy2clt",), ("clt2pxy",)),
        Kind("proxy", ("clt2pxy", "pro2pxy"), ("pxy2pro", "pxy2clt")),
        Kind("protocol", ("pxy2pro", "aft2pro"), ("pro2bfr", "pro2pxy")),
        Kind("pass.before", ("pro2bfr",), ("bfr2prd",)),
        Kind("compute.proceed", ("bfr2prd", "srv2prd"), ("prd2srv", "prd2aft")),
        Kind("pbr.after", ("prd2aft", "srv2aft", "aft2aft"), ("aft2srv", "aft2pro", "aft2aft"), ("aft2aft",)),
        Kind("inner.protocol", ("pxy2pro", "aft2pro"), ("pro2bfr", "pro2pxy")),
        Kind("lfr.before", ("pro2bfr", "bfr2bfr"), ("bfr2prd", "bfr2bfr"), ("bfr2bfr",)),
        Kind("lfr.after", ("prd2aft", "aft2aft"), ("aft2pro", "aft2aft"), ("aft2aft",)),
        Kind("tr.before", ("pro2bfr", "srv2bfr"), ("bfr2srv", "bfr2prd")),
        Kind("tr.proceed", ("bfr2prd", "srv2prd", "aft2prd"), ("prd2srv", "prd2aft")),
        Kind("tr.after", ("prd2aft",), ("aft2prd", "aft2pro")),
        Kind("assert.before", ("pro2bfr",), ("bfr2prd", "bfr2aft")),
        Kind("assert.after", ("prd2aft", "bfr2aft"), ("aft2pro",)),
        Kind(
            "server",
            ("prd2srv", "aft2srv", "bfr2srv"),
            ("srv2prd", "srv2aft", "srv2bfr"),
            ("aft2srv", "bfr2srv", "srv2aft", "srv2bfr"),
        ),
        Kind("bare.server", ("prd2srv",), ("srv2prd",)),
        Kind("watchdog", (), ("wdg2rec",)),
        Kind("recovery", ("wdg2rec", "wdg2rec.b"), (), ("wdg2rec", "wdg2rec.b")),
        Kind("engine", (), ()),
    )
}

_MAKERS: Final[dict[str, Callable[[Setting], Brick]]] = {
    "client": lambda s: Client(),
    "proxy": lambda s: Proxy(),
    "protocol": lambda s: Protocol(s.replica, s.epoch, s.leads),
    "pass.before": lambda s: PassBefore(),
    "compute.proceed": lambda s: Compute(),
    "pbr.after": lambda s: PbrAfter(s.epoch, s.leads),
    "inner.protocol": lambda s: InnerProtocol(),
    "lfr.before": lambda s: LfrBefore(s.epoch, s.leads),
    "lfr.after": lambda s: LfrAfter(s.epoch, s.leads),
    "tr.before": lambda s: TrBefore(),
    "tr.proceed": lambda s: TrProceed(),
    "tr.after": lambda s: TrAfter(),
    "assert.before": lambda s: AssertBefore(),
    "assert.after": lambda s: AssertAfter(s.application().acceptable),
    "server": lambda s: Server(s.application(), s.replica),
    "bare.server": lambda s: Server(s.application(), s.replica),
    "watchdog": lambda s: Watchdog(),
    "recovery": lambda s: Recovery(),
}
assert set(_MAKERS) | {"engine"} == set(KINDS), "every kind of brick has a maker; the Engine's is in `adapt`"

# Which part emits an event, and whether the backup's does (else the leader's). A part is meant by its last
# word (`a/tr.before` is a `before`), and the outermost one where there are several; what only one mechanism
# emits is named by kind.
EMITTERS: Final = {
    Event.REQUEST_SENT: ("client", False),
    Event.REPLY_DELIVERED: ("client", False),
    Event.REPLY_ACCEPTED: ("proxy", False),
    Event.REQUEST_RECEIVED: ("protocol", False),
    Event.REPLY_STORED: ("protocol", False),
    Event.REPLY_SENT: ("protocol", False),
    Event.DEDUPE_HIT: ("protocol", False),
    Event.BEFORE_EXIT: ("before", False),
    Event.PROCEED_ENTER: ("proceed", False),
    Event.SERVER_ENTER: ("server", False),
    Event.SERVER_EXIT: ("server", False),
    Event.STATE_CAPTURED: ("server", False),
    Event.CHECKPOINT_SENT: ("pbr.after", False),
    Event.CHECKPOINT_APPLIED: ("pbr.after", True),
    Event.STATE_RESTORED: ("server", True),
    Event.FOLLOWER_FORWARDED: ("lfr.before", False),
    Event.FOLLOWER_NOTIFIED: ("lfr.after", False),
    Event.FOLLOWER_DIVERGED: ("lfr.after", True),
    Event.VOTE_COMPARED: ("tr.after", False),
    Event.DETECTED_STOP: ("tr.after", False),  # an assertion's too, but one name stands here
    Event.WATCHDOG_SUSPECT: ("watchdog", False),
    Event.RECOVERY_ENTER: ("recovery", False),
    Event.RECOVERY_EXIT: ("recovery", False),
    Event.BACKUP_READY: ("recovery", False),
}


def make(kind: str, setting: Setting) -> Brick:
    """A new brick of `kind`."""
    return _MAKERS[kind](setting)
