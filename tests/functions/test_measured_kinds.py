"""Functions of all kinds, measured in processes of their own: `tests/judge/test_measured.py` has the rest."""

import sys
from pathlib import Path
from typing import Final

import pytest
from examples import HERE, compiled, example

from aftbed.judge.measured import MeasuredFunction, UnmeasuredError, measure

pytestmark = pytest.mark.process

BYTES: Final = [bytes((number * 7 % 256,)) for number in range(30)]


def measured(source: str | Path, requests: list[bytes]) -> MeasuredFunction:
    return measure(str(source), requests, apart_seconds=0.0)


def library(tmp_path: Path, text: str, *options: str) -> Path:
    source = tmp_path / "function.c"
    source.write_text(text)
    return compiled(source, *options)


def test_a_library_is_what_it_declares(tmp_path: Path) -> None:
    found = measured(library(tmp_path, example("sum.c")), BYTES)
    assert (found.wrong, found.access_name, found.serialisable, found.state_bytes) == ((), "exact", True, 4)


def test_a_library_with_one_global_state_is_measured(tmp_path: Path) -> None:
    """There is one instance at a time."""
    text = (HERE / "faulty.c").read_text()
    found = measured(library(tmp_path, text, "-DONE_STATE"), [b"V1", b"S\4" + bytes(7), b"e", b"V2", b"e"])
    assert (found.wrong, found.access_name, found.state_bytes) == ((), "exact", 4), found.differences


def test_a_static_variable_is_a_state_outside_of_the_instance(tmp_path: Path) -> None:
    text = example("sum.c").replace("*sum += request[0];", "static int all; all += request[0]; *sum = all;")
    found = measured(library(tmp_path, text), BYTES)
    assert found.wrong == ("it declares exact state access, and has false state access",)
    assert "there is a state outside of the instance: in a second one, the reply" in found.differences[1]


def test_a_library_that_aborts_is_told_with_the_request(tmp_path: Path) -> None:
    path = library(tmp_path, (HERE / "faulty.c").read_text())
    with pytest.raises(UnmeasuredError) as raised:
        measured(path, [b"e", b"X"])
    assert str(raised.value) == (
        f"{path} cannot be measured: execute of request 2: its process ended with signal 6 (Aborted)"
    )


def test_a_program_is_what_it_declares(tmp_path: Path) -> None:
    (tmp_path / "sum.py").write_text(example("sum.py"))
    found = measured(f"{sys.executable} -I -S {tmp_path}/sum.py", BYTES)
    assert (found.wrong, found.access_name, found.serialisable, found.state_bytes) == ((), "exact", True, 4)


def test_a_program_that_fails_is_told_with_the_request(tmp_path: Path) -> None:
    (tmp_path / "sum.py").write_text(
        example("sum.py").replace("total = (", "assert given != '15', 'tired'; total = (")
    )
    with pytest.raises(UnmeasuredError) as raised:
        measured(f"{sys.executable} -I -S {tmp_path}/sum.py", BYTES)
    first, *_, last = str(raised.value).split("\n")
    assert "cannot be measured: execute of request 4: " in first and "ended with exit code 1" in first
    assert last.endswith("tired"), "the end of its stderr"
