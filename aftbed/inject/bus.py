"""Faults of the CAN bus: what is done, to which frames or nodes, from when, and for how long.

    omission | duplicate | reorder | stuck-counter   bus FRAMES
    delay        bus FRAMES by 40ms
    corrupt      bus FRAMES bit K | signal NAME=VALUE   [crc good]
    masquerade   bus FRAMES as MESSAGE
                 ... [after 2s | when ttc|gap|speed <|> VALUE] [nth N]
                     [for 500ms | intermittent p 0.1 | intermittent every N | permanent]
    babbling NODE | bus-off NODE | partition NODE,...|NODE,...
                 ... [after 2s | when ttc|gap|speed <|> VALUE] [for 500ms | permanent]

FRAMES is the name of a message of the DBC, or `from NODE`. Without a word about how long, one frame is
struck; a babbling node, a bus-off and a partition last for good. A fault opens at once, after some bus
time, or when the car is in a condition; from there on its `nth` frame is the first that is struck. Times
are bus time, in whole microseconds.

The hub knows no DBC. The command resolves the names (`resolved`) before anything runs, so a name that does
not exist is the user's error and costs the run nothing. What a fault does to the frames is in
`bus_disturber`.
"""

import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final, get_args

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.core.units import duration, milliseconds, number
from aftbed.inject import grammar
from aftbed.inject.grammar import NUMBER, ONCE, Chance, Every, Lasting, Permanent, Transient, Trigger, whole
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, receipt_of_car
from aftbed.inject.next_words import next_words
from aftbed.inject.receipts import Receipt
from aftbed.vehicle.can.bus_model import NODES
from aftbed.vehicle.condition import Condition

if TYPE_CHECKING:
    from aftbed.vehicle.can.dbc_file import Codec

BUS: Final = "bus"  # the target of a fault of the bus
FRAME_BITS: Final = 64
CRC_BITS: Final = 8  # of E2E profile 11: the first byte
NTH_MAX: Final = 999_999_999
GRAMMAR: Final = (
    "omission|duplicate|reorder|stuck-counter bus FRAMES, delay bus FRAMES by 40ms,"
    " corrupt bus FRAMES bit K|signal NAME=VALUE [crc good], masquerade bus FRAMES as MESSAGE,"
    " each with [after 2s | when ttc < 1.2] [nth N] [for 500ms | intermittent p 0.1 | permanent],"
    " or babbling|bus-off NODE, partition NODE,...|NODE,... with [after 2s | when ttc < 1.2] [for 500ms]"
)
_Words = Callable[[], Iterable[str]]
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")
_NODE: Final = re.compile(r"[a-z_][a-z0-9_]{0,31}")


# -- what is done ---------------------------------------------------------------------------------


class BusEffect(msgspec.Struct, frozen=True, tag=True):
    """Base of what a fault does to frames or nodes. As text: the words behind the frames."""

    VERB = ""

    def __str__(self) -> str:
        return ""


class Omission(BusEffect, frozen=True):
    """The frame does not come."""

    VERB = "omission"


class Delay(BusEffect, frozen=True):
    """The frame comes later."""

    by_us: int

    VERB = "delay"

    def __str__(self) -> str:
        return f"by {duration(self.by_us / 1000)}"


class Duplicate(BusEffect, frozen=True):
    """The frame comes twice."""

    VERB = "duplicate"


class Reorder(BusEffect, frozen=True):
    """The frame comes after the next one of those that the fault is aimed at."""

    VERB = "reorder"


class FlipBit(BusEffect, frozen=True):
    """Bit `bit`, counted from bit 0 of byte 0, is inverted; `crc_good`: the CRC is made to fit."""

    bit: int
    crc_good: bool = False

    VERB = "corrupt"

    def __str__(self) -> str:
        return f"bit {self.bit}{' crc good' if self.crc_good else ''}"


