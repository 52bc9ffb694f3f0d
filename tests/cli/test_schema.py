"""JSON schemas of the YAML kinds: what editors complete from says what the readers say."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest
import yaml
from fakerun import Output
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft7Validator

import aftbed
from aftbed.adapt.script_file import ScriptFile, script_from
from aftbed.cli.init import FILES, write_file
from aftbed.cli.schema import SHAPES, meanings, schema_of, schema_text, shape_of, structs_of
from aftbed.core.errors import ConfigError
from aftbed.core.yaml_file import read_yaml

PACKAGE: Final = Path(aftbed.__file__).parent
SHIPPED: Final = {
    "scenario": sorted(PACKAGE.glob("vehicle/scenarios/*.yaml")),
    "campaign": sorted(PACKAGE.glob("campaigns/*.yaml")),
    "map": sorted(PACKAGE.glob("vehicle/replay/maps/*.yaml")),
    "policy": sorted(PACKAGE.glob("adapt/policies/*.yaml")),
}
TEXTS: Final = {  # of kinds that are not shipped
    "script": """
purpose: by hand
commit:
- stage: {node: a, bricks: {a/server: {kind: server, source: mine.py:Mine}}, held: true}
- together: [{resume: a}, {bind: a.pro2bfr -> b.pro2bfr}]
finish: [{retire: a}]
""",
    "ports": """
request: [{type: f64, variable: u}, {type: u16, skip: true}]
reply: [{type: f32, variable: y, max: 2}]
step_s: 0.1
start: {k: 1.5}
characteristics: {deterministic: true, state_access: {approximate: 0.1}}
""",
    "table": "{rows: [{mechanism: pbr, tolerates: [crash], cpus: 3}], limits: {low_cpu_load_max: 0.8}}",
}
VALIDATORS: Final = {kind: Draft7Validator(schema_of(kind)) for kind in SHAPES}


@cache
def good(kind: str) -> list[Any]:
    """The content of good files of the kind."""
    texts = [path.read_text() for path in SHIPPED.get(kind, ())] or [TEXTS[kind]]
    return [yaml.safe_load(text) for text in texts]


def test_every_kind_has_a_good_file() -> None:
    assert set(SHAPES) == set(SHIPPED) | set(TEXTS)
    assert all(SHIPPED.values())
    assert set(FILES) <= set(SHAPES)


@pytest.mark.parametrize("kind", SHAPES)
def test_its_schema_is_one_takes_good_files_and_explains_each_key(kind: str) -> None:
    Draft7Validator.check_schema(schema_of(kind))
    for content in good(kind):
        assert [error.message for error in VALIDATORS[kind].iter_errors(content)] == []
    for one in structs_of(shape_of(kind)):
        keys = {field.encode_name for field in msgspec.structs.fields(one)}
        assert keys <= set(meanings(one)), one


@pytest.mark.parametrize("kind", FILES)
def test_a_template_is_read_keeps_to_its_schema_and_names_it(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path, _ = write_file(kind, "mine", None)
    first, *_ = path.read_text().splitlines()
    schema = json.loads((path.parent / first.removeprefix("# yaml-language-server: $schema=")).read_text())
    assert schema == json.loads(schema_text(kind))
    assert not list(Draft7Validator(schema).iter_errors(yaml.safe_load(path.read_text())))
    read_yaml(path, shape_of(kind))
    assert not re.search("@[A-Z]+@", path.read_text())


def refused_by_reader(kind: str, content: object) -> bool:
    try:
        found = msgspec.convert(content, shape_of(kind))
        if isinstance(found, ScriptFile):
            script_from(found, "")
    except (msgspec.ValidationError, ConfigError):
        return True
    return False


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of each value."""
    inner = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    return [path, *(place for key, value in inner for place in places(value, (*path, key)))]


VALUES: Final = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-5, 70_000),
    st.sampled_from([0.5, -0.25, 1e9 + 0.5]),
    st.just([]),
    st.just({}),
) | st.sampled_from(["", "x", "none", "sim", "f64", "TRACK"])


@st.composite
def mutated(draw: st.DrawFn) -> tuple[str, Any]:
    """A good file with one value replaced, one key renamed, left out or added."""
    kind = draw(st.sampled_from([kind for kind in SHAPES if kind != "script"]))
    content = json.loads(json.dumps(draw(st.sampled_from(good(kind)))))
    *way, last = draw(st.sampled_from([place for place in places(content) if place]))
    parent = content
    for key in way:
        parent = parent[key]
    match draw(st.sampled_from(("replace", "rename", "drop", "add"))):
        case "rename" if isinstance(parent, dict):
            parent[f"{last}s"] = parent.pop(last)
        case "drop":
            del parent[last]
        case "add" if isinstance(parent, dict):
            parent[draw(st.sampled_from(("speed", "unit", "name", "scale", "max")))] = draw(VALUES)
        case _:
            parent[last] = draw(VALUES)
    return kind, content


@given(mutated())
def test_schema_and_reader_refuse_the_same_keys_and_types(found: tuple[str, Any]) -> None:
    kind, content = found
    errors = [error.message for error in VALIDATORS[kind].iter_errors(content)]
    assert bool(errors) == refused_by_reader(kind, content), (kind, content, errors)


@pytest.mark.parametrize(
    ("step", "allowed"),
    [
        ({"retire": "a"}, True),
        ({"together": [{"resume": "a/server"}]}, True),
        ({"stage": {"node": "a", "bricks": {"a/server": "server"}}}, True),
        ({}, False),
        ("retire", False),
        ({"retire": 5}, False),
        ({"retires": "a"}, False),
        ({"fence": "a"}, False),
        ({"retire": "a", "resume": "b"}, False),
        ({"together": []}, False),
        ({"together": [{"resumes": "a"}]}, False),
        ({"stage": {"node": "a", "bricks": {}}}, False),
        ({"stage": {"node": "a", "bricks": {"a": {"source": "x"}}}}, False),
        ({"stage": {"node": "a", "bricks": {"a": "server"}, "hold": True}}, False),
        ({"stage": {"bricks": {"a": "server"}}}, False),
    ],
)
def test_a_step_of_a_script_is_what_its_reader_takes(step: object, allowed: bool) -> None:
    content = {"purpose": "x", "commit": [step]}
    assert VALIDATORS["script"].is_valid(content) is allowed
    assert refused_by_reader("script", content) is not allowed


def test_the_command_prints_it_and_a_list(output: Output) -> None:
    assert json.loads(output("schema", "map"))["title"] == "aftbed map"
    assert [line.split()[0] for line in output("schema").splitlines()] == list(SHAPES)
    assert list(json.loads(output("schema", "--json"))["kinds"]) == list(SHAPES)


def test_an_unknown_kind_is_refused(refused: Output) -> None:
    assert "unknown kind of file 'polic'; did you mean 'policy'?" in refused("schema", "polic")
