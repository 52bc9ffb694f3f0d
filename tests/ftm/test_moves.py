"""Every brick in every state against every message on every port: an illegal message changes nothing.

What is legal for a Machine is read off its table, which is what it executes. What is legal for the bricks
without a table stands here.
"""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple, get_args, get_type_hints

import pytest
from counting import Counting
from samples import SAMPLES, STATE, TRIED, inspected

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    SAME_STATE,
    Brick,
    BrickState,
    Choice,
    DeadlinePassed,
    Effect,
    Machine,
    Table,
)
from aftbed.core.errors import PeerError
from aftbed.core.messages import (
    Again,
    AnyMessage,
    CaptureState,
    ChannelEnded,
    Checkpoint,
    HoldAt,
    NodeDied,
    Promotion,
    Rebound,
    Reply,
    Request,
    SeenAlive,
    Situation,
    Submit,
    Suspect,
    TakeOver,
    Trial,
    Trials,
    Tried,
    Watch,
)
from aftbed.ftm.assertion import AssertAfter, AssertBefore
from aftbed.ftm.chain import Compute, InnerProtocol, PassBefore, Protocol
from aftbed.ftm.client import BACKLOG_MAX, Client, Proxy
from aftbed.ftm.failover import Recovery, Watchdog
from aftbed.ftm.lfr import LfrAfter, LfrBefore
from aftbed.ftm.pbr import PbrAfter
from aftbed.ftm.registry import KINDS, Setting, make
from aftbed.ftm.server import STATE_AFTER, STATE_BEFORE, STATE_BEFORE_AND_AFTER, Server
from aftbed.ftm.supervision import SupAfter, SupBefore
from aftbed.ftm.tr import TrAfter, TrBefore, TrProceed

Mail = tuple[tuple[str, type | AnyMessage], ...]
MACHINES: Final = (
    *(Client, Protocol, InnerProtocol, Proxy, PassBefore, Compute, Server, PbrAfter, LfrBefore, LfrAfter),
    *(TrBefore, TrProceed, TrAfter, AssertBefore, AssertAfter, SupBefore, SupAfter),
)
OTHER: Final = Tried(1, 1, 1, b"this", STATE)  # differs from TRIED
DIFFERING: Final = Trials(1, 1, (TRIED, OTHER))


class Case(NamedTuple):
    """A Machine, brought into a state by legal messages. `sample` takes the place of the one of its type."""

    make: Callable[[], Machine]
    mail: Mail = ()
    table: str = ""
    sample: AnyMessage | None = None

    def brick(self) -> Machine:
        brick = self.make()
        for port, one in self.mail:
            brick.step(port, SAMPLES[one] if isinstance(one, type) else one, 0)
        return brick

    def message(self, kind: type) -> AnyMessage:
        return self.sample if self.sample is not None and type(self.sample) is kind else SAMPLES[kind]

    def __str__(self) -> str:
        brick = self.brick()
        return " ".join(filter(None, (type(brick).__name__, brick.state.name, self.table)))


def protocol(*, leads: bool) -> Callable[[], Machine]:
    return lambda: Protocol(1, 1, leads)


def pbr_after(*, leads: bool) -> Callable[[], Machine]:
    return lambda: PbrAfter(1, leads)


def lfr_before(*, leads: bool) -> Callable[[], Machine]:
    return lambda: LfrBefore(1, leads)


def lfr_after(*, leads: bool) -> Callable[[], Machine]:
    return lambda: LfrAfter(1, leads)


def server() -> Machine:
    return Server(Counting(), 1)


def assert_after() -> Machine:
    return AssertAfter(lambda request, reply: True)


def sup_after() -> Machine:
    return SupAfter(1, leads=True)


def bound(*ports: str) -> Mail:
    return tuple((CONTROL, Rebound(port, True, 1)) for port in ports)


def tried(mail: Mail) -> Iterator[Case]:
    """A Server with these bindings after the messages that Before and Proceed send."""
    again = Trial(1, 1, b"what", STATE, rerun=True)
    table = STATE_BEFORE_AND_AFTER if len(mail) > 1 else STATE_BEFORE
    yield Case(server, mail, table)
    yield Case(server, (*mail, ("bfr2srv", CaptureState)), table)
    yield Case(server, (*mail, ("bfr2srv", CaptureState), ("prd2srv", again)), table, again)


