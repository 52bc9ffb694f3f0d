"""The registry of the kinds of faults, and a fault as it is typed and as it travels.

    crash primary at checkpoint.sent nth 100            hang backup for 50ms after 200ms
    delay aft2aft by 5ms in b permanent                 bitflip state.ego_ms bit 52 when ttc < 1.2
    corrupt bus RADAR_TRACK bit 21 crc good for 500ms    radar ghost range 30 speed 10 for 200ms

`FaultAction` registers the kinds, one line each; each has its grammar at the top of its file.
"""

from collections.abc import Sequence
from typing import Final, cast, get_args

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.inject.bus import BUS, BusFault
from aftbed.inject.channel import ChannelFault
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import ONCE, Persistence, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.kind import AnyFault, FaultKind
from aftbed.inject.memory import MemoryFlip
from aftbed.inject.radar import EFFECTS, RADAR, RadarFault
from aftbed.inject.receipts import BusTimes, ReceiptState
from aftbed.inject.slow import Slow
from aftbed.inject.state import StateFlip
from aftbed.inject.value import ValueFlip

FaultAction = (  # the registry: the first kind that claims the words of a fault reads them
    BusFault  # before the channels, which share some of its words
    | RadarFault
    | Crash
    | Hang
    | Slow
    | ChannelFault
    | MemoryFlip  # before all other bit flips
    | StateFlip  # before those without a field
    | ValueFlip
)
KINDS: Final[tuple[type[FaultKind], ...]] = get_args(FaultAction)
NAMES: Final = tuple(dict.fromkeys(name for kind in KINDS for name in kind.NAMES))
SAME_ROLES: Final = {"leader": "primary", "follower": "backup"}
SYNONYMS: Final = {  # of names of faults
    **dict.fromkeys(("kill", "sigkill", "die", "abort"), "crash"),
    **dict.fromkeys(("freeze", "stop", "sigstop", "pause"), "hang"),
    **dict.fromkeys(("drop", "lose", "loss"), "omission"),
    **dict.fromkeys(("flip", "seu", "bit-flip"), "bitflip"),
    **dict.fromkeys(("late", "latency", "lag"), "delay"),
    **dict.fromkeys(("repeat", "double"), "duplicate"),
    **dict.fromkeys(("swap", "shuffle"), "reorder"),
}
GRAMMAR: Final = (
    "crash|hang|slow TARGET [by 2ms | share 25%] [for 50ms] [at EVENT [nth N] | after 200ms],"
    " omission|delay|duplicate|reorder CHANNEL [by 20ms] [in primary|backup|a|b] [nth N | after 200ms],"
    " bitflip PLACE|state.FIELD|memory [bit K] [in primary|backup|a|b] [at EVENT] [nth N] | [after 200ms],"
    f" or {RADAR} {'|'.join(EFFECTS)} [range 30] [speed 10] [by -5] [angle 20] [for 200ms] [after 200ms],"
    " each with [when ttc < 1.2] in place of after"
)


class Fault(AnyFault, frozen=True):
    """A fault of one of the registered kinds, which can be decoded."""

    action: FaultAction


class ArmedFault(msgspec.Struct, frozen=True):
    """The order to a node: the `nth` time that `brick` comes to the point, do `action`, or ask for it.

    `by_itself`: the node does it to itself. `draw` decides what `action` and `persistence` leave open.
    `strikes`: how often it has struck here so far.
    """

    fault: int
    brick: str
    nth: int
    action: FaultAction
    by_itself: bool
    draw: int = 0
    persistence: Persistence = ONCE
    strikes: int = 0


class FaultReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """A fault of a run in its words, with its receipt, as it stands in records and documents.

    `number`: which of the run's faults, from 0 on, as the journals count them. Those of live faults that were
    refused are missing: these have no report.
    """

    fault: str
    receipt: ReceiptState
    detail: str = ""
    live: bool = False  # it was asked for while the run ran
    bus: BusTimes | None = None  # of a fault of the bus that struck
    number: int = 0

    @property
    def fired(self) -> bool:
        return self.receipt.fired

    @property
    def action(self) -> FaultKind:
        return parse(self.fault).action


def on_bus(action: BusFault) -> Fault:
    return Fault(action, BUS, Trigger())


def parse(text: str) -> Fault:
    """The fault that `text` means. Raises ConfigError naming the word that is wrong."""
    return read(text.split())


def read(words: Sequence[str]) -> Fault:
    """The same of words that are separate already: one of them may have spaces.

    `leader` and `follower` mean `primary` and `backup`, whatever mechanism runs.
    """
    words = [SAME_ROLES.get(word, word) for word in words]
    for kind in KINDS:
        if kind.claims(words):
            found = kind.read(words)
            return Fault(cast("FaultAction", found.action), found.target, found.trigger, found.persistence)
    if len(words) < 2:
        raise ConfigError(f"fault {' '.join(words)!r}: expected {GRAMMAR}")
    if words[1] in NAMES:
        raise ConfigError(f"fault {' '.join(words)!r}: the kind comes first: '{words[1]} {words[0]}'")
    raise unknown("fault", words[0], NAMES, SYNONYMS)


def next_words(words: Sequence[str], graph: Graph) -> list[str]:
    """What may stand behind `words` of a fault in a run of `graph`; nothing where they are wrong."""
    if not words:
        return list(NAMES)
    words = [SAME_ROLES.get(word, word) for word in words]
    if len(words) > 1:
        kinds = [kind for kind in KINDS if kind.claims(words)][:1]
    else:
        kinds = [kind for kind in KINDS if words[0] in kind.NAMES]
    return list(dict.fromkeys(word for kind in kinds for word in kind.next_words(words, graph)))
