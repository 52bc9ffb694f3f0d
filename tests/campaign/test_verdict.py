"""The verdict over a record: honest about what is broken, and about what is not known.

Records are made by hand, in the very files that a run leaves behind.
"""

import json
from pathlib import Path
from typing import Final

import msgspec
import pytest

from aftbed.campaign.record import read_record
from aftbed.campaign.verdict import EXIT_CODES, Verdict, judge
from aftbed.core.errors import ConfigError
from aftbed.core.event import Event
from aftbed.core.fault import Act, Fault, Flip, Place, Trigger, flipped
from aftbed.core.journal import DROPPED_OFFSET, EntryKind
from aftbed.runtime.unix.journal import Dialogue, Journal
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, RunOptions, Work
from aftbed.vehicle.function import default_application, sample_requests
from aftbed.vehicle.report import VehicleResult

MS: Final = 1_000_000
START_NS: Final = 10**12
CAR: Final = CarRun("ccrs-50", None, "latch")
STOPPED: Final = VehicleResult(False, None, 2.5, 2.5, 9.0, True)
CRASH: Final = Fault(Act.CRASH, "primary", Trigger("checkpoint.sent", 2))
FLIP: Final = Fault(Act.BITFLIP, "primary", Trigger("server.exit", 2), flip=Flip(Place.RESULT, 8))
FIRST_GENERATION: Final = 1 << 8


class RecordInTheMaking:
    """A run of three requests, in the directory that it leaves; `end` is what the supervisor wrote."""

    def __init__(self, path: Path, work: Work | None = None, faults: tuple[Fault, ...] = ()) -> None:
        self.path = path
        self.work = work or LoadRun(3, 0.0)
        self.options = RunOptions("abc123", "/gone", str(path), "pbr", "process", 7, self.work, faults)
        receipts = [{"fault": str(f), "receipt": "applied"} for f in faults]
        self.end: dict[str, object] | None = {"reason": "", "left": [], "seconds": 1.5, "faults": receipts}
        self.t_ns = START_NS
        (path / "journal").mkdir(parents=True)
        self._journals: dict[str, Journal] = {}
        self._dialogue = Dialogue(path / "journal" / "client.1.dialogue", "client")
        self._bare = default_application()
        self.sent = 0

    def note(self, journal: str, event: Event, request_id: int = 0, detail: int = 0) -> None:
        if journal not in self._journals:
            node = journal.rpartition(".")[0].replace("-", "/")
            self._journals[journal] = Journal(self.path / "journal" / f"{journal}.journal", node)
        self.t_ns += MS
        self._journals[journal].write(self.t_ns, event, request_id, detail)

    def request(
        self, epoch: int = 1, replica: int = 1, answers: int = 1, flipped_bit: int | None = None
    ) -> None:
        """One request, served as it should be, but for `flipped_bit`; answered `answers` times."""
        self.sent += 1
        payload = sample_requests(7, self.sent)[-1]
        self.t_ns += MS
        self._dialogue.write(self.t_ns, self.sent, 0, EntryKind.SENT, payload)
        self.note(f"{'ab'[replica - 1]}-server.1", Event.SERVER_EXIT, self.sent)
        self.note("proxy.1", Event.REPLY_ACCEPTED, self.sent, epoch << 8 | replica)
        reply = self._bare.execute(payload)
        if flipped_bit is not None:
            reply = flipped(reply, flipped_bit)
        for _ in range(answers):
            self._dialogue.write(self.t_ns, self.sent, epoch, EntryKind.ANSWERED, reply)

    def lose(self, name: str, count: int) -> None:
        """Of what belonged into this file, `count` found no room."""
        with (self.path / "journal" / name).open("r+b") as file:
            file.seek(DROPPED_OFFSET)
            file.write(count.to_bytes(4, "little"))

    def failover(self) -> None:
        self.note("a-after.1", Event.FAULT_APPLIED, detail=1)
        self.note("a-watchdog.1", Event.WATCHDOG_SUSPECT, detail=1)
        self.note("supervisor", Event.REPLICA_FENCED, detail=FIRST_GENERATION | 1)
        self.note("b-protocol.1", Event.REPLICA_PROMOTED, detail=2)

    def verdict(self) -> Verdict:
        """Write what is left to write, then read it all back and judge."""
        about = msgspec.to_builtins(self.options) | {"started_ns": START_NS - 250 * MS}
        del about["private"], about["listener"]  # of a live run only
        (self.path / "run.json").write_text(json.dumps(about))
        if self.end is not None:
            (self.path / "end.json").write_text(json.dumps(self.end))
        return judge(read_record(self.path))


