"""What faults of the bus do to its frames. Pure: frames in, frames out; time is the frames' own.

The hub between processes and the bus of the car in virtual time both let a frame pass through a `Disturber`
at the moment at which it wins the bus (`vehicle`'s protocol for it has the calls that a bus makes):

    carry(frame, sender)       what comes onto the bus in its place, now: the frame, another one, two, or none
    release(now_us)            what comes now without being sent now: held back before, or a babbling idiot's
    due_us()                   when to call `release` next
    cut_off(sender, node, ...) whether the node receives nothing of that sender now: bus-off, partition

Several faults are armed at once: what one lets through, the next one gets, in the order of arming. What is
released is not struck again.

*Time.* A fault opens at its time, and ends by time where it lasts. Both are compared with bus time when a
frame or a `release` comes, so how often the bus calls makes no difference.

*Babbling idiot.* A node that sends identifier 0 without a pause wins every arbitration. So no other frame
gets through: a controller holds the latest of each message, as a transmit buffer does, and these go out in
the order of arbitration when the babbling ends. The flood itself is carried as one frame in each
millisecond, which stands for the three or four that 500 kbit/s would allow, so that readers of the bus can
keep up.

*Detection.* A receiver that finds something wrong with a frame, or misses one, reports it beside the bus, by
the identifier (`noticed`), and again when it uses these frames again. A receiver that takes a struck frame in
(`reached`) without a report has believed it. A brake ECU in its fallback counts as having noticed any fault.
A fault is handled when each receiver that has objected uses the frames again (`BusTimes`).
"""

from random import Random
from typing import Final

from e2e.p11 import e2e_p11_protect

from aftbed.inject.bus import (
    NODE_ACTS,
    Babble,
    BusFault,
    BusOff,
    Delay,
    Duplicate,
    FlipBit,
    Masquerade,
    Omission,
    Partition,
    Reorder,
    SetSignal,
    StuckCounter,
)
from aftbed.inject.grammar import Chance, Every, Lasting, Permanent, Transient, with_flipped
from aftbed.inject.receipts import BusReport, BusTimes
from aftbed.vehicle.can.bus_model import FALLBACK, GOOD_AGAIN, CarriedFrame, Notice
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.condition import Condition

REORDER_US_MAX: Final = 1_000_000  # a frame without a successor is not swallowed
FLOOD_US: Final = 1000
FLOOD_ID: Final = 0
FLOOD_FRAMES_MAX: Final = 100  # in one release: a bus that was away for long does not make up for it
COUNTER_MASK: Final = 0x0F
AS_SENT: Final = (Delay, Duplicate, Reorder)  # the content is right; only when it comes is wrong


