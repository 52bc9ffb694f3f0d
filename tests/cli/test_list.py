"""`aftbed list`: live runs and records, those that cannot be read included."""

import json
import os
import tempfile
from pathlib import Path

import msgspec
import pytest
from fakerun import Call, FakeRun, Output
from hypothesis import given
from hypothesis import strategies as st
from liveruns import Home

from aftbed.core import input_file
from aftbed.judge import listed as module
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, Work

DRIVE = CarRun("ccrs-50", 1.0, "latch")
FILES = st.sampled_from(("run.json", "verdict.json"))
KEYS = st.sampled_from(("run", "ftm", "placement", "seed", "work", "type", "scenario", "verdict"))


def record(
    path: Path, run: str = "3f09c1", work: Work = DRIVE, verdict: str | None = "pass", *, end: bool = True
) -> Path:
    """A record with what `aftbed list` reads of it."""
    (path / "journal").mkdir(parents=True)
    about = {"run": run, "ftm": "pbr", "placement": "process", "seed": 4, "work": work, "version": "1"}
    (path / "run.json").write_bytes(msgspec.json.encode(about))
    if end:
        (path / "end.json").write_text("{}")
    if verdict is not None:
        (path / "verdict.json").write_text(json.dumps({"run": run, "verdict": verdict}))
    return path


@pytest.fixture(autouse=True)
def folder(home: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, in which no run lives."""
    found = tmp_path / "work"
    found.mkdir()
    monkeypatch.chdir(found)
    return found


def test_nothing_to_list(output: Output) -> None:
    assert output("list") == "0 alive, 0 recorded\n"
    assert json.loads(output("list", "--json")) == {"runs": [], "whole": True}


def test_records_of_the_working_directory_the_youngest_first(folder: Path, output: Output) -> None:
    for age_s, (name, run, work, verdict) in enumerate(
        [
            ("first", "3f09c1", DRIVE, "pass"),
            ("again/second", "8b63f5", LoadRun(10, 0.0), "fail"),
            ("campaign/records/x", "aa0000", ReplayRun("/l.asc", "/d.dbc", "m", None, False, None), None),
        ]
    ):
        made = record(folder / name, run, work, verdict)
        os.utime(made / "run.json", (1e9 - age_s, 1e9 - age_s))
    record(folder / ".hidden" / "no", "bb0000")
    record(folder / "too" / "deep" / "is" / "this", "cc0000")
    (folder / "link").symlink_to(folder / "first")
    lines = output("list").splitlines()
    assert lines[0].split() == ["RUN", "VERDICT", "MECHANISM", "SCENARIO", "AGE", "RECORD"]
    assert [line.split()[:4] for line in lines[1:3]] == [
        ["3f09c1", "pass", "pbr", "ccrs-50"],
        ["8b63f5", "fail", "pbr", "load"],
    ]
    assert lines[3].startswith("aa0000  not judged  pbr") and "replay /l.asc" in lines[3]
    assert lines[4:] == ["0 alive, 3 recorded"]


def test_what_killed_runs_and_vandals_left_is_listed_as_such(folder: Path, output: Output) -> None:
    record(folder / "killed", verdict=None, end=False)
    record(folder / "cut").joinpath("run.json").write_bytes(b'{"run": "3f\x1b[31m')
    record(folder / "lost").joinpath("run.json").unlink()
    record(folder / "claimed").joinpath("verdict.json").write_text('{"verdict": "splendid"}')
    os.mkfifo(record(folder / "waits", verdict=None) / "verdict.json")
    found = json.loads(output("list", "--json"))["runs"]
    assert {(one["record"], one["state"], one["verdict"]) for one in found} == {
        ("killed", "unfinished", None),
        ("cut", "damaged", None),
        ("lost", "damaged", None),
        ("claimed", "damaged", None),
        ("waits", "damaged", None),
    }
    damage = {one["record"]: one["damage"] for one in found}
    assert damage["lost"] == "lost/run.json: No such file or directory"
    assert "splendid" in damage["claimed"] and damage["waits"].endswith("not a regular file")
    assert "\x1b" not in output("list")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS | st.text(), inner, max_size=6),
)


@given(JSON.map(lambda value: json.dumps(value).encode()) | st.binary(max_size=80), FILES)
def test_whatever_a_file_holds_is_listed(data: bytes, name: str) -> None:
    with tempfile.TemporaryDirectory() as above, pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_directory, "live", list)
        made = record(Path(above) / "r")
        (made / name).write_bytes(data)
        (one,) = module.listed([Path(above)]).runs
        assert one.state in (module.ListedState.ENDED, module.ListedState.DAMAGED)
        msgspec.json.encode(one)


def test_two_small_files_are_read_of_each(
    folder: Path, output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However large its journals are: a thousand records are a matter of a second."""
    for number in range(50):
        record(folder / f"{number:03}", f"{number:06x}")
    read: list[Path] = []

    def counted(path: Path, bytes_max: int) -> bytes:
        read.append(path)
        return input_file.read_input(path, bytes_max)

    monkeypatch.setattr(module, "read_input", counted)
    assert len(json.loads(output("list", "--json"))["runs"]) == 50
    assert len(read) == 2 * 50 and {path.name for path in read} == {"run.json", "verdict.json"}


def test_a_live_run_is_first_and_not_listed_twice(
    fake: FakeRun, folder: Path, output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_directory, "live", lambda: ["abc123"])
    fake.record = record(folder / "now", "abc123", verdict=None, end=False)
    record(folder / "before")
    live, ended = json.loads(output("list", "--json"))["runs"]
    assert (live["run"], live["state"], live["record"]) == ("abc123", "live", str(folder / "now"))
    assert (ended["run"], ended["state"], ended["verdict"]) == ("3f09c1", "ended", "pass")
    assert output("list").endswith("1 alive, 1 recorded\n")


def test_too_much_is_not_looked_into_without_a_word(
    folder: Path, output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FOLDERS_MAX", 2)
    for number in range(4):
        record(folder / f"{number}", f"{number:06x}")
    assert not json.loads(output("list", "--json"))["whole"]
    assert "not all was looked into" in output("list")


def test_a_directory_that_is_none_is_refused(call: Call) -> None:
    code, out, err = call("list", "gone")
    assert (code, out) == (2, "")
    assert err == "aftbed: error: gone: no such directory; one with records of runs is allowed\n"