class SetSignal(BusEffect, frozen=True):
    """The signal has that value, in the units of the DBC; `crc_good`: the CRC is made to fit."""

    signal: str
    value: float
    crc_good: bool = False

    VERB = "corrupt"

    def __str__(self) -> str:
        return f"signal {self.signal}={number(self.value)}{' crc good' if self.crc_good else ''}"


class Masquerade(BusEffect, frozen=True):
    """The CRC is right for the data id of another message."""

    message: str

    VERB = "masquerade"

    def __str__(self) -> str:
        return f"as {self.message}"


class StuckCounter(BusEffect, frozen=True):
    """The counter stays as in the frame before; the CRC fits."""

    VERB = "stuck-counter"


class NodeEffect(BusEffect, frozen=True):
    """Base of what is done to one node."""

    node: str

    def __str__(self) -> str:
        return self.node


class Babble(NodeEffect, frozen=True):
    """The node sends the highest priority without a pause: no other frame gets through, none of its own
    either.
    """

    VERB = "babbling"


class BusOff(NodeEffect, frozen=True):
    """Nothing of the node reaches the bus, and nothing of the bus the node."""

    VERB = "bus-off"


class Partition(BusEffect, frozen=True):
    """The bus is cut: neither side receives the other. A node on neither side receives both."""

    side: tuple[str, ...]
    other: tuple[str, ...]

    VERB = "partition"

    def __str__(self) -> str:
        return f"{','.join(self.side)}|{','.join(self.other)}"


FrameAct = Omission | Delay | Duplicate | Reorder | FlipBit | SetSignal | Masquerade | StuckCounter
NodeAct = Babble | BusOff | Partition
BusAct = FrameAct | NodeAct
NODE_ACTS: Final = (Babble, BusOff, Partition)
BusPersistence = Transient | Lasting | Chance | Every | Permanent

_WITHOUT_WORDS: Final[dict[str, BusAct]] = {
    act.VERB: act for act in (Omission(), Duplicate(), Reorder(), StuckCounter())
}
ON_FRAMES: Final = tuple(dict.fromkeys(act.VERB for act in get_args(FrameAct)))
ON_NODES: Final = tuple(act.VERB for act in NODE_ACTS)
ONLY_ON_BUS: Final = (*ON_NODES, FlipBit.VERB, Masquerade.VERB, StuckCounter.VERB)  # no channel has these


# -- to which frames, from when -------------------------------------------------------------------


class Frames(msgspec.Struct, frozen=True):
    """The frames called `message`, or those that `sender` sends: exactly one of the two is given."""

    message: str = ""
    sender: str = ""

    def __post_init__(self) -> None:
        if bool(self.message) == bool(self.sender):
            raise ValueError(f"frames of message {self.message!r} and of node {self.sender!r}")

    def __str__(self) -> str:
        return f"bus {self.message or f'from {self.sender}'}"


class Opening(msgspec.Struct, frozen=True):
    """At once, after `after_us` of bus time, or when the condition holds; from there on the `nth` frame."""

    after_us: int = 0
    when: Condition | None = None
    nth: int = 1

    def __post_init__(self) -> None:
        if self.after_us and self.when is not None:
            raise ValueError("a fault that opens after a time and on a condition")

    def __str__(self) -> str:
        words = [f"after {duration(self.after_us / 1000)}"] if self.after_us else []
        words += [f"when {self.when}"] if self.when is not None else []
        return " ".join([*words, *([f"nth {self.nth}"] if self.nth != 1 else [])])


class TargetFrame(msgspec.Struct, frozen=True):
    """What the name of a message means. `data_id` -1: it has no E2E protection, or the act needs none of it.

    Of a signal that is set: the bits of it in the data, and what they are to be.
    """

    can_id: int
    data_id: int = -1
    mask: bytes = b""
    bits: bytes = b""


