"""Seeded bugs in the mechanisms, one in each row: in what a brick does with a message.

`explorer` says whose experiments have to find it:

| explorer | its experiments                                            |
|----------|------------------------------------------------------------|
| crash    | a death at each effect of some bricks                      |
| adapt    | a death at each side of each step of an adaptation         |
| pairs    | a second fault, some time after a first one                |
| clean    | nothing happens                                            |
| own      | faults that no explorer puts together, chosen for this bug |
"""

from collections.abc import Callable
from typing import Final

from msgspec.structs import replace
from planting import (
    CLEAN,
    CRASH,
    OWN,
    Mutant,
    answer,
    both,
    clean,
    crash,
    crashes,
    entered,
    flip,
    hang,
    heard,
    instead,
    outcome,
    skipped,
    wrapped,
)

from aftbed.core.application import Application
from aftbed.core.brick import CONTROL, Choice, Effect, Send
from aftbed.core.messages import (
    ChannelEnded,
    Checkpoint,
    Goal,
    Promotion,
    Rebound,
    Reply,
    Request,
    RestoreState,
    Scheduled,
    State,
    Trial,
    Trials,
    Watch,
)
from aftbed.ftm import pages, tr
from aftbed.ftm.assertion import Acceptable, AssertAfter
from aftbed.ftm.chain import Protocol, ProtocolState, RequestAge, learn_duplex, promote_at_once
from aftbed.ftm.client import Client, Proxy, ReplyIs
from aftbed.ftm.failover import Watchdog
from aftbed.ftm.lfr import LfrAfter, LfrBefore, LfrBeforeState
from aftbed.ftm.pages import CheckpointBase
from aftbed.ftm.pbr import PbrAfter, PbrAfterState
from aftbed.ftm.server import Server
from aftbed.ftm.supervision import ReplyComes, SupAfter, SupBefore
from aftbed.ftm.tr import TrAfter, Vote
from aftbed.inject.model import parse
from aftbed.inject.value import ValuePlace
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import ADAPT_RATE_HZ, PAGE_BYTES

RARE_HZ: Final = 100.0  # a new backup is there before the next request
_IDLE, _BUSY = ProtocolState.IDLE, ProtocolState.BUSY
_LOG_IGNORED: Final = {
    (_IDLE, "pxy2pro", Request): Choice(Protocol.age, dict.fromkeys(RequestAge, (Protocol.admit, _BUSY)))
}
_TWO_AT_ONCE: Final = {
    (_BUSY, "pxy2pro", Request): Choice(
        Protocol.age,
        {RequestAge.NEW: (Protocol.admit, _BUSY), RequestAge.OLD: (Protocol.answer_again, _BUSY)},
    )
}
_CHECKPOINTS_NOT_DRAINED: Final = {
    (PbrAfterState.STANDBY, CONTROL, Promotion): (promote_at_once("aft2pro"), PbrAfterState.IDLE)
}
_REQUESTS_NOT_DRAINED: Final = {
    (LfrBeforeState.FOLLOWING, CONTROL, Promotion): (promote_at_once("bfr2prd"), LfrBeforeState.LEADING)
}


def _stateless(effects: list[Effect]) -> list[Effect]:
    return [
        Send(e.port, replace(e.message, state=b""))
        if isinstance(e, Send) and isinstance(e.message, Checkpoint)
        else e
        for e in effects
    ]


def _own_state(server: Server, msg: RestoreState | Trial) -> RestoreState | Trial:
    """Restored, it changes nothing."""
    if isinstance(msg, Trial) and not msg.rerun:
        return msg
    return replace(msg, state=server.application.capture())


def _any_epoch(right: object) -> object:
    def which_reply(self: Proxy, msg: Reply) -> ReplyIs:
        assert self.waiting is not None
        return ReplyIs.WANTED if msg.request_id == self.waiting.request_id else ReplyIs.REPEATED

    return which_reply


