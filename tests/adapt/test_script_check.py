"""A script against the graph that runs: each reason to refuse it, with its step.

And no plan can do without any one of its steps.
"""

from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plans import CASES, Case

from aftbed.adapt.planner import plan, updated
from aftbed.adapt.script_check import refusals
from aftbed.core.script import (
    RECIPES,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Freeze,
    Resume,
    Retire,
    Script,
    Stage,
    Step,
    Suspend,
    Thaw,
    Together,
    Unbind,
    flat,
)
from aftbed.ftm.compose import build

PBR: Final = build("pbr", "process")
_PLANNED: Final = Case("pbr", "pbr+tr").plan().script
_SUSPEND, _REWIRE, _RESUME = _PLANNED.commit
COMPOSE: Final = msgspec.structs.replace(  # with a drain that a person would add, and the plan does not need
    _PLANNED,
    commit=(_SUSPEND, Drain("b/after"), _REWIRE, Together((Resume("b/after"), Resume("a/protocol")))),
)
SWITCH: Final = Case("pbr", "lfr").plan().script
DRAINED: Final = tuple(case for case in CASES if case.recipe == RECIPES[0])
RENEWED: Final = plan(PBR, updated(PBR, "server", "x.py:Server")).script


def prepared(script: Script, *verbs: Step) -> Script:
    """`script` with `verbs` at the end of its preparation."""
    return msgspec.structs.replace(script, prepare=(*script.prepare, *verbs))


def committed(script: Script, at: int, *verbs: Step) -> Script:
    """`script` with `verbs` before step `at` of its commit."""
    return msgspec.structs.replace(script, commit=(*script.commit[:at], *verbs, *script.commit[at:]))


def finished(script: Script, *verbs: Step) -> Script:
    """`script` with `verbs` at its end."""
    return msgspec.structs.replace(script, finish=(*script.finish, *verbs))


def without(script: Script, phase: str, at: int) -> Script:
    """`script` without one step."""
    verbs = getattr(script, phase)
    return msgspec.structs.replace(script, **{phase: verbs[:at] + verbs[at + 1 :]})