class BusFault(FaultKind, frozen=True, tag="bus"):
    """One fault of the bus. `frames` is None for an act on nodes, which lasts, for a time or for good.

    `targets`: what its names mean; None until they are resolved, and none for an act on nodes.
    """

    effect: BusAct
    frames: Frames | None = None
    opening: Opening = Opening()
    persistence: BusPersistence = ONCE
    targets: tuple[TargetFrame, ...] | None = None

    NAMES = (*ON_FRAMES, *ON_NODES)

    needs_bus = True

    def __post_init__(self) -> None:
        """Refuse, with a ValueError, what means nothing."""
        on_nodes = isinstance(self.effect, NODE_ACTS)
        name = type(self.effect).__name__
        if on_nodes != (self.frames is None):
            raise ValueError(f"{name} {'with' if on_nodes else 'without'} frames")
        if on_nodes and (self.opening.nth != 1 or not isinstance(self.persistence, Lasting | Permanent)):
            raise ValueError(f"{name} lasts, and strikes no nth frame")

    # -- words

    @classmethod
    def claims(cls, words: Sequence[str]) -> bool:
        return bool(words) and (words[0] in ONLY_ON_BUS or BUS in words[1:2])

    @classmethod
    def read(cls, words: Sequence[str]) -> AnyFault:
        return AnyFault(read_bus_fault(" ".join(words)), BUS)

    @classmethod
    def next_words(cls, words: Sequence[str], graph: Graph) -> Iterable[str]:
        """As `read_bus_fault` reads them. The messages are those of the car's own bus."""
        verb, *rest = words
        keys: tuple[str, ...] = ("after", "when", "for", grammar.PERMANENT)
        if verb in ON_NODES:
            sides = f"{NODES[0]}|{','.join(NODES[1:])}"
            places: list[_Words] = [lambda: (sides,) if verb == Partition.VERB else NODES]
        else:
            places = [lambda: (BUS,), lambda: ("from", *_own_messages())]
            places += [lambda: NODES] if rest[1:2] == ["from"] else []
            places += _BEHIND_FRAMES.get(verb, ())
            keys = (*keys, "nth", grammar.INTERMITTENT)
        if len(rest) < len(places):
            return places[len(rest)]()
        behind = rest[len(places) :]
        if verb != FlipBit.VERB or (behind and behind[0] != "crc"):
            return next_words(behind, keys, graph)
        if len(behind) == 1:
            return ("good",)
        return next_words(behind[2:], keys, graph) if behind else ("crc", *next_words([], keys, graph))

    @property
    def name(self) -> str:
        return self.effect.VERB

    def subject(self, target: str) -> list[str]:
        """All the rest: a fault of the bus has words of its own for when and how often."""
        frames = "" if self.frames is None else str(self.frames)
        return [frames, str(self.effect), str(self.opening), str(self.persistence)]

    def __str__(self) -> str:
        return " ".join(filter(None, [self.name, *self.subject(BUS)]))

    # -- checks

    def validate(self, fault: AnyFault) -> None:
        if (fault.trigger, fault.target) != (Trigger(), BUS):
            raise ValueError("a fault of the bus has its own words for when")
        super().validate(fault)

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """It names what is on the bus, not in the graph."""

    def resolved(
        self, codecs: "Sequence[Codec]", nodes: Sequence[str] = NODES, *, car: bool = True
    ) -> "BusFault":
        """The same with what its names mean on a bus of these messages and `nodes`. `car`: there is one.

        Raises ConfigError naming the message, signal, bit or node that does not exist.
        """
        if self.opening.when is not None and not car:
            raise ConfigError(f"{self}: 'when' looks at the car, and a replay has none")
        match self.effect:
            case NodeEffect(node):
                named: tuple[str, ...] = (node,)
            case Partition(side, other):
                named = (*side, *other)
            case _:
                named = ()
        for node in named:
            if node not in nodes:
                raise unknown("node of the bus", node, nodes)
        found = _messages(self.frames, codecs) if self.frames is not None else []
        targets = tuple(_target(self.effect, codec, name) for codec, name in found)
        return msgspec.structs.replace(self, targets=targets)

    # -- in the run

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        yield from run.disturb(injection)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        return receipt_of_car(injection, run, self.opening.when)