class _ArmedBusFault:
    """A fault, and what it has come to."""

    def __init__(self, number: int, fault: BusFault, chance: Random, now_us: int) -> None:
        assert fault.targets is not None, f"the names of {fault} are not resolved"
        opening = fault.opening
        self.number, self.fault, self.chance = number, fault, chance
        self.targets = {target.can_id: target for target in fault.targets}
        self.opens_us = now_us + opening.after_us if opening.when is None else None
        self.since_us: int | None = None  # when it first struck, or took hold
        self.over = False
        self.seen = 0
        self.counters: dict[int, int] = {}  # of the frames before
        self.swapped: CarriedFrame | None = None
        self.swap_due_us = 0
        self.starved: dict[int, CarriedFrame] = {}
        self.flood_us = 0
        self.frames = self.first_us = self.first_id = 0
        self.ids: set[int] = set()
        self.noticed = self.believed = ""
        self.taken_us: int | None = None  # a receiver took a struck frame in, when first
        self.noticed_us: int | None = None
        self.good_us: int | None = None
        self.fallback_us: int | None = None
        self._objections: set[tuple[str, int]] = set()  # of a node to the frames of an identifier
        self._used_us = 0  # when a node that had objected used the frames again, the latest

    @property
    def on_nodes(self) -> bool:
        return isinstance(self.fault.effect, NODE_ACTS)

    def is_open(self, now_us: int) -> bool:
        return not self.over and self.opens_us is not None and self.opens_us <= now_us

    def ends_us(self) -> int | None:
        """When it ends by time; None before it has begun, or without such an end."""
        persistence, since_us = self.fault.persistence, self.since_us
        if self.over or since_us is None or not isinstance(persistence, Lasting):
            return None
        return since_us + persistence.for_us

    def holds(self, now_us: int) -> bool:
        """Whether it has hold of its nodes, from the first call in its time on."""
        if not self.is_open(now_us):
            return False
        if self.since_us is None:
            assert self.opens_us is not None
            self.since_us = self.flood_us = self.opens_us
        return not self.ended(now_us)

    def ended(self, now_us: int) -> bool:
        ends_us = self.ends_us()
        self.over = self.over or (ends_us is not None and now_us >= ends_us)
        return self.over

    def strikes(self, now_us: int) -> bool:
        """Whether it strikes the frame of now, which is one of its targets."""
        if not self.is_open(now_us):
            return False
        self.seen += 1
        if self.seen < self.fault.opening.nth:
            return False
        self.since_us = now_us if self.since_us is None else self.since_us
        match self.fault.persistence:
            case Transient():
                self.over = True
                return True
            case Lasting():
                return not self.ended(now_us)
            case Chance(p):
                return self.chance.random() < p
            case Every(count):
                return (self.seen - self.fault.opening.nth) % count == 0
            case Permanent():
                return True

    def count(self, frame: Frame) -> None:
        """`frame` was struck."""
        if not self.frames:
            self.first_us, self.first_id = frame.t_us, frame.can_id
        self.frames += 1
        self.ids.add(frame.can_id)

    def reached(self, node: str, t_us: int) -> None:
        """`node` has taken in a frame that it has struck."""
        if not self.believed:
            self.believed, self.taken_us = node, t_us

    def was_noticed(self, node: str, notice: Notice) -> None:
        """Once it has struck. Each node has a connection of its own, so a report may be heard late."""
        word, t_us, by = notice.word, notice.t_us, (node, notice.can_id)
        if t_us < self.first_us:
            return
        if word == GOOD_AGAIN:
            if by in self._objections:
                self._objections.remove(by)
                self._used_us = max(self._used_us, t_us)
                if not self._objections and self.good_us is None:
                    self.good_us = self._used_us
            return
        if word != FALLBACK and notice.can_id not in self.ids:
            return
        self._objections.add(by)
        if self.noticed_us is None or t_us < self.noticed_us:
            self.noticed, self.noticed_us = f"{node} ({word})", t_us
        if self.good_us is not None and t_us < self.good_us:
            self.good_us = None
        if word == FALLBACK and self.good_us is None:
            self.fallback_us = t_us  # the last: the brakes bridge a gap before they give up

    def times(self) -> BusTimes | None:
        if not self.frames:
            return None
        if self.noticed:
            return BusTimes(self.first_us, self.noticed_us, self.good_us, self.fallback_us)
        taken_us = self.taken_us if isinstance(self.fault.effect, AS_SENT) else None
        return BusTimes(self.first_us, None, taken_us, None, believed=bool(self.believed))

    def report(self) -> BusReport:
        return BusReport(
            self.number,
            self.frames,
            self.first_us,
            self.first_id,
            self.noticed,
            self.believed,
            began=self.on_nodes and self.since_us is not None,
            waits=self.opens_us is None,
            times=self.times(),
        )