CASES: Final = (
    Case(Client, (("submit", Submit),)),
    Case(Client, (("submit", Submit),) * BACKLOG_MAX),
    Case(Client, ((CONTROL, HoldAt), ("submit", Submit))),
    Case(protocol(leads=False)),
    Case(protocol(leads=True)),
    Case(protocol(leads=True), (("pxy2pro", Request),)),
    Case(InnerProtocol),
    Case(InnerProtocol, (("pxy2pro", Request),)),
    Case(InnerProtocol, (("pxy2pro", TakeOver),)),
    Case(Proxy),
    Case(Proxy, bound("pxy2pro")),
    Case(Proxy, (*bound("pxy2pro"), ("clt2pxy", Request))),
    Case(Proxy, (*bound("pxy2pro"), ("clt2pxy", Request), (CONTROL, Rebound("pxy2pro", False, 1)))),
    Case(PassBefore),
    Case(Compute),
    Case(Compute, (("bfr2prd", Request),)),
    Case(server),
    Case(server, (("prd2srv", Request),)),
    Case(server, bound("srv2aft"), STATE_AFTER),
    Case(server, (*bound("srv2aft"), ("prd2srv", Request)), STATE_AFTER),
    Case(server, (*bound("srv2aft"), ("prd2srv", Request), ("aft2srv", CaptureState)), STATE_AFTER),
    *tried(bound("srv2bfr")),
    *tried(bound("srv2bfr", "srv2aft")),
    Case(
        server,
        (
            *bound("srv2bfr", "srv2aft"),
            ("prd2srv", Trial(1, 1, b"what", STATE, rerun=True)),
            ("aft2srv", CaptureState),
        ),
        STATE_BEFORE_AND_AFTER,
    ),
    Case(pbr_after(leads=True)),
    Case(pbr_after(leads=True), (("prd2aft", Reply),)),
    Case(pbr_after(leads=False)),
    Case(pbr_after(leads=False), (("aft2aft", Checkpoint),)),
    Case(pbr_after(leads=False), (("aft2aft", ChannelEnded),)),
    Case(pbr_after(leads=False), ((CONTROL, Promotion),)),
    Case(pbr_after(leads=False), ((CONTROL, Promotion), ("aft2aft", Checkpoint))),
    Case(pbr_after(leads=False), (("aft2aft", ChannelEnded), (CONTROL, Promotion))),
    Case(lfr_before(leads=True)),
    Case(lfr_before(leads=False)),
    Case(lfr_before(leads=False), (("bfr2bfr", ChannelEnded),)),
    Case(lfr_before(leads=False), ((CONTROL, Promotion),)),
    Case(lfr_before(leads=False), (("bfr2bfr", ChannelEnded), (CONTROL, Promotion))),
    Case(lfr_after(leads=True)),
    Case(lfr_after(leads=False)),
    Case(lfr_after(leads=False), (("prd2aft", Reply),)),
    Case(lfr_after(leads=False), (("prd2aft", Reply), ("aft2aft", ChannelEnded))),
    Case(lfr_after(leads=False), (("prd2aft", TakeOver),)),
    Case(TrBefore),
    Case(TrBefore, (("pro2bfr", Request),)),
    Case(TrProceed),
    Case(TrProceed, (("bfr2prd", Trial),)),
    Case(TrProceed, (("bfr2prd", Trial), ("srv2prd", Tried))),
    Case(TrProceed, (("bfr2prd", Trial), ("srv2prd", Tried), ("srv2prd", OTHER))),
    Case(TrProceed, (("bfr2prd", Trial), ("srv2prd", Tried), ("srv2prd", OTHER), ("aft2prd", Again))),
    Case(TrAfter, sample=DIFFERING),
    Case(TrAfter, (("prd2aft", DIFFERING),), sample=Trials(1, 1, (TRIED,))),
    Case(AssertBefore),
    Case(assert_after),
    Case(assert_after, (("prd2aft", Reply),)),
    Case(SupBefore),
    Case(sup_after),
    Case(sup_after, (("prd2aft", Reply),)),
    Case(sup_after, (("bfr2aft", Request),)),
)


