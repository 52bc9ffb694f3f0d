"""The faults that a node was told to wait for, and what it does to itself when they are due.

Written once for all runtimes. Nearly all wait for a Note: it is being performed, all effects before it are,
none behind it is. Two values are out of reach by then, what the Server was handed and what has gone to the
backup; so when their event is next, the brick's `step` is *tapped*: what goes in, or what comes out, is hit,
and the tap is taken away. Nothing here is run by a node that no fault waits in.
"""

import math
from collections.abc import Iterable
from typing import Final, assert_never

import msgspec
from msgspec import structs

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event, event_named
from aftbed.core.fault import Disturb, mark
from aftbed.core.messages import (
    AnyMessage,
    Checkpoint,
    Message,
    Reply,
    Request,
    StateCaptured,
    StoreReply,
    Trial,
    Tried,
)
from aftbed.core.persistence import gap
from aftbed.core.valuefault import Flip, Place, changed, hit
from aftbed.runtime import control
from aftbed.runtime.diversion import BITTEN, Diversion, Meddler
from aftbed.runtime.host import Host, Hosted

OFF_THE_FAST_WAY: Final = control.Arm(control.UNANSWERED, Event.FAULT_APPLIED.label, ())  # nothing emits it
TAPPED: Final = (Place.REQUEST, Place.CHECKPOINT)
Log = tuple[int, list[tuple[int, bytes]]]  # as a Protocol hands it out: the last id, ids with their replies


def take(node: Host, order: control.Arm | control.Interfere | control.SlowDown) -> None:
    """What a node is told of faults."""
    match order:
        case control.Arm():
            arm(node, order)
        case control.Interfere(_, blow):
            interfere(node, blow)
        case control.SlowDown():
            slow_down(node, order)
        case _:
            assert_never(order)


def arm(node: Host, order: control.Arm) -> None:
    """Faults that wait for the same event go on counting; one that is told of again begins anew."""
    event = event_named(order.event)
    before = node.armed.pop(event, None)
    told = {blow.fault for blow in order.blows}
    kept = [blow for blow in before.blows if blow.fault not in told] if before is not None else []
    blows = (*kept, *(blow for blow in order.blows if blow.nth))
    if blows:
        node.armed[event] = control.Arm(control.UNANSWERED, order.event, blows)
    _tap_anew(node, before.blows if before is not None else ())


def fire(node: Host, hosted: Hosted, effects: list[Effect], note: Note) -> None:
    """`note`, one of `effects`, is being performed: what waits for it and is due happens now.

    A value is hit in what is sent behind it, so `effects` may be others from there on.
    """
    armed = node.armed.get(note.event)
    if armed is None:
        return
    counted = [b if b.brick != hosted.name else structs.replace(b, nth=b.nth - 1) for b in armed.blows]
    arm(node, control.Arm(control.UNANSWERED, armed.event, tuple(map(_again, counted))))
    for blow in counted:
        if blow.nth == 0 and isinstance(blow.action, Flip) and not blow.action.field:
            if blow.action.place not in TAPPED:
                _flip(node, hosted, effects, note, blow, blow.action)
        elif blow.nth == 0:
            _strike(node, blow)


def _again(blow: control.Blow) -> control.Blow:
    """What is left of `blow` when it is due: nothing, or the way to its next strike."""
    if blow.nth:
        return blow
    struck = blow.struck + 1
    return structs.replace(blow, nth=gap(blow.persistence, blow.draw, struck), struck=struck)


def _strike(node: Host, blow: control.Blow) -> None:
    """Do it to ourselves, or wait until the executive has done it."""
    node.record(Event.FAULT_APPLIED, 0, mark(blow.fault))
    if blow.itself:
        node.die_here()
        return
    node.say(control.Fired(blow.fault))
    node.wait_until_hit(blow.fault)


# -- values ---------------------------------------------------------------------------------------


