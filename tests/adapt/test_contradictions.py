"""Which rules of a policy contradict each other; those that may stand together never fight."""

from pathlib import Path
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies import TO_LFR, TO_PBR, beyond_oracle, beyonds, read

from aftbed.adapt.policy import Beyond, Rule, contradiction
from aftbed.core.errors import ConfigError

BURST: Final = "event: value_fault, count: 2, within_s: 10"


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [
        ((BURST, "compose tr"), (BURST, "decompose"), "the same condition, and two actions"),
        ((BURST, "compose tr"), (BURST, "switch lfr"), "the same condition, and two actions"),
        ((BURST, "to lfr"), ("event: value_fault, count: 5, within_s: 10", "to pbr"), "narrower"),
        ((BURST, "to lfr"), ("event: value_fault, count: 2, within_s: 4", "to pbr"), "narrower"),
        ((BURST, "compose tr"), ("event: value_fault, quiet_s: 9", "decompose"), "quiet_s must be 15 s"),
        (("event: value_fault, quiet_s: 14", "decompose"), (BURST, "compose tr"), "quiet_s must be 15 s"),
        (("event: crash, quiet_s: 5", "to pbr"), ("event: crash, quiet_s: 6", "to lfr"), "narrower"),
        (("resource: cpus, above: 2", "to pbr"), ("resource: cpus, below: 3", "to lfr"), "a gap"),
        (("resource: cpus, above: 2", "to pbr"), ("resource: cpus, below: 2", "to lfr"), "a gap"),
        (("resource: cpus, below: 2", "to pbr"), ("resource: cpus, above: 2", "to lfr"), "a gap"),
        (
            ("resource: cpu_load, above: 0.8, until: 0.2", "to pbr"),
            ("resource: cpu_load, below: 0.4", "to lfr"),
            "both can hold at once",
        ),
        (
            ("resource: cpu_load, above: 0.8", "to pbr"),
            ("resource: cpu_load, below: 0.4, until: 0.9", "to lfr"),
            "both can hold at once",
        ),
        (
            ("resource: cpu_load, above: 0.5", "to pbr+tr"),
            ("resource: cpu_load, above: 0.8", "to pbr"),
            "narrower",
        ),
        (
            ("resource: cpu_load, above: 0.8", "to pbr"),
            ("resource: cpu_load, above: 0.8, until: 0.5", "to lfr"),
            "narrower",
        ),
        (
            ("resource: cpu_load, below: 0.5", "to pbr+tr"),
            ("resource: cpu_load, below: 0.2, for_s: 9", "to pbr"),
            "narrower",
        ),
        (
            ("resource: cpu_load, above: 0.8", "to pbr"),
            ("resource: cpu_load, above: 0.5", "to pbr+tr"),
            "a value around 0.8 would lead to and fro",
        ),
    ],
)
def test_two_rules_that_contradict_each_other_are_both_named(
    tmp_path: Path, first: tuple[str, str], second: tuple[str, str], reason: str
) -> None:
    rules = [f"when: {{{when}}}, then: {then}" for when, then in (first, second)]
    with pytest.raises(ConfigError) as error:
        read(tmp_path, *rules)
    text = str(error.value)
    assert reason in text
    assert text.startswith(f"{tmp_path}/mine.yaml: line 4, column 5: rules[1]: rules[0] (")
    assert " and rules[1] (" in text
    assert f": {first[1]})" in text and f": {second[1]})" in text


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((BURST, "compose tr"), ("event: value_fault, quiet_s: 15", "decompose")),
        ((BURST, "compose tr"), (BURST, "compose tr")),
        ((BURST, "compose tr"), ("event: crash, count: 2, within_s: 10", "decompose")),
        ((BURST, "compose tr"), ("event: value_fault, count: 5, within_s: 10", "switch lfr")),
        (("event: value_fault, count: 5, within_s: 10", "to pbr"), (BURST, "to lfr")),
        (("resource: cpus, above: 2", "to pbr"), ("resource: cpus, below: 1.9", "to lfr")),
        (("resource: cpus, above: 2", "switch pbr"), ("resource: cpus, above: 1", "compose tr")),
        (
            ("resource: cpu_load, above: 0.8, until: 0.4", "to pbr"),
            ("resource: cpu_load, below: 0.4, until: 0.8", "to lfr"),
        ),
        (
            ("resource: cpu_load, above: 0.8, until: 0.7", "to pbr"),
            ("resource: cpu_load, above: 0.5", "to pbr+tr"),
        ),
        (
            ("resource: cpu_load, above: 0.8, for_s: 30", "to pbr"),
            ("resource: cpu_load, above: 0.8, for_s: 3", "to pbr+tr"),
        ),
        (("resource: cpu_load, above: 0.8", "to pbr"), ("resource: traffic_kbit_s, above: 1", "to lfr")),
    ],
)
def test_two_rules_that_may_stand_together(
    tmp_path: Path, first: tuple[str, str], second: tuple[str, str]
) -> None:
    read(tmp_path, *(f"when: {{{when}}}, then: {then}" for when, then in (first, second)))


@pytest.mark.parametrize(
    ("when", "value", "begins", "ends"),
    [
        (Beyond("cpus", True, 8, 5, 0), 8.1, True, False),
        (Beyond("cpus", True, 8, 5, 0), 8, False, False),
        (Beyond("cpus", True, 8, 5, 0), 5.1, False, False),
        (Beyond("cpus", True, 8, 5, 0), 5, False, True),
        (Beyond("cpus", False, 5, 8, 0), 4.9, True, False),
        (Beyond("cpus", False, 5, 8, 0), 5, False, False),
        (Beyond("cpus", False, 5, 8, 0), 7.9, False, False),
        (Beyond("cpus", False, 5, 8, 0), 8, False, True),
    ],
)
def test_where_a_condition_begins_and_ends(when: Beyond, value: float, begins: bool, ends: bool) -> None:
    assert (when.begins(value), when.ends(value)) == (begins, ends)


@given(beyonds(), beyonds(), st.lists(st.integers(-1, 17).map(lambda n: n / 2), max_size=30))
@settings(max_examples=4 * settings.default.max_examples)
def test_opposite_rules_that_may_stand_together_never_hold_together(
    one: Beyond, other: Beyond, samples: list[float]
) -> None:
    rules = Rule("rules[0]", one, TO_PBR), Rule("rules[1]", other, TO_LFR)
    if one.above == other.above or contradiction(*rules):
        return
    holds = [beyond_oracle(when, list(enumerate(samples))) for when in (one, other)]
    assert not any(both for both in zip(*holds, strict=True) if all(both))
