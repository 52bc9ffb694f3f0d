"""Every adaptation that can be planned between two expressions: all pairs, placements, leaders, recipes."""

from functools import cache
from itertools import product
from typing import Final, NamedTuple

from aftbed.adapt.planner import Plan, plan
from aftbed.core.graph import PLACEMENTS
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import EXPRESSIONS, NONE, REPLICAS, build, replication_of

RUNNABLE: Final = tuple(e for e in EXPRESSIONS if e != NONE)


class Case(NamedTuple):
    """One of them."""

    old: str
    new: str
    placement: str = PLACEMENTS[0]
    leader: str = REPLICAS[0]
    recipe: str = RECIPES[0]

    def plan(self) -> Plan:
        """Its plan, which all tests look at and none changes."""
        return _planned(self)


@cache
def _planned(case: Case) -> Plan:
    old, new = (build(e, case.placement, case.leader) for e in (case.old, case.new))
    return plan(old, new, case.recipe)


def _alike(old: str, new: str) -> bool:
    """The paper has as many replicas after an adaptation as before."""
    return bool(replication_of(old)) == bool(replication_of(new))


CASES: Final = tuple(
    Case(old, new, placement, leader, recipe)
    for old, new, placement, leader, recipe in product(RUNNABLE, RUNNABLE, PLACEMENTS, REPLICAS, RECIPES)
    if old != new
    and (leader == REPLICAS[0] or placement == PLACEMENTS[0])
    and (recipe == RECIPES[0] or (placement == PLACEMENTS[0] and _alike(old, new)))
)
