"""The line of a long command: what it says, that it fits, and where it is silent."""

import io
import os
import sys
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.report import progress as module
from aftbed.report.progress import BAR, ERASE, ProgressLine, clock, pace


class Terminal(io.StringIO):
    """A standard error that is a terminal, so wide."""

    columns = 100

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """What stood in the line, one after the other."""
        return self.getvalue().split(ERASE)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    found = Terminal()
    monkeypatch.setattr(module, "sys", SimpleNamespace(stderr=found))
    monkeypatch.setattr(module, "REDRAW_S", 0.0)
    monkeypatch.setattr(module, "_columns", lambda: found.columns)
    return found


@pytest.mark.parametrize(
    ("done", "total", "seconds", "unit", "said"),
    [
        (0, 400, 0.0, "runs", "0 of 400 runs"),
        (100, 400, 50.0, "runs", "100 of 400 runs, 2/s, 2:30 left"),
        (400, 400, 50.0, "runs", "400 of 400 runs, 8/s"),
        (12_000, 48_000, 10.0, "runs", "12 000 of 48 000 runs, 1 200/s, 0:30 left"),
        (1, 14, 60.0, "", "1 of 14, 1/min, 13:00 left"),
        (60, 1800, 60.0, "s", "60 of 1 800 s, 29:00 left"),
        (30, 0, 10.0, "runs", "30 runs, 3/s"),
        (996, 0, 10.0, "runs", "996 runs, 100/s"),
        (0, 0, 10.0, "runs", ""),
    ],
)
def test_count_rate_and_the_time_that_is_left(
    done: float, total: float, seconds: float, unit: str, said: str
) -> None:
    assert pace(done, total, seconds, unit) == said


def test_a_long_time_has_hours() -> None:
    assert (clock(8), clock(3723)) == ("0:08", "1:02:03")


def test_a_terminal_has_one_line_that_is_erased_at_the_end(terminal: Terminal) -> None:
    with ProgressLine("explore crash", 4, "runs") as progress:
        progress.show(1)
        progress.show(2, note="1 broken")
    lines = terminal.lines()
    assert "\n" not in terminal.getvalue() and lines[-1] == ""
    assert lines[1] == f"[{'.' * BAR}] explore crash: 0 of 4 runs"
    assert lines[2].startswith(f"[{'#' * 5}{'.' * 15}] explore crash: 1 of 4 runs, ")
    assert "2 of 4 runs" in lines[3] and lines[3].endswith(" left; 1 broken")


@given(st.integers(1, 200), st.text(max_size=80), st.text(max_size=80))
def test_it_fits_the_terminal_whatever_it_says(columns: int, what: str, note: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        found = Terminal()
        patch.setattr(module, "sys", SimpleNamespace(stderr=found))
        patch.setattr(module, "_columns", lambda: columns)
        with ProgressLine(what, 10, "runs") as progress:
            progress.step(note)
    assert all(len(line) < columns and line.isprintable() for line in found.lines())


def test_what_is_printed_stands_above_the_line(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", terminal)
    with ProgressLine("sim", 2, "runs") as progress:
        progress.print("seed 3: broken")
    assert f"{ERASE}seed 3: broken\n{ERASE}[" in terminal.getvalue()


def test_a_terminal_that_is_gone_ends_no_command(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(text: str) -> int:
        raise OSError(5, os.strerror(5))

    with ProgressLine("sim", 2, "runs") as progress:
        monkeypatch.setattr(terminal, "write", gone)
        progress.show(1)
        progress.show(2)


def test_a_pipe_gets_a_plain_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with ProgressLine("sim", 4, "runs") as progress:
        progress.show(1)
        assert capsys.readouterr() == ("", "")
        monkeypatch.setattr(module, "LINE_S", 0.0)
        progress.show(2)
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("sim: 2 of 4 runs, ") and err.endswith(" left\n")


def test_a_pipe_is_told_of_each_of_a_few_long_steps(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressLine("bench all", 2) as progress:
        progress.step("aftbed bench cycle")
    assert capsys.readouterr().err == "bench all: 0 of 2; aftbed bench cycle\n"


def test_a_pipe_beside_a_document_gets_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LINE_S", 0.0)
    with ProgressLine("sim", 4, "runs", plain=False) as progress:
        progress.show(2)
        progress.step("the last two")
    assert capsys.readouterr() == ("", "")
