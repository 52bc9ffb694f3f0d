"""Every brick in every state against every message: legal pairs are taken, all others change nothing.

The pairs are made out of the bricks' own tables where they have one; the table of the others stands here.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import pytest
from counting import Counting
from samples import SAMPLES, STATE, TRIED, inspected

from aftbed.core.brick import Brick, BrickState
from aftbed.core.errors import PeerError
from aftbed.core.messages import (
    Again,
    AnyMessage,
    CaptureState,
    ChannelEnded,
    Checkpoint,
    HoldAt,
    NodeDied,
    Promote,
    Pulses,
    Rebound,
    Release,
    Reply,
    Request,
    RestoreState,
    Situation,
    Submit,
    Suspect,
    TakeOver,
    Trial,
    Trials,
    Tried,
    Watch,
)
from aftbed.ftm import assertion, chain, client, lfr, pbr, server, tr
from aftbed.ftm.assertion import AssertAfter, AssertBefore
from aftbed.ftm.chain import Compute, InnerProtocol, PassBefore, Protocol
from aftbed.ftm.client import BACKLOG_MAX, Client, Proxy
from aftbed.ftm.failover import Recovery, Watchdog
from aftbed.ftm.lfr import LfrAfter, LfrBefore
from aftbed.ftm.pbr import PbrAfter
from aftbed.ftm.registry import KINDS, Setting, make
from aftbed.ftm.server import Server
from aftbed.ftm.tr import TrAfter, TrBefore, TrProceed

BOUND: Final = Rebound("pxy2pro", True, 1)
TELLS: Final = frozenset({Rebound})  # the runtime's word, of interest in any state

Moves = dict[tuple[BrickState, type], BrickState]


class Case(NamedTuple):
    """A brick, brought into its state by legal mail; `moves` is None where no table says what follows.

    `sample` takes the place of the one of its type. A Server goes by the `port` of a message too.
    """

    name: str
    make: Callable[[], Brick]
    mail: tuple[type | AnyMessage, ...]
    legal: frozenset[type]
    moves: Moves | None = None
    sample: AnyMessage | None = None
    port: str = "port"

    def message(self, kind: type) -> AnyMessage:
        return self.sample if type(self.sample) is kind and self.sample is not None else SAMPLES[kind]


def by_table(
    make: Callable[[], Brick],
    state: BrickState,
    mail: tuple[type | AnyMessage, ...],
    moves: Moves,
    tells: frozenset[type],
    sample: AnyMessage | None = None,
) -> Case:
    legal = frozenset(kind for at, kind in moves if at is state)
    return Case(f"{type(make()).__name__} {state.name}", make, mail, legal | tells, moves, sample)


def by_hand(
    name: str, make: Callable[[], Brick], mail: tuple[type, ...], *legal: type, port: str = "port"
) -> Case:
    return Case(name, make, mail, frozenset(legal), port=port)


def backup_protocol() -> Brick:
    return Protocol(2, 1, leads=False)


def leading_protocol() -> Brick:
    return Protocol(1, 1, leads=True)


def backup_after() -> Brick:
    return PbrAfter(1, leads=False)


def leading_after() -> Brick:
    return PbrAfter(1, leads=True)


def bound_proxy() -> Brick:
    brick = Proxy()
    brick.step("control", BOUND, 0)
    return brick


def server_of(*outputs: str) -> Callable[[], Brick]:
    def make() -> Brick:
        brick = Server(Counting(), 1)
        for port in outputs:
            brick.step("control", Rebound(port, True, 1), 0)
        return brick

    return make


def leading_lfr_before() -> Brick:
    return LfrBefore(1, leads=True)


def following_lfr_before() -> Brick:
    return LfrBefore(1, leads=False)


def leading_lfr_after() -> Brick:
    return LfrAfter(1, leads=True)


def following_lfr_after() -> Brick:
    return LfrAfter(1, leads=False)


def assert_after() -> Brick:
    return AssertAfter(lambda request, reply: True)


def client_that_waits() -> Brick:
    brick = Client()
    brick.step("submit", Submit(b"what"), 0)
    return brick


_P, _A, _C = chain.ProtocolState, pbr.PbrAfterState, chain.ComputeState
_LB, _LA, _TP = lfr.LfrBeforeState, lfr.LfrAfterState, tr.TrProceedState
DIFFERING: Final = Trials(1, 1, (TRIED, Tried(1, 1, 1, b"this", STATE)))

Legal = dict[str, tuple[type, ...]]  # by port
STANDBY: Final[Legal] = {
    "prd2srv": (Request, Trial),
    "aft2srv": (RestoreState,),
    "bfr2srv": (CaptureState,),
    "srv2prd": (),
}
READY: Final[Legal] = {"prd2srv": (Request, Trial), "aft2srv": (), "bfr2srv": (CaptureState,)}
EXECUTED: Final[Legal] = {"prd2srv": (), "aft2srv": (CaptureState,), "bfr2srv": ()}
TRYING: Final[Legal] = {"prd2srv": (Trial,), "aft2srv": (), "bfr2srv": ()}
CASES: Final = (
    by_table(backup_protocol, _P.BACKUP, (), chain.PROTOCOL_MOVES, TELLS),
    by_table(leading_protocol, _P.IDLE, (), chain.PROTOCOL_MOVES, TELLS),
    by_table(leading_protocol, _P.BUSY, (Request,), chain.PROTOCOL_MOVES, TELLS),
    by_table(leading_after, _A.IDLE, (), pbr.MOVES, TELLS),
    by_table(leading_after, _A.CAPTURING, (Reply,), pbr.MOVES, TELLS),
    by_table(backup_after, _A.STANDBY, (), pbr.MOVES, TELLS | {Promote}),
    by_table(backup_after, _A.APPLYING, (Checkpoint,), pbr.MOVES, TELLS | {Promote}),
    by_table(Compute, _C.IDLE, (), chain.COMPUTE_MOVES, TELLS),
    by_table(Compute, _C.COMPUTING, (Request,), chain.COMPUTE_MOVES, TELLS),
    by_hand("Proxy UNBOUND", Proxy, (), Rebound),
    by_hand("Proxy IDLE", bound_proxy, (), Rebound, Request),
    by_hand("Proxy WAITING", bound_proxy, (Request,), Rebound, Reply),
    *(
        by_hand(f"Server {state} of {name} on {port}", server_of(*outputs), mail, *legal, Rebound, port=port)
        for name, outputs in (("lfr", ()), ("pbr", ("srv2aft",)), ("pbr+tr", ("srv2aft", "srv2bfr")))
        for state, mail, ports in (
            ("STANDBY", (), STANDBY),
            ("after a request", (Request,), EXECUTED if outputs else READY),
            ("after the state", (Request, CaptureState), READY),
            ("after a trial", (Trial,), TRYING),
        )
        if outputs or CaptureState not in mail
        for port, legal in ports.items()
    ),
    by_table(InnerProtocol, chain.InnerState.IDLE, (), chain.INNER_MOVES, TELLS),
    by_table(InnerProtocol, chain.InnerState.BUSY, (Request,), chain.INNER_MOVES, TELLS),
    by_table(InnerProtocol, chain.InnerState.HANDING_ON, (TakeOver,), chain.INNER_MOVES, TELLS),
    by_table(leading_lfr_before, _LB.LEADING, (), lfr.BEFORE_MOVES, TELLS),
    by_table(following_lfr_before, _LB.FOLLOWING, (), lfr.BEFORE_MOVES, TELLS | {Promote}),
    by_table(following_lfr_before, _LB.LEADING, (ChannelEnded, Promote), lfr.BEFORE_MOVES, TELLS),
    by_table(leading_lfr_after, _LA.LEADING, (), lfr.AFTER_MOVES, TELLS),
    by_table(following_lfr_after, _LA.FOLLOWING, (), lfr.AFTER_MOVES, TELLS),
    by_table(following_lfr_after, _LA.HOLDING, (Reply,), lfr.AFTER_MOVES, TELLS),
    by_table(following_lfr_after, _LA.LEADING, (TakeOver,), lfr.AFTER_MOVES, TELLS),
    by_table(TrBefore, tr.TrBeforeState.IDLE, (), tr.BEFORE_MOVES, TELLS),
    by_table(TrBefore, tr.TrBeforeState.CAPTURING, (Request,), tr.BEFORE_MOVES, TELLS),
    by_table(TrProceed, _TP.IDLE, (), tr.PROCEED_MOVES, TELLS),
    by_table(TrProceed, _TP.FIRST, (Trial,), tr.PROCEED_MOVES, TELLS),
    by_table(TrProceed, _TP.SECOND, (Trial, Tried), tr.PROCEED_MOVES, TELLS),
    by_table(TrProceed, _TP.VOTING, (Trial, Tried, Tried), tr.PROCEED_MOVES, TELLS),
    by_table(TrProceed, _TP.THIRD, (Trial, Tried, Tried, Again), tr.PROCEED_MOVES, TELLS),
    by_table(TrAfter, tr.TrAfterState.IDLE, (), tr.AFTER_MOVES, TELLS, DIFFERING),
    by_table(TrAfter, tr.TrAfterState.ASKED, (DIFFERING,), tr.AFTER_MOVES, TELLS, Trials(1, 1, (TRIED,))),
    by_hand("AssertBefore", AssertBefore, (), Rebound, Request, TakeOver),
    by_table(assert_after, assertion.AssertAfterState.IDLE, (), assertion.MOVES, TELLS),
    by_table(assert_after, assertion.AssertAfterState.HOLDING, (Reply,), assertion.MOVES, TELLS),
    by_hand("Client", Client, (), Rebound, HoldAt, Release, Submit),
    by_hand("Client waiting", client_that_waits, (), Rebound, HoldAt, Release, Submit, Reply),
    by_hand("Client full", Client, (Submit,) * BACKLOG_MAX, Rebound, HoldAt, Release, Reply),
    by_hand("PassBefore", PassBefore, (), Rebound, Request, TakeOver),
    by_hand("Watchdog", Watchdog, (Watch,), Watch, NodeDied, Pulses, Rebound),
    by_hand("Recovery", Recovery, (), Suspect, Situation, Rebound),
)


def brought_there(case: Case) -> Brick:
    brick = case.make()
    for one in case.mail:
        message = SAMPLES[one] if isinstance(one, type) else one
        brick.step("aft2srv" if one is CaptureState else "prd2srv", message, 0)
    return brick


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("kind", SAMPLES, ids=lambda k: k.__name__)
def test_a_legal_message_is_taken_and_an_illegal_one_changes_nothing(case: Case, kind: type) -> None:
    brick = brought_there(case)
    before = inspected(brick)
    if kind in case.legal:
        brick.step(case.port, case.message(kind), 0)
        moved = case.moves.get((before["state"], kind)) if case.moves else None  # type: ignore[arg-type]
        assert moved is None or vars(brick)["state"] is moved
        return
    with pytest.raises(PeerError, match=f"(?i){kind.__name__}"):
        brick.step(case.port, case.message(kind), 0)
    assert inspected(brick) == before


@pytest.mark.parametrize(
    "case",
    [c for c in CASES if not c.name.startswith(("Client", "Proxy", "Watchdog"))],
    ids=lambda c: c.name,
)
@pytest.mark.parametrize("bound", [True, False])
def test_where_a_port_leads_is_nothing_to_a_brick_that_asks_nothing_again(case: Case, bound: bool) -> None:
    """Every brick is told of every output of its own; these have nothing to do about it."""
    brick = brought_there(case)
    before = inspected(brick)
    assert brick.step("control", Rebound("x", bound, 1), 0) == []
    assert inspected(brick) == before


@pytest.mark.parametrize(
    ("name", "states"),
    [
        ("Protocol", chain.ProtocolState),
        ("PbrAfter", pbr.PbrAfterState),
        ("Compute", chain.ComputeState),
        ("Proxy", client.ProxyState),
        ("Server", server.ServerState),
        ("InnerProtocol", chain.InnerState),
        ("LfrBefore", lfr.LfrBeforeState),
        ("LfrAfter", lfr.LfrAfterState),
        ("TrBefore", tr.TrBeforeState),
        ("TrProceed", tr.TrProceedState),
        ("TrAfter", tr.TrAfterState),
        ("AssertAfter", assertion.AssertAfterState),
    ],
)
def test_every_state_is_among_the_cases(name: str, states: type[BrickState]) -> None:
    covered = {vars(brought_there(c))["state"] for c in CASES if c.name.startswith(name)}
    assert covered == set(states)


def test_every_brick_is_among_the_cases() -> None:
    made = {type(make(kind, Setting(1, 1, True, Counting))) for kind in KINDS if kind != "engine"}
    assert {type(case.make()) for case in CASES} == made


def test_only_an_unbound_proxy_is_open_for_nothing() -> None:
    """A brick that waits for mail which its ports do not let in would wait for ever."""
    closed = {case.name for case in CASES if not brought_there(case).open_ports()}
    assert closed == {"Proxy UNBOUND"}
