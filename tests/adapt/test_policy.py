"""Policies: what a file may say, which rules contradict each other, and when what is proposed.

The observer is compared with an oracle that keeps the whole history and looks at all of it each time.
"""

from pathlib import Path
from typing import Final, get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.adapt.observer import (
    Declined,
    Measured,
    Observation,
    Observer,
    Proposal,
    Running,
    Seen,
    symptoms,
)
from aftbed.adapt.policy import (
    ADAPTABLE,
    NS_PER_S,
    SYMPTOMS,
    Action,
    Beyond,
    Burst,
    Condition,
    Policy,
    PolicyFile,
    Quiet,
    Resource,
    Rule,
    action,
    conflict,
    contradiction,
    policy_from,
)
from aftbed.core.errors import ConfigError
from aftbed.core.event import Event
from aftbed.ftm.mechanism import DUPLEX, EXPRESSIONS, SIMPLEX, parse
from aftbed.vehicle.yamlfile import read_yaml

S: Final = NS_PER_S
COMPOSE, DECOMPOSE = Action("compose", "tr"), Action("decompose")
TO_LFR, TO_PBR = Action("switch", "lfr"), Action("switch", "pbr")
ACTIONS: Final = (
    *(Action("to", e) for e in ADAPTABLE),
    *(Action("switch", name) for name in DUPLEX),
    *(Action("compose", name) for name in SIMPLEX),
    DECOMPOSE,
)


def read(tmp_path: Path, *rules: str, dwell: str = "5") -> Policy:
    """The policy of a file with these rules."""
    path = tmp_path / "mine.yaml"
    path.write_text(f"dwell_s: {dwell}\nrules:\n" + "".join(f"  - {{{rule}}}\n" for rule in rules))
    return policy_from(read_yaml(path, PolicyFile), str(path))


# -- actions


@pytest.mark.parametrize(
    ("text", "running", "target"),
    [
        ("to lfr+tr", "pbr", "lfr+tr"),
        ("to pbr", "pbr", "pbr"),
        ("switch lfr", "pbr", "lfr"),
        ("switch lfr", "pbr+tr", "lfr+tr"),
        ("switch lfr", "lfr+assert", "lfr+assert"),
        ("switch pbr", "tr", "pbr+tr"),
        ("compose tr", "pbr", "pbr+tr"),
        ("compose tr", "pbr+tr", "pbr+tr"),
        ("compose tr", "lfr+assert", "lfr+assert+tr"),
        ("compose assert", "lfr+tr", "lfr+assert+tr"),
        ("compose assert", "tr", "assert+tr"),
        ("decompose", "pbr+tr", "pbr"),
        ("decompose", "lfr+assert+tr", "lfr"),
        ("decompose", "tr", "tr"),
        ("to pbr", "none", "none"),
        ("compose tr", "none", "none"),
    ],
)
def test_what_an_action_makes_of_what_runs(text: str, running: str, target: str) -> None:
    assert action(text, "x").applied(running) == target


@given(st.sampled_from(ACTIONS), st.sampled_from((*EXPRESSIONS, "lfr+assert+tr", "assert+tr")))
def test_an_action_leads_to_an_expression_and_is_done_once(one: Action, running: str) -> None:
    target = one.applied(running)
    assert "+".join(parse(target)) == target or target == running == "none"
    assert one.applied(target) == target


@given(st.sampled_from(ACTIONS))
def test_an_action_is_read_as_it_is_written(one: Action) -> None:
    assert action(str(one), "x") == one


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("compos tr", "unknown action 'compos'; did you mean 'compose'?"),
        ("", "unknown action ''"),
        ("to lfrr", "unknown FTM 'lfrr'; did you mean 'lfr'?"),
        ("to tr+lfr", "innermost"),
        ("to none", "nothing leads to it"),
        ("to", "unknown FTM ''"),
        ("switch tr", "unknown FTM to switch 'tr'"),
        ("switch pbr+tr", "unknown FTM to switch 'pbr+tr'; did you mean 'pbr'?"),
        ("compose lfr", "unknown FTM to compose 'lfr'"),
        ("decompose tr", "found 'decompose tr', allowed is `decompose`"),
    ],
)
def test_what_is_no_action_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        action(text, "mine.yaml: rules[0].then")
    assert str(error.value).startswith("mine.yaml: rules[0].then: ") and reason in str(error.value)


