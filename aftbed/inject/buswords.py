"""The words of a fault of the bus, the same on `run --inject "..."` and on `aftbed inject bus "..."`.

omission | duplicate | reorder | stuck-counter   bus FRAMES
delay        bus FRAMES by 40ms
corrupt      bus FRAMES bit K | signal NAME=VALUE   [crc good]
masquerade   bus FRAMES as MESSAGE
             ... [after 2s | when ttc|gap|speed <|> VALUE] [nth N]
                 [for 500ms | intermittent p 0.1 | intermittent every N | permanent]
babbling NODE | bus-off NODE | partition NODE,...|NODE,...
             ... [after 2s | when ttc|gap|speed <|> VALUE] [for 500ms | permanent]

FRAMES is the name of a message of the DBC, or `from NODE`. Without a word about how long, one frame is
struck; a babbling node, a bus-off and a partition last for good. Names are compared with the DBC later,
by whoever has it: here is what can be said of the words alone.
"""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from aftbed.core.busfault import (
    Babble,
    BusAct,
    BusFault,
    BusOff,
    Condition,
    Delay,
    Duplicate,
    FlipBit,
    Frames,
    Masquerade,
    Omission,
    Opening,
    Partition,
    Persistence,
    Reorder,
    SetSignal,
    StuckCounter,
)
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.persistence import ONCE, Chance, Every, Lasting, Permanent
from aftbed.core.units import milliseconds
from aftbed.inject import parts

GRAMMAR: Final = (
    "omission|duplicate|reorder|stuck-counter bus FRAMES, delay bus FRAMES by 40ms,"
    " corrupt bus FRAMES bit K|signal NAME=VALUE [crc good], masquerade bus FRAMES as MESSAGE,"
    " each with [after 2s | when ttc < 1.2] [nth N] [for 500ms | intermittent p 0.1 | permanent],"
    " or babbling|bus-off NODE, partition NODE,...|NODE,... with [after 2s | when ttc < 1.2] [for 500ms]"
)
ON_FRAMES: Final = ("omission", "delay", "duplicate", "reorder", "corrupt", "masquerade", "stuck-counter")
ON_NODES: Final = ("babbling", "bus-off", "partition")
VERBS: Final = (*ON_FRAMES, *ON_NODES)
FRAME_BITS: Final = 64
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")
_NODE: Final = re.compile(r"[a-z_][a-z0-9_]{0,31}")
NTH_MAX: Final = 999_999_999
_PLAIN: Final[dict[str, BusAct]] = {
    "omission": Omission(),
    "duplicate": Duplicate(),
    "reorder": Reorder(),
    "stuck-counter": StuckCounter(),
}


def speaks_of_the_bus(words: Sequence[str]) -> bool:
    """Whether these are words of a fault of the bus, right or wrong; channels have omissions, too."""
    return bool(words) and (
        words[0] in (*ON_NODES, "corrupt", "masquerade", "stuck-counter") or "bus" in words[1:2]
    )


def parse(text: str) -> BusFault:
    """The fault that `text` means, not aimed yet. Raises ConfigError naming the word that is wrong."""
    words = _Words(text)
    verb = words.next("a fault of the bus")
    if verb in ON_NODES:
        act, frames, permanent = _node_act(verb, words), None, True
    elif verb in ON_FRAMES:
        frames = _frames(words)
        act, permanent = _frame_act(verb, words), False
    else:
        raise unknown("fault of the bus", verb, VERBS)
    opening, persistence = _rest(words, on_nodes=permanent)
    return BusFault(act, frames, opening, persistence)


class _Words:
    """What is left of the text."""

    def __init__(self, text: str) -> None:
        self.text, self._left = text, deque(text.split())

    def next(self, what: str) -> str:
        """The next word, which is `what`."""
        if not self._left:
            raise self.wrong(f"{what} is missing")
        return self._left.popleft()

    def take(self, word: str) -> bool:
        """Take `word` if it is the next one."""
        if self._left and self._left[0] == word:
            self._left.popleft()
            return True
        return False

    def demand(self, word: str) -> None:
        """The next word has to be `word`."""
        found = self.next(repr(word))
        if found != word:
            raise self.wrong(f"found {found[:40]!r} where {word!r} is expected")

    def more(self) -> bool:
        return bool(self._left)

    @contextmanager
    def blaming(self) -> Iterator[None]:
        """An error from here on is one of this fault."""
        try:
            yield
        except ConfigError as error:
            raise self.wrong(str(error)) from None

    def wrong(self, why: str) -> ConfigError:
        return ConfigError(f"fault {self.text[:200]!r}: {why}; allowed is: {GRAMMAR}")


