"""The fault agent of a node: the faults that wait in it, and what it does when they are due.

Written once for all runtimes; the interface to its node is `host.AgentHost`. Most faults wait for a Note: its
record is written, all effects before it are done, none behind it is. Two values are out of reach by then,
what the Server was handed and what has gone to the backup; a fault of one of these alters what goes into the
step whose event is the next one, or what comes out of it.

A node in which no fault waits (`active` is False) calls nothing of this.
"""

import math
from collections.abc import Sequence
from typing import Final

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
from aftbed.runtime.cell import is_shared, move_in
from aftbed.runtime.diversion import BITTEN, Diversion, Meddler, Sender
from aftbed.runtime.host import AgentHost

AROUND_STEP: Final = (Place.REQUEST, Place.CHECKPOINT)  # altered before or behind a step, not at a Note
LoggedReplies = tuple[
    int, list[tuple[int, bytes]]
]  # as a Protocol captures it: the last id, ids with their replies


class FaultAgent:
    """Of one node. The node reads `active`, `slowed` and `filters`; it never changes them."""

    def __init__(self, host: AgentHost) -> None:
        self._host = host
        self.active = False  # a fault waits here: the node calls the methods below
        self.slowed = False  # steps take longer
        self.filters: dict[Sender, Diversion] = {}  # what lies on the channel that a brick writes to
        self._armed: dict[Event, tuple[control.Blow, ...]] = {}
        self._around: dict[str, list[tuple[control.Blow, Flip]]] = {}  # by brick: due in its next such step
        self._slow: dict[int, control.SlowDown] = {}
        self._felt: set[int] = set()  # slow-downs whose effect is recorded
        self._shares_state = False

    # -- orders of the executive ------------------------------------------------------------------

    def arm(self, event: str, faults: Sequence[control.Blow]) -> None:
        """Wait for `event`. Faults that wait for it already go on counting; one that is given again begins
        anew.

        `nth` 0: wait no longer.
        """
        self._arm(event_named(event), faults)

    def disturb(self, fault: control.Blow) -> None:
        """Have a fault of a channel wait at its sender; with `nth` 0, wait there no longer."""
        assert isinstance(fault.action, Disturb)
        key = (fault.brick, fault.action.channel)
        if fault.nth:
            note = _ChannelRecords(self._host, fault.fault)
            self.filters.setdefault(key, Diversion()).add(fault.fault, Meddler(fault, note))
        elif key in self.filters:
            self.filters[key].stop(fault.fault)
        self.settle()

    def slow_down(self, order: control.SlowDown) -> None:
        """Have each step take longer; by nothing, with the whole CPU: no longer."""
        self._slow.pop(order.fault, None)
        if order.by_ns or order.share < control.WHOLE:
            self._slow[order.fault] = order
        self._update()

    def share_state(self, brick: str, number: int, memory: memoryview) -> bytes:
        """Have the function of the Server `brick` keep its state in `memory`. Raises PeerError."""
        answer = move_in(self._host, brick, number, memory)
        self._shares_state = self._shares_state or is_shared(self._host.brick(brick))
        self._update()  # what others change is recorded within a step: not on the fast path
        return answer

    def settle(self) -> None:
        """Drop the filters that do nothing any more."""
        for key in [key for key, found in self.filters.items() if found.over]:
            del self.filters[key]
        self._update()

    def _update(self) -> None:
        self.slowed = bool(self._slow)
        self.active = bool(self._armed or self._slow or self.filters or self._shares_state)

    def _arm(self, event: Event, faults: Sequence[control.Blow]) -> None:
        given = {fault.fault for fault in faults}
        kept = [fault for fault in self._armed.pop(event, ()) if fault.fault not in given]
        waiting = (*kept, *(fault for fault in faults if fault.nth))
        if waiting:
            self._armed[event] = waiting
        self._around = {}
        for fault in (fault for armed in self._armed.values() for fault in armed if fault.nth == 1):
            if isinstance(fault.action, Flip) and fault.action.place in AROUND_STEP:
                self._around.setdefault(fault.brick, []).append((fault, fault.action))
        self._update()

    # -- around a step ----------------------------------------------------------------------------

    def step(
        self, name: str, brick: Brick, port: str, message: AnyMessage | Message, now_ns: int
    ) -> list[Effect]:
        """Have `brick` handle `message`, either altered by the faults that are due. Raises PeerError as it
        does.
        """
        due = self._around.get(name, ())
        handed, hits = message, []
        for fault, flip in reversed(due):
            if flip.place is Place.REQUEST and isinstance(handed, Request | Trial):
                bits = hit(flip.pattern, handed.payload, fault.draw)
                hits.append((fault, bits))
                if bits:
                    handed = structs.replace(handed, payload=changed(handed.payload, bits))
        effects = brick.step(port, handed, now_ns)  # type: ignore[arg-type]
        for fault, bits in reversed(hits):  # only now: a brick that refuses the request was not hit
            assert isinstance(handed, Request | Trial)
            self._record_hit(fault, handed.request_id, bits, 8 * len(handed.payload))
        for fault, flip in due:
            if flip.place is Place.CHECKPOINT:
                effects = self._alter_checkpoint(fault, flip, effects)
        return effects

    def _alter_checkpoint(self, fault: control.Blow, flip: Flip, effects: list[Effect]) -> list[Effect]:
        for at, effect in enumerate(effects):
            if isinstance(effect, Send) and isinstance(effect.message, Checkpoint):
                sent = effect.message
                data = sent.state + sent.reply
                bits = hit(flip.pattern, data, fault.draw)
                if bits:
                    data, length = changed(data, bits), len(sent.state)
                    other = structs.replace(sent, state=data[:length], reply=data[length:])
                    effects = [*effects[:at], Send(effect.port, other), *effects[at + 1 :]]
                self._record_hit(fault, sent.request_id, bits, 8 * len(data))
                break
        return effects

    # -- at a Note --------------------------------------------------------------------------------

    def noted(self, name: str, brick: Brick, effects: list[Effect], at: int) -> None:
        """The record of the Note `effects[at]` of `name` is written: what waits for it and is due happens
        now.

        A value is altered in what is sent behind the Note, so effects behind `at` may be replaced.
        """
        note = effects[at]
        assert isinstance(note, Note)
        armed = self._armed.get(note.event)
        if armed is None:
            return
        counted = [f if f.brick != name else structs.replace(f, nth=f.nth - 1) for f in armed]
        self._arm(note.event, tuple(map(_next_strike, counted)))
        for fault in counted:
            if fault.nth == 0 and isinstance(fault.action, Flip) and not fault.action.field:
                if fault.action.place not in AROUND_STEP:
                    self._flip(brick, effects, at, fault, fault.action)
            elif fault.nth == 0:
                self._strike(fault)

    def _strike(self, fault: control.Blow) -> None:
        """End this node, or wait until the executive has done what the fault says."""
        self._host.record(Event.FAULT_APPLIED, 0, mark(fault.fault))
        if fault.itself:
            self._host.kill()
            return
        self._host.report_fired(fault.fault)
        self._host.wait_until_applied(fault.fault)

    def _flip(self, brick: Brick, effects: list[Effect], at: int, fault: control.Blow, flip: Flip) -> None:
        """Alter what the brick has in hand, and the message behind the Note that carries it away."""
        note = effects[at]
        assert isinstance(note, Note)
        place, send = next((i, e) for i, e in enumerate(effects) if i > at and isinstance(e, Send))
        data = _aimed_at(brick, send.message, flip.place, note)
        bits = hit(flip.pattern, data, fault.draw)
        message = _altered(brick, send.message, flip.place, note, changed(data, bits)) if bits else None
        if message is not None:
            effects[place] = Send(send.port, message)
        self._record_hit(fault, note.request_id, bits if message is not None else (), 8 * len(data))

    def _record_hit(self, fault: control.Blow, about: int, bits: tuple[int, ...] | None, size: int) -> None:
        """Record which bits were altered, or, where none was, how many there were.

        Of a fault that strikes again and again, only the first attempt that fails is recorded.
        """
        for bit in bits or ():
            self._host.record(Event.FAULT_APPLIED, about, mark(fault.fault, bit))
        if not bits and not fault.struck:
            self._host.record(Event.PEER_REFUSED, about, mark(fault.fault, size))
        if not fault.struck:
            self._host.report_fired(fault.fault)

    # -- slow steps -------------------------------------------------------------------------------

    def delay_ns(self) -> int:
        """A step is being taken: by how many ns it is slower. The first such step of a fault is recorded."""
        return sum(self._feel(order).by_ns for order in list(self._slow.values()) if order.by_ns)

    def stretch_ns(self, used_ns: int) -> int:
        """How many ns more `used_ns` of CPU time would have taken with no more than the given share."""
        slow = [order for order in self._slow.values() if order.share < control.WHOLE]
        return round(used_ns * (1 / math.prod(self._feel(order).share for order in slow) - 1))

    def _feel(self, order: control.SlowDown) -> control.SlowDown:
        if order.fault not in self._felt:
            self._felt.add(order.fault)
            self._host.record(Event.FAULT_APPLIED, 0, mark(order.fault))
        return order


