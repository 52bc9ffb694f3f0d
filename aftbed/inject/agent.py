"""The fault agent of a node: the faults that wait in it, and what it does when they are due.

It is the half of the injector that sits in the target, the same for all runtimes. Most faults wait for a
Note: its record is written, all effects before it are done, none behind it is. Where that is too late (what
a Server was handed, what has gone to the backup), the fault strikes within the step whose event is the next
one.

A node in which no fault waits (`active` is False) calls nothing of this. The agent reads no clock, never
sleeps and does no I/O: the node does that for it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import msgspec
from msgspec import structs

from aftbed.core.application import fields_of
from aftbed.core.brick import Brick, Effect, Note
from aftbed.core.errors import PeerError
from aftbed.core.events import Event, event_named
from aftbed.core.messages import AnyMessage, Message
from aftbed.ftm.server import Server
from aftbed.inject.channel import ALTERED, ChannelFault, ChannelFilter, FilterStage, RecordStrike
from aftbed.inject.grammar import gap
from aftbed.inject.kind import Alteration
from aftbed.inject.model import ArmedFault
from aftbed.inject.receipts import record_detail
from aftbed.inject.shared_state import SHARED_BYTES, SharedFunction, StateLayout
from aftbed.inject.slow import WHOLE_CPU

Sender = tuple[str, str]  # a brick and its port


class AgentHost(Protocol):
    """The node, as its fault agent sees it."""

    def brick(self, name: str) -> Brick:
        """The brick of that name. Raises KeyError."""
        ...

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        ...

    def report_fired(self, fault: int) -> None:
        """Report to the supervisor that `fault` is due, or has struck."""
        ...

    def wait_until_applied(self, fault: int) -> None:
        """Perform no further effect until the supervisor has acknowledged `fault`."""
        ...

    def kill(self) -> None:
        """End this node with SIGKILL, at once."""
        ...

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end this node at once."""
        ...


class _SlowDown(NamedTuple):
    by_ns: int
    share: float  # of a CPU


