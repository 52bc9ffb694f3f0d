"""The verdict over a record: honest about what is broken, and about what is not known."""

import json
from pathlib import Path
from typing import Final

import msgspec
import pytest
from msgspec.structs import replace
from records import CRASH, FLIP, RecordInTheMaking, outcomes, whole

from aftbed.core.events import FIRST_FAULT, Event
from aftbed.ftm.compose import build
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.judge.record import read_record
from aftbed.judge.verdict import EXIT_CODES
from aftbed.runtime.unix.options import COMMAND_GONE
from aftbed.runtime.unix.run_directory import HISTORY_NAME


def test_a_run_without_trouble_passes(path: Path) -> None:
    verdict = whole(path).verdict()
    assert (verdict.verdict, verdict.reasons) == ("pass", [])
    assert set(verdict.checks) == {
        "at_most_once",
        "exactly_one_answer",
        "one_history",
        "one_master",
        "whole_graph",
        "clean_exit",
        "faults_applied",
        "complete",
        "sources_agree",
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
    assert verdict.faults == [FaultReport(str(CRASH), ReceiptState.APPLIED)]
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
    record.note("a.server.1", Event.SERVER_EXIT, 3)
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


def test_half_a_graph_fails(path: Path) -> None:
    record = whole(path)
    record.host(bricks=[[b.name, b.kind] for b in build("pbr", "process").bricks if b.name != "b/after"])
    verdict = record.verdict()
    assert verdict.verdict == "fail"
    assert verdict.reasons == ["whole_graph: b/after (pbr.after) is missing"]


def test_a_leader_that_is_no_replica_fails(path: Path) -> None:
    record = whole(path)
    record.host(leader="c")
    assert "whole_graph: 'c' leads, which is no replica" in record.verdict().reasons


def test_a_graph_to_which_no_adaptation_led_fails(path: Path) -> None:
    record = whole(path)
    record.host(ftm="lfr", bricks=[[b.name, b.kind] for b in build("lfr", "process").bricks])
    assert record.verdict().reasons == ["whole_graph: lfr runs, though the adaptations came to pbr"]
    (path / HISTORY_NAME).write_text(outcomes({"ftm": "lfr"}))
    assert record.verdict().verdict == "pass"


def test_the_graph_of_a_service_that_is_gone_is_not_asked_for(path: Path) -> None:
    record = whole(path)
    record.host(leader="", bricks=[])
    assert record.verdict().checks["whole_graph"] == "pass"


def test_what_was_under_way_at_the_end_is_not_known(path: Path) -> None:
    record = whole(path)
    assert record.end is not None
    record.end["unfinished"] = ["new backup is under way"]
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["whole_graph"]) == ("inconclusive", "unknown")
    assert verdict.reasons == ["whole_graph: the run ended before it was at rest: new backup is under way"]


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


@pytest.mark.parametrize(("reason", "word"), [(COMMAND_GONE, "unknown"), ("", "fail")])
def test_a_run_whose_command_was_killed_waits_for_no_answer(path: Path, reason: str, word: str) -> None:
    record = whole(path)
    record.request(answers=0)
    assert record.end is not None
    record.end["reason"] = reason
    assert record.verdict().checks["exactly_one_answer"] == word


# -- what is not known is no pass


def test_a_run_without_an_end_is_inconclusive(path: Path) -> None:
    record = whole(path)
    record.end = None
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["clean_exit"]) == ("inconclusive", "unknown")
    assert verdict.reasons == [
        "whole_graph: the supervisor did not live to report the graph",
        "clean_exit: the supervisor did not live to end the run",
    ]
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


@pytest.mark.parametrize("receipt", ["not_activated", "inject_error", "unknown"])
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
    assert verdict.faults == [FaultReport(str(CRASH), ReceiptState.UNKNOWN)]
    assert verdict.checks["faults_applied"] == "unknown"


@pytest.mark.parametrize("name", ["a.server.1.journal", "client.1.dialogue"])
def test_a_history_that_is_not_whole_is_inconclusive(path: Path, name: str) -> None:
    record = whole(path)
    record.lose(name, 3)
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["whole_history"]) == ("inconclusive", "unknown")
    assert verdict.reasons == ["whole_history: 3 records found no room in the journals"]


@pytest.mark.parametrize(("dropped", "expected"), [(0, "fail"), (2, "inconclusive")])
def test_what_found_no_room_is_no_contradiction(path: Path, dropped: int, expected: str) -> None:
    """The dialogue was full before the fourth request; without a word about that, the record is wrong."""
    record = whole(path)
    record.note("a.server.1", Event.SERVER_EXIT, 4)
    record.note("proxy.1", Event.REPLY_ACCEPTED, 4, 1 << 8 | 1)
    record.lose("client.1.dialogue", dropped)
    verdict = record.verdict()
    assert verdict.verdict == expected
    told = any("request 4: executed, but never sent" in reason for reason in verdict.reasons)
    assert told is (expected == "fail")


def test_what_all_journals_have_dropped_is_added_up(path: Path) -> None:
    record = whole(path)
    for name in ("a.server.1.journal", "proxy.1.journal", "client.1.dialogue"):
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


