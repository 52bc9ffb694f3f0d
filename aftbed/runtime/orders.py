"""The orders that a node takes from the executive, and the faults that it was told to wait for.

Written once for all runtimes: a `Host` is what a runtime makes of a node.
"""

from typing import Final, Protocol, assert_never

from msgspec import structs

from aftbed.core.brick import Brick, Effect, Halt, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event, event_named
from aftbed.core.fault import Act, Flip, Place, flipped, mark
from aftbed.core.message import Message, Reply, StateCaptured, Tried, Watch
from aftbed.runtime import control

Fds = list[int]
WATCHDOG: Final = "{}/watchdog"


class Hosted(Protocol):
    """A brick in its node."""

    name: str
    brick: Brick


class Host(Protocol):
    """A node, as an order finds it."""

    armed: dict[Event, control.Arm]

    def hosted(self, brick: str) -> Hosted:
        """The brick of that name. Raises KeyError."""
        ...

    def bind_input(self, brick: str, port: str, end: int | None) -> None:
        """Read `port` from that end of a channel, or from nowhere."""
        ...

    def bind_output(self, brick: str, port: str, end: int | None, epoch: int) -> None:
        """Write `port` to that end, or to nowhere, and tell the brick."""
        ...

    def suspend(self, token: int, *, drain: bool) -> None:
        """Answer `token` as soon as no request is inside (`drain`: nor waits)."""
        ...

    def resume(self) -> None:
        """Undo `suspend`."""
        ...

    def tell(self, brick: str, message: control.Told) -> None:
        """Have `brick` step with `message`."""
        ...

    def watch(self, order: control.WatchNodes, fds: Fds) -> None:
        """Have the Watchdog watch these."""
        ...

    def stats(self) -> bytes:
        """What its device counts."""
        ...

    def quiet(self) -> None:
        """Its device hands in nothing more."""
        ...

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        ...

    def say(self, report: control.FromNode) -> None:
        """To the executive."""
        ...

    def strike_itself(self, act: Act) -> None:
        """Die, or stop, here and now."""
        ...

    def wait_until_hit(self, fault: int) -> None:
        """Go no further until the executive has answered for `fault`."""
        ...

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end here and now."""
        ...


def carry_out(node: Host, order: control.ToNode, fds: Fds) -> bytes | None:
    """Do what `order` says; the data of its Ack, or None where the Ack comes later.

    Raises PeerError where a brick refuses, or the order is not for a node.
    """
    match order:
        case control.BindInput(_, brick, port):
            node.bind_input(brick, port, fds.pop() if fds else None)
        case control.BindOutput(_, brick, port, epoch):
            node.bind_output(brick, port, fds.pop() if fds else None, epoch)
        case control.Follow(_, brick, port, output, epoch):
            read, write = fds
            node.bind_input(brick, port, read)
            node.bind_output(brick, output, write, epoch)
        case control.Rewire():
            return _rewire(node, order, fds)
        case control.Suspend(token, drain):
            node.suspend(token, drain=drain)
            return None  # answered when quiescent
        case control.Resume():
            node.resume()
        case control.Capture(_, brick):
            return node.hosted(brick).brick.capture()
        case control.Restore(_, brick, state, migrate):
            taker = node.hosted(brick).brick
            take = getattr(taker, "migrate", taker.restore) if migrate else taker.restore
            take(state)
        case control.Tell(_, brick, message):
            node.tell(brick, message)
        case control.WatchNodes():
            node.watch(order, fds)
            node.tell(WATCHDOG.format(order.replica), Watch(order.replica, order.generation, order.nodes))
        case control.Arm():
            _arm(node, order)
        case control.Stats():
            return node.stats()
        case control.Quiet():
            node.quiet()
        case control.Park() | control.Assign() | control.Serve() | control.Stop() | control.Ack():
            raise PeerError(f"{type(order).__name__} to a node")
        case _:
            assert_never(order)
    return b""


def _rewire(node: Host, order: control.Rewire, fds: Fds) -> bytes | None:
    for port in order.inputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.bind_input(port.brick, port.port, found)
    for port in order.outputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.bind_output(port.brick, port.port, found, order.epoch)
    if not order.suspend:
        return b""
    node.suspend(order.token, drain=False)
    return None  # answered when quiescent


# -- faults ---------------------------------------------------------------------------------------


def _arm(node: Host, order: control.Arm) -> None:
    """Faults that wait for the same event go on counting; one that is told of again begins anew."""
    event = event_named(order.event)
    before = node.armed.pop(event, None)
    told = {blow.fault for blow in order.blows}
    kept = [blow for blow in before.blows if blow.fault not in told] if before is not None else []
    blows = (*kept, *(blow for blow in order.blows if blow.nth))
    if blows:
        node.armed[event] = control.Arm(control.UNANSWERED, order.event, blows)


def fire(node: Host, hosted: Hosted, effects: list[Effect], note: Note) -> None:
    """`note`, one of `effects`, is being performed: what waits for it and is due happens now.

    A bit is flipped in what is sent behind it, so `effects` may be others from there on.
    """
    arm = node.armed.get(note.event)
    if arm is None:
        return
    counted = [b if b.brick != hosted.name else structs.replace(b, nth=b.nth - 1) for b in arm.blows]
    _arm(node, control.Arm(control.UNANSWERED, arm.event, tuple(counted)))
    for blow in counted:
        if blow.nth == 0 and blow.flip is not None:
            _flip(node, hosted, effects, note, blow, blow.flip)
        elif blow.nth == 0:
            _strike(node, blow)


def _strike(node: Host, blow: control.Blow) -> None:
    """Do it to ourselves, or wait until the supervisor has done it."""
    node.record(Event.FAULT_APPLIED, 0, mark(blow.fault))
    if blow.itself:
        node.strike_itself(blow.act)
        return
    node.say(control.Fired(blow.fault))
    node.wait_until_hit(blow.fault)


def _flip(
    node: Host, hosted: Hosted, effects: list[Effect], note: Note, blow: control.Blow, flip: Flip
) -> None:
    """Hit what the Server has just made; the message that carries it away shows it.

    The journal says which bit was hit, or, where that did not come to be, how many bits there were.
    """
    behind = next(i for i, effect in enumerate(effects) if effect is note) + 1
    at, send = next((i, e) for i, e in enumerate(effects) if i >= behind and isinstance(e, Send))
    data = _aimed_at(hosted.brick, send.message, flip.place)
    bits = 8 * len(data)
    bit = flip.bit if flip.bit is not None else blow.draw % max(1, bits)
    message = None
    if bit < bits:
        message = _hit(hosted.brick, send.message, flip.place, data, bit)
    if message is None:
        node.record(Event.PEER_REFUSED, note.request_id, mark(blow.fault, bits))
    else:
        effects[at] = Send(send.port, message)
        node.record(Event.FAULT_APPLIED, note.request_id, mark(blow.fault, bit))
    node.say(control.Fired(blow.fault))  # nobody has to be waited for


def _aimed_at(brick: Brick, message: Message, place: Place) -> bytes:
    """The bytes that have the bit; none where the function does not hand out its state."""
    if place is Place.RESULT:
        assert isinstance(message, Reply | Tried), message
        return message.payload
    try:
        return brick.capture()
    except PeerError:
        return b""


def _hit(brick: Brick, message: Message, place: Place, data: bytes, bit: int) -> Message | None:
    """What `message` is after the hit; None where the function refuses such a state, or ignores the bit."""
    if place is Place.RESULT:
        return structs.replace(message, payload=flipped(data, bit))
    try:
        brick.restore(flipped(data, bit))
    except PeerError:
        return None
    state = brick.capture()
    if state == data:
        return None
    return structs.replace(message, state=state) if isinstance(message, Tried | StateCaptured) else message


def order_or_halt(node: Host, hosted: Hosted, effect: Effect) -> None:
    """The rare effects: a script for the runtime, or the end of this node."""
    if isinstance(effect, Order):
        node.say(control.Ordered(hosted.name, effect.script, effect.phase, effect.number))
        return
    assert isinstance(effect, Halt)
    node.stop_detected(hosted.name, effect.reason)
