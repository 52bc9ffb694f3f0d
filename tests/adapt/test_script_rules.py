"""A script is checked whole before its first step: every reason to refuse one."""

import msgspec
import pytest

from aftbed.adapt.script_check import STEPS_MAX, problems
from aftbed.core.script import (
    Attach,
    Bind,
    Fence,
    Kill,
    Promote,
    Resume,
    Script,
    Spawn,
    Step,
    Suspend,
    Transfer,
    Unbind,
)


def script(prepare: tuple[Step, ...] = (), commit: tuple[Step, ...] = ()) -> Script:
    return Script("test", "b", prepare, commit)


@pytest.mark.parametrize(
    "good",
    [
        script(),
        script((Spawn("b"), Transfer("b/x", "b/y"), Bind("b/x", "p", "b/y"), Unbind("b/x", "p"), Kill("b"))),
        script(commit=(Fence("a"), Promote("b", 2), Attach("b", 2), Kill("a"))),
        script(commit=(Suspend("a/x"), Transfer("a/x", "b/x"), Bind("a/x", "p", "b/x"), Resume("a/x"))),
        script(commit=(Suspend("a/x"), Suspend("a/y"), Resume("a/x"), Bind("a/z", "p", "b"), Resume("a/y"))),
        script(commit=(Fence("b"), Unbind("a/after", "aft2aft"), Kill("b"))),
        script(commit=(Fence("b"),) * STEPS_MAX),
    ],
)
def test_a_good_script_has_no_problems(good: Script) -> None:
    assert problems(good) == []


@pytest.mark.parametrize(
    ("bad", "problem"),
    [
        (script((Kill("a"),)), "prepare touches what already serves: Kill(replica='a')"),
        (script((Spawn("b"), Suspend("a/x"))), "prepare touches what already serves: Suspend(brick='a/x')"),
        (script((Spawn("b"), Fence("a"))), "prepare touches what already serves: Fence(replica='a')"),
        (script((Spawn("b"), Promote("a", 2))), "prepare touches what already serves: Promote"),
        (script((Spawn("b"), Unbind("a/x", "p"))), "prepare touches what already serves: Unbind"),
        (script((Spawn("b"), Resume("a/x"))), "prepare touches what already serves: Resume"),
        (script((Spawn("b"), Transfer("a/x", "a/y"))), "prepare touches what already serves: Transfer"),
        (script((Spawn("b"), Bind("a/x", "p", "a/y"))), "prepare touches what already serves: Bind"),
        (script((Spawn("b"), Transfer("a/x", "b/x"))), "prepare touches what already serves: Transfer"),
        (script((Spawn("b"), Transfer("b/x", "a/x"))), "prepare touches what already serves: Transfer"),
        (script((Spawn("b"), Bind("a/x", "p", "b/x"))), "prepare touches what already serves: Bind"),
        (script((Spawn("b"), Bind("b/x", "p", "a/x"))), "prepare touches what already serves: Bind"),
        (script((Transfer("b/x", "b/y"), Spawn("b"))), "prepare touches what already serves: Transfer"),
        (script(commit=(Fence("b"),) * (STEPS_MAX + 1)), f"more than {STEPS_MAX} steps"),
        (script(commit=(Resume("a/x"),)), "resumed, not suspended: a/x"),
        (script(commit=(Suspend("a/x"), Resume("a/x"), Resume("a/x"))), "resumed, not suspended: a/x"),
        (script(commit=(Suspend("a/x"),)), "suspended, not resumed: a/x"),
        (script(commit=(Kill("a"),)), "killed before it was fenced: a"),
        (script(commit=(Fence("b"), Kill("a"))), "killed before it was fenced: a"),
        (script(commit=(Kill("a"), Fence("a"))), "killed before it was fenced: a"),
        (script(commit=(Promote("b", 2),)), "a new master while the old one is not fenced: Promote"),
        (script(commit=(Attach("b", 2), Fence("a"))), "a new master while the old one is not fenced: Attach"),
        (
            script(commit=(Fence("a"), Promote("a", 2))),
            "a new master while the old one is not fenced: Promote",
        ),
        (script(commit=(Fence("a"), Attach("a", 2))), "a new master while the old one is not fenced: Attach"),
        (script(commit=(Fence("a"), Fence("b"), Promote("b", 2))), "a master that is fenced: Promote"),
        (script(commit=(Transfer("a/x", "b/x"),)), "changed while requests flow: Transfer"),
        (script(commit=(Bind("a/x", "p", "b/x"),)), "changed while requests flow: Bind"),
        (
            script(commit=(Suspend("a/x"), Resume("a/x"), Bind("a/x", "p", "b/x"))),
            "changed while requests flow: Bind",
        ),
        (script(commit=(Spawn("b"),)), "spawned while the client waits: b"),
    ],
)
def test_each_reason_to_refuse_a_script(bad: Script, problem: str) -> None:
    found = problems(bad)
    assert len(found) == 1 and found[0].startswith(problem), found


def test_every_problem_is_named() -> None:
    bad = script((Kill("a"),), (Resume("a/x"), Promote("b", 2), Suspend("a/y"), Suspend("a/x")))
    assert [p.partition(":")[0] for p in problems(bad)] == [
        "prepare touches what already serves",
        "resumed, not suspended",
        "suspended, not resumed",
        "suspended, not resumed",
        "a new master while the old one is not fenced",
    ]


def test_a_script_is_data() -> None:
    whole = script((Spawn("b"),), (Fence("a"), Promote("b", 2), Bind("a/x", "p", "b/x")))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(whole), type=Script) == whole
    assert msgspec.json.decode(msgspec.json.encode(whole), type=Script) == whole
