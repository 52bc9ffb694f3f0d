"""Faults of the CAN bus, as values: what is done, to which frames, from when, and for how long.

    omission bus RADAR_TRACK nth 5
    delay bus AEB_REQ by 40ms when ttc < 1.2 for 500ms
    corrupt bus RADAR_TRACK bit 21 crc good permanent
    bus-off radar after 2s for 300ms

Some acts strike *frames*, chosen by the name of their message or by the node that sends it; others, a
bus-off, a babbling idiot, a partition, take hold of *nodes*. A fault opens at once, some bus time after it
was armed, or when the car is in a certain condition; from there on its `nth` frame is the first that is
struck. What follows is the persistence: no more (transient), all for a time, some by chance, or all to the
end.

Names say nothing to a bus, which knows numbers. Whoever knows the DBC *aims* a fault before it is armed
(`vehicle.disturbance.aimed`): an `Aim` is what the names came to. It is no part of the words.

Times are bus time, in whole microseconds, as everything on the bus is.
"""

from typing import Final, Literal

import msgspec

from aftbed.core.persistence import ONCE, Chance, Every, Lasting, Permanent, Transient
from aftbed.core.units import duration, number

SECOND_US: Final = 1_000_000
NODES: Final = ("radar", "brake", "gateway")  # that a car's bus has
FALLBACK: Final = "fallback"  # what a brake ECU that misses its requests says that it has noticed
QUANTITIES: Final = ("ttc", "gap", "speed")

Quantity = Literal["ttc", "gap", "speed"]  # s, m, m/s: of the plant itself, not of what a sensor says
Receipt = Literal["armed", "applied", "activated", "not_activated", "inject_error"]


# -- what is done --------------------------------------------------------------------------------


class Omission(msgspec.Struct, frozen=True, tag=True):
    """The frame does not come."""


class Delay(msgspec.Struct, frozen=True, tag=True):
    """The frame comes later."""

    by_us: int


class Duplicate(msgspec.Struct, frozen=True, tag=True):
    """The frame comes twice."""


class Reorder(msgspec.Struct, frozen=True, tag=True):
    """The frame comes after the next one of those that the fault is aimed at."""


class FlipBit(msgspec.Struct, frozen=True, tag=True):
    """Bit `bit`, from bit 0 of byte 0, is the other way round; `crc_good`: and the CRC is made to fit."""

    bit: int
    crc_good: bool = False


class SetSignal(msgspec.Struct, frozen=True, tag=True):
    """The signal has that value, in the units of the DBC; `crc_good`: and the CRC is made to fit."""

    signal: str
    value: float
    crc_good: bool = False


class Masquerade(msgspec.Struct, frozen=True, tag=True):
    """The CRC is right, for the data id of another message."""

    message: str


class StuckCounter(msgspec.Struct, frozen=True, tag=True):
    """The counter stays what it was in the frame before; the CRC fits."""


class Babble(msgspec.Struct, frozen=True, tag=True):
    """The node sends the highest priority without a pause: nobody else, and none of its own, gets through."""

    node: str


class BusOff(msgspec.Struct, frozen=True, tag=True):
    """Nothing of the node comes to the bus, nothing of the bus to the node."""

    node: str


class Partition(msgspec.Struct, frozen=True, tag=True):
    """The bus is cut: those of one side hear nothing of the other. Who is on neither hears both."""

    side: tuple[str, ...]
    other: tuple[str, ...]


FrameAct = Omission | Delay | Duplicate | Reorder | FlipBit | SetSignal | Masquerade | StuckCounter
NodeAct = Babble | BusOff | Partition
BusAct = FrameAct | NodeAct
NODE_ACTS: Final = (Babble, BusOff, Partition)


# -- to which frames, from when, for how long ----------------------------------------------------


class Frames(msgspec.Struct, frozen=True):
    """The frames called `message`, or those that `sender` sends: one of the two is given."""

    message: str = ""
    sender: str = ""

    def __post_init__(self) -> None:
        if bool(self.message) == bool(self.sender):
            raise ValueError(f"frames of message {self.message!r} and of node {self.sender!r}")


class Condition(msgspec.Struct, frozen=True):
    """A quantity of the car is below, or else above, a value. What is not known is neither."""

    quantity: Quantity
    below: bool
    value: float

    def holds(self, ttc_s: float | None, gap_m: float | None, speed_ms: float) -> bool:
        """Whether it is so, in a car with these."""
        found = {"ttc": ttc_s, "gap": gap_m, "speed": speed_ms}[self.quantity]
        if found is None:
            return False
        return found < self.value if self.below else found > self.value

    def __str__(self) -> str:
        return f"{self.quantity} {'<' if self.below else '>'} {number(self.value)}"