@pytest.mark.parametrize(
    ("one", "other", "found"),
    [
        (COMPOSE, DECOMPOSE, True),
        (TO_LFR, TO_PBR, True),
        (Action("to", "pbr"), Action("to", "lfr"), True),
        (Action("to", "pbr"), COMPOSE, True),
        (Action("to", "pbr"), TO_LFR, True),
        (COMPOSE, COMPOSE, False),
        (COMPOSE, Action("compose", "assert"), False),
        (COMPOSE, TO_LFR, False),
        (DECOMPOSE, TO_LFR, False),
        (Action("to", "pbr+tr"), COMPOSE, False),
        (Action("to", "pbr+tr"), TO_PBR, False),
    ],
)
def test_actions_conflict_where_they_undo_each_other(one: Action, other: Action, found: bool) -> None:
    assert conflict(one, other) == conflict(other, one) == found


# -- files


@pytest.mark.parametrize(
    ("rule", "when", "words"),
    [
        (
            "when: {event: value_fault, count: 2, within_s: 10}, then: compose tr",
            Burst("value_fault", 2, 10 * S, 15 * S),
            "2 value_fault within 10 s",
        ),
        (
            "when: {event: crash, quiet_s: 60}, then: decompose",
            Quiet("crash", 60 * S),
            "no crash for 60 s",
        ),
        (
            "when: {resource: cpu_load, above: 0.8, until: 0.6, for_s: 2.5}, then: to pbr",
            Beyond("cpu_load", True, 0.8, 0.6, 2_500_000_000),
            "cpu_load above 0.8 for 2.5 s until 0.6",
        ),
        (
            "when: {resource: bandwidth_kbit_s, below: 200}, then: switch lfr",
            Beyond("bandwidth_kbit_s", False, 200, 200, 0),
            "bandwidth_kbit_s below 200",
        ),
    ],
)
def test_a_rule_is_read(tmp_path: Path, rule: str, when: Condition, words: str) -> None:
    policy = read(tmp_path, rule)
    assert policy.dwell_ns == 5 * S
    assert policy.rules[0].when == when and str(when) == words
    assert str(policy.rules[0]) == f"rules[0] ({words}: {policy.rules[0].then})"