def whole(path: Path, work: Work | None = None, faults: tuple[Fault, ...] = ()) -> RecordInTheMaking:
    """A run in which nothing is wrong."""
    record = RecordInTheMaking(path, work, faults)
    for _ in range(3):
        record.request()
    return record


def drive(path: Path, result: VehicleResult | None, end: str = "stopped itself") -> RecordInTheMaking:
    record = whole(path, CAR)
    assert record.end is not None
    if result is not None:
        record.end["result"] = {"end": end, "result": msgspec.to_builtins(result)}
    return record


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "record"


def test_a_run_without_trouble_passes(path: Path) -> None:
    verdict = whole(path).verdict()
    assert (verdict.verdict, verdict.reasons) == ("pass", [])
    assert set(verdict.checks) == {
        "at_most_once",
        "exactly_one_answer",
        "one_history",
        "one_master",
        "clean_exit",
        "faults_applied",
        "whole_history",
    }
    assert set(verdict.checks.values()) == {"pass"}
    assert (verdict.run, verdict.seed, verdict.ftm, verdict.placement) == ("abc123", 7, "pbr", "process")
    assert (verdict.scenario, verdict.seconds, verdict.failovers) == ("load", 1.5, [])
    assert verdict.launch_ms == 251.0, "from the command's start to the first request"
    assert (verdict.requests.sent, verdict.requests.answered) == (3, 3)


def test_a_fault_that_was_survived_passes_and_is_told(path: Path) -> None:
    record = whole(path, faults=(CRASH,))
    record.failover()
    record.request(epoch=2, replica=2)
    verdict = record.verdict()
    assert (verdict.verdict, verdict.reasons) == ("pass", [])
    assert verdict.faults == [{"fault": str(CRASH), "receipt": "applied"}]
    assert [(f.epoch, f.cause, f.detected_ms) for f in verdict.failovers] == [(2, "fault", 1.0)]


def test_exit_codes() -> None:
    assert EXIT_CODES == {"pass": 0, "fail": 1, "inconclusive": 3}


# -- a broken promise is a fail


def test_a_lost_request_fails(path: Path) -> None:
    record = whole(path)
    record.request(answers=0)
    verdict = record.verdict()
    assert verdict.verdict == "fail" and verdict.requests.lost == 1
    assert "exactly_one_answer: request 4: 0 replies" in verdict.reasons


def test_a_doubled_reply_fails(path: Path) -> None:
    record = whole(path)
    record.request(answers=2)
    verdict = record.verdict()
    assert verdict.verdict == "fail" and verdict.requests.duplicated == 1


def test_a_doubled_execution_fails(path: Path) -> None:
    record = whole(path)
    record.note("a-server.1", Event.SERVER_EXIT, 3)
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["at_most_once"]) == ("fail", "fail")


def test_a_master_that_was_not_fenced_fails(path: Path) -> None:
    record = whole(path)
    record.request(epoch=2, replica=2)
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["one_master"]) == ("fail", "fail")


def test_what_is_left_behind_fails(path: Path) -> None:
    record = whole(path)
    assert record.end is not None
    record.end["left"] = ["a/after (123)"]
    verdict = record.verdict()
    assert verdict.verdict == "fail"
    assert verdict.reasons == ["clean_exit: left behind: ['a/after (123)']"]


def test_a_fail_weighs_more_than_what_is_not_known(path: Path) -> None:
    record = whole(path)
    record.request(answers=2)
    record.end = None
    assert record.verdict().verdict == "fail"


def test_what_waited_when_the_run_was_cut_off_is_not_known(path: Path) -> None:
    record = whole(path)
    record.request(answers=0)
    record.end = None
    assert record.verdict().checks["exactly_one_answer"] == "unknown"


# -- what is not known is no pass


def test_a_run_without_an_end_is_inconclusive(path: Path) -> None:
    record = whole(path)
    record.end = None
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["clean_exit"]) == ("inconclusive", "unknown")
    assert verdict.reasons == ["clean_exit: the supervisor did not live to end the run"]
    assert verdict.seconds is None


def test_trouble_of_the_harness_is_inconclusive(path: Path) -> None:
    record = whole(path)
    assert record.end is not None
    record.end["reason"] = "hub: died (signal 9)"
    verdict = record.verdict()
    assert verdict.verdict == "inconclusive"
    assert verdict.reasons == ["clean_exit: hub: died (signal 9)"]