class _ChannelRecords:
    """Records what a fault of a channel did; reports it once."""

    def __init__(self, host: AgentHost, fault: int) -> None:
        self._host, self._fault, self._reported = host, fault, False

    def __call__(self, what: int, about: int) -> None:
        self._host.record(Event.FAULT_APPLIED, about, mark(self._fault, what))
        if what == BITTEN and not self._reported:
            self._reported = True
            self._host.report_fired(self._fault)


def _next_strike(fault: control.Blow) -> control.Blow:
    """The fault as it waits from here on; one that is due counts to its next strike, if there is one."""
    if fault.nth:
        return fault
    struck = fault.struck + 1
    return structs.replace(fault, nth=gap(fault.persistence, fault.draw, struck), struck=struck)


# -- values ---------------------------------------------------------------------------------------


def _aimed_at(brick: Brick, message: Message, place: Place, note: Note) -> bytes:
    """The bytes that have the bits; none where the brick does not hand them out."""
    if place is Place.LOG and note.event is Event.REPLY_STORED:
        log = _logged(brick)
        return dict(log[1]).get(note.request_id, b"") if log is not None else b""
    if place is not Place.STATE:
        assert isinstance(message, Reply | Tried | StoreReply), message
        return message.payload
    try:
        return brick.capture()
    except PeerError:
        return b""


def _altered(brick: Brick, message: Message, place: Place, note: Note, data: bytes) -> Message | None:
    """What `message` is with `data`; None where the brick refuses such a state, or ignores the bits."""
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


def _logged(brick: Brick) -> LoggedReplies | None:
    """The replies that a Protocol keeps; None where it captures something else."""
    try:
        log: LoggedReplies = msgspec.msgpack.decode(brick.capture(), type=LoggedReplies)
    except (msgspec.DecodeError, PeerError):
        return None
    return log


def _relog(brick: Brick, note: Note, reply: bytes) -> bool:
    """Keep `reply` for the request of `note`; False if the Protocol does not take it."""
    log = _logged(brick)
    if log is None:
        return False
    kept = [(number, reply if number == note.request_id else payload) for number, payload in log[1]]
    try:
        brick.restore(msgspec.msgpack.encode((log[0], kept)))
    except PeerError:
        return False
    return True