def _own_messages() -> list[str]:
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415 - cantools, only where a shell asks

    return own_dbc().names()


_BEHIND_FRAMES: Final[dict[str, tuple[_Words, ...]]] = {  # by word, what it may be
    Delay.VERB: (lambda: ("by",), lambda: ("20ms", "40ms")),
    FlipBit.VERB: (lambda: ("bit",), lambda: ("21", "40")),
    Masquerade.VERB: (lambda: ("as",), _own_messages),
}


# -- names ----------------------------------------------------------------------------------------


def _messages(frames: Frames, codecs: "Sequence[Codec]") -> "list[tuple[Codec, str]]":
    """The messages that `frames` means, each with the codec that has it."""
    if frames.message:
        found = [(codec, frames.message) for codec in codecs if frames.message in codec.names()][:1]
        if not found:
            raise unknown("message", frames.message, {name for codec in codecs for name in codec.names()})
        return found
    found = [(codec, name) for codec in codecs for name in codec.sent_by(frames.sender)]
    if not found:
        raise unknown("sender of frames", frames.sender, {s for codec in codecs for s in codec.senders()})
    return found


def _target(act: BusAct, codec: "Codec", name: str) -> TargetFrame:
    can_id = codec.can_id(name)
    match act:
        case FlipBit(bit, crc_good):
            if bit >= 8 * codec.length(name):
                raise ConfigError(f"bit {bit}: {name} has the bits 0 to {8 * codec.length(name) - 1}")
            if crc_good and bit < CRC_BITS:
                raise ConfigError(
                    f"bit {bit} crc good: bits 0 to {CRC_BITS - 1} of {name} are the CRC itself"
                )
            return TargetFrame(can_id, codec.data_id(name) if crc_good else -1)
        case SetSignal(signal, value, crc_good):
            mask, bits = codec.patch(name, signal, value)
            return TargetFrame(can_id, codec.data_id(name) if crc_good else -1, mask, bits)
        case Masquerade(message):
            own, other = codec.data_id(name), codec.data_id(message)
            if own == other:
                raise ConfigError(f"{name} as {message}: both have the data id {own}")
            return TargetFrame(can_id, other)
        case StuckCounter():
            return TargetFrame(can_id, codec.data_id(name))
        case _:
            return TargetFrame(can_id)


# -- reading the words ----------------------------------------------------------------------------


def read_bus_fault(text: str) -> BusFault:
    """The fault that `text` means, its names not resolved.

    Raises ConfigError naming the word that is wrong.
    """
    words = _WordReader(text)
    try:
        verb = words.next("a fault of the bus")
        if verb not in BusFault.NAMES:
            raise unknown("fault of the bus", verb, BusFault.NAMES)
        on_nodes = verb in ON_NODES
        frames = None if on_nodes else words.frames()
        act = _act(verb, words)
        opening, persistence = _opening_and_persistence(words, on_nodes=on_nodes)
    except ConfigError as error:
        raise ConfigError(f"fault {text[:200]!r}: {error}; allowed is: {GRAMMAR}") from None
    return BusFault(act, frames, opening, persistence)


class _WordReader:
    """Takes the words of the text one by one. All raise ConfigError on a word that is missing or wrong."""

    def __init__(self, text: str) -> None:
        self.left = deque(text.split())

    def next(self, what: str) -> str:
        """The next word, which is `what`."""
        if not self.left:
            raise ConfigError(f"{what} is missing")
        return self.left.popleft()

    def take(self, word: str) -> bool:
        """Whether the next word is `word`; then it is taken."""
        if self.left and self.left[0] == word:
            self.left.popleft()
            return True
        return False

    def demand(self, word: str) -> None:
        found = self.next(repr(word))
        if found != word:
            raise ConfigError(f"found {found[:40]!r} where {word!r} is expected")

    def whole(self, what: str, least: int, most: int) -> int:
        return whole(what, self.next(f"the number of {what!r}"), least, most)

    def duration_us(self) -> int:
        found = self.next("a duration")
        value = round(milliseconds("duration", found) * 1000)
        if value == 0:
            raise ConfigError(f"duration {found[:40]!r}: a microsecond is the least")
        return value

    def message(self) -> str:
        return self._name(_NAME, "message", self.next("the name of a message"))

    def node(self) -> str:
        return self._name(_NODE, "node", self.next("the name of a node").lower())

    @staticmethod
    def _name(pattern: re.Pattern[str], of: str, found: str) -> str:
        if not pattern.fullmatch(found):
            raise ConfigError(f"{found[:40]!r} is no name of a {of}")
        return found

    def frames(self) -> Frames:
        self.demand("bus")
        return Frames(sender=self.node()) if self.take("from") else Frames(message=self.message())

    def crc_good(self) -> bool:
        if not self.take("crc"):
            return False
        self.demand("good")
        return True


