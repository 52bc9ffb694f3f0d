"""Policies: what a file may say, what an action makes of what runs, and the words for it."""

import re
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies import ACTIONS, COMPOSE, DECOMPOSE, TO_LFR, TO_PBR, S, policy_at, read

from aftbed.adapt.policy import (
    Action,
    Beyond,
    Burst,
    Condition,
    Quiet,
    Resource,
    Symptom,
    action,
    conflict,
    symptoms,
)
from aftbed.core.errors import ConfigError
from aftbed.core.events import LATE, Event
from aftbed.ftm.compose import EXPRESSIONS, parse

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
    place = f"{tmp_path}/mine.yaml: line \\d+, column \\d+: "
    assert re.match(f"{place}{re.escape(reason)}", str(error.value)), error.value


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
        policy_at(path)
    assert re.match(f"{path}: line \\d+, column \\d+: {re.escape(reason)}", str(error.value)), error.value


# -- the words


@pytest.mark.parametrize(
    ("event", "detail", "found"),
    [
        (Event.VOTE_COMPARED, 2, ()),
        (Event.VOTE_COMPARED, 3, ("value_fault",)),
        (Event.VOTE_COMPARED, 0, ()),  # the detected stop that follows counts
        (Event.DETECTED_STOP, 0, ("detected_stop", "value_fault")),
        (Event.DETECTED_STOP, LATE, ("detected_stop",)),
        (Event.FOLLOWER_DIVERGED, 0, ("divergence", "value_fault")),
        (Event.SERVER_EXIT, 3, ()),
    ],
)
def test_what_an_event_is_a_symptom_of(event: Event, detail: int, found: tuple[str, ...]) -> None:
    assert symptoms(event, detail) == found
    assert set(found) <= set(get_args(Symptom))


def test_the_page_names_every_symptom_and_resource_and_its_policy_can_be_read(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "ftar.md").read_text()
    for name in (*get_args(Symptom), *get_args(Resource)):
        assert f"`{name}`" in page, name
    text = page.split("```yaml file=policy.yaml\n")[1].split("```")[0]
    path = tmp_path / "policy.yaml"
    path.write_text(text)
    assert len(policy_at(path).rules) > 1
