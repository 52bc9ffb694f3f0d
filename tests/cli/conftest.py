"""Fixtures that call a command in this process, with the same temporary home as in `tests/process`."""

import sys
from pathlib import Path

import pytest
from fakerun import Call, FakeRun, Output
from liveruns import Home, home

from aftbed.cli import main
from aftbed.runtime.unix import control_client, run_directory

__all__ = ["home"]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRun:
    """The only live run."""
    run = FakeRun()
    monkeypatch.setattr(control_client, "ask", run.ask)
    monkeypatch.setattr(run_directory, "find", lambda name: Path("/nowhere/abc123"))
    return run


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Call `aftbed` with these arguments: exit code, output, errors."""

    def aftbed(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["aftbed", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        shown = capsys.readouterr()
        return int(ended.value.code or 0), shown.out, shown.err

    return aftbed


@pytest.fixture
def output(call: Call) -> Output:
    """The output of a command that must succeed."""

    def aftbed(*arguments: str | Path) -> str:
        code, out, err = call(*arguments)
        assert code == 0, err
        return out

    return aftbed


@pytest.fixture
def refused(home: Home, call: Call) -> Output:
    """The error of a command that must be refused: one message, nothing printed, nothing left."""

    def aftbed(*arguments: str | Path) -> str:
        code, out, err = call(*arguments)
        assert (code, out) == (2, ""), (code, out, err)
        assert err.startswith("aftbed: error: ")
        assert all(line.startswith(" ") for line in err.splitlines()[1:]), "one message"
        assert home.left() == []
        return err

    return aftbed