def _never_promoted(right: Callable[..., list[Effect]]) -> object:
    def step(self: Protocol, port: str, msg: object, now_ns: int) -> list[Effect]:
        before = self.epoch
        effects = right(self, port, msg, now_ns)
        self.epoch = before
        return effects

    return step


def _base_not_kept(right: Callable[..., None]) -> object:
    def restore(self: CheckpointBase, application: Application, number: int, state: State) -> None:
        before = self._number
        right(self, application, number, state)
        self._number = before or number

    return restore


def _own_base(right: Callable[..., State]) -> object:
    def capture(self: CheckpointBase, application: Application, number: int, base: int) -> State:
        return right(self, application, number, self._number)

    return capture


def _there_and_back() -> list[Setup]:
    """The backup goes with the first adaptation, and another one comes with the second."""
    ways = (Scheduled(Goal(expression="tr"), 20), Scheduled(Goal(expression="pbr"), 90))
    return [Setup("pbr", count=200, rate_hz=ADAPT_RATE_HZ, adaptations=ways, page_bytes=PAGE_BYTES)]


def _gullible(right: Callable[..., None]) -> object:
    def init(self: AssertAfter, acceptable: Acceptable) -> None:
        right(self, lambda request, reply: True)

    return init


def _minority(right: object) -> object:
    def reply_by_third(self: TrAfter, msg: Trials) -> list[Effect]:
        (third,) = msg.tried
        wrong = next((t for t in self._held if not tr.equal(t, third)), third)
        self._held = ()
        return self._reply(wrong, 3)

    return reply_by_third


def _promoted_with_mail(ftm: str, behind: str, event: str) -> list[Setup]:
    """The backup is behind when its leader dies: what was sent to it waits in its channel."""
    return [
        Setup(ftm, count=20, faults=(hang(behind, 20, "server.exit", 3), crash("primary", event, nth)))
        for nth in (6, 8)
    ]


def _asked_meanwhile() -> list[Setup]:
    """A new Proxy asks for what is being executed: its predecessor had asked, and died."""
    return [
        Setup(
            "pbr",
            count=10,
            faults=(hang("a/server", 20, "server.exit", nth), crash("proxy", "server.exit", nth)),
        )
        for nth in (3, 4)
    ]


def _flips(ftm: str, place: ValuePlace, *bits: int) -> list[Setup]:
    """In the first trial of a request, and in the second."""
    return [
        Setup(ftm, count=6, faults=(flip(place, bit, "server.exit", nth),)) for bit in bits for nth in (3, 4)
    ]


def _disturbed(*words: str) -> list[Setup]:
    """A step is skipped, doubled or late in the leader."""
    faults = tuple(map(parse, words))
    return [Setup(ftm, count=8, faults=faults) for ftm in ("pbr+sup", "lfr+sup")]


