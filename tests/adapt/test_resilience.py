"""The resilience of a set: each figure is counted again, the slow way, from what `ftm check` says."""

from collections import Counter
from collections.abc import Iterator
from itertools import product
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.adapt.resilience import (
    Addition,
    AssumptionKind,
    Axis,
    AxisValue,
    ChangeAnswer,
    Resilience,
    axes,
    expressions_of,
    hands_over,
    mechanisms_of,
    resilience,
)
from aftbed.adapt.suitability import (
    FAULTS,
    TABLE,
    FaultModel,
    Limits,
    Resources,
    Row,
    SuitabilityTable,
    consistent,
    problems,
)
from aftbed.core.application import EXACT, NONE, Characteristics
from aftbed.core.errors import ConfigError
from aftbed.ftm.compose import parse
from aftbed.ftm.registry import MECHANISMS

AXES: Final = axes()
PAPER: Final = ("pbr", "lfr", "tr")
Values = tuple[AxisValue, ...]
Given = tuple[FaultModel, Characteristics, Resources]


def assumed(values: Values) -> Given:
    """FT, A and R of a situation: of each axis, what its value says."""
    asked = {fault for value in values for fault in value.faults.asked()}
    access = next(
        (v.characteristics.state_access for v in values if v.characteristics.state_access != EXACT), EXACT
    )
    rates = [v.resources.bandwidth_kbit_s for v in values if v.resources.bandwidth_kbit_s is not None]
    return (
        FaultModel(**{fault: fault in asked for fault in FAULTS}),
        Characteristics(all(v.characteristics.deterministic for v in values), access),
        Resources(
            min(v.resources.cpus for v in values),
            max(v.resources.cpu_load for v in values),
            min(rates, default=None),
        ),
    )


def changed(situation: Values) -> Iterator[tuple[Axis, Values]]:
    """The situations that differ by one value."""
    for at, axis in enumerate(AXES):
        for value in axis.values:
            if value != situation[at]:
                yield axis, (*situation[:at], value, *situation[at + 1 :])


def answer(running: str, ftms: tuple[str, ...], before: Values, then: Values) -> tuple[ChangeAnswer, str]:
    """And to what it is adapted."""
    if not problems(running, *assumed(then)):
        return ChangeAnswer.STAYS, ""
    closed = all(assumed(values)[1].state_access == NONE for values in (before, then))
    suiting = [one for one in consistent(*assumed(then)) if one in ftms]
    possible = [one for one in suiting if not (closed and hands_over(running, one))]
    return (ChangeAnswer.ADAPTS, possible[0]) if possible else (ChangeAnswer.NOTHING, "")


def unanswered(
    mechanisms: tuple[str, ...], more: tuple[str, ...] = ()
) -> tuple[Counter[tuple[AssumptionKind, ChangeAnswer]], Counter[tuple[str, str]]]:
    """All changes from the states of `mechanisms`, answered by these and `more`."""
    ftms, known = expressions_of(mechanisms), expressions_of((*mechanisms, *more))
    answers: Counter[tuple[AssumptionKind, ChangeAnswer]] = Counter()
    needed: Counter[tuple[str, str]] = Counter()
    for before in product(*(axis.values for axis in AXES)):
        for running in ftms:
            if problems(running, *assumed(before)):
                continue
            for axis, then in changed(before):
                found, new = answer(running, known, before, then)
                answers[axis.kind, found] += 1
                if new:
                    needed[running, new] += 1
    return answers, needed


@pytest.fixture(scope="module")
def paper() -> Resilience:
    """Of the mechanisms of the paper."""
    return resilience(PAPER)


def test_the_counts_are_those_of_asking_for_each_change(paper: Resilience) -> None:
    answers, needed = unanswered(PAPER)
    for of in paper.kinds:
        counts = of.counts
        found = {
            ChangeAnswer.STAYS: counts.stays,
            ChangeAnswer.ADAPTS: counts.adapts,
            ChangeAnswer.NOTHING: counts.nothing,
        }
        assert found == {one: answers[of.kind, one] for one in ChangeAnswer}, of.kind
    assert {(one.old, one.new): one.changes for one in paper.adaptations} == needed
    total = paper.total
    assert total.changes == answers.total() == sum(of.counts.changes for of in paper.kinds)
    assert total.changes == sum(one.counts.changes for one in paper.changes)
    assert total.answered == round((total.stays + total.adapts) / total.changes, 4)
    assert total.of_breaking == round(total.adapts / (total.adapts + total.nothing), 4)


def test_a_mechanism_more_answers_what_it_is_said_to_answer(paper: Resilience) -> None:
    shipped = {one.mechanism: one for one in paper.additions if one.addition is Addition.AS_SHIPPED}
    assert "assert" in shipped and not set(shipped) & set(PAPER)
    for name, one in shipped.items():
        answers, _ = unanswered(PAPER, (name,))
        left = sum(count for (_, found), count in answers.items() if found is ChangeAnswer.NOTHING)
        assert paper.total.nothing - one.answers == left, name


def test_each_state_can_be_reached_by_changes_that_the_mechanism_outlives(paper: Resilience) -> None:
    reached = set()
    for running in paper.ftms:
        ahead = [tuple(axis.values[0] for axis in AXES)]
        while ahead:
            here = ahead.pop()
            if (running, here) not in reached and not problems(running, *assumed(here)):
                reached.add((running, here))
                ahead += [then for _, then in changed(here)]
    assert len(reached) == paper.states