@pytest.mark.parametrize(
    ("when", "reason"),
    [
        ("count: 2", "rules[0].when: found none of them, allowed is one of event, resource"),
        ("event: crash, resource: cpus, count: 1, within_s: 1", "rules[0].when: found both"),
        ("event: crush, quiet_s: 1", "rules[0].when.event: found 'crush', allowed is one of crash"),
        ("event: crash", "rules[0].when: an event needs count and within_s, or quiet_s"),
        ("event: crash, count: 2", "rules[0].when: an event needs count and within_s"),
        ("event: crash, quiet_s: 2, count: 2", "rules[0].when: count does not go with quiet_s"),
        ("event: crash, count: 1, within_s: 1, until: 0", "rules[0].when: until does not go with event"),
        ("event: crash, count: 0, within_s: 1", "rules[0].when.count: found 0, allowed is a whole number"),
        ("event: crash, count: 1, within_s: -1", "rules[0].when.within_s: found -1"),
        ("event: crash, count: 1, within_s: 0.0009", "rules[0].when.within_s: found 0.0009"),
        ("resource: cpus", "rules[0].when: found none of them, allowed is one of above, below"),
        ("resource: cpus, above: 1, below: 2", "rules[0].when: found both"),
        ("resource: cpus, above: 1, quiet_s: 2", "rules[0].when: quiet_s does not go with resource"),
        ("resource: cpus, above: .nan", "rules[0].when.above: found nan"),
        ("resource: cpu_lod, above: 1", "rules[0].when.resource: found 'cpu_lod'"),
        (
            "resource: cpu_load, above: 0.5, until: 0.6",
            "rules[0].when.until: found 0.6, allowed is at most 0.5",
        ),
        ("resource: cpu_load, below: 0.5, until: 0", "rules[0].when.until: found 0, allowed is at least 0.5"),
        ("resource: cpus, over: 1", "rules[0].when: unknown key 'over'"),
    ],
)
def test_a_condition_that_is_none_is_refused(tmp_path: Path, when: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        read(tmp_path, f"when: {{{when}}}, then: decompose")
    assert str(error.value).startswith(f"{tmp_path}/mine.yaml: {reason}"), error.value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("dwell_s: 5\nrules: []", "rules: found 0, allowed are 1 to 64"),
        ("dwell_s: 0\nrules: [{when: {event: crash, quiet_s: 1}, then: decompose}]", "dwell_s: found 0"),
        ("rules: [{when: {event: crash, quiet_s: 1}, then: decompose}]", "key 'dwell_s' is missing"),
        ("dwell: 5", "unknown key 'dwell'; did you mean 'dwell_s'?"),
        ("dwell_s: 5\nrules: [{when: {event: crash, quiet_s: 1}}]", "rules[0]: key 'then' is missing"),
        ("", "key 'dwell_s' is missing"),
    ],
)
def test_a_file_that_is_no_policy_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        policy_from(read_yaml(path, PolicyFile), str(path))
    assert str(error.value).startswith(f"{path}: {reason}"), error.value


# -- contradictions

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
    assert text.startswith(f"{tmp_path}/mine.yaml: rules[0] (") and " and rules[1] (" in text
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


levels = st.integers(0, 8).map(float)


@st.composite
def beyonds(draw: st.DrawFn) -> Beyond:
    """Conditions on one resource."""
    above, threshold = draw(st.booleans()), draw(levels)
    until = draw(levels.filter(lambda value: value <= threshold if above else value >= threshold))
    return Beyond("cpus", above, threshold, until, draw(st.integers(0, 3)))


@given(beyonds(), beyonds(), st.lists(st.integers(-1, 17).map(lambda n: n / 2), max_size=30))
@settings(max_examples=300)
def test_opposite_rules_that_may_stand_together_never_hold_together(
    one: Beyond, other: Beyond, samples: list[float]
) -> None:
    rules = Rule("rules[0]", one, TO_PBR), Rule("rules[1]", other, TO_LFR)
    if one.above == other.above or contradiction(*rules):
        return
    holds = [_beyond_oracle(when, list(enumerate(samples))) for when in (one, other)]
    assert not any(both for both in zip(*holds, strict=True) if all(both))


def _beyond_oracle(when: Beyond, samples: list[tuple[int, float]]) -> list[bool]:
    """After each sample, whether the condition holds; by looking at all samples so far."""
    found = []
    for index in range(len(samples)):
        held = False
        for t_ns, value in samples[: index + 1]:
            run = 0
            past = [s for s in samples[: index + 1] if s[0] <= t_ns]
            while run < len(past) and when.begins(past[-1 - run][1]):
                run += 1
            begun = run > 0 and t_ns - past[-run][0] >= when.for_ns
            held = not when.ends(value) if held else begun
        found.append(held)
    return found


# -- observing: by hand


def observer(*rules: tuple[Condition, Action], running: str = "pbr", dwell_s: int = 5) -> Observer:
    named = tuple(Rule(f"rules[{n}]", when, then) for n, (when, then) in enumerate(rules))
    return Observer(Policy(named, dwell_s * S), running, 0)


def load(value: float) -> Measured:
    return Measured({"cpu_load": value})


