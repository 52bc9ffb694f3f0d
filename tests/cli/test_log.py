"""`aftbed log`: what it prints, what it writes, and what it refuses."""

from pathlib import Path

import pytest
from fakerun import Output

LOG = "(0000000001.000000) can0 120#1B10413600000000\n(0000000001.010000) can0 7FF#\n"


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = Path("bus.log")
    path.write_text(LOG)
    return path


def test_a_log_is_converted_there_and_back(log: Path, output: Output) -> None:
    assert output("log", "convert", log, "bus.blf") == "bus.blf: 2 frames, candump to blf\n"
    assert (
        output("log", "convert", "bus.blf", "again", "--to", "candump") == "again: 2 frames, blf to candump\n"
    )
    assert Path("again").read_text() == LOG


def test_frames_that_are_left_out_are_counted(log: Path, output: Output) -> None:
    assert output("log", "convert", log, "bus.csv") == (
        "bus.csv: 1 frames, candump to csv\n  left out: 1 times frame that the DBC does not have\n"
    )


def test_bad_lines_are_an_error_or_are_counted(log: Path, output: Output, refused: Output) -> None:
    log.write_text(LOG + "hello\n\x1b[2J\n")
    assert "bus.log: line 3: not a candump line: 'hello', expected" in refused(
        "log", "convert", log, "bus.asc"
    )
    said = output("log", "convert", log, "bus.asc", "--skip-bad")
    assert said.startswith(
        "bus.asc: 2 frames, candump to asc\n  skipped: 2 bad parts, the first at line 3: not a"
    )


def test_an_unknown_format_is_refused_with_those_allowed(log: Path, refused: Output) -> None:
    allowed = "(one of: asc, blf, candump, csv, mf4, trc)"
    assert refused("log", "convert", log, "bus.txt") == (
        f"aftbed: error: bus.txt: the ending '.txt' says no format; --to does {allowed}\n"
    )


def test_an_export_without_a_file_and_one_of_no_record_are_refused(log: Path, refused: Output) -> None:
    assert "nothing to write: give --mcap FILE, --trace FILE, or both" in refused("log", "export", ".")
    assert "run.json: No such file or directory; is this the record of a run?" in refused(
        "log", "export", ".", "--trace", "trace.json"
    )
    assert not Path("trace.json").exists()