# -- what ----------------------------------------------------------------------------------------


def _frames(words: _Words) -> Frames:
    words.demand("bus")
    if words.take("from"):
        return Frames(sender=_node(words))
    return Frames(message=_name(words, "message"))


def _frame_act(verb: str, words: _Words) -> BusAct:
    if verb == "delay":
        words.demand("by")
        return Delay(_duration_us(words))
    if verb == "masquerade":
        words.demand("as")
        return Masquerade(_name(words, "message"))
    return _corruption(words) if verb == "corrupt" else _PLAIN[verb]


def _corruption(words: _Words) -> BusAct:
    what = words.next("'bit K' or 'signal NAME=VALUE'")
    if what == "bit":
        bit = _whole(words, "bit", 0, FRAME_BITS - 1)
        return FlipBit(bit, _crc_good(words))
    if what == "signal":
        text = words.next("NAME=VALUE")
        name, _, value = text.partition("=")
        if not _NAME.fullmatch(name) or not parts.NUMBER.fullmatch(value):
            raise words.wrong(f"signal {text[:40]!r}: NAME=VALUE is allowed, with up to six decimals")
        return SetSignal(name, float(value), _crc_good(words))
    raise words.wrong(f"found {what[:40]!r} where 'bit' or 'signal' is expected")


def _crc_good(words: _Words) -> bool:
    if not words.take("crc"):
        return False
    words.demand("good")
    return True


def _node_act(verb: str, words: _Words) -> BusAct:
    if verb != "partition":
        return Babble(_node(words)) if verb == "babbling" else BusOff(_node(words))
    text = words.next("NODE,...|NODE,...")
    sides = [side.split(",") for side in text.split("|")]
    nodes = [node for side in sides for node in side]
    if len(sides) != 2 or not all(map(_NODE.fullmatch, nodes)) or len(set(nodes)) != len(nodes):
        raise words.wrong(
            f"partition {text[:80]!r}: two sides, and each node once, is allowed: radar|brake,gateway"
        )
    return Partition(tuple(sides[0]), tuple(sides[1]))


# -- when, and for how long ----------------------------------------------------------------------


def _rest(words: _Words, *, on_nodes: bool) -> tuple[Opening, Persistence]:
    """Each of these words once, in any order."""
    after_us, when, nth = 0, None, 1
    persistence: Persistence = Permanent() if on_nodes else ONCE
    seen: set[str] = set()
    while words.more():
        word = words.next("")
        kind = "opening" if word in ("after", "when") else "nth" if word == "nth" else "persistence"
        if kind in seen:
            raise words.wrong(f"{word!r} says again what has been said")
        seen.add(kind)
        match word:
            case "after":
                after_us = _duration_us(words)
            case "when":
                when = _condition(words)
            case "nth" if not on_nodes:
                nth = _whole(words, "nth", 1, NTH_MAX)
            case "for":
                persistence = Lasting(_duration_us(words))
            case "intermittent" if not on_nodes:
                persistence = _intermittent(words)
            case "permanent":
                persistence = Permanent()
            case "nth" | "intermittent":
                raise words.wrong(f"{word!r} is about frames; this fault takes hold of nodes, and lasts")
            case _:
                raise words.wrong(f"unknown word {word[:40]!r}")
    return Opening(after_us, when, nth), persistence


def _condition(words: _Words) -> Condition:
    found = [words.next(what) for what in ("ttc, gap or speed", "'<' or '>'", "a value")]
    with words.blaming():
        return parts.condition(*found)


def _intermittent(words: _Words) -> Every | Chance:
    """Every Nth, or by chance."""
    word, value = words.next("'every' or 'p'"), words.next("a number")
    with words.blaming():
        return parts.intermittent(word, value)


# -- words ---------------------------------------------------------------------------------------


def _name(words: _Words, what: str) -> str:
    found = words.next(f"the name of a {what}")
    if not _NAME.fullmatch(found):
        raise words.wrong(f"{found[:40]!r} is no name of a {what}")
    return found


def _node(words: _Words) -> str:
    found = words.next("the name of a node").lower()
    if not _NODE.fullmatch(found):
        raise words.wrong(f"{found[:40]!r} is no name of a node")
    return found


def _whole(words: _Words, what: str, least: int, most: int) -> int:
    found = words.next(f"the number of {what!r}")
    with words.blaming():
        return parts.whole(what, found, least, most)


def _duration_us(words: _Words) -> int:
    found = words.next("a duration")
    value = round(milliseconds("duration", found) * 1000)
    if value == 0:
        raise words.wrong(f"duration {found[:40]!r}: a microsecond is the least")
    return value
