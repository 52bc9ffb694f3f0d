"""A script as a file: written and read back it is the same, and every mistake is named with its place."""

from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Final

import msgspec
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from plans import CASES, Case

from aftbed.adapt.script_check import refusals
from aftbed.adapt.script_file import RECOVERY, VERBS, ScriptFile, mapping, port_names, refuse, script_from
from aftbed.cli.adapt import yaml_lines
from aftbed.core.errors import ConfigError, ScriptError
from aftbed.core.graph import BrickSpec
from aftbed.core.script import (
    RECIPES,
    Align,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Fence,
    Freeze,
    Migrate,
    Resume,
    Retire,
    Script,
    Stage,
    Step,
    Suspend,
    Thaw,
    Together,
    Transfer,
    Unbind,
)
from aftbed.core.yaml_file import position, read_yaml
from aftbed.ftm.compose import EXPRESSIONS
from aftbed.ftm.registry import KINDS

SWITCH: Final = Case("pbr", "lfr").plan().script


def read(text: str) -> Script:
    """The script in the text of a file."""
    return script_from(msgspec.convert(yaml.safe_load(text), ScriptFile), "x.yaml")


def written(script: Script) -> str:
    """As `adapt plan --yaml` prints it."""
    return "\n".join(yaml_lines(mapping(script))) + "\n"


# -- round trip


@given(st.sampled_from(CASES))
def test_every_plan_is_read_as_it_is_written(case: Case) -> None:
    plan = case.plan()
    assert read(written(plan.script)) == plan.script
    assert refusals(plan.old, plan.script) == []


names = st.builds(  # cheaper than a regular expression
    "{}{}{}".format,
    st.sampled_from(("", "a/", "b/")),
    st.just("") | st.text(ascii_lowercase, min_size=1, max_size=5).map("{}.".format),
    st.text(ascii_lowercase, min_size=1, max_size=8),
)
ports = st.sampled_from(port_names())
sources = st.just("") | st.sampled_from(("a.b:C", "/x y/z: w.py:C", "it's.py:C", "übung.py:Übung"))
bricks = st.builds(BrickSpec, names, st.sampled_from(tuple(KINDS)), sources, sources)
binds = st.builds(lambda b, p, t, q: Bind(b, p, t, "" if p == q else q), names, ports, names, ports)
stages = st.builds(
    Stage,
    names,
    st.lists(bricks, min_size=1, max_size=3, unique_by=lambda b: b.name).map(tuple),
    st.booleans(),
)
ones = st.one_of(
    *(
        st.builds(v, names)
        for v in (Suspend, Drain, Resume, Migrate, Exchange, Retire, Freeze, Thaw, Destroy)
    ),
    *(st.builds(v, names, names) for v in (Transfer, Align)),
    st.builds(Unbind, names, ports),
    binds,
    stages,
)
verbs = st.recursive(
    ones, lambda inner: st.builds(Together, st.lists(inner, min_size=1, max_size=3).map(tuple)), max_leaves=4
)
steps = st.lists(verbs, max_size=4).map(tuple)
purposes = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=20) | st.sampled_from(
    ("no", "1", "a: b", "- x", "# y", "'", '"')
)


@given(
    st.builds(
        Script,
        purposes,
        st.just(""),
        steps,
        steps,
        steps,
        st.sampled_from(("", *EXPRESSIONS)),
        st.sampled_from(RECIPES),
    )
)
def test_whatever_a_script_holds_is_read_as_it_is_written(script: Script) -> None:
    assert read(written(script)) == script


def test_the_file_is_what_a_person_would_write(tmp_path: Path) -> None:
    text = """\
purpose: pbr to lfr
ftm: lfr
prepare:
- stage: {node: a/before, bricks: {a/before: lfr.before}, held: true}
"""
    assert written(SWITCH).startswith(text)
    assert "- bind: a/before.bfr2bfr -> b/before.bfr2bfr\n" in written(SWITCH)
    assert "- together:\n  - exchange: a/before\n" in written(SWITCH)
    assert "- align: a/server -> b/server\n" in written(SWITCH)
    path = tmp_path / "x.yaml"
    path.write_text(written(SWITCH))
    assert script_from(read_yaml(path, ScriptFile), "x") == SWITCH