@given(st.tuples(*(st.sampled_from(axis.values) for axis in AXES)), st.sampled_from(expressions_of(PAPER)))
def test_an_expression_suits_a_situation_if_it_suits_each_of_its_values(values: Values, name: str) -> None:
    by_value = all(
        not problems(name, one.faults, one.characteristics, one.resources, TABLE) for one in values
    )
    assert by_value == (not problems(name, *assumed(values)))


def test_what_a_set_can_run() -> None:
    assert expressions_of(PAPER) == ("pbr", "lfr", "tr", "pbr+tr", "lfr+tr")
    assert resilience(("assert",)).ftms == ("assert",)


def test_one_mechanism_alone_can_only_stay() -> None:
    found = resilience(("pbr",))
    assert (found.total.adapts, found.adaptations, found.total.of_breaking) == (0, (), 0.0)
    lost = next(one for one in found.changes if (one.old, one.new) == ("exact", "no"))
    assert lost.counts.nothing == lost.counts.changes > 0, "a checkpoint needs the state"
    random = next(one for one in found.changes if one.new == "not deterministic")
    assert random.counts.stays == random.counts.changes


def test_a_change_for_the_better_needs_no_answer(paper: Resilience) -> None:
    numbers = {axis.name: [value.label for value in axis.values] for axis in AXES if axis.name != "value"}
    for one in paper.changes:
        labels = numbers.get(one.axis, [])
        if one.new in labels and labels.index(one.new) < labels.index(one.old):
            assert one.counts.stays == one.counts.changes, one
            assert one.counts.of_breaking is None


@pytest.mark.parametrize(
    ("old", "new", "does"),
    [
        ("tr", "pbr", True),  # the new backup is given the state
        ("assert", "lfr+assert", True),
        ("pbr", "lfr", True),  # the backup becomes a follower, which has to have the leader's
        ("pbr", "tr", False),
        ("lfr", "lfr+tr", False),
        ("lfr", "lfr", False),
    ],
)
def test_an_adaptation_that_needs_the_state_of_the_function(old: str, new: str, does: bool) -> None:
    assert hands_over(old, new) == does


def test_without_state_access_no_second_replica_is_made() -> None:
    """`assert` and `lfr` need no state; the way from one to the other does."""
    found = {(one.old, one.new): one.changes for one in resilience(("lfr", "assert")).adaptations}
    everywhere = Counter[tuple[str, str]]()
    for before in product(*(axis.values for axis in AXES)):
        if not problems("assert", *assumed(before)):
            for _, then in changed(before):
                suiting = [one for one in consistent(*assumed(then)) if one in ("lfr", "lfr+assert")]
                if problems("assert", *assumed(then)) and suiting:
                    everywhere["assert", suiting[0]] += 1
    for pair, count in everywhere.items():
        assert 0 < found[pair] < count, pair


def test_the_values_are_those_that_a_table_tells_apart() -> None:
    rows = TABLE.rows | {"tr": Row(mechanism="tr", cpus=3)}
    limits = Limits(low_cpu_load_max=1.0, low_bandwidth_kbit_s_min=256.0)
    labels = {one.name: [value.label for value in one.values] for one in axes(SuitabilityTable(rows, limits))}
    assert labels["CPUs"] == ["3", "2", "1"]
    assert labels["CPU load"] == ["up to 50%", "up to 100%"]
    assert labels["bandwidth"] == ["256 kbit/s", "less"]
    assert labels["value"] == ["no", "implausible", "value"]


def test_a_table_of_ones_own_is_asked(paper: Resilience) -> None:
    row = Row(mechanism="tr", tolerates=("crash", "value", "implausible"))
    found = resilience(PAPER, SuitabilityTable(TABLE.rows | {"tr": row}))
    assert found.total.answered is not None and paper.total.answered is not None
    assert found.total.answered > paper.total.answered


def test_every_mechanism_with_an_assumption_less_is_tried() -> None:
    """The best of them is the one that nothing else in the set is like."""
    found = resilience(tuple(MECHANISMS)).additions
    assert all(one.addition is not Addition.AS_SHIPPED for one in found)
    assert [one.answers for one in found] == sorted((one.answers for one in found), reverse=True)
    words = {one.words for one in found}
    assert {
        "one like assert that also tolerates value",
        "one like tr that needs no state access",
        "one like lfr that needs 1 CPU",
        "one like pbr that takes less bandwidth",
    } <= words
    assert not [one for one in found if one.detail in TABLE.rows[one.mechanism].tolerates]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", f"a set without a mechanism answers nothing; {', '.join(MECHANISMS)} are allowed"),
        (" , ", "a set without a mechanism answers nothing"),
        ("pbr,lfrr", "unknown mechanism 'lfrr'; did you mean 'lfr'"),
        ("pbr,none", "no adaptation leads to it"),
        ("pbr+tr", "pbr+tr is a composition: a set has what its mechanisms compose; pbr,tr is allowed"),
    ],
)
def test_what_is_no_set(text: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        mechanisms_of(text)
    assert reason in str(caught.value)


def test_a_set_is_in_the_order_of_the_registry() -> None:
    assert mechanisms_of("tr, pbr,tr") == ("pbr", "tr")
    assert all(parse(one) for one in expressions_of(mechanisms_of("tr,pbr")))
