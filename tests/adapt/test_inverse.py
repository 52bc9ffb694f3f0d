"""The way back is data: after any part of a plan, its inverse leads to the graph that was there before."""

from typing import Final

import msgspec
import pytest
from plans import CASES, Case

from aftbed.adapt.planner import drains
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Link
from aftbed.core.script import RECIPES, Layout, Step, applied, flat, inverse, reversible
from aftbed.ftm.registry import KINDS

Part = tuple[tuple[Step, ...], tuple[Step, ...]]  # of `prepare` and of `commit`
PLANS: Final = [case for case in CASES if case.recipe == RECIPES[0]]


def parts(prepare: tuple[Step, ...], commit: tuple[Step, ...]) -> list[Part]:
    """Every prefix of a script up to its finish; and every prefix of the steps that happen together."""
    found: list[Part] = [(prepare[:count], ()) for count in range(len(prepare) + 1)]
    for index, step in enumerate(commit):
        inner = tuple(flat((step,)))
        found += [(prepare, (*commit[:index], *inner[:count])) for count in range(1, len(inner))]
        found.append((prepare, commit[: index + 1]))
    return found


def in_order(layout: Layout) -> object:
    """All that `layout` says, in an order of its own."""
    graph = layout.graph

    def bricks(found: tuple[BrickSpec, ...]) -> list[BrickSpec]:
        return sorted(found, key=lambda b: b.name)

    def links(found: tuple[Link, ...]) -> list[Link]:
        return sorted(found, key=msgspec.structs.astuple)

    return (
        (graph.ftm, graph.placement, bricks(graph.bricks), links(graph.links)),
        {node: sorted(hosted) for node, hosted in graph.nodes.items()},
        {node: bricks(found) for node, found in layout.staged.items()},
        {node: bricks(found) for node, found in layout.replaced.items()},
        (layout.added, links(layout.prepared), layout.suspended),
    )


def undone(old: Graph, new: Graph, part: Part) -> Layout:
    """What is there when `part` has been done and undone."""
    prepare, commit = part
    there = applied(applied(Layout(old), prepare, KINDS, committing=False), commit, KINDS)
    return applied(there, inverse(old, (*prepare, *commit), KINDS, drains(new, old)), KINDS)


@pytest.mark.parametrize(
    "plans",
    [pytest.param(PLANS[::29], id="some"), pytest.param(PLANS, id="all", marks=pytest.mark.deep)],
)
def test_every_part_of_every_plan_and_its_inverse_lead_back_to_the_graph(plans: list[Case]) -> None:
    """All pairs of expressions, both leaders. Nothing is left staged, prepared or suspended."""
    assert {case.placement for case in plans} == set(PLACEMENTS)
    for case in plans:
        plan = case.plan()
        start = in_order(Layout(plan.old))
        found = parts(plan.script.prepare, plan.script.commit)
        assert len(found) > 1
        for part in found:
            assert in_order(undone(plan.old, plan.new, part)) == start, (case, part)


def test_the_finish_of_a_plan_is_one_way_and_what_is_before_it_is_not() -> None:
    for case in PLANS:
        script = case.plan().script
        assert reversible((*script.prepare, *script.commit)), case
        assert not script.finish or not reversible(script.finish[:1]), case


def test_state_is_handed_back_only_where_requests_may_have_passed() -> None:
    plan = Case("pbr", "lfr", "replica").plan()
    *before, resumes = plan.script.commit
    closed = inverse(plan.old, (*plan.script.prepare, *before), KINDS, drains(plan.new, plan.old))
    opened = inverse(plan.old, (*plan.script.prepare, *before, resumes), KINDS, drains(plan.new, plan.old))
    assert [type(step).__name__ for step in closed] == ["Together"] * 3
    assert [type(step).__name__ for step in opened] == [
        *("Suspend", "Drain"),
        *["Together"] * 4,
    ]
    assert [type(step).__name__ for step in flat(opened[2:3])] == ["Migrate", "Migrate"]