def _flip(
    node: Host, hosted: Hosted, effects: list[Effect], note: Note, blow: control.Blow, flip: Flip
) -> None:
    """Hit what the brick has in hand; the message that carries it away shows it."""
    behind = next(i for i, effect in enumerate(effects) if effect is note) + 1
    at, send = next((i, e) for i, e in enumerate(effects) if i >= behind and isinstance(e, Send))
    data = _aimed_at(hosted.brick, send.message, flip.place, note)
    bits = hit(flip.pattern, data, blow.draw)
    message = None
    if bits:
        message = _hit(hosted.brick, send.message, flip.place, note, changed(data, bits))
    if message is not None:
        effects[at] = Send(send.port, message)
    _tell(node, blow, note.request_id, bits if message is not None else (), 8 * len(data))


def _tell(node: Host, blow: control.Blow, about: int, bits: tuple[int, ...] | None, size: int) -> None:
    """The journal says which bits were hit, or, where that did not come to be, how many there were.

    Of a fault that strikes again and again, only the first attempt that fails is written down.
    """
    for bit in bits or ():
        node.record(Event.FAULT_APPLIED, about, mark(blow.fault, bit))
    if not bits and not blow.struck:
        node.record(Event.PEER_REFUSED, about, mark(blow.fault, size))
    if not blow.struck:
        node.say(control.Fired(blow.fault))  # nobody has to be waited for


def _aimed_at(brick: Brick, message: Message, place: Place, note: Note) -> bytes:
    """The bytes that have the bits; none where the brick does not hand them out."""
    if place is Place.LOG and note.event is Event.REPLY_STORED:
        log = _log(brick)
        return dict(log[1]).get(note.request_id, b"") if log is not None else b""
    if place is not Place.STATE:
        assert isinstance(message, Reply | Tried | StoreReply), message
        return message.payload
    try:
        return brick.capture()
    except PeerError:
        return b""


def _hit(brick: Brick, message: Message, place: Place, note: Note, data: bytes) -> Message | None:
    """What `message` is after the hit; None where the brick refuses such a state, or ignores the bits."""
    if place is Place.LOG and note.event is not Event.CHECKPOINT_APPLIED and not _relog(brick, note, data):
        return None
    if place is Place.LOG and note.event is Event.REPLY_STORED:
        return message  # the reply itself is as it should be
    if place is not Place.STATE:
        return structs.replace(message, payload=data)
    before = brick.capture()
    try:
        brick.restore(data)
    except PeerError:
        return None
    state = brick.capture()
    if state == before:
        return None
    return structs.replace(message, state=state) if isinstance(message, Tried | StateCaptured) else message


def _log(brick: Brick) -> Log | None:
    """The replies that a Protocol keeps; None where it hands out something else."""
    try:
        log: Log = msgspec.msgpack.decode(brick.capture(), type=Log)
    except (msgspec.DecodeError, PeerError):
        return None
    return log


def _relog(brick: Brick, note: Note, reply: bytes) -> bool:
    """Keep `reply` for the request of `note`; False if the Protocol does not take it."""
    log = _log(brick)
    if log is None:
        return False
    kept = [(number, reply if number == note.request_id else payload) for number, payload in log[1]]
    try:
        brick.restore(msgspec.msgpack.encode((log[0], kept)))
    except PeerError:
        return False
    return True


# -- taps -----------------------------------------------------------------------------------------


def _tap_anew(node: Host, gone: Iterable[control.Blow]) -> None:
    """Tap the bricks whose event is next; `gone` may have tapped some that no longer need it."""
    waiting = [blow for armed in node.armed.values() for blow in armed.blows]
    taps = [
        (b, b.action) for b in (*gone, *waiting) if isinstance(b.action, Flip) and b.action.place in TAPPED
    ]
    for blow, _ in taps:
        vars(node.hosted(blow.brick).brick).pop("step", None)
    for blow, flip in taps:
        if blow.nth == 1 and blow in waiting:
            _tap(node, node.hosted(blow.brick).brick, blow, flip)