def ports_of(table: Table) -> set[str]:
    return {port for _, port, _ in table.rows} | {"elsewhere"}


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_legal_message_is_taken_and_an_illegal_one_changes_nothing(case: Case) -> None:
    table = type(case.brick()).TABLES[case.table]
    for kind, port in ((kind, port) for kind in SAMPLES for port in sorted(ports_of(table))):
        brick = case.brick()
        before, state = inspected(brick), brick.state
        row = table.rows.get((state, port, kind))
        if row is None:
            with pytest.raises(PeerError, match=f"{kind.__name__} on {port} while {state.name}"):
                brick.step(port, case.message(kind), 0)
            assert inspected(brick) == before
            continue
        brick.step(port, case.message(kind), 0)
        _, then, answers = row
        assert brick.state in ({then} if answers is None else {after for _, after in answers.values()})


@pytest.mark.parametrize("kind", MACHINES, ids=lambda k: k.__name__)
def test_every_state_of_every_table_is_among_the_cases(kind: type[Machine]) -> None:
    covered: dict[str, set[BrickState]] = {}
    for case in CASES:
        if type(case.brick()) is kind:
            covered.setdefault(case.table, set()).add(case.brick().state)
    for name, table in kind.TABLES.items():
        assert covered[name] >= {at for at, ports in table.open_ports.items() if ports}
    assert set().union(*covered.values()) == set(kind.TABLES[""].states)


@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("is_bound", [True, False])
def test_a_binding_of_a_port_that_it_has_not_changes_nothing(case: Case, is_bound: bool) -> None:
    """The runtime sends a Rebound to every brick, for every output of it."""
    brick = case.brick()
    before = inspected(brick)
    assert brick.step(CONTROL, Rebound("x", is_bound, 1), 0) == []
    assert inspected(brick) == before


@pytest.mark.parametrize("kind", [*MACHINES, AdaptationEngine], ids=lambda k: k.__name__)
def test_a_handler_takes_the_type_of_its_row(kind: type[Machine]) -> None:
    for moves in kind.all_moves().values():
        for (_, _, message), move in moves.items():
            handlers = [do for do, _ in move.moves.values()] if isinstance(move, Choice) else [move[0]]
            for method in (*handlers, *([move.question] if isinstance(move, Choice) else [])):
                hint = get_type_hints(method)["msg"]
                takes = any(issubclass(message, one) for one in get_args(hint) or (hint,))
                assert takes, f"{method.__qualname__} of {message.__name__}"


@pytest.mark.parametrize("kind", [*MACHINES, AdaptationEngine], ids=lambda k: k.__name__)
def test_a_state_with_a_request_inside_can_be_entered_and_left(kind: type[Machine]) -> None:
    entered: set[BrickState] = set()
    left: set[BrickState] = set()
    for table in kind.TABLES.values():
        for (at, _, _), (_, then, answers) in table.rows.items():
            after = {then} if answers is None else {one for _, one in answers.values()}
            entered |= {one for one in after if one is not None and one is not at}
            left |= {at} if after - {at} else set()
    busy = set(kind.TABLES[""].states) - set(kind.AT_REST)
    assert entered >= busy and left >= busy


def test_only_an_unbound_proxy_is_open_for_nothing() -> None:
    """A brick that waits for a message on a port that is closed would wait for ever."""
    closed = {str(case) for case in CASES if not case.brick().open_ports()}
    assert closed == {"Proxy UNBOUND", "Proxy UNBOUND_WAITING"}


# -- the runner -----------------------------------------------------------------------------------


class LampState(BrickState):
    DARK = "dark"
    LIT = "lit"


