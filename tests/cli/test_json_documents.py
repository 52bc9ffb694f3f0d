"""`--json`: every command has it, and prints one document and nothing else."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call, FakeRun
from liveruns import Home
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from aftbed.cli.app import app
from aftbed.cli.lazy import LazyCommand

WITHOUT: Final = {  # commands, each with the reason
    ("campaign", "schema"): "its output is one JSON document, a schema",
    ("completion", "bash"): "its output is a script for a shell",
    ("completion", "zsh"): "the same",
    ("completion", "fish"): "the same",
    ("completion", "answer"): "the shell's script reads it",
    ("man",): "its output is a manual page",
}


def commands(command: object, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], TyperCommand]]:
    """All commands that do something, by the words that call them."""
    if isinstance(command, LazyCommand):
        command = command.load()
    if isinstance(command, TyperGroup):
        for name, inner in command.commands.items():
            yield from commands(inner, (*path, name))
    else:
        assert isinstance(command, TyperCommand)
        yield path, command


ALL: Final = dict(commands(get_command(app)))


def test_every_command_has_it_or_a_reason() -> None:
    lacking = {path for path, one in ALL.items() if not any("--json" in p.opts for p in one.params)}
    assert lacking == set(WITHOUT), "a command that prints a result needs --json"


def test_the_schema_is_a_document(call: Call) -> None:
    code, out, err = call("campaign", "schema")
    assert (code, err) == (0, "") and "$defs" in json.loads(out)


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        ("list", {"runs", "whole"}),
        ("graph --ftm none", {"ftm", "placement", "bricks", "links", "nodes"}),
        ("app header", {"header"}),
        ("app new heater", {"files", "next"}),
        ("campaign list", {"campaigns"}),
        ("map list", {"maps"}),
    ],
)
def test_a_command_without_a_run_prints_one_document(
    words: str, keys: set[str], home: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call(*words.split(), "--json")
    assert (code, err, out.count("\n")) == (0, "", 1)
    assert keys <= json.loads(out).keys()


@pytest.mark.parametrize(
    ("words", "document"),
    [
        (["stop"], {"run": "abc123", "stopping": True}),
        (
            ["inject", "crash primary after 200ms"],
            {"run": "abc123", "fault": "crash primary after 200ms"},
        ),
        (["inject", "omission", "aft2aft", "--nth", "5"], None),
        (["inject", "bus", "omission bus RADAR_TRACK for 200ms"], None),
        (["inject", "radar", "ghost", "--range", "30", "--speed", "10"], None),
        (["graph"], None),
        (["status"], None),
    ],
)
def test_a_command_to_a_live_run_prints_one_document(
    words: list[str], document: object, fake: FakeRun, tmp_path: Path, call: Call
) -> None:
    fake.record = tmp_path
    work = {"type": "CarRun", "scenario": "ccrs-50", "pace": 1.0, "brake_policy": "latch"}
    (tmp_path / "run.json").write_text(json.dumps({"work": work}))
    code, out, err = call(*words, "--json")
    assert (code, err, out.count("\n")) == (0, "", 1)
    assert json.loads(out) == (document or json.loads(out))


def test_an_error_is_no_document(home: Home, call: Call) -> None:
    code, out, err = call("stop", "--json")
    assert (code, out) == (2, "") and err.startswith("aftbed: error: no run is alive")
    code, out, err = call("graph", "--ftm", "none", "--format", "dot", "--json")
    assert (code, out) == (2, "")
    assert err == "aftbed: error: --json and --format dot: one of them is allowed\n"