TWO_FAULTS: Final = Burst("value_fault", 2, 10 * S, 15 * S)
FAULT: Final = Seen("value_fault")
BUSY: Final = Beyond("cpu_load", True, 0.8, 0.5, 2 * S)


def test_two_value_faults_in_ten_seconds() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    assert loop.step(FAULT, 1 * S) is None
    assert loop.step(Seen("crash"), 2 * S) is None
    assert loop.step(FAULT, 4 * S) == Proposal(
        "rules[0]", "2 value_fault within 10 s", "compose tr", "pbr", "pbr+tr", 1 * S, 4 * S
    )


def test_two_value_faults_too_far_apart() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    assert loop.step(FAULT, 1 * S) is None
    assert loop.step(FAULT, 11 * S) is None
    assert loop.step(FAULT, 21 * S - 1) is not None


def test_a_burst_that_goes_on_began_with_its_first_event() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 2 * S) is not None
    assert [loop.step(FAULT, t * S) for t in (3, 4, 5)] == [None] * 3
    proposal = loop.wake(7 * S)
    assert proposal is not None and proposal.since_ns == 1 * S, "rolled back, and proposed again"


def test_when_a_burst_is_over_it_is_the_turn_of_those_below() -> None:
    loop = observer((TWO_FAULTS, Action("to", "pbr")), (Quiet("crash", 1 * S), TO_LFR))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 1 * S) is None, "it holds, and pbr runs"
    assert loop.deadline_ns() == 1 * S + 1, "of the quiet"
    assert loop.wake(2 * S) is None, "the lower one would have lfr"
    assert loop.deadline_ns() == 16 * S + 1
    assert loop.wake(16 * S) is None
    proposal = loop.wake(16 * S + 1)
    assert proposal is not None and proposal.target == "lfr"


def test_a_load_must_last_and_is_over_where_the_rule_says() -> None:
    loop = observer((BUSY, Action("to", "pbr")), running="lfr")
    assert [loop.step(load(v), t * S) for t, v in ((0, 0.9), (1, 0.9), (1.5, 0.8))] == [None] * 3
    assert loop.step(load(0.9), 2 * S) is None, "it began anew"
    proposal = loop.step(load(0.85), 4 * S)
    assert proposal is not None and (proposal.since_ns, proposal.now_ns) == (2 * S, 4 * S)


def test_between_its_thresholds_a_rule_keeps_what_it_was() -> None:
    loop = observer((BUSY, Action("to", "pbr")), running="lfr", dwell_s=1)
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    assert loop.step(load(0.51), 4 * S) is not None, "it holds, and lfr still runs"
    assert loop.step(load(0.5), 6 * S) is None
    assert loop.step(load(0.79), 8 * S) is None


def test_nothing_is_proposed_within_the_dwell_time_and_it_is_said_when_to_look_again() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), (BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    loop.step(Running("lfr"), 3 * S)
    assert loop.deadline_ns() == 8 * S
    assert [loop.step(FAULT, t * S) for t in (4, 5)] == [None, None]
    assert loop.wake(8 * S - 1) is None
    proposal = loop.wake(8 * S)
    assert proposal is not None and (proposal.target, proposal.since_ns) == ("lfr+tr", 4 * S)


def test_what_runs_already_is_not_proposed() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), running="pbr+tr")
    assert [loop.step(FAULT, t * S) for t in range(5)] == [None] * 5
    assert loop.step(Running("pbr"), 5 * S) is None
    assert loop.wake(10 * S) is not None, "somebody took it away, and the burst still holds"


def test_the_way_back_when_it_is_quiet() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), (Quiet("value_fault", 60 * S), DECOMPOSE))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 2 * S) is not None
    loop.step(Running("pbr+tr"), 2 * S)
    assert loop.wake(62 * S) is None
    assert loop.deadline_ns() == 62 * S + 1
    proposal = loop.wake(62 * S + 1)
    assert proposal is not None and (proposal.target, proposal.since_ns) == ("pbr", 2 * S)