class FaultAgent:
    """Of one node. The node reads `active`, `slowed` and `filters`; it never changes them."""

    def __init__(self, host: AgentHost) -> None:
        self._host = host
        self.active = False  # a fault waits here: the node calls the methods below
        self.slowed = False  # steps take longer
        self.filters: dict[Sender, ChannelFilter] = {}  # what lies on the channel that a brick writes to
        self._armed: dict[Event, tuple[ArmedFault, ...]] = {}
        self._in_step: dict[str, list[ArmedFault]] = {}  # by brick: due in its next step with that event
        self._slow: dict[int, _SlowDown] = {}
        self._felt: set[int] = set()  # slow-downs whose effect is recorded
        self._shares_state = False

    # -- orders of the supervisor ------------------------------------------------------------------

    def arm(self, label: str, faults: Sequence[ArmedFault]) -> None:
        """Wait for the event with that label; with `nth` 0, wait no longer.

        Faults that already wait for it go on counting; one that is given again begins anew.
        """
        event, given = event_named(label), {fault.fault for fault in faults}
        kept = [fault for fault in self._armed.get(event, ()) if fault.fault not in given]
        self._set(event, (*kept, *faults))

    def disturb(self, fault: ArmedFault) -> None:
        """Have a fault of a channel wait at its sender; with `nth` 0, wait there no longer."""
        action = fault.action
        assert isinstance(action, ChannelFault), action
        key = (fault.brick, action.channel)
        if fault.nth:
            stage = FilterStage(
                action, fault.nth, fault.persistence, fault.draw, self._strike_recorder(fault.fault)
            )
            self.filters.setdefault(key, ChannelFilter()).add(fault.fault, stage)
        elif key in self.filters:
            self.filters[key].stop(fault.fault)
        self.settle()

    def _strike_recorder(self, fault: int) -> RecordStrike:
        """Records what a fault of a channel did; reports once that it fired."""
        reported = False

        def record(what: int, about: int) -> None:
            nonlocal reported
            self._host.record(Event.FAULT_APPLIED, about, record_detail(fault, what))
            if what == ALTERED and not reported:
                reported = True
                self._host.report_fired(fault)

        return record

    def slow_down(self, fault: int, by_ns: int, share_of_cpu: float) -> None:
        """Have each step take longer; by nothing, with the whole CPU: no longer."""
        self._slow.pop(fault, None)
        if by_ns or share_of_cpu < WHOLE_CPU:
            self._slow[fault] = _SlowDown(by_ns, share_of_cpu)
        self._update()

    def share_state(self, name: str, number: int, memory: memoryview) -> bytes:
        """Have the function of the Server `name` keep its state in `memory`; the answer is its StateLayout.

        `number` is in the records of what is found changed. Raises PeerError where there is no function, or
        the fields are not in the state.
        """
        server = self._host.brick(name)
        if not isinstance(server, Server):
            raise PeerError(f"{name} has no function")
        fields = fields_of(server.application)
        if fields and not isinstance(server.application, SharedFunction):  # else a repeated order
            size_bytes = len(server.application.capture())
            last_bytes = max(field.offset_bytes + field.size_bits // 8 for field in fields)
            if not last_bytes <= size_bytes <= SHARED_BYTES:
                raise PeerError(f"a state of {size_bytes} bytes with fields up to byte {last_bytes}")
            server.application = SharedFunction(
                server.application, memory, lambda bits, refusal: self._changed(name, number, bits, refusal)
            )
        self._shares_state = self._shares_state or bool(fields)
        self._update()  # what the supervisor changes is recorded within a step: not on the fast path
        return msgspec.msgpack.encode(StateLayout(fields))

    def _changed(self, name: str, number: int, bits: list[int], refusal: PeerError | None) -> None:
        """The function of `name` has found these bits of its state changed."""
        event = Event.FAULT_APPLIED if refusal is None else Event.PEER_REFUSED
        for bit in bits:
            self._host.record(event, 0, record_detail(number, bit))
        if refusal is not None:
            self._host.record(Event.DETECTED_STOP, 0, 0)
            self._host.stop_detected(name, f"the state in memory is refused: {refusal}")

    def settle(self) -> None:
        """Drop the filters that do nothing any more."""
        for key in [key for key, found in self.filters.items() if found.over]:
            del self.filters[key]
        self._update()

    def _update(self) -> None:
        self.slowed = bool(self._slow)
        self.active = bool(self._armed or self._slow or self.filters or self._shares_state)

    def _set(self, event: Event, faults: Sequence[ArmedFault]) -> None:
        """These wait for `event`, where their `nth` is not 0."""
        self._armed.pop(event, None)
        if waiting := tuple(fault for fault in faults if fault.nth):
            self._armed[event] = waiting
        self._in_step = {}
        for fault in (fault for armed in self._armed.values() for fault in armed if fault.nth == 1):
            if fault.action.alters_step:
                self._in_step.setdefault(fault.brick, []).append(fault)
        self._update()

    # -- in a step --------------------------------------------------------------------------------

    def step(
        self, name: str, brick: Brick, port: str, message: AnyMessage | Message, now_ns: int
    ) -> list[Effect]:
        """Have `brick` handle `message`, with both altered by the faults that are due.

        Raises PeerError as it does.
        """
        due = self._in_step.get(name, ())
        handed, hits = message, list[tuple[ArmedFault, Alteration]]()
        for fault in reversed(due):
            handed, hit = fault.action.alter_input(handed, fault.draw)
            if hit is not None:
                hits.append((fault, hit))
        refused = False
        try:
            effects = brick.step(port, handed, now_ns)  # type: ignore[arg-type]
        except PeerError:
            refused = True
            raise
        finally:  # a brick that refuses the request was not hit; one that fails at it was, and its node ends
            for fault, hit in reversed(hits) if not refused else ():
                self._record(fault, hit)
        for fault in due:
            effects, hit = fault.action.alter_output(effects, fault.draw)
            if hit is not None:
                self._record(fault, hit)
        return effects

    # -- at a Note --------------------------------------------------------------------------------

    def noted(self, name: str, brick: Brick, effects: list[Effect], at: int) -> None:
        """Strike what waits for the Note `effects[at]` of `name`, whose record is written, and is due.

        A value is altered in what is sent behind the Note, so effects behind `at` may be replaced.
        """
        note = effects[at]
        assert isinstance(note, Note)
        armed = self._armed.get(note.event)
        if armed is None:
            return
        counted = [f if f.brick != name else structs.replace(f, nth=f.nth - 1) for f in armed]
        self._set(note.event, tuple(map(_next_strike, counted)))
        for fault in counted:
            if fault.nth or fault.action.alters_step:
                continue
            if fault.action.acts_in_node:
                self._record(fault, fault.action.alter_at(brick, effects, at, fault.draw))
            else:
                self._strike(fault)

    def _strike(self, fault: ArmedFault) -> None:
        """End this node, or wait until the supervisor has done what the fault says."""
        self._host.record(Event.FAULT_APPLIED, 0, record_detail(fault.fault))
        if fault.by_itself:
            self._host.kill()
            return
        self._host.report_fired(fault.fault)
        self._host.wait_until_applied(fault.fault)

    def _record(self, fault: ArmedFault, hit: Alteration) -> None:
        """Record which bits were altered, or, where none was, how many there were.

        Of a fault that strikes again and again, only the first attempt that fails is recorded.
        """
        for bit in hit.bits:
            self._host.record(Event.FAULT_APPLIED, hit.request_id, record_detail(fault.fault, bit))
        if not hit.bits and not fault.strikes:
            self._host.record(Event.PEER_REFUSED, hit.request_id, record_detail(fault.fault, hit.size))
        if not fault.strikes:
            self._host.report_fired(fault.fault)

    # -- slow steps -------------------------------------------------------------------------------

    def delay_ns(self) -> int:
        """By how many ns the step that is being taken is slower.

        The first such step of a fault is recorded.
        """
        return sum(self._feel(fault, slow).by_ns for fault, slow in list(self._slow.items()) if slow.by_ns)

    def stretch_ns(self, used_ns: int) -> int:
        """How many ns more `used_ns` of CPU time would have taken with no more than the given share."""
        slow = [(fault, slow) for fault, slow in self._slow.items() if slow.share < WHOLE_CPU]
        return round(used_ns * (1 / math.prod(self._feel(*one).share for one in slow) - 1))

    def _feel(self, fault: int, slow: _SlowDown) -> _SlowDown:
        if fault not in self._felt:
            self._felt.add(fault)
            self._host.record(Event.FAULT_APPLIED, 0, record_detail(fault))
        return slow


def _next_strike(fault: ArmedFault) -> ArmedFault:
    """The fault as it waits from here on; one that is due counts to its next strike, if there is one."""
    if fault.nth:
        return fault
    strikes = fault.strikes + 1
    return structs.replace(fault, nth=gap(fault.persistence, fault.draw, strikes), strikes=strikes)
