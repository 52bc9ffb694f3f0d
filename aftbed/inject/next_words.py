"""What may stand next in the words of a fault that are being typed: for the completion of a shell.

`next_words` knows the keys that kinds share. A kind says by `FaultKind.next_words` what stands before them.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from aftbed.core.graph import Graph
from aftbed.inject import targets
from aftbed.inject.grammar import BYTE, CHANCE, EVERY, FOR, INTERMITTENT, PERMANENT, count_of_values
from aftbed.vehicle.condition import QUANTITIES

EXCLUSIVE: Final = (  # of each row, one key at most
    ("at", "after"),
    ("nth", "after"),
    ("after", "when"),
    ("bits", BYTE, "burst", "stuck"),
    ("bits", BYTE, "bit", "stuck"),
    (PERMANENT, INTERMITTENT, FOR),
    ("by", "share"),
)
EXAMPLES: Final = {  # values that nothing lists: usual ones, which fit any kind of fault
    "nth": ("1", "10", "100"),
    "after": ("200ms", "2s"),
    FOR: ("50ms", "500ms"),
    "by": ("2ms", "20ms"),
    "share": ("25%", "50%"),
    "bit": ("0", "7"),
    "bits": ("2", "3"),
    BYTE: ("0",),
    "burst": ("3", "8"),
    "stuck": ("7=0", "7=1"),
    "address": ("0x7f0012345678",),
    "range": ("30", "40"),
    "speed": ("10",),
    "angle": ("20",),
}
THRESHOLDS: Final = {"ttc": ("1.2", "2.0"), "gap": ("10", "20"), "speed": ("5", "10")}  # s, m, m/s


def next_words(
    words: Sequence[str], keys: Sequence[str], graph: Graph, examples: Mapping[str, Sequence[str]] = EXAMPLES
) -> Iterable[str]:
    """What may follow `words`, which begin behind the subject: a key of `keys`, or the value of the last."""
    used, at = list[str](), 0
    while at < len(words):
        key = words[at]
        count = count_of_values(key)
        values = words[at + 1 : at + 1 + count]
        if key == BYTE and len(values) == 1 and values[0] in keys:  # its number may be left out
            values, count = [], 0
        if len(values) < count:
            optional = _other_keys((*used, key), keys) if key == BYTE else ()
            return (*_values(key, values, graph, examples), *optional)
        used.append(key)
        at += 1 + count
    return _other_keys(used, keys)


def _other_keys(used: Sequence[str], keys: Sequence[str]) -> tuple[str, ...]:
    """Those that may still be given."""
    excluded = {key for row in EXCLUSIVE if set(row) & set(used) for key in row} | set(used)
    if "at" in keys and "at" not in used:
        excluded.add("nth")  # there is nothing for it to count
    return tuple(key for key in keys if key not in excluded)


def _values(
    key: str, given: Sequence[str], graph: Graph, examples: Mapping[str, Sequence[str]]
) -> Iterable[str]:
    """The next word of the value of `key`, behind the words of it that are given."""
    match key, given:
        case "at", []:
            return targets.events_in(graph)
        case "in", []:
            return (*targets.roles_in(graph), *targets.replicas(graph))
        case "when", []:
            return QUANTITIES
        case "when", [_]:
            return ("<", ">")
        case "when", [quantity, _]:
            return THRESHOLDS.get(quantity, ())
        case _ if key == INTERMITTENT:
            return ("2", "10") if list(given) == [EVERY] else ("0.1",) if given else (EVERY, CHANCE)
        case _:
            return examples.get(key, ())