def _tap(node: Host, brick: Brick, blow: control.Blow, flip: Flip) -> None:
    """Hit the next request that goes into `brick`, or the next checkpoint that comes out of it."""
    step = brick.step

    def tapped(port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if flip.place is Place.CHECKPOINT:
            return _checkpoint_hit(node, blow, flip, step(port, msg, now_ns))
        if not isinstance(msg, Request | Trial):
            return step(port, msg, now_ns)
        bits = hit(flip.pattern, msg.payload, blow.draw)
        handed = structs.replace(msg, payload=changed(msg.payload, bits)) if bits else msg
        effects = step(port, handed, now_ns)  # raises where it is no request's turn: then nothing was hit
        _tell(node, blow, msg.request_id, bits, 8 * len(msg.payload))
        return effects

    vars(brick)["step"] = tapped


def _checkpoint_hit(node: Host, blow: control.Blow, flip: Flip, effects: list[Effect]) -> list[Effect]:
    for at, effect in enumerate(effects):
        if isinstance(effect, Send) and isinstance(effect.message, Checkpoint):
            sent = effect.message
            data = sent.state + sent.reply
            bits = hit(flip.pattern, data, blow.draw)
            if bits:
                data, length = changed(data, bits), len(sent.state)
                other = structs.replace(sent, state=data[:length], reply=data[length:])
                effects = [*effects[:at], Send(effect.port, other), *effects[at + 1 :]]
            _tell(node, blow, sent.request_id, bits, 8 * len(data))
            break
    return effects


# -- channels and time ----------------------------------------------------------------------------


def interfere(node: Host, blow: control.Blow) -> None:
    """Have a fault of a channel wait at its sender, or wait there no longer. Raises PeerError."""
    assert isinstance(blow.action, Disturb)
    key = (blow.brick, blow.action.channel)
    diversion = node.diverted.get(key)
    if blow.nth == 0:
        if diversion is not None:
            diversion.stop(blow.fault)
    else:
        diversion = node.diverted.setdefault(key, Diversion())
        diversion.add(blow.fault, Meddler(blow, _Noting(node, blow)))
    node.divert(*key)


class _Noting:
    """Writes down what a fault of a channel did, and says it once."""

    def __init__(self, node: Host, blow: control.Blow) -> None:
        self._node, self._fault, self._said = node, blow.fault, False

    def __call__(self, what: int, about: int) -> None:
        self._node.record(Event.FAULT_APPLIED, about, mark(self._fault, what))
        if what == BITTEN and not self._said:
            self._said = True
            self._node.say(control.Fired(self._fault))


def slow_down(node: Host, order: control.SlowDown) -> None:
    """Have each step take so much longer, or no longer."""
    node.slowed.pop(order.fault, None)
    if order.by_ns or order.share < control.WHOLE:
        node.slowed[order.fault] = order
    node.slow()


class Slowness:
    """How much longer a step takes. It is written down of each fault when that is felt for the first time."""

    def __init__(self, node: Host) -> None:
        self._node = node
        self._felt: set[int] = set()

    def longer_ns(self) -> int:
        """A step is being taken: by how many ns it is slower."""
        return sum(self._feel(order).by_ns for order in self._slowed() if order.by_ns)

    def stretched_ns(self, used_ns: int) -> int:
        """Of a CPU, so much was used: how many ns more it would have taken with no more than its share."""
        shares = [self._feel(order).share for order in self._slowed() if order.share < control.WHOLE]
        return round(used_ns * (1 / math.prod(shares) - 1))

    def _slowed(self) -> list[control.SlowDown]:
        return list(self._node.slowed.values())

    def _feel(self, order: control.SlowDown) -> control.SlowDown:
        if order.fault not in self._felt:
            self._felt.add(order.fault)
            self._node.record(Event.FAULT_APPLIED, 0, mark(order.fault))
        return order