@pytest.mark.parametrize("reason", ["", "interrupted", "stopped"])
def test_an_end_that_somebody_wanted_is_none(path: Path, reason: str) -> None:
    record = whole(path)
    assert record.end is not None
    record.end["reason"] = reason
    assert record.verdict().verdict == "pass"


@pytest.mark.parametrize("receipt", ["not_activated", "failed", "unknown"])
def test_a_fault_that_did_not_fire_is_inconclusive(path: Path, receipt: str) -> None:
    record = whole(path, faults=(CRASH,))
    assert record.end is not None
    record.end["faults"] = [{"fault": str(CRASH), "receipt": receipt}]
    verdict = record.verdict()
    assert verdict.verdict == "inconclusive"
    assert verdict.reasons == [f"faults_applied: never fired: {CRASH}"]


def test_without_an_end_the_receipts_of_faults_are_not_known(path: Path) -> None:
    record = whole(path, faults=(CRASH,))
    record.end = None
    verdict = record.verdict()
    assert verdict.faults == [{"fault": str(CRASH), "receipt": "unknown"}]
    assert verdict.checks["faults_applied"] == "unknown"


@pytest.mark.parametrize("name", ["a-server.1.journal", "client.1.dialogue"])
def test_a_history_that_is_not_whole_is_inconclusive(path: Path, name: str) -> None:
    record = whole(path)
    record.lose(name, 3)
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["whole_history"]) == ("inconclusive", "unknown")
    assert verdict.reasons == ["whole_history: 3 records found no room in the journals"]


def test_what_all_journals_have_dropped_is_added_up(path: Path) -> None:
    record = whole(path)
    for name in ("a-server.1.journal", "proxy.1.journal", "client.1.dialogue"):
        record.lose(name, 2)
    record.verdict()
    assert read_record(path).history.dropped == 6


def test_what_is_wrong_in_a_history_that_is_not_whole_fails(path: Path) -> None:
    record = whole(path)
    record.request(answers=0)
    record.lose("proxy.1.journal", 1)
    assert record.verdict().verdict == "fail"


def test_an_end_that_was_just_being_written_is_none(path: Path) -> None:
    """It is written beside its place and renamed: the supervisor may die in between."""
    record = whole(path)
    record.end = None
    (path / "end.json.new").write_text('{"rea')
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["clean_exit"]) == ("inconclusive", "unknown")


def test_a_run_without_a_request_is_inconclusive(path: Path) -> None:
    verdict = RecordInTheMaking(path).verdict()
    assert verdict.verdict == "inconclusive" and verdict.launch_ms is None
    assert verdict.checks["one_history"] == verdict.checks["exactly_one_answer"] == "unknown"


# -- the car


def test_a_car_that_does_what_the_scenario_expects_passes(path: Path) -> None:
    verdict = drive(path, STOPPED).verdict()
    assert (verdict.verdict, verdict.checks["vehicle"], verdict.scenario) == ("pass", "pass", "ccrs-50")
    assert verdict.vehicle == STOPPED


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (VehicleResult(True, 31.0, 0.0, None, 9.0, True), "vehicle: collision at 31.0 km/h, expected stop"),
        (VehicleResult(False, None, 5.0, None, 4.0, True), "vehicle: the car did not stop, expected stop"),
        (
            VehicleResult(False, None, 0.2, 0.2, 9.0, True),
            "vehicle: stopped at 0.20 m, at least 0.50 m expected",
        ),
    ],
)
def test_a_car_that_does_not_fails(path: Path, result: VehicleResult, reason: str) -> None:
    verdict = drive(path, result).verdict()
    assert verdict.verdict == "fail" and verdict.reasons == [reason]


def test_a_car_that_did_not_report_is_inconclusive(path: Path) -> None:
    verdict = drive(path, None).verdict()
    assert verdict.verdict == "inconclusive" and verdict.vehicle is None
    assert verdict.reasons == ["vehicle: the car did not report"]


def test_a_drive_that_was_broken_off_is_judged_by_what_it_did(path: Path) -> None:
    under_way = VehicleResult(False, None, 20.0, None, 0.0, False)
    assert drive(path / "1", under_way, end="stopped").verdict().verdict == "pass"
    hit = VehicleResult(True, 31.0, 0.0, None, 9.0, True)
    assert drive(path / "2", hit, end="stopped").verdict().verdict == "fail"