def restored_by(path: Path, brick: int, tried_ftm: str) -> list[str]:
    """A process of replica b restores a state as its brick `brick`; the adaptation was rolled back."""
    record = whole(path)
    record.options = replace(record.options, placement="replica")
    record.note("b.2", Event.STATE_RESTORED, 3, brick=brick)
    undone = {"outcome": "rolled back", "ftm": "pbr", "tried_ftm": tried_ftm}
    (path / HISTORY_NAME).write_text(outcomes(undone))
    return [one for one in record.verdict().reasons if "journal b.2" in one]


def test_a_staged_process_of_an_adaptation_that_was_rolled_back_has_effects(path: Path) -> None:
    server = build("pbr+tr", "replica").nodes["b"].index("b/server")
    assert restored_by(path, server, "pbr+tr") == []


@pytest.mark.parametrize(("brick", "tried_ftm"), [(7, "lfr"), (5, "pbr+tr")])
def test_effects_of_what_is_no_server_are_told(path: Path, brick: int, tried_ftm: str) -> None:
    assert restored_by(path, brick, tried_ftm) == [
        "sources_agree: the journal b.2 has effects of what is no server of b"
    ]


NODE_FAILED: Final = """\
a/proceed (pid 4711):
Traceback (most recent call last):
  File "node.py", line 7, in turn
    assert port in self.open_ports
           ^^^^^^^^^^^^^^^^^^^^^^^
AssertionError: pro2bfr
of request 3
"""


def test_a_process_that_ended_in_an_error_is_no_pass(path: Path) -> None:
    record = whole(path)
    (path / "processes.log").write_text(f"b/after (pid 12): detected stop: no majority\n{NODE_FAILED}")
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["sources_agree"]) == ("inconclusive", "unknown")
    assert verdict.reasons == [
        "sources_agree: processes.log has a traceback of a/proceed (pid 4711): AssertionError: pro2bfr"
    ]


def test_what_processes_print_beside_is_no_trouble(path: Path) -> None:
    record = whole(path)
    (path / "processes.log").write_text("b/after (pid 12): detected stop: no majority\n  a warning\n")
    assert record.verdict().verdict == "pass"


def test_an_error_that_a_flipped_bit_explains_is_no_trouble(path: Path) -> None:
    record = hit(path)
    (path / "processes.log").write_text(NODE_FAILED)
    assert record.verdict().verdict == "pass"


def test_a_function_that_failed_is_told_with_what_a_crash_left_on_stderr(path: Path) -> None:
    record = whole(path)
    log = (
        "a warning of another one",
        "b/server (pid 12): detected stop: the function failed: lib.so: aft_execute returned -1",
        "too old",
        "no gains",
        "gain 3: NaN",
        "assertion failed",
        "a/server (pid 13): the function failed: its process was killed by SIGABRT",
    )
    (path / "processes.log").write_text("\n".join(log) + "\n")
    verdict = record.verdict()
    assert verdict.function_failures == [
        "b/server: lib.so: aft_execute returned -1",
        "a/server: its process was killed by SIGABRT;"
        " the log has before it: no gains | gain 3: NaN | assertion failed",
    ]
    assert verdict.verdict == "pass", "it was failed over"


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
    assert verdict.faults == [FaultReport(str(FLIP), ReceiptState.APPLIED, "bit 8 of the result")]


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


def test_a_verdict_is_one_json_document(path: Path) -> None:
    verdict = whole(path).verdict()
    document = json.loads(msgspec.json.encode(verdict))
    assert document["verdict"] == "pass" and document["checks"]["one_master"] == "pass"
    assert {"requests", "vehicle", "failovers", "checks", "run", "seed", "ftm", "scenario"} <= set(document)


def test_a_fault_has_the_number_that_the_journals_have(path: Path) -> None:
    """The first fault of the run, a live one, was refused: it has no receipt."""
    record = whole(path)
    record.note("a.after.1", Event.FAULT_APPLIED, detail=FIRST_FAULT + 1)
    assert record.end is not None
    crash = {"fault": str(CRASH), "receipt": "applied", "live": True, "number": 1}
    record.end["faults"] = [crash]
    assert record.verdict().verdict == "pass"
    record.end["faults"] = [{key: value for key, value in crash.items() if key != "number"}]
    assert "sources_agree: a fault has struck, and there is no receipt: number 2" in record.verdict().reasons
    record.end["faults"] = [crash, crash]
    twice = "sources_agree: two receipts have the number of one fault: number 2"
    assert twice in record.verdict().reasons


def test_a_fault_that_the_supervisor_applies_again_is_an_error_of_the_run(path: Path) -> None:
    record = whole(path)
    record.note("a.after.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    record.note("supervisor.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    assert record.end is not None
    record.end["faults"] = [{"fault": str(CRASH), "receipt": "activated", "live": True}]
    assert record.verdict().checks["sources_agree"] == "pass"
    record.note("supervisor.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    twice = "sources_agree: the supervisor has applied one fault 2 times: number 1"
    assert twice in record.verdict().reasons
