"""The report of one run as a page: one file, which needs neither network nor script nor anything beside it.

From the record, real: the verdict and why, the drive over time, failovers and adaptations with a space-time
diagram, how long each fault took, what was on the bus, and what the run printed.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Final

import msgspec
from markupsafe import Markup

from aftbed.core.events import Event
from aftbed.judge.checks import stranger_line
from aftbed.judge.record import RunRecord
from aftbed.judge.timeline import TimeAxis, logged_events, node_journals, sent_requests
from aftbed.judge.verdict import CHECKERS, Verdict
from aftbed.report import plots
from aftbed.report.html import TEMPLATES, engine, page_text
from aftbed.report.sequence import space_time_of
from aftbed.runtime.unix.options import CarRun, LoadRun
from aftbed.runtime.unix.run_directory import BUS_NAME
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.decoded_log import decoded_log

KMH_PER_MS: Final = 3.6
PROMISES: Final = {checker.name: checker.promise for checker in CHECKERS}
MARKED: Final = (Event.FAULT_APPLIED, Event.NODE_DIED)  # on the plots of the drive
MARKS_MAX: Final = 40


class DriveSeries(msgspec.Struct):
    """Points (s of bus time, value) of what was on the bus, and how many frames of each name."""

    speed_kmh: list[tuple[float, float]] = []
    gap_m: list[tuple[float, float]] = []
    demanded_ms2: list[tuple[float, float]] = []
    actual_ms2: list[tuple[float, float]] = []
    frames: Counter[str] = msgspec.field(default_factory=Counter)
    damaged: int = 0
    seconds: float = 0.0


def run_page(record: RunRecord, verdict: Verdict) -> str:
    """The whole page."""
    drive = drive_of(record)
    return page_text(
        engine(TEMPLATES).get_template("run.html.j2"),
        record=record,
        verdict=verdict,
        promises=PROMISES,
        drive=drive,
        drawings=[(title, Markup(svg)) for title, svg in _drawings(drive, _marks(record))],
        diagram=space_time_of(record),
        strangers=list(map(stranger_line, verdict.strangers)),
        lines=[((one.t_ns - record.started_ns) / 1e6, one.event, one.text) for one in logged_events(record)],
    )


def drive_of(record: RunRecord) -> DriveSeries:
    """What the frames say; of a replay, what the requests say of the car."""
    found = DriveSeries()
    work = record.options.work
    if isinstance(work, LoadRun):
        return found
    for one in decoded_log(record.path / BUS_NAME, load_dbc(), own=isinstance(work, CarRun)):
        at_s = one.t_ns / 1e9
        found.seconds = max(found.seconds, at_s)
        found.frames[one.name or f"{one.frame.can_id:03X}"] += 1
        found.damaged += one.whole is False
        signals = one.signals
        if signals is None:
            continue
        match one.name:
            case "EGO_STATE" if signals["SPEED_VALID"]:
                found.speed_kmh.append((at_s, signals["SPEED"] * KMH_PER_MS))
            case "RADAR_TRACK" if signals["VALID"]:
                found.gap_m.append((at_s, signals["RANGE"]))
            case "AEB_REQ":
                found.demanded_ms2.append((at_s, signals["DECELERATION"]))
            case "BRAKE_STATUS":
                found.actual_ms2.append((at_s, signals["DECELERATION_ACTUAL"]))
            case _:
                pass
    if not isinstance(work, CarRun):
        for _, request in sent_requests(record):
            if request.ego_valid:
                found.speed_kmh.append((request.t_ms / 1e3, request.ego_speed_ms * KMH_PER_MS))
            if request.targets:
                found.gap_m.append((request.t_ms / 1e3, min(target.range_m for target in request.targets)))
    return found


def _marks(record: RunRecord) -> list[tuple[float, str]]:
    """When faults struck and processes died, in bus time; at the end of the run all of them do."""
    axis = TimeAxis(record)
    last_ns = max((one.t_ns for one in record.history.dialogue), default=0)
    found = {
        round(axis.at(one.t_ns) / 1e9, 3): str(one.event)
        for _, _, records in node_journals(record)
        for one in records
        if one.event in MARKED and one.t_ns <= last_ns
    }
    return sorted(found.items())[:MARKS_MAX]


def _drawings(drive: DriveSeries, marks: list[tuple[float, str]]) -> Iterator[tuple[str, str]]:
    for title, unit, lines in (
        ("Speed of the car", "km/h", {"speed": drive.speed_kmh}),
        ("Gap as the radar sees it", "m", {"gap": drive.gap_m}),
        ("Deceleration", "m/s2", {"demanded": drive.demanded_ms2, "actual": drive.actual_ms2}),
    ):
        if any(lines.values()):
            yield title, plots.over_time(title, lines, unit, marks)
