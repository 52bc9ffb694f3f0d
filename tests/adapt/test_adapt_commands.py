"""The words of an adaptation: each word that is wrong is named, and for a slip of the verb the right verb."""

from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plans import CASES, Case

from aftbed.adapt.commands import VERBS, Timed, Wish, goal, plan_goal, read, verb_for
from aftbed.core.errors import ConfigError, ScriptError
from aftbed.core.messages import Goal
from aftbed.core.script import RECIPES, Bind, Destroy, Resume, Script, Suspend
from aftbed.ftm.compose import EXPRESSIONS, NONE, build, parse

RUNNABLE: Final = tuple(e for e in EXPRESSIONS if e != NONE)
PBR: Final = build("pbr", "process")
SCRIPT: Final = Case("pbr", "pbr+tr").plan().script


# -- reading


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("to lfr", Timed(Wish("to", "lfr"))),
        ("switch lfr at request 120", Timed(Wish("switch", "lfr"), at_request=120)),
        ("compose lfr+tr after 500ms", Timed(Wish("compose", "lfr+tr"), after_ms=500.0)),
        ("decompose after 1.5s", Timed(Wish("decompose"), after_ms=1500.0)),
        ("decompose", Timed(Wish("decompose"))),
        ("decompose after 0.5ms", Timed(Wish("decompose"), after_ms=0.5)),
        ("decompose after 3600s", Timed(Wish("decompose"), after_ms=3_600_000.0)),
        ("update tr.after to x.py:After", Timed(Wish("update", "tr.after", "x.py:After"))),
        ("  update app to a.b:C   at request 1 ", Timed(Wish("update", "app", "a.b:C"), at_request=1)),
    ],
)
def test_what_is_read(text: str, wanted: Timed) -> None:
    assert read(text) == wanted


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("expected to|switch|compose EXPR",)),
        ("   ", ("expected to|switch|compose EXPR",)),
        ("composse lfr+tr", ("unknown adaptation 'composse'", "did you mean 'compose'", "update")),
        ("to", ("adaptation 'to'", "expected")),
        ("switch", ("adaptation 'switch'", "expected")),
        ("update", ("adaptation 'update'", "update BRICK to SOURCE")),
        ("update app", ("update BRICK to SOURCE",)),
        ("update app x:Y", ("update BRICK to SOURCE",)),
        ("update app from x:Y", ("update BRICK to SOURCE",)),
        ("to lfr at 12", ("found 'at 12'", "'at request N' or 'after 500ms'")),
        ("to lfr at request", ("found 'at request'",)),
        ("to lfr at request 5 after 5ms", ("found 'at request 5 after 5ms'",)),
        ("to lfr after", ("found 'after'",)),
        ("decompose lfr", ("found 'lfr'",)),
        ("to lfr at request 0", ("at request '0'", "from 1 on")),
        ("to lfr at request -1", ("at request '-1'",)),
        ("to lfr at request ²", ("at request '²'",)),
        ("to lfr at request " + "9" * 30, ("a whole number from 1 on",)),
        ("to lfr after 5", ("after '5'", "50ms or 2s")),
        ("to lfr after 0ms", ("after '0ms'", "a positive number")),
        ("to lfr after -5ms", ("after '-5ms'",)),
        ("to lfr after 3601s", ("after '3601s'", "up to 3600s")),
        ("to lfr after 5min", ("after '5min'",)),
    ],
)
def test_what_cannot_be_read(text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as error:
        read(text)
    assert all(word in str(error.value) for word in words), error.value


wishes = st.one_of(
    st.builds(Wish, st.sampled_from(("to", "switch", "compose")), st.sampled_from(RUNNABLE)),
    st.just(Wish("decompose")),
    st.builds(Wish, st.just("update"), st.sampled_from(("app", "tr.after")), st.just("m:C")),
)
WHEN: Final = {"": (0, 0.0), " at request 7": (7, 0.0), " after 20ms": (0, 20.0)}


@given(wishes, st.sampled_from(tuple(WHEN)))
def test_a_wish_is_read_as_it_is_written(wish: Wish, when: str) -> None:
    assert read(f"{wish}{when}") == Timed(wish, *WHEN[when])


@given(
    st.text(max_size=60)
    | st.lists(st.sampled_from((*VERBS, "at", "request", "7", "after", "lfr"))).map(" ".join)
)
def test_whatever_is_typed_is_read_or_refused(text: str) -> None:
    try:
        timed = read(text)
    except ConfigError:
        return
    assert timed.wish.verb in VERBS
    assert not (timed.at_request and timed.after_ms)


# -- what it comes to


@pytest.mark.parametrize(
    ("running", "wish", "expression"),
    [
        ("pbr", Wish("to", "lfr+tr"), "lfr+tr"),
        ("pbr+tr", Wish("to", "pbr"), "pbr"),
        ("pbr", Wish("switch", "lfr"), "lfr"),
        ("pbr+tr", Wish("switch", "lfr"), "lfr"),
        ("tr", Wish("switch", "pbr+tr"), "pbr+tr"),
        ("pbr", Wish("compose", "pbr+tr"), "pbr+tr"),
        ("pbr+tr", Wish("compose", "pbr+assert+tr"), "pbr+assert+tr"),
        ("pbr+tr", Wish("decompose"), "pbr"),
        ("pbr+assert+tr", Wish("decompose"), "pbr"),
    ],
)
def test_where_it_leads(running: str, wish: Wish, expression: str) -> None:
    assert goal(wish, running) == Goal(expression=expression)
    assert goal(wish, running, "paper") == Goal(expression=expression, recipe="paper")


def test_an_update_leads_to_a_class() -> None:
    assert goal(Wish("update", "app", "m:C"), "pbr") == Goal(part="app", source="m:C")


@pytest.mark.parametrize(
    ("running", "wish", "reason"),
    [
        (
            "pbr",
            Wish("compose", "lfr+tr"),
            "lfr is not what runs (pbr): aftbed adapt to lfr+tr, or switch lfr first",
        ),
        ("pbr", Wish("compose", "lfr"), "lfr is not what runs (pbr): aftbed adapt to lfr"),
        ("pbr", Wish("compose", "tr"), "tr is not what runs (pbr): aftbed adapt compose pbr+tr, or to tr"),
        ("pbr+tr", Wish("compose", "tr"), "tr is not what runs (pbr+tr): aftbed adapt to tr"),
        (
            "pbr+tr",
            Wish("compose", "pbr"),
            "pbr is not all of pbr+tr, and more inside: aftbed adapt decompose",
        ),
        (
            "pbr+tr",
            Wish("compose", "pbr+assert"),
            "pbr+assert is not all of pbr+tr, and more inside: aftbed adapt to pbr+assert",
        ),
        (
            "pbr",
            Wish("switch", "pbr+tr"),
            "pbr is the outer mechanism already (pbr runs): aftbed adapt compose pbr+tr",
        ),
        (
            "pbr+tr",
            Wish("switch", "pbr+assert"),
            "pbr is the outer mechanism already (pbr+tr runs): aftbed adapt to pbr+assert",
        ),
        (
            "pbr+tr",
            Wish("switch", "pbr"),
            "pbr is the outer mechanism already (pbr+tr runs): aftbed adapt decompose",
        ),
        ("pbr", Wish("compose", "pbr"), "pbr is what runs already"),
        ("lfr+tr", Wish("switch", "lfr+tr"), "lfr+tr is what runs already"),
        ("pbr", Wish("decompose"), "there is nothing inside pbr: decompose takes away what is"),
        ("none", Wish("decompose"), "there is nothing inside none: decompose takes away what is"),
    ],
)
def test_a_slip_of_the_verb_is_refused_with_the_right_one(running: str, wish: Wish, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        goal(wish, running)
    assert str(error.value) == reason


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        (Wish("to", "pbrr"), "did you mean 'pbr'"),
        (Wish("compose", "tr+pbr"), "it can only be innermost (pbr+tr?)"),
        (Wish("switch", "lfr+tr+assert"), "it can only be innermost (lfr+assert+tr?)"),
        (Wish("to", ""), "unknown FTM ''"),
    ],
)
def test_an_expression_that_makes_no_sense(wish: Wish, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        goal(wish, "pbr")
    assert words in str(error.value)


def test_an_unknown_recipe() -> None:
    with pytest.raises(ConfigError, match="unknown recipe 'papr'; did you mean 'paper'"):
        goal(Wish("to", "lfr"), "pbr", "papr")
    assert RECIPES == ("drained", "paper")


pairs = st.tuples(st.sampled_from(RUNNABLE), st.sampled_from(RUNNABLE)).filter(lambda p: p[0] != p[1])


@given(pairs)
def test_for_every_pair_the_verb_that_is_named_does_it(pair: tuple[str, str]) -> None:
    """And of switch, compose and decompose, no other one does."""
    running, wanted = pair
    right = verb_for(parse(running), parse(wanted))
    assert goal(Wish("to", wanted), running).expression == wanted
    for verb in ("switch", "compose"):
        if verb == right:
            assert goal(Wish(verb, wanted), running).expression == wanted
            continue
        with pytest.raises(ConfigError) as error:
            goal(Wish(verb, wanted), running)
        named = "decompose" if right == "decompose" else wanted
        assert "aftbed adapt " in str(error.value) and named in str(error.value)
    if right == "decompose":
        assert goal(Wish("decompose"), running).expression == wanted


# -- the plan that leads to a goal


@given(st.sampled_from(CASES))
def test_the_plan_to_an_expression_and_the_plan_of_its_script_lead_to_one_graph(case: Case) -> None:
    plan = case.plan()
    assert plan_goal(plan.old, Goal(expression=case.new, recipe=case.recipe)) == plan
    by_hand = plan_goal(plan.old, Goal(script=plan.script))
    assert by_hand.script == plan.script
    assert set(by_hand.new.links) == set(plan.new.links) and by_hand.new.nodes == plan.new.nodes


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (Goal(expression="pbrr"), "unknown FTM 'pbrr'; did you mean 'pbr'?"),
        (Goal(expression="tr+pbr"), "innermost"),
        (Goal(expression="pbr"), "pbr is what runs already"),
        (Goal(expression="none"), "neither starts nor ends"),
        (Goal(expression="lfr", recipe="papr"), "did you mean 'paper'"),
        (Goal(part="proced", source="x.py:X"), "did you mean 'proceed'"),
        (Goal(script=msgspec.structs.replace(SCRIPT, commit=SCRIPT.commit[1:])), "resumed, not suspended"),
        (Goal(script=msgspec.structs.replace(SCRIPT, finish=())), "is not bound"),
    ],
)
def test_a_goal_that_leads_nowhere_is_refused(goal: Goal, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        plan_goal(PBR, goal)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (Script("x", "", (), (Suspend("a/protocol"),)), "suspended, not resumed: a/protocol"),
        (Script("x", "", (), (Destroy("a/proceed"),)), "killed with a request inside: a/proceed"),
        (
            Script(
                "x",
                "",
                (),
                (
                    Suspend("a/protocol"),
                    Bind("a/before", "bfr2prd", "b/proceed"),
                    Resume("a/protocol"),
                ),
            ),
            "a/proceed:bfr2prd is not bound; commit[1]: b/before:bfr2prd is not bound",
        ),
    ],
)
def test_a_script_written_by_hand_is_checked_whole(script: Script, words: str) -> None:
    with pytest.raises(ScriptError) as error:
        plan_goal(PBR, Goal(script=script))
    assert str(error.value).startswith("the script 'x' is refused: ") and words in str(error.value)
    with pytest.raises(ScriptError, match=r"^mine\.yaml: "):
        plan_goal(PBR, Goal(script=script, file="mine.yaml"))