class Disturber:
    """All faults of one bus."""

    def __init__(self) -> None:
        self._armed: dict[int, _ArmedBusFault] = {}
        self._held: list[tuple[int, CarriedFrame]] = []  # due, in the order of their coming

    def arm(self, number: int, fault: BusFault, draw: int, now_us: int) -> None:
        """From now on. The names of `fault` are resolved; `draw` seeds its chance."""
        self._armed[number] = _ArmedBusFault(number, fault, Random(draw), now_us)

    def forget(self, number: int, now_us: int) -> None:
        """End it now; what it holds back is due."""
        armed = self._armed.get(number)
        if armed is not None:
            armed.over = True
            armed.swap_due_us = now_us
            self._held = [(now_us if number in sent.by else due_us, sent) for due_us, sent in self._held]

    def conditions(self) -> list[tuple[int, Condition]]:
        """The conditions of the car that are waited for, by the number of the fault."""
        return [
            (armed.number, armed.fault.opening.when)
            for armed in self._armed.values()
            if armed.opens_us is None and not armed.over and armed.fault.opening.when is not None
        ]

    def met(self, number: int, now_us: int) -> None:
        """Open the fault: its condition holds now."""
        armed = self._armed.get(number)
        if armed is not None and armed.opens_us is None:
            armed.opens_us = now_us

    def reports(self) -> list[BusReport]:
        return [armed.report() for armed in self._armed.values()]

    @property
    def idle(self) -> bool:
        """Whether the bus is undisturbed, and stays so."""
        return not self._held and all(
            armed.over and armed.swapped is None and not armed.starved for armed in self._armed.values()
        )

    # -- frames -----------------------------------------------------------------------------------

    def carry(self, frame: Frame, sender: str) -> list[CarriedFrame]:
        """What comes onto the bus now, since `sender` has sent `frame`; `t_us` of it is now."""
        sent = [CarriedFrame(frame, sender)]
        for armed in self._armed.values():
            if armed.on_nodes:
                sent = [one for one in sent if self._gets_through(armed, one)]
            elif frame.can_id in armed.targets:
                sent = [out for one in sent for out in self._struck(armed, one)]
        return sent

    def release(self, now_us: int) -> list[CarriedFrame]:
        """What comes onto the bus now without being sent now."""
        for armed in self._armed.values():
            self._let_go(armed, now_us)
        due = [sent for due_us, sent in self._held if due_us <= now_us]
        self._held = [(due_us, sent) for due_us, sent in self._held if due_us > now_us]
        return [_at(now_us, sent) for sent in due] + [
            flood for armed in self._armed.values() for flood in self._flood(armed, now_us)
        ]

    def due_us(self) -> int | None:
        """When to call `release` next, whatever frames there are."""
        due = [due_us for due_us, _ in self._held]
        for armed in self._armed.values():
            due += [armed.swap_due_us] if armed.swapped is not None else []
            due += [0] if armed.starved and armed.over else []
            due += [ends_us] if (ends_us := armed.ends_us()) is not None else []
            if armed.on_nodes and not armed.over and armed.opens_us is not None:
                if armed.since_us is None:
                    due.append(armed.opens_us)
                elif isinstance(armed.fault.effect, Babble):
                    due.append(armed.flood_us)
        return min(due, default=None)

    def cut_off(self, sender: str, node: str, now_us: int) -> bool:
        """Whether `node` receives nothing of `sender` now."""
        for armed in self._armed.values():
            if not armed.on_nodes or not armed.holds(now_us):
                continue
            match armed.fault.effect:
                case BusOff(off) if node == off:
                    return True
                case Partition(side, other) if (sender in side and node in other) or (
                    sender in other and node in side
                ):
                    return True
        return False

    # -- detection --------------------------------------------------------------------------------

    def noticed(self, node: str, notice: Notice) -> None:
        """`node` reports something wrong with frames, or that it uses them again."""
        for armed in self._armed.values():
            if armed.frames:
                armed.was_noticed(node, notice)

    def reached(self, by: tuple[int, ...], node: str, t_us: int) -> None:
        """`node` has taken in a frame that these faults have struck."""
        for number in by:
            self._armed[number].reached(node, t_us)

    # -- acts -------------------------------------------------------------------------------------

    def _gets_through(self, armed: _ArmedBusFault, sent: CarriedFrame) -> bool:
        """Whether the frame comes onto the bus in spite of what has hold of a node."""
        frame = sent.frame
        if not armed.holds(frame.t_us):
            return True
        match armed.fault.effect:
            case Babble():
                armed.count(frame)
                armed.starved[frame.can_id] = sent
                return False
            case BusOff(node):
                armed.count(frame)  # it is kept from the bus, or else from the node
                return sent.sender != node
            case Partition(side, other):
                if sent.sender in (*side, *other):
                    armed.count(frame)
        return True

    def _struck(self, armed: _ArmedBusFault, sent: CarriedFrame) -> list[CarriedFrame]:
        """What `armed` makes of one of its frames."""
        frame, by = sent.frame, (*sent.by, armed.number)
        if armed.swapped is not None:
            late, armed.swapped = armed.swapped, None
            return [sent, _at(frame.t_us, late)]
        strikes = armed.strikes(frame.t_us)
        changed = _changed(armed, frame) if strikes else None
        if changed is None:
            if strikes and isinstance(armed.fault.persistence, Transient):
                armed.over = False  # nothing to change in this frame: the next one is due
            if len(frame.data) > 1:
                armed.counters[frame.can_id] = frame.data[1] & COUNTER_MASK
            return [sent]
        armed.count(frame)
        struck = CarriedFrame(changed, sent.sender, by)
        match armed.fault.effect:
            case Omission():
                return []
            case Delay(by_us):
                self._held.append((frame.t_us + by_us, struck))
                return []
            case Duplicate():
                return [sent, struck]
            case Reorder():
                armed.swapped, armed.swap_due_us = struck, frame.t_us + REORDER_US_MAX
                return []
            case _:
                return [struck]

    def _let_go(self, armed: _ArmedBusFault, now_us: int) -> None:
        """Let go of what a fault that is over holds back."""
        if armed.on_nodes:
            armed.holds(now_us)
        else:
            armed.ended(now_us)
        if armed.swapped is not None and now_us >= armed.swap_due_us:
            self._held.append((armed.swap_due_us, armed.swapped))
            armed.swapped = None
        if armed.over and armed.starved:
            waiting = sorted(armed.starved.items())
            armed.starved = {}
            self._held += [(now_us, sent) for _, sent in waiting]

    def _flood(self, armed: _ArmedBusFault, now_us: int) -> list[CarriedFrame]:
        if not isinstance(armed.fault.effect, Babble) or not armed.holds(now_us):
            return []
        node = armed.fault.effect.node
        missed = (now_us - armed.flood_us) // FLOOD_US + 1
        armed.flood_us += max(0, missed) * FLOOD_US
        off = [a.fault.effect for a in self._armed.values() if a.on_nodes and a.holds(now_us)]
        if BusOff(node) in off:
            return []
        flood = CarriedFrame(Frame(now_us, FLOOD_ID, bytes(8)), node)
        return [flood] * min(max(0, missed), FLOOD_FRAMES_MAX)