class Opening(msgspec.Struct, frozen=True):
    """At once, `after_us` of bus time, or when the condition holds; from there on the `nth` frame."""

    after_us: int = 0
    when: Condition | None = None
    nth: int = 1

    def __post_init__(self) -> None:
        if self.after_us and self.when is not None:
            raise ValueError("a fault that opens after a time and on a condition")


Persistence = Transient | Lasting | Chance | Every | Permanent


# -- what the names came to ----------------------------------------------------------------------


class Mark(msgspec.Struct, frozen=True):
    """A message that is aimed at. `data_id` -1: it has no E2E protection, or the act needs none of it.

    Of a signal that is set: the bits of it in the data, and what they are to be.
    """

    can_id: int
    data_id: int = -1
    mask: bytes = b""
    bits: bytes = b""


class Aim(msgspec.Struct, frozen=True):
    """All messages that are aimed at; none for an act on nodes."""

    marks: tuple[Mark, ...] = ()


class BusFault(msgspec.Struct, frozen=True, tag="bus"):
    """One fault of the bus. `frames` is None for an act on nodes, which lasts, for a time or for good."""

    act: BusAct
    frames: Frames | None = None
    opening: Opening = Opening()
    persistence: Persistence = ONCE
    aim: Aim | None = None

    def __post_init__(self) -> None:
        """Refuse, with a ValueError, what means nothing."""
        on_nodes = isinstance(self.act, NODE_ACTS)
        if on_nodes != (self.frames is None):
            raise ValueError(f"{type(self.act).__name__} {'with' if on_nodes else 'without'} frames")
        if on_nodes and (self.opening.nth != 1 or not isinstance(self.persistence, Lasting | Permanent)):
            raise ValueError(f"{type(self.act).__name__} lasts, and strikes no nth frame")

    @property
    def verb(self) -> str:
        """What it is called."""
        return _act(self.act)[0]

    def __str__(self) -> str:
        whom = [] if self.frames is None else ["bus", *_frames(self.frames)]
        verb, *how = _act(self.act)
        words = [verb, *whom, *how, *_opening(self.opening), str(self.persistence)]
        return " ".join(filter(None, words))


class Struck(msgspec.Struct, frozen=True):
    """What has become of a fault: how many frames it struck, the first of them, who noticed it how.

    `believed`: by whom a struck frame was taken without a word. `error` is of the injector itself.
    """

    number: int
    frames: int = 0
    first_us: int = 0
    first_id: int = 0
    noticed: str = ""
    believed: str = ""
    began: bool = False  # an act on nodes took hold, of whatever frames there were
    error: str = ""
    waits: bool = False  # for its condition, which has not held yet

    @property
    def receipt(self) -> Receipt:
        """In one word; a fault that has not struck yet is armed."""
        if self.error:
            return "inject_error"
        if not self.frames and not self.began:
            return "armed"
        return "activated" if self.noticed or self.believed else "applied"

    @property
    def detail(self) -> str:
        """In a few words."""
        if self.error:
            return self.error
        if not self.frames:
            return "took hold, of no frame" if self.began else ""
        many = f"{self.frames} frame{'s' if self.frames > 1 else ''}"
        first = f"{'the first ' if self.frames > 1 else ''}at {self.first_us / SECOND_US:.6f} s"
        known = f"noticed by {self.noticed}" if self.noticed else "noticed by nobody"
        if self.believed and not self.noticed:
            known = f"believed by {self.believed}"
        return f"{many}, {first}, id {self.first_id:03X}; {known}"


# -- the words -----------------------------------------------------------------------------------


def _act(act: BusAct) -> list[str]:
    """The verb, and what stands behind the frames."""
    match act:
        case Omission():
            return ["omission"]
        case Delay(by_us):
            return ["delay", "by", duration(by_us / 1000)]
        case Duplicate():
            return ["duplicate"]
        case Reorder():
            return ["reorder"]
        case FlipBit(bit, crc_good):
            return ["corrupt", "bit", str(bit), *_crc(crc_good)]
        case SetSignal(signal, value, crc_good):
            return ["corrupt", "signal", f"{signal}={number(value)}", *_crc(crc_good)]
        case Masquerade(message):
            return ["masquerade", "as", message]
        case StuckCounter():
            return ["stuck-counter"]
        case Babble(node):
            return ["babbling", node]
        case BusOff(node):
            return ["bus-off", node]
        case Partition(side, other):
            return ["partition", f"{','.join(side)}|{','.join(other)}"]


def _crc(good: bool) -> list[str]:
    return ["crc", "good"] if good else []


def _frames(frames: Frames) -> list[str]:
    return [frames.message] if frames.message else ["from", frames.sender]


def _opening(opening: Opening) -> list[str]:
    words = ["after", duration(opening.after_us / 1000)] if opening.after_us else []
    if opening.when is not None:
        words = ["when", str(opening.when)]
    return words + (["nth", str(opening.nth)] if opening.nth != 1 else [])