def test_a_brick_written_off_line_has_its_class_beside_its_kind() -> None:
    stage = Stage("a/after", (BrickSpec("a/after", "pbr.after", "x.py:After"),))
    script = Script("update", "", (stage,), ())
    assert mapping(script)["prepare"] == [
        {"stage": {"node": "a/after", "bricks": {"a/after": {"kind": "pbr.after", "source": "x.py:After"}}}}
    ]


def test_a_port_with_a_dot_in_its_name() -> None:
    """`recovery` has one, and so have inner bricks: the longest end that is a port is the port."""
    links = (Bind("b/watchdog", "wdg2rec", "recovery", "wdg2rec.b"), Unbind("a/tr.protocol", "pro2pxy"))
    script = Script("x", "", (), links)
    assert mapping(script)["commit"] == [
        {"bind": "b/watchdog.wdg2rec -> recovery.wdg2rec.b"},
        {"unbind": "a/tr.protocol.pro2pxy"},
    ]
    assert read(written(script)) == script


def test_no_verb_is_missing() -> None:
    """Each verb of core.script is either in the file's grammar or Recovery's."""
    known = {v.__name__.lower() for v in Step.__args__}  # type: ignore[attr-defined]
    assert known == {*VERBS, *RECOVERY}


@pytest.mark.parametrize("verb", [Fence("a")])
def test_what_is_of_recovery_cannot_be_written(verb: Step) -> None:
    with pytest.raises(AssertionError, match="no place"):
        mapping(Script("x", "", (), (verb,)))