class Lamp(Machine):
    AT_REST = (LampState.DARK,)

    def __init__(self) -> None:
        super().__init__(LampState.DARK)

    def light(self, msg: Request) -> list[Effect]:
        if msg.request_id > 1:
            raise PeerError("too late")
        return []

    def asks_for_light(self, msg: Reply) -> object:
        return msg.payload == b"that" or msg.payload

    def go_out(self, msg: object) -> list[Effect]:
        return []

    MOVES = {  # noqa: RUF012
        (LampState.DARK, "switch", Request): (light, LampState.LIT),
        (LampState.DARK, "wall", Reply): Choice(asks_for_light, {True: (go_out, LampState.LIT)}),
        (LampState.LIT, "switch", Request): (go_out, LampState.DARK),
        (LampState.LIT, "fuse", TakeOver): (go_out, LampState.DARK),
        (ANY_STATE, "wall", TakeOver): (go_out, SAME_STATE),
    }


class LateLamp(Lamp):
    def light(self, msg: Request) -> list[Effect]:
        return super().light(Request(msg.epoch, 1, msg.payload))


def test_a_move_enters_its_state_and_opens_its_ports() -> None:
    lamp = Lamp()
    assert lamp.open_ports() == ("switch", "wall") and lamp.quiescent()
    lamp.step("switch", SAMPLES[Request], 0)
    assert lamp.open_ports() == ("switch", "fuse", "wall") and not lamp.quiescent()
    lamp.step("wall", SAMPLES[TakeOver], 0)
    assert lamp.state is LampState.LIT


def test_a_handler_that_refuses_leaves_the_state_as_it_is() -> None:
    lamp = Lamp()
    with pytest.raises(PeerError, match="too late"):
        lamp.step("switch", Request(1, 2, b""), 0)
    assert lamp.state is LampState.DARK


def test_an_answer_without_a_move_is_illegal() -> None:
    lamp = Lamp()
    with pytest.raises(PeerError, match="Reply on wall while DARK"):
        lamp.step("wall", Reply(1, 1, 1, b"other"), 0)
    lamp.step("wall", SAMPLES[Reply], 0)
    assert lamp.state is LampState.LIT


def test_a_subclass_may_override_a_handler() -> None:
    lamp = LateLamp()
    lamp.step("switch", Request(1, 2, b""), 0)
    assert lamp.state is LampState.LIT


def test_a_message_on_another_port_than_its_own_is_illegal() -> None:
    lamp = Lamp()
    with pytest.raises(PeerError, match="Request on fuse while DARK"):
        lamp.step("fuse", SAMPLES[Request], 0)


def test_the_end_of_a_deadline_is_a_row_too() -> None:
    assert any(kind is DeadlinePassed for _, _, kind in AdaptationEngine.MOVES)
    with pytest.raises(PeerError, match="DeadlinePassed on control while IDLE"):
        AdaptationEngine().wake(0)


# -- the bricks without a table -------------------------------------------------------------------


class Plain(NamedTuple):
    """A brick without states, after these messages, and the types that it takes then."""

    name: str
    make: Callable[[], Brick]
    mail: tuple[type, ...]
    legal: tuple[type, ...]


def by_hand(name: str, make: Callable[[], Brick], mail: tuple[type, ...], *legal: type) -> Plain:
    return Plain(name, make, mail, legal)


PLAIN: Final = (
    by_hand("Watchdog", Watchdog, (Watch,), Watch, NodeDied, SeenAlive, Rebound),
    by_hand("Recovery", Recovery, (), Suspect, Situation, Rebound),
)


@pytest.mark.parametrize("case", PLAIN, ids=lambda c: c.name)
@pytest.mark.parametrize("kind", SAMPLES, ids=lambda k: k.__name__)
def test_a_brick_without_a_table_takes_what_is_legal_and_nothing_else(case: Plain, kind: type) -> None:
    brick = case.make()
    for one in case.mail:
        brick.step("port", SAMPLES[one], 0)
    before = inspected(brick)
    if kind in case.legal:
        brick.step("port", SAMPLES[kind], 0)
        return
    with pytest.raises(PeerError, match=f"(?i){kind.__name__}"):
        brick.step("port", SAMPLES[kind], 0)
    assert inspected(brick) == before


def test_every_brick_is_among_the_cases() -> None:
    made = {type(make(kind, Setting(1, 1, True, Counting))) for kind in KINDS if kind != "engine"}
    assert {*MACHINES, *(type(case.make()) for case in PLAIN)} == made
    assert {type(case.make()) for case in CASES} == set(MACHINES)