def test_a_replay_gives_its_figures_and_needs_no_car(path: Path) -> None:
    record = whole(path, ReplayRun("drive.log", "radar.dbc", "toyota", None))
    assert record.end is not None
    record.end["result"] = {"played": 5}
    verdict = record.verdict()
    assert (verdict.scenario, verdict.replay, verdict.vehicle) == ("replay drive.log", {"played": 5}, None)
    assert verdict.verdict == "pass" and "vehicle" not in verdict.checks


# -- value faults


def hit(path: Path, receipt: str = "applied", detail: str = "bit 8 of the result") -> RecordInTheMaking:
    """A run in which a bit was to be flipped."""
    record = whole(path, faults=(FLIP,))
    assert record.end is not None
    record.end["faults"] = [{"fault": str(FLIP), "receipt": receipt, "detail": detail}]
    return record


def test_a_value_fault_that_never_reached_the_client_passes(path: Path) -> None:
    verdict = hit(path).verdict()
    assert (verdict.verdict, verdict.checks["value"], verdict.requests.wrong) == ("pass", "pass", 0)
    assert verdict.faults == [{"fault": str(FLIP), "receipt": "applied", "detail": "bit 8 of the result"}]


def test_a_value_fault_that_did_fails_and_says_what_it_asked_of_the_brakes(path: Path) -> None:
    record = hit(path)
    record.request(flipped_bit=8)  # byte 1 is the stage
    verdict = record.verdict()
    assert (verdict.verdict, verdict.requests.wrong) == ("fail", 1)
    assert verdict.checks["value"] == verdict.checks["one_history"] == "fail"
    assert verdict.reasons[-1] == "value: request 4: sdc: stage 1 instead of 0"


def test_where_none_was_asked_for_there_is_no_such_check(path: Path) -> None:
    record = whole(path, faults=(CRASH,))
    record.failover()
    assert "value" not in record.verdict().checks
    assert "value" not in whole(path.parent / "other").verdict().checks


def test_a_value_fault_that_was_not_applied_proves_nothing(path: Path) -> None:
    verdict = hit(path, "not_activated", "there are 264 bits").verdict()
    assert (verdict.verdict, verdict.checks["value"]) == ("inconclusive", "unknown")
    assert verdict.reasons == [
        f"faults_applied: not_activated: {FLIP}: there are 264 bits",
        "value: no value fault was applied",
    ]


def test_a_wrong_reply_weighs_more_than_a_missing_receipt(path: Path) -> None:
    record = hit(path)
    record.request(flipped_bit=8)
    record.end = None
    assert (record.verdict().verdict, record.verdict().checks["value"]) == ("fail", "fail")


def test_without_an_end_it_is_not_known_whether_a_bit_was_flipped(path: Path) -> None:
    record = hit(path)
    record.end = None
    assert record.verdict().checks["value"] == "unknown"


# -- records that are none


def test_several_incarnations_of_the_client_are_one_dialogue(path: Path) -> None:
    """In the order of their numbers, not of their names: 10 comes after 9."""
    record = whole(path)
    for incarnation in range(2, 11):
        record._dialogue = Dialogue(path / "journal" / f"client.{incarnation}.dialogue", "client")
        record.request()
    verdict = record.verdict()
    assert verdict.verdict == "pass" and verdict.requests.sent == 12


def test_a_directory_that_is_no_record(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"run\.json: No such file or directory; is this the record of a run\?"
    ):
        read_record(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        ("{}", "not the options of a run: "),
        ('{"run": 1}', "not the options of a run: "),
    ],
)
def test_a_run_json_that_is_none(path: Path, text: str, message: str) -> None:
    record = whole(path)
    record.verdict()
    (path / "run.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"run\.json: {message}"):
        read_record(path)


@pytest.mark.parametrize("name", ["a-server.1.journal", "client.1.dialogue"])
def test_a_journal_that_is_none(path: Path, name: str) -> None:
    whole(path).verdict()
    (path / "journal" / name).write_bytes(b"garbage")
    with pytest.raises(ConfigError, match=r"journal: not a journal \(7 bytes\)"):
        read_record(path)


def test_a_verdict_is_one_json_document(path: Path) -> None:
    verdict = whole(path).verdict()
    document = json.loads(msgspec.json.encode(verdict))
    assert document["verdict"] == "pass" and document["checks"]["one_master"] == "pass"
    assert {"requests", "vehicle", "failovers", "checks", "run", "seed", "ftm", "scenario"} <= set(document)
