"""The timeline of a recorded run: steps and links on the path of requests, and the axis of time."""

from pathlib import Path
from typing import Final

import msgspec
from recordedruns import PBR_PATH, asking, finished, run_of
from records import CAR, CRASH, MS, RecordInTheMaking

from aftbed.core.events import FIRST_FAULT, Event
from aftbed.core.journal import Record
from aftbed.judge.record import RunRecord
from aftbed.judge.timeline import (
    TimeAxis,
    between_processes,
    describe,
    ends_ns,
    links_of,
    steps_of,
)
from aftbed.runtime.unix.options import CarRun, LoadRun


def arrows(record: RunRecord) -> list[tuple[str, str, str]]:
    steps = steps_of(record)
    found = between_processes(steps, links_of(steps))
    return [(steps[one.cause].node, one.channel, steps[one.effect].node) for one in found]


def test_the_messages_of_a_request_are_those_of_the_paper(tmp_path: Path) -> None:
    assert arrows(finished(run_of(tmp_path, requests=1))) == [
        ("client", "pxy2pro", "a/protocol"),
        ("a/protocol", "pro2bfr", "a/before"),
        ("a/before", "bfr2prd", "a/proceed"),
        ("a/proceed", "prd2srv", "a/server"),
        ("a/server", "srv2aft", "a/after"),
        ("a/after", "aft2aft", "b/server"),
        ("a/after", "aft2pro", "a/protocol"),
        ("b/server", "srv2aft", "b/after"),
        ("a/protocol", "pro2pxy", "proxy"),
        ("proxy", "pxy2clt", "client"),
    ]


def test_a_repeated_request_is_answered_by_the_new_leader(tmp_path: Path) -> None:
    run = RecordInTheMaking(tmp_path)
    for journal, event in PBR_PATH[:8]:
        run.note(journal, event, 1)
    run.note("b.protocol.1", Event.DEDUPE_HIT, 1)
    run.note("proxy.1", Event.REPLY_ACCEPTED, 1)
    assert arrows(finished(run))[-2:] == [
        ("client", "pxy2pro", "b/protocol"),
        ("b/protocol", "pro2pxy", "proxy"),
    ]


LFR_PATH: Final = (
    *PBR_PATH[:2],
    ("a.before.1", Event.FOLLOWER_FORWARDED),
    ("a.proceed.1", Event.PROCEED_ENTER),
    ("b.before.1", Event.BEFORE_EXIT),
    ("b.proceed.1", Event.PROCEED_ENTER),
    ("a.server.1", Event.SERVER_ENTER),
    ("b.server.1", Event.SERVER_ENTER),
    ("a.server.1", Event.SERVER_EXIT),
    ("b.server.1", Event.SERVER_EXIT),
    ("a.after.1", Event.FOLLOWER_NOTIFIED),
    ("a.protocol.1", Event.REPLY_STORED),
)


def test_both_replicas_of_lfr_execute(tmp_path: Path) -> None:
    run = RecordInTheMaking(tmp_path)
    for journal, event in LFR_PATH:
        run.note(journal, event, 1)
    assert arrows(finished(run)) == [
        ("client", "pxy2pro", "a/protocol"),
        ("a/protocol", "pro2bfr", "a/before"),
        ("a/before", "bfr2bfr", "b/before"),
        ("b/before", "bfr2prd", "b/proceed"),
        ("a/proceed", "prd2srv", "a/server"),
        ("b/proceed", "prd2srv", "b/server"),
        ("a/server", "prd2aft", "a/after"),
        ("a/after", "aft2pro", "a/protocol"),
    ]


def test_arrows_belong_to_one_request(tmp_path: Path) -> None:
    run = RecordInTheMaking(tmp_path)
    run.note("client.1", Event.REQUEST_SENT, 1)
    run.note("client.1", Event.REQUEST_SENT, 2)
    run.note("a.protocol.1", Event.REQUEST_RECEIVED, 1)
    steps = steps_of(finished(run))
    assert [(steps[f.cause].request_id, steps[f.effect].request_id) for f in links_of(steps)] == [(1, 1)]


def test_a_step_ends_when_its_effect_begins_and_before_the_next_step_of_its_process(tmp_path: Path) -> None:
    run = RecordInTheMaking(tmp_path)
    run.t_ns -= MS  # each note is a ms behind the one before
    run.note("client.1", Event.REQUEST_SENT, 1)
    run.t_ns -= MS - 50_000
    run.note("a.protocol.1", Event.REQUEST_RECEIVED, 1)
    run.t_ns -= MS - 500
    run.note("a.protocol.1", Event.DEDUPE_HIT, 2)
    steps = steps_of(finished(run))
    lengths = [end - step.t_ns for step, end in zip(steps, ends_ns(steps, links_of(steps)), strict=True)]
    assert lengths == [50_000, 500, 1_000]


def test_a_step_with_a_late_effect_is_drawn_short(tmp_path: Path) -> None:
    run = RecordInTheMaking(tmp_path)
    run.note("client.1", Event.REQUEST_SENT, 1)
    run.note("a.protocol.1", Event.REQUEST_RECEIVED, 1)  # a ms later: the first was hung
    steps = steps_of(finished(run))
    assert ends_ns(steps, links_of(steps))[0] - steps[0].t_ns == 200_000


# -- words -----------------------------------------------------------------------------------------


def test_a_fault_is_described_in_the_words_of_its_user(tmp_path: Path) -> None:
    record = finished(run_of(tmp_path))
    applied = Record(0, Event.FAULT_APPLIED, 0, FIRST_FAULT, "a/after")
    assert describe(applied, record.faults) == str(CRASH)
    injected_later = msgspec.structs.replace(applied, detail=FIRST_FAULT + 1)
    assert describe(injected_later, record.faults) == "a fault"
    hang = msgspec.structs.replace(record.faults[0], fault="hang backup", number=1)
    record = msgspec.structs.replace(record, faults=(*record.faults, hang))
    assert describe(injected_later, record.faults) == "hang backup"


# -- the axis of time -----------------------------------------------------------------------------


def test_in_real_time_the_axis_is_the_monotonic_clock_less_one_offset(tmp_path: Path) -> None:
    begin = 5_000 * MS
    late = ((begin + 20 * MS + 900_000, 20), (begin + 40 * MS + 100_000, 40), (begin + 130 * MS, 60))
    axis = TimeAxis(asking(tmp_path, CarRun("ccrs-50", 1.0, "latch"), *late))
    assert axis.at(begin + 50 * MS) == 50 * MS - 100_000, "by the fastest request"
    assert axis.at(begin - 1_000 * MS) == 0, "what was before the car's run lies at its beginning"


def test_at_another_pace_bus_time_goes_faster(tmp_path: Path) -> None:
    axis = TimeAxis(asking(tmp_path, CarRun("ccrs-50", 4.0, "latch"), (1_005 * MS, 20), (1_010 * MS, 40)))
    assert axis.at(1_020 * MS) == 80 * MS


def test_in_lockstep_time_stands_still_while_the_function_works(tmp_path: Path) -> None:
    axis = TimeAxis(asking(tmp_path, CAR, (1_000 * MS, 20), (1_002 * MS, 40)))
    assert [axis.at(t * MS) for t in (999, 1_000, 1_001, 1_002, 1_999)] == [
        0,
        20 * MS,
        20 * MS,
        40 * MS,
        40 * MS,
    ]


def test_without_a_bus_the_axis_is_the_time_since_the_launch(tmp_path: Path) -> None:
    record = finished(run_of(tmp_path, LoadRun(2, 0.0)))
    assert TimeAxis(record).at(record.started_ns + 7) == 7