def _act(verb: str, words: _WordReader) -> BusAct:
    """What `verb` does, with the words behind the frames."""
    match verb:
        case Delay.VERB:
            words.demand("by")
            return Delay(words.duration_us())
        case FlipBit.VERB:
            return _corruption(words)
        case Masquerade.VERB:
            words.demand("as")
            return Masquerade(words.message())
        case Babble.VERB:
            return Babble(words.node())
        case BusOff.VERB:
            return BusOff(words.node())
        case Partition.VERB:
            return _partition(words.next("NODE,...|NODE,..."))
        case _:
            return _WITHOUT_WORDS[verb]


def _corruption(words: _WordReader) -> BusAct:
    what = words.next("'bit K' or 'signal NAME=VALUE'")
    if what == "bit":
        return FlipBit(words.whole("bit", 0, FRAME_BITS - 1), words.crc_good())
    if what == "signal":
        text = words.next("NAME=VALUE")
        name, _, value = text.partition("=")
        if not _NAME.fullmatch(name) or not NUMBER.fullmatch(value):
            raise ConfigError(f"signal {text[:40]!r}: NAME=VALUE is allowed, with up to six decimals")
        return SetSignal(name, float(value), words.crc_good())
    raise ConfigError(f"found {what[:40]!r} where 'bit' or 'signal' is expected")


def _partition(text: str) -> Partition:
    sides = [side.split(",") for side in text.split("|")]
    nodes = [node for side in sides for node in side]
    if len(sides) != 2 or not all(map(_NODE.fullmatch, nodes)) or len(set(nodes)) != len(nodes):
        raise ConfigError(
            f"partition {text[:80]!r}: two sides, and each node once, is allowed: radar|brake,gateway"
        )
    return Partition(tuple(sides[0]), tuple(sides[1]))


def _opening_and_persistence(words: _WordReader, *, on_nodes: bool) -> tuple[Opening, BusPersistence]:
    """Each of these words once, in any order."""
    after_us, when, nth = 0, None, 1
    persistence: BusPersistence = Permanent() if on_nodes else ONCE
    seen: set[str] = set()
    while words.left:
        word = words.left.popleft()
        kind = "opening" if word in ("after", "when") else "nth" if word == "nth" else "persistence"
        if kind in seen:
            raise ConfigError(f"{word!r} says again what has been said")
        seen.add(kind)
        match word:
            case "after":
                after_us = words.duration_us()
            case "when":
                when = grammar.condition(
                    *(words.next(what) for what in ("ttc, gap or speed", "'<' or '>'", "a value"))
                )
            case "nth" if not on_nodes:
                nth = words.whole("nth", 1, NTH_MAX)
            case "for":
                persistence = Lasting(words.duration_us())
            case "intermittent" if not on_nodes:
                persistence = grammar.intermittent(words.next("'every' or 'p'"), words.next("a number"))
            case "permanent":
                persistence = Permanent()
            case "nth" | "intermittent":
                raise ConfigError(f"{word!r} is about frames; this fault takes hold of nodes, and lasts")
            case _:
                raise ConfigError(f"unknown word {word[:40]!r}")
    return Opening(after_us, when, nth), persistence
