"""The orders that a node takes from the supervisor, and the faults that it was told to wait for."""

import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Final, assert_never

from msgspec import structs

from aftbed.core.brick import CONTROL, Brick, Effect, Halt, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event, event_named
from aftbed.core.fault import Act, Flip, Place, flipped, mark
from aftbed.core.message import Message, Reply, StateCaptured, Tried, Watch
from aftbed.runtime.unix import control
from aftbed.runtime.unix.devices import Sensor
from aftbed.runtime.unix.wiring import Hosted

if TYPE_CHECKING:
    from aftbed.runtime.unix.node import Node

FAULT_SECONDS_MAX: Final = 5.0
EXIT_DETECTED: Final = 71  # a detected stop


def carry_out(node: "Node", order: control.ToNode, fds: list[int]) -> bytes | None:
    """Do what `order` says; the data of its Ack, or None where the Ack comes later.

    Raises PeerError where a brick refuses, or the order is not for a node.
    """
    wiring = node.wiring
    match order:
        case control.BindInput(_, brick, port):
            wiring.bind_input(brick, port, fds.pop() if fds else None)
        case control.BindOutput(_, brick, port, epoch):
            node.bind_output(brick, port, fds.pop() if fds else None, epoch)
        case control.Follow(_, brick, port, output, epoch):
            read, write = fds
            wiring.bind_input(brick, port, read)
            node.bind_output(brick, output, write, epoch)
        case control.Rewire():
            return _rewire(node, order, fds)
        case control.Suspend(token, drain):
            node.suspend_token, node.draining = token, drain
            return None  # answered when quiescent
        case control.Resume():
            node.suspended, node.suspend_token = False, 0
        case control.Capture(_, brick):
            return wiring.hosted[brick].brick.capture()
        case control.Restore(_, brick, state, migrate):
            taker = wiring.hosted[brick].brick
            take = getattr(taker, "migrate", taker.restore) if migrate else taker.restore
            take(state)
        case control.Tell(_, brick, message):
            node.step(wiring.hosted[brick], CONTROL, message)
        case control.WatchNodes():
            _watch(node, order, fds)
        case control.Arm():
            _arm(node, order)
        case control.Stats():
            return node.device.stats() if node.device is not None else b""
        case control.Quiet():
            assert node.device is not None
            node.device.quiet()
        case control.Park() | control.Assign() | control.Serve() | control.Stop() | control.Ack():
            raise PeerError(f"{type(order).__name__} to a node")
        case _:
            assert_never(order)
    return b""


def _rewire(node: "Node", order: control.Rewire, fds: list[int]) -> bytes | None:
    for port in order.inputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.wiring.bind_input(port.brick, port.port, found)
    for port in order.outputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.bind_output(port.brick, port.port, found, order.epoch)
    if not order.suspend:
        return b""
    node.suspend_token, node.draining = order.token, False
    return None  # answered when quiescent


def _watch(node: "Node", order: control.WatchNodes, fds: list[int]) -> None:
    assert isinstance(node.device, Sensor) and node.device_brick is not None
    node.device.watch(order.nodes, order.journals, order.pids, fds)
    node.wiring.forget_plans()
    node.step(node.device_brick, CONTROL, Watch(order.replica, order.generation, order.nodes))


# -- faults ---------------------------------------------------------------------------------------


def _arm(node: "Node", order: control.Arm) -> None:
    """Faults that wait for the same event go on counting; one that is told of again begins anew."""
    event = event_named(order.event)
    before = node.armed.pop(event, None)
    told = {blow.fault for blow in order.blows}
    kept = [blow for blow in before.blows if blow.fault not in told] if before is not None else []
    blows = (*kept, *(blow for blow in order.blows if blow.nth))
    if blows:
        node.armed[event] = control.Arm(control.UNANSWERED, order.event, blows)


def fire(node: "Node", hosted: Hosted, effects: list[Effect], note: Note) -> None:
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


def _strike(node: "Node", blow: control.Blow) -> None:
    """Do it to ourselves, or wait until the supervisor has done it."""
    node.journal.write(time.monotonic_ns(), Event.FAULT_APPLIED, 0, mark(blow.fault))
    if blow.itself:
        os.kill(os.getpid(), signal.SIGKILL if blow.act is Act.CRASH else signal.SIGSTOP)
        return
    node.line.send(control.Fired(blow.fault))
    limit = time.monotonic() + FAULT_SECONDS_MAX
    while time.monotonic() < limit:
        if node.serve_control(wait=True, until=blow.fault):
            return
    raise AssertionError(f"fault {blow.fault} was not applied within {FAULT_SECONDS_MAX} s")


def _flip(
    node: "Node", hosted: Hosted, effects: list[Effect], note: Note, blow: control.Blow, flip: Flip
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
        node.journal.write(time.monotonic_ns(), Event.PEER_REFUSED, note.request_id, mark(blow.fault, bits))
    else:
        effects[at] = Send(send.port, message)
        node.journal.write(time.monotonic_ns(), Event.FAULT_APPLIED, note.request_id, mark(blow.fault, bit))
    node.line.send(control.Fired(blow.fault))  # nobody has to be waited for


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


def order_or_halt(node: "Node", hosted: Hosted, effect: Effect) -> None:
    """The rare effects: a script for the runtime, or the end of this node."""
    if isinstance(effect, Order):
        node.line.send(control.Ordered(hosted.name, effect.script, effect.phase, effect.number))
        return
    assert isinstance(effect, Halt)
    print(f"{hosted.name} (pid {os.getpid()}): detected stop: {effect.reason}", file=sys.stderr, flush=True)
    os._exit(EXIT_DETECTED)
