"""The terminal: lines at the end, a picture while it runs; plain lines where it is no terminal."""

import io
import os
import pty
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from campaigns import result
from reported import summary_of, with_results

from aftbed.campaign.ledger import Ledger
from aftbed.report import progress as progress_of_any
from aftbed.report.terminal import CampaignProgress, summary_lines


def test_the_lines_name_strata_gates_and_last_the_verdict(ledger: Ledger) -> None:
    summary = summary_of(ledger)
    lines = summary_lines(summary)
    assert lines[0] == f"campaign mixed, seed 7: {len(ledger.results)} experiments in 2.5 s"
    assert lines[-1] == "gate: fail"
    for stratum in summary.strata:
        line, *of_handling = [line for line in lines if line.startswith(f"{stratum.name}  ")]
        assert ", ".join(f"{name} {count}" for name, count in stratum.outcomes.items()) in line
        assert bool(of_handling) is (stratum.handling is not None)
    for gate in summary.gates:
        assert any(
            line.startswith(gate.word) and gate.metric in line and gate.limit in line for line in lines
        )


def test_the_handling_of_faults_has_its_times_its_bound_and_its_coverage(ledger: Ledger) -> None:
    lines = summary_lines(summary_of(ledger))
    head = next(line for line in lines if line.startswith("handling of faults "))
    rows = lines[lines.index(head) + 1 : lines.index("", lines.index(head))]
    crash = next(row for row in rows if row.startswith("lfr · steady · crash primary "))
    assert "not known of 3" in crash and " of 2.936 ms " in crash and crash.endswith("operational 3")
    wrong = next(row for row in rows if row.startswith("lfr · steady · bitflip result "))
    assert wrong.endswith("none 3")


def test_columns_are_aligned(ledger: Ledger) -> None:
    lines = summary_lines(summary_of(ledger))
    head = next(line for line in lines if line.startswith("stratum "))
    rows = lines[lines.index(head) + 1 : lines.index("", lines.index(head))]
    assert rows and all(row[head.index("runs") - 1] == " " != row[head.index("runs")] for row in rows)


def test_what_is_missing_is_said(ledger: Ledger) -> None:
    summary = msgspec.structs.replace(summary_of(ledger), planned=1000)
    assert f"{len(ledger.results)} of 1000 experiments" in summary_lines(summary)[0]
    silent = with_results(ledger, result("masked", activated=False), result("masked", index=1))
    assert any("2, 1 struck" in line for line in summary_lines(summary_of(silent)))
    assert summary_lines(summary_of(with_results(ledger)))[-1] == "gate: fail"


def test_plain_lines_where_standard_error_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_of_any, "LINE_S", 0.0)
    with CampaignProgress("try", 3) as progress:
        progress.add(result("tolerated"))
        progress.add(result("sdc", index=1, unexpected=True))
    out, err = capsys.readouterr()
    first, second = err.splitlines()[-2:]
    assert out == ""
    assert first.startswith("campaign try: 1 of 3 experiments, ") and first.endswith(" left; tolerated 1")
    assert second.startswith("campaign try: 2 of 3 experiments, ")
    assert second.endswith("; tolerated 1, sdc 1; 1 unexpected")


LIVE = """
import sys, threading
sys.path.insert(0, {folder!r})
from campaigns import result
from aftbed.report import terminal
terminal.REDRAW_S = 0.0
with terminal.CampaignProgress("try", 40) as progress:
    for index in range(40):
        progress.add(result("tolerated", f"pbr {{index}}", index, unexpected=index == 7))
    assert threading.active_count() == 1, "a thread would be forked with the workers"
"""


def test_a_terminal_gets_a_picture_that_goes_away() -> None:
    """In a real one: the picture is redrawn in place, and no thread draws it."""
    master, slave = pty.openpty()
    code = LIVE.format(folder=str(Path(__file__).resolve().parents[1] / "campaign"))
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120", "LINES": "60"}
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=slave, env=environment
    )
    os.close(slave)
    seen = io.BytesIO()
    while data := _read(master):
        seen.write(data)
    os.close(master)
    assert child.wait(60) == 0, seen.getvalue().decode()
    said = seen.getvalue().decode()
    assert "40 of 40 experiments" in said and "1 unexpected" in said and "pbr 0" in said
    assert "and 10 more strata" in said and "\x1b[1A" in said


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 65536)
    except OSError:  # the other end is closed
        return b""
