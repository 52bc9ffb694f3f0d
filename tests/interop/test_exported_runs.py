"""A run as a trace and as MCAP: a viewer shows what the record says."""

import copy
import json
from collections import Counter
from pathlib import Path
from typing import Any, Final

import pytest
from mcap.reader import make_reader
from recordedruns import asking, finished, run_of
from records import CAR, MS
from tracechecks import problems

from aftbed.core.errors import ConfigError
from aftbed.core.events import FIRST_FAULT, Event
from aftbed.interop import perfetto
from aftbed.interop.export import ExportFiles, check, export
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix.options import ReplayRun
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.e2e import protect
from aftbed.vehicle.can.frame import Frame

CODEC: Final[Codec] = load_dbc()


# -- the trace ---


@pytest.fixture
def eventful(tmp_path: Path) -> RunRecord:
    """A crash, a failover, an adaptation, requests, and printed lines."""
    run = run_of(tmp_path)
    run.request()
    run.note("a.after.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
    run.note("a.watchdog.1", Event.WATCHDOG_SUSPECT, detail=1)
    run.note("supervisor.1", Event.NODE_DIED, detail=4711)
    run.note("engine.1", Event.ADAPT_PLAN, detail=1)
    run.note("supervisor.1", Event.ADAPT_STEP_ENTER, detail=3)
    run.note("engine.1", Event.ADAPT_COMMIT, detail=1)
    run.note("a.after.2", Event.CHECKPOINT_APPLIED, 2)
    told = [{"t_ms": 1.5, "event": "alarm", "text": "a: crash"}, {"t_ms": 2.5, "event": "roles", "text": "b"}]
    lines = "".join(json.dumps(line) + "\n" for line in told) + '{"t_ms": 3'
    (tmp_path / "events.jsonl").write_text(lines)
    return finished(run)


def traced(record: RunRecord) -> list[dict[str, Any]]:
    """As the file has it."""
    path = record.path / "trace.json"
    assert perfetto.write(record, path) == len(json.loads(path.read_text())["traceEvents"])
    document = json.loads(path.read_text())
    assert document["otherData"]["ftm"] == "pbr"
    return document["traceEvents"]  # type: ignore[no-any-return]


def test_a_viewer_can_show_the_trace(eventful: RunRecord) -> None:
    events = traced(eventful)
    assert problems(events) == []
    assert {"X", "s", "f", "i", "b", "e", "M"} == {event["ph"] for event in events}


def test_faults_and_adaptation_steps_are_instants(eventful: RunRecord) -> None:
    instants = {e["name"]: e["cat"] for e in traced(eventful) if e["ph"] == "i"}
    assert instants == {
        "crash primary at checkpoint.sent nth 2": "fault",
        "watchdog.suspect": "failure",
        "node.died: process 4711": "failure",
        "adapt.plan": "adaptation",
        "adapt.step.enter 3": "adaptation",
        "adapt.commit": "adaptation",
        "alarm: a: crash": "told",
        "roles: b": "told",
    }


def test_a_replacement_process_has_its_own_track(eventful: RunRecord) -> None:
    threads = [e["args"]["name"] for e in traced(eventful) if e["name"] == "thread_name"]
    assert {"a/after", "a/after (2)"} < set(threads)
    assert threads[0] == "client"
    assert len(threads) == len(set(threads))


def test_a_request_is_a_slice_from_its_sending_to_its_reply(eventful: RunRecord) -> None:
    found = [e for e in traced(eventful) if e.get("cat") == "request"]
    assert [(e["ph"], e["name"]) for e in found] == [("b", "request 1"), ("e", "request 1")]


@pytest.mark.parametrize(
    ("phase", "change", "said"),
    [
        ("f", {"id": 999_999}, "has one end only"),
        ("f", {"ts": 0.0}, "goes back in time"),
        ("s", {"ts": 0.001}, "is bound to no slice"),
        ("s", {"name": "aft2aft2"}, "changes its name"),
        ("X", {"dur": 1e9}, "begins within the one before"),
        ("X", {"dur": -1.0}, "ends before it begins"),
        ("X", {"ts": 1e12}, "is behind"),
        ("X", {"tid": 77}, "has no name"),
        ("e", {"id": 77}, "ends and was not begun"),
        ("b", {"id": 77}, "never ends"),
    ],
)
def test_the_checker_of_traces_refuses_a_broken_one(
    phase: str, change: dict[str, object], said: str, eventful: RunRecord
) -> None:
    events = copy.deepcopy(traced(eventful))
    next(event for event in events if event["ph"] == phase).update(change)
    assert any(said in problem for problem in problems(events)), problems(events)


# -- MCAP -----------------------------------------------------------------------------------------


def frame(t_us: int, name: str, broken: bool = False, **signals: float) -> str:
    values = dict.fromkeys(CODEC.signal_names(name), 0.0) | signals
    data = protect(CODEC.encode(name, values), CODEC.data_id(name), 0)
    if broken:
        data = bytes([data[0] ^ 1]) + data[1:]
    return log_line(Frame(t_us, CODEC.can_id(name), data), "can0")


def mcap_of(record: RunRecord) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """What the reader of the format finds: time and message, by topic."""
    path = record.path / "run.mcap"
    lines = list(map(str, export(record, ExportFiles(mcap=path))))
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    times = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None and schema.encoding == "jsonschema"
            about = json.loads(schema.data)
            content = json.loads(message.data)
            assert about["type"] == "object" and "$ref" not in schema.data.decode()
            assert set(about.get("required", ())) <= set(content) <= set(about["properties"])
            found.setdefault(channel.topic, []).append((message.log_time, content))
            times.append(message.log_time)
    assert times == sorted(times)
    assert lines == [f"{path}: {len(times)} messages"]
    return found


def test_the_frames_of_the_bus_are_on_the_topics(tmp_path: Path) -> None:
    run = run_of(tmp_path, CAR)
    (tmp_path / "bus.log").write_text(
        frame(1_000, "EGO_STATE", SPEED=15, ACCELERATION=-2.0, SPEED_VALID=1)
        + frame(2_000, "RADAR_TRACK", VALID=1, RANGE=30, RELATIVE_SPEED=-10, LATERAL_OFFSET=0.5)
        + frame(3_000, "AEB_REQ", STAGE=2, DECELERATION=4, TTC=3, TTC_VALID=1, TARGET=5, SEQUENCE=9)
        + frame(
            4_000,
            "BRAKE_STATUS",
            STAGE_APPLIED=2,
            FALLBACK=3,
            DECELERATION_ACTUAL=3.5,
            DECELERATION_DEMANDED=4,
        )
        + frame(5_000, "RADAR_TRACK")
        + frame(6_000, "EGO_STATE", broken=True, SPEED=60, SPEED_VALID=1)
        + "(0000000000.006000) can0 13"
    )
    found = mcap_of(finished(run))
    assert found["/ego"] == [(MS, {"speed_ms": 15.0, "speed_kmh": 54.0, "acceleration_ms2": -2.0})]
    lead = {"in_sight": True, "gap_m": 30.0, "relative_speed_ms": -10.0, "speed_ms": 5.0}
    assert found["/lead"] == [
        (2 * MS, lead | {"lateral_offset_m": 0.5, "ttc_s": 3.0}),
        (5 * MS, {"in_sight": False}),
    ]
    asked = {"stage": 2, "stage_name": "PARTIAL", "demand_ms2": 4.0, "sequence": 9, "ttc_s": 3.0, "target": 5}
    assert found["/function"] == [(3 * MS, asked)]
    ((_, brake),) = found["/brake"]
    assert (brake["stage_name"], brake["fallback_name"], brake["deceleration_ms2"]) == (
        "PARTIAL",
        "LATCH",
        3.5,
    )
    frames = found["/can"]
    assert [message["intact"] for _, message in frames] == [True] * 5 + [False], (
        "the broken one is not believed"
    )
    assert frames[0][1] | {"data": ""} == {
        "id": 0x120, "interface": "can0", "length": 8, "data": "", "name": "EGO_STATE", "intact": True,
    }  # fmt: skip


def test_faults_and_adaptations_are_on_a_topic_apart_from_the_path_of_requests(eventful: RunRecord) -> None:
    found = mcap_of(eventful)
    kinds = Counter(message["kind"] for _, message in found["/ftm"])
    assert kinds == {"fault": 1, "failure": 2, "adaptation": 3}
    assert {message["kind"] for _, message in found["/ftm/requests"]} == {"request"}
    ((t_ns, fault),) = [(t, m) for t, m in found["/ftm"] if m["kind"] == "fault"]
    assert fault["text"] == "crash primary at checkpoint.sent nth 2"
    assert (fault["node"], fault["run_ms"]) == ("a/after", t_ns / 1e6)
    assert [(m["level"], m["message"]) for _, m in found["/log"]] == [(3, "alarm: a: crash"), (2, "roles: b")]
    assert found["/log"][0][1]["timestamp"] == {"sec": 0, "nsec": 1_500_000}


def test_a_replay_shows_the_requests_to_the_function(tmp_path: Path) -> None:
    work = ReplayRun("/gone.log", "/gone.dbc", "/gone.yaml", None)
    record = asking(tmp_path, work, (1_000 * MS, 20))
    (tmp_path / "bus.log").write_text(
        "(0000000000.020000) can1 120#0102\n" + frame(20_500, "AEB_REQ", STAGE=1)
    )
    found = mcap_of(record)
    assert found["/ego"] == [(20 * MS, {"speed_ms": 14.0, "speed_kmh": 50.4})]
    lead = {"in_sight": True, "gap_m": 40.0, "relative_speed_ms": -10.0, "speed_ms": 4.0, "ttc_s": 4.0}
    assert found["/lead"] == [(20 * MS, lead)]
    assert "name" not in found["/can"][0][1], "a frame of another bus is not aftbed's EGO_STATE"
    assert [message["stage"] for _, message in found["/function"]] == [1]


def test_a_file_that_cannot_be_written_is_refused_before_the_run(tmp_path: Path) -> None:
    for wanted, said in (
        (ExportFiles(mcap=tmp_path), f"--mcap {tmp_path}: is a directory, a file is allowed"),
        (ExportFiles(trace=tmp_path / "no" / "a"), f"--trace {tmp_path}/no/a: {tmp_path}/no is no directory"),
        (
            ExportFiles(tmp_path / "a", tmp_path / "a"),
            f"--mcap and --trace: {tmp_path}/a is asked for as both",
        ),
    ):
        with pytest.raises(ConfigError) as refused:
            check(wanted)
        assert str(refused.value) == said


@pytest.mark.parametrize("kind", ["mcap", "trace"])
def test_a_full_disk_is_an_error(kind: str, tmp_path: Path) -> None:
    """Here: in a directory that takes no new file."""
    record = finished(run_of(tmp_path / "run"))
    wanted = ExportFiles(**{kind: Path("/proc/file")})
    with pytest.raises(ConfigError, match=r"^/proc/file: cannot be written: "):
        export(record, wanted)