def test_the_scripts_of_these_tests_are_good_before_they_are_spoilt() -> None:
    for script in (COMPOSE, SWITCH, RENEWED):
        assert refusals(PBR, script) == []


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (
            committed(COMPOSE, 4, Suspend("a/protocool")),
            "commit[4]: suspend: unknown brick 'a/protocool'; did you mean 'a/protocol'?",
        ),
        (
            finished(COMPOSE, Retire("a/proced")),
            "finish[2]: retire: unknown node 'a/proced'; did you mean 'a/proceed'?",
        ),
        (committed(COMPOSE, 2, Exchange("a/tr.after")), "commit[2]: exchange: unknown node 'a/tr.after'"),
        (
            prepared(COMPOSE, Bind("a/tr.befor", "bfr2prd", "a/tr.proceed")),
            "prepare[30]: bind: unknown brick 'a/tr.befor'; did you mean 'a/tr.before'?",
        ),
    ],
)
def test_names_that_do_not_exist(bad: Script, reason: str) -> None:
    (found,) = map(str, refusals(PBR, bad))
    assert found.startswith(reason)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (without(COMPOSE, "commit", 0), "commit[2]: resumed, not suspended: a/protocol"),
        (without(COMPOSE, "commit", 3), "commit[0]: suspended, not resumed: a/protocol"),
        (without(COMPOSE, "commit", 3), "commit[1]: suspended, not resumed: b/after"),
        (committed(COMPOSE, 1, Destroy("a/proceed")), "commit[1]: killed with a request inside: a/proceed"),
        (committed(COMPOSE, 0, COMPOSE.commit[2]), "commit[0]: changed while requests flow: Bind("),
        (
            committed(COMPOSE, 2, Exchange("a/after")),
            "commit[2]: nothing is staged to take the place of a/after",
        ),
        (prepared(COMPOSE, Suspend("a/after")), "prepare[30]: prepare touches what already serves: Suspend("),
        (finished(COMPOSE, Resume("a/after")), "finish[2]: finish only retires: Resume("),
        (committed(COMPOSE, 1, Freeze("a/after")), "commit[1]: freeze is for recipe paper only: a/after"),
        (committed(COMPOSE, 4, Thaw("a/after")), "commit[4]: thaw is for recipe paper only: a/after"),
        (
            prepared(COMPOSE, Stage("a/after", (PBR.brick("a/after"),))),
            "prepare[30]: a/after serves, and what is staged beside it never takes its place",
        ),
        (prepared(COMPOSE, COMPOSE.prepare[2]), "prepare[30]: a/tr.proceed is staged twice"),
        (
            committed(COMPOSE, 2, Unbind("a/tr.after", "aft2prd")),
            "commit[2]: unbinds what is new: a/tr.after.aft2prd",
        ),
        (
            committed(COMPOSE, 2, Bind("proxy", "pxy2pro", "b/protocol")),
            "commit[2]: an adaptation does not change the leader: proxy.pxy2pro -> b/protocol.pxy2pro is on",
        ),
    ],
)
def test_what_a_script_may_not_do(bad: Script, reason: str) -> None:
    assert any(str(found).startswith(reason) for found in refusals(PBR, bad)), refusals(PBR, bad)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (msgspec.structs.replace(COMPOSE, finish=()), "commit[2]: a/proceed:prd2srv is not bound"),
        (without(COMPOSE, "finish", 1), "commit[2]: b/proceed:prd2srv is not bound"),
        (without(COMPOSE, "prepare", 9), "prepare[0]: a/tr.protocol:pro2bfr is not bound"),
        (without(COMPOSE, "prepare", 9), "prepare[1]: a/tr.before:pro2bfr is not bound"),
        (
            committed(COMPOSE, 2, Bind("a/tr.after", "aft2pro", "a/protocol")),
            "commit[2]: a/tr.after:aft2pro is bound 2 times",
        ),
        (
            committed(COMPOSE, 3, Bind("a/tr.protocol", "pro2bfr", "a/server", "prd2srv")),
            "commit[3]: a/tr.protocol.pro2bfr does not carry what a/server.prd2srv takes",
        ),
        (
            committed(COMPOSE, 3, Bind("a/tr.before", "bfr2prd", "a/tr.protocol", "pxy2pro")),
            "commit[3]: a loop in the request path: a/tr.protocol -> a/tr.before -> a/tr.protocol",
        ),
        (
            without(COMPOSE, "commit", 2),
            "prepare[8]: prepared, and not bound in commit: a/before.bfr2prd -> a/tr.protocol.pxy2pro",
        ),
        (
            msgspec.structs.replace(COMPOSE, ftm="lfr+tr"),
            "under lfr+tr replicas speak through after.aft2aft, before.bfr2bfr, found after.aft2aft: say",
        ),
        (
            msgspec.structs.replace(SWITCH, ftm=""),
            "prepare[5]: under pbr replicas speak through after.aft2aft, found after.aft2aft, before.bfr2bfr",
        ),
        (
            committed(COMPOSE, 3, Bind("proxy", "pxy2pro", "b/tr.protocol")),
            "commit[3]: an adaptation does not change the leader: proxy.pxy2pro leads to b/tr.protocol, a",
        ),
        (msgspec.structs.replace(COMPOSE, ftm="none"), "an adaptation neither starts nor ends at none"),
    ],
)
def test_a_graph_that_cannot_run(bad: Script, reason: str) -> None:
    assert any(str(found).startswith(reason) for found in refusals(PBR, bad)), refusals(PBR, bad)