MECHANISMS: Final = (
    Mutant(
        "reply before checkpoint",
        "PbrAfter sends the reply first, so the client may have one that no backup knows of",
        outcome(PbrAfter, "checkpoint_then_reply", lambda effects: effects[-1:] + effects[:-1]),
        CRASH,
        crashes("pbr", "a/after"),
        "G3",
    ),
    Mutant(
        "no dedupe",
        "Protocol executes what is asked again, though the reply is in its log",
        entered(Protocol, _LOG_IGNORED),
        CRASH,
        crashes("pbr", "a/protocol"),
        "G1",
    ),
    Mutant(
        "dedupe from the stored reply only",
        "Protocol admits an id again while it is being executed",
        entered(Protocol, _TWO_AT_ONCE),
        OWN,
        _asked_meanwhile,
        "G1",
    ),
    Mutant(
        "backup's reply not stored",
        "PbrAfter of the backup applies a checkpoint, and does not tell its Protocol of the reply in it",
        outcome(PbrAfter, "store_reply", lambda effects: effects[:1]),
        CRASH,
        crashes("pbr", "a/protocol"),
        "G1",
    ),
    Mutant(
        "checkpoint without state",
        "PbrAfter sends a checkpoint with the reply, and with no state",
        outcome(PbrAfter, "checkpoint_then_reply", _stateless),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "checkpoint not applied",
        "Server of the backup says that it has restored the state, and has not",
        heard(Server, RestoreState, _own_state),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G3",
    ),
    Mutant(
        "checkpoint forgotten",
        "PbrAfter replies without any checkpoint, though there is a backup",
        outcome(PbrAfter, "checkpoint_then_reply", lambda effects: effects[-1:]),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G3",
    ),
    Mutant(
        "page lost",
        "of the pages that have changed, the first one never travels",
        outcome(pages, "changed_pages", lambda found: found[1:]),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G3",
    ),
    Mutant(
        "stale base",
        "Server of the backup goes by the first checkpoint that it had, whatever has come since",
        wrapped(CheckpointBase, "restore", _base_not_kept),
        CLEAN,
        clean(Setup("pbr", count=6, page_bytes=PAGE_BYTES)),
        "needless_stop",
    ),
    Mutant(
        "base of before an adaptation",
        "Server sends what has changed since a checkpoint of before its After was replaced",
        both(
            skipped(CheckpointBase, "forget"),
            wrapped(CheckpointBase, "capture", _own_base),
        ),
        OWN,
        _there_and_back,
        "needless_stop",
    ),
    Mutant(
        "no whole checkpoint to a new backup",
        "PbrAfter takes a new backup for one that has what was sent to the old one",
        instead(PbrAfter, "learn_backup", learn_duplex("aft2aft")),
        CRASH,
        lambda: (replace(s, rate_hz=RARE_HZ) for s in crashes("pbr", "b/after")()),
        "needless_stop",
    ),
    Mutant(
        "promoted before its channel is drained",
        "PbrAfter of the backup leads as soon as it is told to, with checkpoints in its channel",
        entered(PbrAfter, _CHECKPOINTS_NOT_DRAINED),
        OWN,
        lambda: _promoted_with_mail("pbr", "b/after", "checkpoint.sent"),
        "G3",
    ),
    Mutant(
        "leads with requests forwarded",
        "LfrBefore of the follower leads as soon as it is told to, with requests in its channel",
        entered(LfrBefore, _REQUESTS_NOT_DRAINED),
        OWN,
        lambda: _promoted_with_mail("lfr", "b/before", "follower.notified"),
        "G3",
    ),
    Mutant(
        "request not forwarded",
        "LfrBefore of the leader passes a request on, and its follower never has it",
        outcome(LfrBefore, "forward", lambda effects: effects[-2:]),
        CRASH,
        crashes("lfr", "a/before"),
        "G3",
    ),
    Mutant(
        "forwarded after it was passed on",
        "LfrBefore of the leader has it executed first, so it may be answered and its follower not have it",
        outcome(LfrBefore, "forward", lambda effects: effects[2:] + effects[:2]),
        CRASH,
        crashes("lfr", "a/before"),
        "G3",
    ),
    Mutant(
        "held reply lost with the leader",
        "LfrAfter of the follower lets go of the reply that it holds when it hears that the leader is gone",
        answer(LfrAfter, ChannelEnded, lambda effects: []),
        CRASH,
        crashes("lfr", "a/after"),
        "G1",
    ),
    Mutant(
        "old epoch kept",
        "Protocol leads under the epoch in which it was a backup",
        wrapped(Protocol, "step", _never_promoted),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "epoch not checked",
        "Protocol and Proxy believe what comes under whatever epoch, so that no one misses a new one",
        both(
            wrapped(Protocol, "step", _never_promoted),
            heard(Protocol, Request, lambda leading, msg: replace(msg, epoch=leading.epoch)),
            wrapped(Proxy, "which_reply", _any_epoch),
        ),
        CRASH,
        crashes("pbr", "a/after"),
        "G6",
    ),
    Mutant(
        "epoch not taken over",
        "Proxy follows a new leader, and speaks to it under the epoch of the old one",
        heard(Proxy, Rebound, lambda bound, msg: replace(msg, epoch=bound.epoch or msg.epoch)),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "new leader not asked",
        "Proxy does not ask the new leader what the old one has not answered",
        answer(Proxy, Rebound, lambda effects: []),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "client does not ask again",
        "Client does not ask a new Proxy what the old one has not answered",
        answer(Client, Rebound, lambda effects: []),
        CRASH,
        crashes("pbr", "proxy"),
        "G2",
    ),
    Mutant(
        "references compared",
        "TrAfter compares what is the same object, and never sees a difference",
        instead(tr, "equal", lambda one, other: True),
        OWN,
        lambda: _flips("pbr+tr", ValuePlace.RESULT, 0),
        "G4",
    ),
    Mutant(
        "replies compared, states not",
        "TrAfter sees no fault that hits only what the function remembers",
        instead(tr, "equal", lambda one, other: one.payload == other.payload),
        OWN,
        lambda: _flips("pbr+tr", ValuePlace.STATE, *range(0, 400, 40)),
        "G4",
    ),
    Mutant(
        "second trial from the state after the first",
        "Server does not restore the state before it executes once more",
        heard(Server, Trial, _own_state),
        CLEAN,
        clean(Setup("tr", count=6), Setup("pbr+tr", count=6)),
        "G2",
    ),
    Mutant(
        "third trial skipped",
        "TrAfter answers with the second trial where the first two differ",
        instead(TrAfter, "vote", lambda self, msg: Vote.MAJORITY),
        OWN,
        lambda: _flips("lfr+tr", ValuePlace.RESULT, 0),
        "G4",
    ),
    Mutant(
        "minority wins",
        "TrAfter answers with the trial that no other one is equal to",
        wrapped(TrAfter, "reply_by_third", _minority),
        OWN,
        lambda: _flips("tr", ValuePlace.RESULT, 0),
        "G4",
    ),
    Mutant(
        "assertion always true",
        "AssertAfter lets any reply pass",
        wrapped(AssertAfter, "__init__", _gullible),
        OWN,
        lambda: _flips("pbr+assert", ValuePlace.RESULT, 0, 1, 2),
        "G4",
    ),
    Mutant(
        "no deadline",
        "SupAfter is never woken, however long a request is inside",
        instead(SupAfter, "deadline_ns", lambda self: None),
        OWN,
        lambda: _disturbed("omission prd2srv nth 4"),
        "G2",
    ),
    Mutant(
        "any reply is in order",
        "SupAfter lets the reply to another request pass",
        instead(SupAfter, "how", lambda self, msg: ReplyComes.IN_ORDER),
        OWN,
        lambda: _disturbed("duplicate srv2prd nth 4"),
        "G2",
    ),
    Mutant(
        "any request is the next one",
        "SupBefore has a request executed that was executed before",
        instead(SupBefore, "is_next", lambda self, msg: True),
        OWN,
        lambda: _disturbed("duplicate bfr2prd nth 4"),
        "G1",
    ),
    Mutant(
        "a lost backup is not told",
        "SupAfter stops a slow leader that no other replica can replace",
        instead(SupAfter, "learn_redundancy", lambda self, msg: []),
        OWN,
        lambda: _disturbed("delay srv2prd by 40ms nth 6", "crash backup at server.exit nth 4"),
        "G2",
    ),
    Mutant(
        "deaths not told",
        "Watchdog suspects no node, whichever dies",
        instead(Watchdog, "_suspect", lambda self, node, cause, now_ns: []),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "first node watched",
        "Watchdog looks at the first node of its replica, and at no other one",
        heard(Watchdog, Watch, lambda watchdog, msg: replace(msg, nodes=msg.nodes[:1])),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
)
