"""Every brick in every state against every message: legal pairs are taken, all others change nothing.

The pairs are made out of the bricks' own tables where they have one; the table of the others stands here.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import pytest
from counting import Counting
from samples import SAMPLES, inspected

from aftbed.core.brick import Brick, BrickState
from aftbed.core.errors import PeerError
from aftbed.core.message import (
    CaptureState,
    Checkpoint,
    NodeDied,
    Promote,
    Pulses,
    Rebound,
    Reply,
    Request,
    RestoreState,
    Situation,
    Submit,
    Suspect,
    Watch,
)
from aftbed.ftm import after, proceed, protocol, proxy, server
from aftbed.ftm.after import PbrAfter
from aftbed.ftm.before import PassBefore
from aftbed.ftm.client import BACKLOG_MAX, Client
from aftbed.ftm.engine import AdaptationEngine
from aftbed.ftm.proceed import Compute
from aftbed.ftm.protocol import Protocol
from aftbed.ftm.proxy import Proxy
from aftbed.ftm.recovery import Recovery
from aftbed.ftm.server import Server
from aftbed.ftm.watchdog import Watchdog

BOUND: Final = Rebound("pxy2pro", True, 1)
TELLS: Final = frozenset({Rebound})  # the runtime's word, of interest in any state

Moves = dict[tuple[BrickState, type], BrickState]


class Case(NamedTuple):
    """A brick, brought into its state by legal mail; `moves` is None where no table says what follows."""

    name: str
    make: Callable[[], Brick]
    mail: tuple[type, ...]
    legal: frozenset[type]
    moves: Moves | None = None


def by_table(
    make: Callable[[], Brick], state: BrickState, mail: tuple[type, ...], moves: Moves, tells: frozenset[type]
) -> Case:
    legal = frozenset(kind for at, kind in moves if at is state)
    return Case(f"{type(make()).__name__} {state.name}", make, mail, legal | tells, moves)


def by_hand(name: str, make: Callable[[], Brick], mail: tuple[type, ...], *legal: type) -> Case:
    return Case(name, make, mail, frozenset(legal))


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


def new_server(*, leads: bool, captured: bool = True) -> Brick:
    return Server(Counting(), 1, leads=leads, captured=captured)


def bare_server() -> Brick:
    return new_server(leads=True, captured=False)


def client_that_waits() -> Brick:
    brick = Client()
    brick.step("submit", Submit(b"what"), 0)
    return brick


_P, _A, _C = protocol.State, after.State, proceed.State
CASES: Final = (
    by_table(backup_protocol, _P.BACKUP, (), protocol.MOVES, TELLS),
    by_table(leading_protocol, _P.IDLE, (), protocol.MOVES, TELLS),
    by_table(leading_protocol, _P.BUSY, (Request,), protocol.MOVES, TELLS),
    by_table(leading_after, _A.IDLE, (), after.MOVES, TELLS),
    by_table(leading_after, _A.CAPTURING, (Reply,), after.MOVES, TELLS),
    by_table(backup_after, _A.STANDBY, (), after.MOVES, TELLS | {Promote}),
    by_table(backup_after, _A.APPLYING, (Checkpoint,), after.MOVES, TELLS | {Promote}),
    by_table(Compute, _C.IDLE, (), proceed.MOVES, TELLS),
    by_table(Compute, _C.COMPUTING, (Request,), proceed.MOVES, TELLS),
    by_hand("Proxy UNBOUND", Proxy, (), Rebound),
    by_hand("Proxy IDLE", bound_proxy, (), Rebound, Request),
    by_hand("Proxy WAITING", bound_proxy, (Request,), Rebound, Reply),
    by_hand("Server STANDBY", lambda: new_server(leads=False), (), Rebound, Request, RestoreState),
    by_hand("Server READY", lambda: new_server(leads=True), (), Rebound, Request),
    by_hand("Server EXECUTED", lambda: new_server(leads=True), (Request,), Rebound, CaptureState),
    by_hand("Server READY bare", bare_server, (Request,), Rebound, Request),
    by_hand("Client", Client, (), Rebound, Submit),
    by_hand("Client waiting", client_that_waits, (), Rebound, Submit, Reply),
    by_hand("Client full", Client, (Submit,) * BACKLOG_MAX, Rebound, Reply),
    by_hand("PassBefore", PassBefore, (), Rebound, Request),
    by_hand("Watchdog", Watchdog, (Watch,), Watch, NodeDied, Pulses, Rebound),
    by_hand("Recovery", Recovery, (), Suspect, Situation, Rebound),
    by_hand("AdaptationEngine", AdaptationEngine, (), Rebound),
)


def brought_there(case: Case) -> Brick:
    brick = case.make()
    for kind in case.mail:
        brick.step("as it should", SAMPLES[kind], 0)
    return brick


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("kind", SAMPLES, ids=lambda k: k.__name__)
def test_a_legal_message_is_taken_and_an_illegal_one_changes_nothing(case: Case, kind: type) -> None:
    brick = brought_there(case)
    before = inspected(brick)
    if kind in case.legal:
        brick.step("port", SAMPLES[kind], 0)
        moved = case.moves.get((before["state"], kind)) if case.moves else None  # type: ignore[arg-type]
        assert moved is None or vars(brick)["state"] is moved
        return
    with pytest.raises(PeerError, match=f"(?i){kind.__name__}"):
        brick.step("port", SAMPLES[kind], 0)
    assert inspected(brick) == before


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.name.startswith(("PassBefore", "Compute", "Server"))], ids=lambda c: c.name
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
        ("Protocol", protocol.State),
        ("PbrAfter", after.State),
        ("Compute", proceed.State),
        ("Proxy", proxy.State),
        ("Server", server.State),
    ],
)
def test_every_state_is_among_the_cases(name: str, states: type[BrickState]) -> None:
    covered = {vars(brought_there(c))["state"] for c in CASES if c.name.startswith(name)}
    assert covered == set(states)


def test_only_an_unbound_proxy_and_the_engine_are_open_for_nothing() -> None:
    """A brick that waits for mail which its ports do not let in would wait for ever."""
    closed = {case.name for case in CASES if not brought_there(case).open_ports()}
    assert closed == {"Proxy UNBOUND", "AdaptationEngine"}
