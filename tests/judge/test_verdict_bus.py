"""The verdict over what strangers did on the bus."""

from pathlib import Path
from typing import Final

import msgspec
import pytest
from records import CAR, STOPPED, RecordInTheMaking, whole

from aftbed.cli.check import write_html
from aftbed.cli.views import show_verdict
from aftbed.vehicle.can.bus_load import BusLoad
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubCounts, Stranger

LISTENER: Final = Stranger(1000, connections=2)
FORGER: Final = Stranger(1000, connections=1, frames=9, forged={"100": 5, "130": 1, "7FF": 2})


def drive(path: Path, *strangers: Stranger, is_open: bool = False, frames: int = 0) -> RecordInTheMaking:
    """A drive that went well, on whose bus these strangers were."""
    record = whole(path, CAR)
    record.options = msgspec.structs.replace(record.options, bus_open=is_open)
    assert record.end is not None
    stopped = {"end": "standstill", "t_us": 4_000_000, "result": msgspec.to_builtins(STOPPED)}
    record.end["result"] = stopped
    record.end["bus"] = msgspec.to_builtins(HubCounts(is_open, frames, strangers=list(strangers)))
    return record


@pytest.mark.parametrize("stranger", [LISTENER, Stranger(1000, connections=1, frames=9, put_out_fast=1)])
def test_strangers_in_nobodys_name_are_told_and_change_nothing(path: Path, stranger: Stranger) -> None:
    verdict = drive(path, stranger).verdict()
    assert (verdict.verdict, verdict.checks["no_forged_frames"]) == ("pass", "pass")
    assert verdict.strangers == [stranger]


def test_with_forged_frames_a_run_proves_nothing(path: Path) -> None:
    verdict = drive(path, LISTENER, FORGER).verdict()
    assert (verdict.verdict, verdict.checks["no_forged_frames"]) == ("inconclusive", "unknown")
    forged = "a stranger of user 1000 sent 5 AEB_REQ, 1 RADAR_TRACK, 2 0x7FF, which was not asked for"
    assert verdict.reasons == [f"no_forged_frames: {forged}"]
    assert verdict.strangers[1].forged == {"AEB_REQ": 5, "RADAR_TRACK": 1, "0x7FF": 2}


def test_on_an_open_bus_forged_frames_are_a_part_of_the_run(path: Path) -> None:
    verdict = drive(path, FORGER, is_open=True).verdict()
    assert (verdict.verdict, verdict.checks["no_forged_frames"]) == ("pass", "pass")
    assert verdict.strangers[0].forged["AEB_REQ"] == 5


def test_what_strangers_did_is_shown(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unknown = Stranger(None, turned_away=3, refused=4, commands_refused=2, put_out_slow=1)
    show_verdict(drive(path, FORGER, unknown).verdict(), as_json=False)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  bus ")]
    assert lines == [
        "  bus        a stranger of user 1000: 1 on the bus,"
        " 9 frames (forged: 5 AEB_REQ, 1 RADAR_TRACK, 2 0x7FF)",
        "  bus        a stranger of an unknown user: 3 turned away, 4 elements refused, 2 of them commands,"
        " 1 put out as too slow",
    ]


def test_a_hub_that_did_not_report_leaves_it_unknown(path: Path) -> None:
    record = drive(path)
    assert record.end is not None
    record.end["bus"] = None
    verdict = record.verdict()
    assert verdict.verdict == "inconclusive"
    assert verdict.reasons == ["sources_agree: the hub did not report what happened on the bus"]
    del record.end["bus"]
    assert "sources_agree: end.json has no 'bus'" in record.verdict().reasons


def test_the_log_of_the_bus_has_what_the_hub_says_that_it_carried(path: Path) -> None:
    for frames, word in ((2, "pass"), (3, "pass"), (4, "fail")):
        record = drive(path / str(frames), frames=frames)
        (record.path / "bus.log").write_text("(0000000000.000000) can0 130#\n" * 3)
        assert record.verdict().verdict == word, frames
    assert record.verdict().reasons == ["sources_agree: the hub carried 4 frames, and bus.log has 3"]


def test_a_bus_that_was_opened_later_on_paper_is_a_contradiction(path: Path) -> None:
    record = drive(path, FORGER)
    record.options = msgspec.structs.replace(record.options, bus_open=True)
    told = "run.json and end.json do not agree whether the bus was open to all"
    assert record.verdict().reasons == [f"sources_agree: {told}"]
    assert record.verdict().verdict == "fail"


def logged(path: Path, *strangers: Stranger) -> RecordInTheMaking:
    """A drive with 100 frames of 8 bytes in each of ten windows, at 250 kbit/s; the hub counted them."""
    record = drive(path, *strangers, frames=1001)
    record.options = msgspec.structs.replace(
        record.options, work=msgspec.structs.replace(CAR, bitrate_bps=250_000)
    )
    frames = (Frame(1_000 * n, 0x100, bytes(8)) for n in range(1001))
    (path / "bus.log").write_text("".join(log_line(frame, "can0") for frame in frames))
    return record


def test_the_load_of_the_bus_is_in_the_verdict_and_shown(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verdict = logged(path).verdict()
    assert verdict.bus_load == BusLoad(250_000, 10, 54.0, 54.0, 44.4, 44.4)
    show_verdict(verdict, as_json=True)
    assert '"bus_load":{"bitrate_bps":250000,"windows":10,"p50_percent":54.0' in capsys.readouterr().out
    show_verdict(verdict, as_json=False)
    assert "  bus load   54.0 % (p50), 54.0 % at most\n" in capsys.readouterr().out


def test_a_run_without_a_bus_has_no_load(path: Path) -> None:
    assert whole(path).verdict().bus_load is None


@pytest.mark.parametrize("log", [True, False])
def test_the_report_has_the_load_and_who_else_was_on_the_bus(path: Path, tmp_path: Path, log: bool) -> None:
    """Also where there was no frame, as of one that was turned away while the run started."""
    away = Stranger(1001, turned_away=2)
    record = logged(path, FORGER, away) if log else drive(path, FORGER, away)
    verdict = record.verdict()
    write_html(tmp_path / "run.html", path, verdict)
    page = (tmp_path / "run.html").read_text()
    said = "Load at 250 kbit/s over 10 windows of 100 ms: 54.0 % (p50), 54.0 % at most"
    assert (said in page) == log
    assert (
        "<li>a stranger of user 1000: 1 on the bus, 9 frames (forged: 5 AEB_REQ, 1 RADAR_TRACK, 2 0x7FF)</li>"
    ) in page
    assert "<li>a stranger of user 1001: 2 turned away</li>" in page
    assert 'href="#bus"' in page and "Nobody but" not in page