def together_without(script: Script, at: int, verb: Step) -> Script:
    """`script` without `verb`, which stands in the Together at step `at` of its commit."""
    step = script.commit[at]
    assert isinstance(step, Together) and verb in step.steps
    rest = Together(tuple(v for v in step.steps if v != verb))
    return msgspec.structs.replace(script, commit=(*script.commit[:at], rest, *script.commit[at + 1 :]))


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (
            together_without(
                committed(COMPOSE, 0, Suspend("a/after"), Resume("a/after")), 5, Resume("b/after")
            ),
            "commit[3]: suspended, not resumed: b/after",
        ),
        (
            committed(msgspec.structs.replace(SWITCH, commit=SWITCH.commit[1:]), 0, Suspend("b/protocol")),
            "commit[4]: resumed, not suspended: a/protocol",
        ),
        (
            committed(COMPOSE, 0, Suspend("b/before"), COMPOSE.commit[2], Resume("b/before")),
            "commit[1]: changed while a/protocol lets requests in: bind a/before.bfr2prd -> a/tr.",
        ),
        (
            committed(committed(SWITCH, 5, SWITCH.commit[2], Resume("b/proceed")), 0, Suspend("b/proceed")),
            "commit[6]: changed while a/protocol lets requests in: align a/server -> b/server",
        ),
        (
            committed(SWITCH, 1, SWITCH.commit[2]),
            "commit[1]: changed before b/after is drained: align a/server -> b/server",
        ),
        (together_without(SWITCH, 4, Resume("b/before")), "prepare[2]: held, and never resumed: b/before"),
        (
            together_without(SWITCH, 3, Unbind("a/server", "srv2aft")),
            "prepare[1]: leads nowhere, and is not unbound: a/server.srv2aft",
        ),
        (without(SWITCH, "commit", 2), "may be behind a/server, and is not aligned: b/server"),
        (without(RENEWED, "commit", 2), "begins without a state: a/server"),
    ],
)
def test_what_would_be_lost_on_the_way(bad: Script, reason: str) -> None:
    assert any(reason in str(found) for found in refusals(PBR, bad)), refusals(PBR, bad)


def test_to_resume_another_brick_does_not_let_requests_in() -> None:
    good = committed(SWITCH, 1, Suspend("b/proceed"), Resume("b/proceed"))
    assert refusals(PBR, good) == []


def test_a_recipe_of_the_paper_is_for_one_brick_per_process() -> None:
    case = Case("pbr", "lfr", placement="replica").plan()
    paper = msgspec.structs.replace(case.script, recipe="paper")
    assert "recipe paper is for placement process only, found replica" in map(str, refusals(case.old, paper))


def test_every_problem_of_a_look_is_told_at_once() -> None:
    bad = finished(committed(COMPOSE, 1, Freeze("a/after"), Destroy("a/proceed")), Resume("b/after"))
    assert [found.place for found in refusals(PBR, bad)] == [
        "commit[2]",
        "commit[1]",
        "finish[2]",
        "commit[1]",
    ]


# -- all plans


@pytest.mark.parametrize("part", ["before", "proceed", "after", "protocol", "server", "app"])
@pytest.mark.parametrize("placement", ["process", "replica", "single"])
def test_an_update_is_let_through(part: str, placement: str) -> None:
    graph = build("pbr", placement)
    assert refusals(graph, plan(graph, updated(graph, part, "x.py:X")).script) == []


def losses(verbs: tuple[Step, ...]) -> list[tuple[Step, tuple[Step, ...]]]:
    """Each verb, however deep, with the steps that are left without it."""
    found = []
    for at, verb in enumerate(verbs):
        found.append((verb, verbs[:at] + verbs[at + 1 :]))
        if isinstance(verb, Together):
            found += [
                (inner, (*verbs[:at], Together(rest), *verbs[at + 1 :])) for inner, rest in losses(verb.steps)
            ]
    return found


@given(st.sampled_from(DRAINED), st.sampled_from(("prepare", "commit", "finish")), st.data())
def test_of_no_plan_can_a_step_be_left_out(case: Case, phase: str, data: st.DataObject) -> None:
    """But what is said twice: a channel that is prepared and bound, the end of what was exchanged."""
    there = case.plan()
    verbs: tuple[Step, ...] = getattr(there.script, phase)
    if not verbs:
        return
    lost, rest = data.draw(st.sampled_from(losses(verbs)))
    commit = tuple(flat(there.script.commit))
    if (phase == "prepare" and isinstance(lost, Bind) and lost in commit) or (
        isinstance(lost, Retire) and Exchange(lost.node) in commit
    ):
        return
    assert refusals(there.old, msgspec.structs.replace(there.script, **{phase: rest})) != [], lost


def test_a_beginning_that_leaves_the_proxy_bound_to_nobody_is_looked_at_as_well() -> None:
    there = Case("assert", "pbr+assert", "replica", "a", "drained").plan()
    (opened,) = there.script.commit[-1:]
    assert isinstance(opened, Together) and Resume("b/protocol") in opened.steps
    without = Together(tuple(v for v in opened.steps if v != Resume("b/protocol")))
    script = msgspec.structs.replace(there.script, commit=(*there.script.commit[:-1], without))
    assert refusals(there.old, script) != []
