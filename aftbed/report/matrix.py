"""The outcomes as a matrix: a row per mechanism (with its placement and adaptation), a column per fault.

A cell is a stratum. Its bar shows the outcomes in their order, the best on the left; what counts stands below
it in words and figures, so that nothing rests on telling colours apart.
"""

from collections.abc import Iterable
from typing import Final

import msgspec

from aftbed.campaign.plan import JOINED, strata_of
from aftbed.campaign.spec import Spec
from aftbed.campaign.summary import StratumSummary
from aftbed.judge.outcome import OUTCOMES

MEANINGS: Final = {
    "masked": "nobody could notice the fault",
    "latent": "right replies, but the state of a replica is wrong at the end",
    "tolerated": "the mechanism had to act: a failover, a third execution",
    "degraded": "late replies, a recovery over its budget, or no redundancy at the end",
    "detected_stop": "a replica ended itself rather than answer",
    "omission": "requests without a reply, then replies again",
    "duplicate_effect": "a request took effect twice, or was answered twice",
    "unavailable": "no replica was left",
    "hang": "a replica was left, but no reply came any more",
    "sdc": "a wrong reply reached the client",
    "inconclusive": "the record is not whole: nothing is known of the mechanism",
    "harness_error": "trouble of the testbed: nothing is known of the mechanism",
}
assert tuple(MEANINGS) == OUTCOMES


class Share(msgspec.Struct, frozen=True):
    """A piece of a bar."""

    outcome: str
    count: int
    percent: float


class Cell(msgspec.Struct, frozen=True):
    """A stratum; `anchor` is where the page has more of it."""

    stratum: StratumSummary
    anchor: str
    shares: tuple[Share, ...]


class Row(msgspec.Struct, frozen=True):
    """The strata of one mechanism; None where it has none with that fault."""

    name: str
    cells: tuple[Cell | None, ...]


class Matrix(msgspec.Struct, frozen=True):
    """Names of faults, and the rows below them."""

    faults: tuple[str, ...]
    rows: tuple[Row, ...]


def matrix(spec: Spec, strata: Iterable[StratumSummary]) -> Matrix:
    """Of a summary's strata, in their order."""
    place = Places(spec)
    cells = [(place(s.name), Cell(s, anchor_of(number), shares(s))) for number, s in enumerate(strata)]
    faults = tuple(dict.fromkeys(fault for (_, fault), _ in cells))
    rows = dict.fromkeys(row for (row, _), _ in cells)
    found = dict(cells)
    return Matrix(faults, tuple(Row(row, tuple(found.get((row, f)) for f in faults)) for row in rows))


def shares(stratum: StratumSummary) -> tuple[Share, ...]:
    """The pieces of its bar, the best first."""
    counts = stratum.outcomes.items()
    return tuple(Share(name, count, 100 * count / stratum.experiments) for name, count in counts)


def anchor_of(number: int) -> str:
    """Of the stratum with that number."""
    return f"stratum-{number}"


class Places:
    """Row and column of each stratum of a spec, by its name; of one that is none of it, by its parts."""

    def __init__(self, spec: Spec) -> None:
        self._fault = {stratum.name: stratum.fault.name for stratum in strata_of(spec)}

    def __call__(self, name: str) -> tuple[str, str]:
        fault = self._fault.get(name, name.rpartition(JOINED)[2])
        return name.removesuffix(f"{JOINED}{fault}"), fault
