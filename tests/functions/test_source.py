"""What a text names, and where that is found."""

import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from aftbed.core.errors import ConfigError
from aftbed.functions.source import FunctionKind, located, parse_source, renamed, told_of


@pytest.mark.parametrize(
    ("text", "kind", "place", "part"),
    [
        ("package.module:Class", FunctionKind.CLASS, "package.module", "Class"),
        ("path/file.py:Class", FunctionKind.CLASS, "path/file.py", "Class"),
        ("a b/file.py:Class", FunctionKind.CLASS, "a b/file.py", "Class"),
        ("path/lib.so", FunctionKind.LIBRARY, "path/lib.so", ""),
        ("lib.so.1.2", FunctionKind.LIBRARY, "lib.so.1.2", ""),
        ("path/model.fmu", FunctionKind.MODEL, "path/model.fmu", "path/ports.yaml"),
        ("model.fmu:other.yaml", FunctionKind.MODEL, "model.fmu", "other.yaml"),
        ("awk -f brake.awk", FunctionKind.PROGRAM, "awk -f brake.awk", ""),
        ("sh", FunctionKind.PROGRAM, "sh", ""),
    ],
)
def test_each_form(text: str, kind: FunctionKind, place: str, part: str) -> None:
    found = parse_source(text)
    assert (found.kind, found.place, found.part) == (kind, place, part)


@pytest.mark.parametrize(
    "text",
    ["package.module:Class", "path/file.py:Class", "path/lib.so", "model.fmu:other.yaml", "awk -f 'a b'"],
)
def test_a_version_is_behind_any_form(text: str) -> None:
    plain, found = parse_source(text), parse_source(f"{text}@sha256:0123456789ab")
    assert found == replace(plain, version="0123456789ab") and str(found) == f"{text}@sha256:0123456789ab"
    assert found.key != plain.key and found.key.endswith("@sha256:0123456789ab")
    assert parse_source(f"{text} @sha256:0").version == ""


def test_a_function_is_read_from_other_files(tmp_path: Path) -> None:
    for name in ("brake.py", "other.py"):
        (tmp_path / name).touch()
    paths = {f"{tmp_path}/brake.py": "/kept/brake.py"}
    found = parse_source(f"sh {tmp_path}/brake.py {tmp_path}/other.py --fast").reading(paths)
    assert found.words == ["sh", "/kept/brake.py", f"{tmp_path}/other.py", "--fast"]
    model = parse_source(f"{tmp_path}/m.fmu").reading({f"{tmp_path}/ports.yaml": "/kept/ports.yaml"})
    assert (model.place, model.part) == (f"{tmp_path}/m.fmu", "/kept/ports.yaml")


@pytest.mark.parametrize("text", ["", "  ", "mine", ":Class", "module:", "module:no-name"])
def test_what_names_no_function(text: str) -> None:
    with pytest.raises(ConfigError, match=r"names no function; MODULE:CLASS, FILE\.py:CLASS, FILE\.so, "):
        parse_source(text)


def test_paths_are_made_absolute(tmp_path: Path) -> None:
    for name in ("brake.py", "brake.so", "brake.fmu", "ports.yaml", "my data.txt"):
        (tmp_path / name).touch()
    (tmp_path / "program").write_text("#!/bin/sh\n")
    (tmp_path / "program").chmod(0o755)
    assert located("brake.py:Brake", tmp_path) == f"{tmp_path}/brake.py:Brake"
    assert located("package.module:Brake", tmp_path) == "package.module:Brake"
    assert located("brake.so", tmp_path) == f"{tmp_path}/brake.so"
    assert located("brake.fmu", tmp_path) == f"{tmp_path}/brake.fmu:{tmp_path}/ports.yaml"
    assert located("./program 'my data.txt' --fast", tmp_path) == (
        f"{tmp_path}/program '{tmp_path}/my data.txt' --fast"
    )
    assert located("sh -c true", tmp_path) == "sh -c true"


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("none.py:Brake", "none.py: no such file"),
        ("none.so", "none.so: no such file"),
        ("none.fmu", "none.fmu: no such file"),
        ("brake.fmu", "ports.yaml: no such file"),
        ("./none --fast", "none is no program that can be executed; MODULE:CLASS"),
        ("no-such-program --fast", "no-such-program is no program that can be executed"),
        ("./brake.c", "brake.c is no program that can be executed"),
        ("no/such/file", "no/such/file is no program that can be executed"),
        ("sh 'open", "no closing quotation"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, text: str, missing: str) -> None:
    (tmp_path / "brake.fmu").touch()
    (tmp_path / "brake.c").touch()
    with pytest.raises(ConfigError, match=missing):
        located(text, tmp_path)


@pytest.mark.parametrize(
    ("text", "reason", "told"),
    [
        ("/a/b.so", "/a/b.so: lacks aft_init", "/a/b.so: lacks aft_init"),
        ("/a/b.so", "not today", "/a/b.so: not today"),
        ("/a/b.py:Brake", "Brake: not today", "/a/b.py:Brake: Brake: not today"),
        ("/a/b.fmu:/a/p.yaml", "/a/p.yaml: step_s: found -1", "/a/p.yaml: step_s: found -1"),
        ("/a/b.fmu:/a/p.yaml", "/a/b.fmu: no FMU", "/a/b.fmu: no FMU"),
        ("/a/b.fmu:/a/p.yaml", "not today", "/a/b.fmu:/a/p.yaml: not today"),
    ],
)
def test_a_reason_names_its_function_once(text: str, reason: str, told: str) -> None:
    assert told_of(text, reason) == told


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("/a/brake.py:Brake", "/a/./brake.py:Brake"),
        ("/a/brake.so", "/a/./brake.so"),
        ("/a/brake.fmu:/b/ports.yaml", "/a/./brake.fmu:/b/ports.yaml"),
        ("sh /a/brake.sh 'my data'", "'sh' /a/brake.sh 'my data'"),
        ("'/my a/brake' fast", "'/my a/brake''' fast"),
        ("/bin/true", "/bin/./true"),
        ("true", ""),
        ("package.module:Brake", ""),
    ],
)
def test_another_name_is_of_the_same_function(text: str, other: str) -> None:
    assert renamed(text) == other
    if other:
        one, same = parse_source(text), parse_source(renamed(text))
        assert (one.kind, one.part) == (same.kind, same.part) and renamed(text) != text
        if one.kind is FunctionKind.PROGRAM and len(one.words) > 1:
            assert one.words == same.words
        else:
            assert Path(one.place) == Path(same.place)


def test_the_files_that_a_judge_has_to_trust(tmp_path: Path) -> None:
    """A program's interpreter and its script; not the words that are no files."""
    script = tmp_path / "brake.py"
    script.touch()
    files = parse_source(located(f"{sys.executable} brake.py --fast", tmp_path)).files()
    assert files == [Path(sys.executable).resolve(), script]
    model = parse_source("/m/brake.fmu")
    assert model.files() == [Path("/m/brake.fmu"), Path("/m/ports.yaml")]
    assert parse_source("module:Class").files() == []


@given(st.text(max_size=40))
def test_whatever_is_typed_is_read_or_refused(text: str) -> None:
    try:
        found = parse_source(text)
    except ConfigError:
        return
    assert found.place and str(found)