def _at(now_us: int, sent: CarriedFrame) -> CarriedFrame:
    frame = sent.frame
    return CarriedFrame(Frame(now_us, frame.can_id, frame.data), sent.sender, sent.by)


def _changed(armed: _ArmedBusFault, frame: Frame) -> Frame | None:
    """The frame as the act makes it; None where there is nothing to change: then it is not struck."""
    target, data = armed.targets[frame.can_id], frame.data
    match armed.fault.effect:
        case FlipBit(bit):
            data = with_flipped(data, [bit]) if bit < 8 * len(data) else data
        case SetSignal():
            if len(data) == len(target.mask):
                parts = zip(data, target.mask, target.bits, strict=True)
                data = bytes(byte & ~where | bits for byte, where, bits in parts)
        case StuckCounter():
            counter = armed.counters.get(frame.can_id)
            if counter is not None and len(data) > 1:
                data = bytes([data[0], data[1] & ~COUNTER_MASK | counter, *data[2:]])
        case Masquerade():
            return Frame(frame.t_us, frame.can_id, resealed(data, target.data_id)) if len(data) > 1 else None
        case _:
            return frame
    if data == frame.data:
        return None
    return Frame(frame.t_us, frame.can_id, resealed(data, target.data_id) if target.data_id >= 0 else data)


def resealed(data: bytes, data_id: int) -> bytes:
    """`data` with a CRC that fits it and `data_id`; the counter stays as it is."""
    frame = bytearray(data)
    e2e_p11_protect(frame, data_id, increment_counter=False)
    return bytes(frame)