# -- mistakes in the file


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        ("suspend", "commit[0]: found 'suspend', allowed is one verb"),
        ("{}", "commit[0]: found {}, allowed is one verb"),
        ("{suspend: a/x, resume: a/x}", "allowed is one verb"),
        ("{drane: a/x}", "commit[0]: unknown verb 'drane'; did you mean 'drain'?"),
        ("{Suspend: a/x}", "did you mean 'suspend'?"),
        ("{7: a/x}", "commit[0]: unknown verb '7'"),
        ("{kill: a}", "commit[0]: kill is Recovery's; an adaptation has suspend, drain"),
        ("{promote: b}", "commit[0]: promote is Recovery's"),
        ("{suspend: }", "commit[0].suspend: found None, allowed is the name of a brick or a node"),
        ("{suspend: [a/x]}", "commit[0].suspend: found ['a/x'], allowed is the name"),
        ("{suspend: ' '}", "commit[0].suspend: found ' ', allowed is the name"),
        ("{bind: a/before.bfr2prd}", "commit[0].bind: found 'a/before.bfr2prd', allowed is BRICK.PORT -> "),
        ("{bind: a/x.pro2bfr -> b/x.pro2bfr -> a/y.pro2bfr}", "allowed is BRICK.PORT -> BRICK.PORT"),
        ("{bind: a/before.bfr2prx -> a/x.bfr2prd}", "unknown port 'bfr2prx'; did you mean 'bfr2prd'?"),
        ("{bind: a/before -> a/x.bfr2prd}", "commit[0].bind: found 'a/before', allowed is BRICK.PORT"),
        ("{bind: .bfr2prd -> a/x.bfr2prd}", "commit[0].bind: unknown port"),
        ("{unbind: a/before}", "commit[0].unbind: found 'a/before', allowed is BRICK.PORT"),
        ("{transfer: a/x}", "commit[0].transfer: found 'a/x', allowed is BRICK -> BRICK"),
        ("{align: a/x ->}", "commit[0].align: found 'a/x ->', allowed is BRICK -> BRICK"),
        ("{together: a/x}", "commit[0].together: found 'a/x', allowed is a list of steps"),
        ("{together: []}", "commit[0].together: found [], allowed is a list of steps"),
        ("{together: [{resume: a/x}, {drane: b}]}", "commit[0].together[1]: unknown verb 'drane'"),
        ("{stage: a/x}", "commit[0].stage: found 'a/x', allowed are the keys node, bricks, held"),
        ("{stage: {node: a/x}}", "commit[0].stage: key 'bricks' is missing"),
        ("{stage: {node: a/x, brick: {}}}", "commit[0].stage: unknown key 'brick'; did you mean 'bricks'?"),
        ("{stage: {node: a/x, bricks: {}}}", "commit[0].stage.bricks: found {}, allowed is BRICK: KIND"),
        ("{stage: {node: 5, bricks: {a/x: server}}}", "commit[0].stage.node: found 5, allowed is the name"),
        ("{stage: {node: a/x, bricks: {a/x: servr}}}", "bricks.a/x: unknown kind of brick 'servr'"),
        ("{stage: {node: a/x, bricks: {a/x: {source: q}}}}", "stage.bricks.a/x: key 'kind' is missing"),
        ("{stage: {node: a/x, bricks: {a/x: {kind: server, sauce: q}}}}", "did you mean 'source'?"),
        ("{stage: {node: a/x, bricks: {a/x: server}, held: 1}}", "stage.held: found 1, allowed is true"),
    ],
)  # fmt: skip
def test_a_step_that_is_wrong(step: str, reason: str) -> None:
    with pytest.raises(ScriptError) as error:
        read(f"purpose: x\ncommit:\n- {step}\n")
    assert str(error.value).startswith("x.yaml: commit[0]") and reason in str(error.value), error.value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("purpose: x\n", "x.yaml: line 1, column 1: key 'commit' is missing"),
        ("commit: []\n", "x.yaml: line 1, column 1: key 'purpose' is missing"),
        ("purpose: x\ncommit: []\nprepair: []\n", "x.yaml: line 3, column 1: unknown key 'prepair'; did"),
        ("purpose: x\ncommit: a/x\n", "x.yaml: line 2, column 9: commit: found 'a/x', allowed"),
        ("purpose: x\ncommit: []\nrecipe: papr\n", "x.yaml: line 3, column 9: recipe: found 'papr'"),
        ("purpose: ''\ncommit: []\n", "x.yaml: line 1, column 10: purpose: found ''"),
        ("purpose: x\ncommit: []\ncommit: []\n", "x.yaml: line 3, column 1: key 'commit' stands twice"),
        ("purpose: x\ncommit: []\nftm: lfrr\n", "x.yaml: line 3, column 6: ftm: unknown FTM 'lfrr'; did you"),
        ("purpose: x\ncommit: []\nftm: tr+pbr\n", "x.yaml: line 3, column 6: ftm: tr+pbr: "),
    ],
)  # fmt: skip
def test_a_key_that_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, reason: str) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("x.yaml")
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        script_from(read_yaml(path, ScriptFile), str(path), partial(position, path))
    assert str(error.value).startswith(reason), error.value


def test_all_that_is_wrong_is_told_at_once() -> None:
    with pytest.raises(ScriptError) as error:
        read(
            "purpose: x\nftm: nox\nprepare: [1]\nfinish: [4]\n"
            "commit: [{suspend: 1}, {drain: a/x}, {together: [2, 3]}]\n"
        )
    lines = str(error.value).splitlines()
    assert lines[0] == "x.yaml: 6 problems:"
    assert [line.split(":")[0] for line in lines[1:]] == [
        "  ftm",
        "  prepare[0]",
        "  commit[0].suspend",
        "  commit[2].together[0]",
        "  commit[2].together[1]",
        "  finish[0]",
    ]


def test_nothing_is_refused_without_a_problem() -> None:
    refuse("x.yaml", [])