def test_the_upper_rule_decides_where_two_that_conflict_hold() -> None:
    busy_wire = Beyond("traffic_kbit_s", True, 500, 400, 0)
    loop = observer((BUSY, Action("to", "pbr")), (busy_wire, TO_LFR), dwell_s=1)
    both = Measured({"cpu_load": 0.9, "traffic_kbit_s": 600})
    assert loop.step(both, 0) is not None, "the lower one holds first"
    loop.step(Running("lfr"), 0)
    proposal = loop.step(both, 2 * S)
    assert proposal is not None and proposal.target == "pbr"
    loop.step(Running("pbr"), 2 * S)
    assert loop.step(both, 9 * S) is None
    proposal = loop.step(Measured({"cpu_load": 0.1, "traffic_kbit_s": 600}), 10 * S)
    assert proposal is not None and proposal.target == "lfr", "the upper one has ended"


def test_a_rolled_back_adaptation_is_proposed_again_and_a_declined_one_is_not() -> None:
    loop = observer((BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    assert loop.step(load(0.9), 7 * S) is not None
    loop.step(Declined(), 8 * S)
    assert loop.step(load(0.9), 20 * S) is None
    loop.step(load(0.1), 21 * S)
    loop.step(load(0.9), 22 * S)
    assert loop.step(load(0.9), 24 * S) is not None, "another time"


def test_what_was_not_measured_is_beyond_nothing() -> None:
    loop = observer((BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(Measured({}), 1 * S) is None
    assert loop.step(load(0.9), 2 * S) is None


def test_an_observation_that_comes_late_counts_as_of_now() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    loop.step(FAULT, 20 * S)
    proposal = loop.step(FAULT, 1 * S)
    assert proposal is not None and (proposal.since_ns, proposal.now_ns) == (20 * S, 20 * S)


# -- observing: against the oracle

conditions: Final = st.one_of(
    st.builds(
        lambda event, count, within: Burst(event, count, within, within + 4),
        st.sampled_from(("crash", "hang")),
        st.integers(1, 3),
        st.integers(1, 12),
    ),
    st.builds(Quiet, st.sampled_from(("crash", "hang")), st.integers(1, 30)),
    beyonds(),
)
policies: Final = st.lists(st.tuples(conditions, st.sampled_from(ACTIONS)), min_size=1, max_size=4).map(
    lambda found: Policy(tuple(Rule(f"rules[{n}]", w, t) for n, (w, t) in enumerate(found)), 4)
)
observations: Final = st.one_of(
    st.builds(Seen, st.sampled_from(("crash", "hang", "divergence"))),
    levels.map(lambda value: Measured({"cpus": value})),
    st.sampled_from(ADAPTABLE).map(Running),
    st.just(None),  # only time passes
)
histories: Final = st.lists(st.tuples(observations, st.integers(0, 9)), max_size=40)


def holds(when: Condition, past: list[tuple[Observation | None, int]], now: int) -> bool:
    """Whether `when` holds, by all that was ever observed."""
    if isinstance(when, Beyond):
        samples = [(t, o.values["cpus"]) for o, t in past if isinstance(o, Measured)]
        return bool(samples) and _beyond_oracle(when, samples)[-1]
    seen = [t for o, t in past if isinstance(o, Seen) and o.event == when.event]
    if isinstance(when, Quiet):
        return now - (seen[-1] if seen else 0) > when.quiet_ns
    begun = False
    for index, t in enumerate(seen):
        if begun and t - seen[index - 1] > when.hold_ns:
            begun = False
        begun = begun or sum(t - s < when.within_ns for s in seen[: index + 1]) >= when.count
    return begun and now - seen[-1] <= when.hold_ns


def expected(policy: Policy, running: str, past: list[tuple[Observation | None, int]], now: int) -> str:
    """What should be proposed but for the dwell time, as `rule target`; "" for nothing."""
    held = [rule for rule in policy.rules if holds(rule.when, past, now)]
    for index, rule in enumerate(held):
        silent = any(conflict(above.then, rule.then) for above in held[:index])
        if not silent and rule.then.applied(running) != running:
            return f"{rule.key} {rule.then.applied(running)}"
    return ""


@given(policies, st.sampled_from(ADAPTABLE), histories, st.booleans())
@settings(max_examples=400)
def test_what_is_proposed_is_what_the_whole_history_says(
    policy: Policy, running: str, history: list[tuple[Observation | None, int]], obeyed: bool
) -> None:
    loop, now, rest_until = Observer(policy, running, 0), 0, 0
    past: list[tuple[Observation | None, int]] = []
    for observation, later in history:
        now += later
        past.append((observation, now))
        if isinstance(observation, Running):
            rest_until = now + 4 if observation.expression != running else rest_until
            running = observation.expression
        proposal = loop.step(observation, now) if observation is not None else loop.wake(now)
        wanted = expected(policy, running, past, now) if now >= rest_until else ""
        assert (f"{proposal.rule} {proposal.target}" if proposal else "") == wanted
        if proposal is not None:
            assert proposal.running == running != proposal.target and proposal.since_ns <= now
            rest_until = now + 4
            if obeyed:
                running = proposal.target
                past.append((Running(running), now))
                assert loop.step(Running(running), now) is None


@given(policies, st.sampled_from(ADAPTABLE), histories)
@settings(max_examples=200)
def test_whoever_wakes_it_at_its_deadlines_misses_nothing(
    policy: Policy, running: str, history: list[tuple[Observation | None, int]]
) -> None:
    """Woken each nanosecond, or only when it asked for it: the same proposals at the same times."""
    times = [sum(later for _, later in history[: n + 1]) for n in range(len(history))]
    due: dict[int, list[Observation]] = {}
    for (observation, _), t in zip(history, times, strict=True):
        if observation is not None:
            due.setdefault(t, []).append(observation)
    found: list[list[Proposal]] = []
    for patient in (False, True):
        loop, proposals = Observer(policy, running, 0), list[Proposal | None]()
        for now in range(max(times, default=0) + 40):
            deadline = loop.deadline_ns()
            assert deadline is None or deadline > now - 1
            for observation in due.get(now, []):
                proposals.append(loop.step(observation, now))
            if not patient or (deadline is not None and deadline <= now):
                proposals.append(loop.wake(now))
        found.append([p for p in proposals if p is not None])
    assert found[0] == found[1]
    gaps = [b.now_ns - a.now_ns for a, b in zip(found[0], found[0][1:], strict=False)]
    assert all(gap >= policy.dwell_ns for gap in gaps)


# -- the words


@pytest.mark.parametrize(
    ("event", "detail", "found"),
    [
        (Event.VOTE_COMPARED, 2, ()),
        (Event.VOTE_COMPARED, 3, ("value_fault",)),
        (Event.VOTE_COMPARED, 0, ()),  # the detected stop that follows counts
        (Event.DETECTED_STOP, 0, ("detected_stop", "value_fault")),
        (Event.FOLLOWER_DIVERGED, 0, ("divergence", "value_fault")),
        (Event.SERVER_EXIT, 3, ()),
    ],
)
def test_what_an_event_is_a_symptom_of(event: Event, detail: int, found: tuple[str, ...]) -> None:
    assert symptoms(event, detail) == found
    assert set(found) <= set(SYMPTOMS)


def test_the_page_names_every_symptom_and_resource_and_its_policy_can_be_read(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "ftar.md").read_text()
    for name in (*SYMPTOMS, *get_args(Resource)):
        assert f"`{name}`" in page, name
    text = page.split("```yaml file=policy.yaml\n")[1].split("```")[0]
    path = tmp_path / "policy.yaml"
    path.write_text(text)
    assert len(policy_from(read_yaml(path, PolicyFile), str(path)).rules) > 1
