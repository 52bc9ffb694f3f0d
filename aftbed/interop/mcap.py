"""Writes a run as MCAP for Foxglove: JSON messages, with their JSON schemas in the file.

| topic | contents | source |
|---|---|---|
| `/ego` | the car: speed, acceleration | EGO_STATE; in a replay, the requests |
| `/brake` | the brake ECU: request followed, actual deceleration | BRAKE_STATUS |
| `/lead` | the target in front: gap, speeds, time to collision | RADAR_TRACK; in a replay, the requests |
| `/function` | the demand of the function | AEB_REQ |
| `/can` | every frame on the bus | the bus log |
| `/ftm` | faults, failures, recovery, adaptations | the journals |
| `/ftm/requests` | the events on the path of requests | the journals |
| `/log` | the lines that the run printed | `events.jsonl` |

A frame is decoded only if its E2E CRC is right, as on the bus. One with a wrong CRC is on `/can` with
`intact` false, and makes no other message. The true state of the car is not on the bus, so it is not in the
file.

All times are on one axis, see `judge.timeline`; `run_ms` is the time of the processes. A field whose value is
unknown is left out of its message, because a plot has no null. The extra `mcap` brings the library.
"""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
from msgspec import UNSET, Meta, UnsetType

from aftbed.core.errors import ConfigError
from aftbed.judge.record import RunRecord
from aftbed.judge.timeline import (
    Category,
    TimeAxis,
    category_of,
    describe,
    logged_events,
    node_journals,
    sent_requests,
)
from aftbed.runtime.unix.options import CarRun, ReplayRun
from aftbed.runtime.unix.run_directory import BUS_NAME
from aftbed.vehicle.aeb.messages import AebInput
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.decoded_log import decoded_log

STAGES: Final = ("NONE", "WARN", "PARTIAL", "FULL")
FALLBACKS: Final = ("NONE", "HOLD", "RELEASE", "LATCH")
INFORMATION, WARNING = 2, 3  # levels of `/log`
ALARM: Final = "alarm"  # the event whose lines are warnings

Text = Annotated[str, Meta(description="In words.")]
RunMs = Annotated[float, Meta(description="Time of the processes since the launch of the run, in ms.")]


# -- messages -------------------------------------------------------------------------------------


class EgoMotion(msgspec.Struct, frozen=True):
    """Motion of the car as measured by its wheels. Without speed fields the speed is unknown."""

    speed_ms: float | UnsetType = UNSET
    speed_kmh: float | UnsetType = UNSET
    acceleration_ms2: float | UnsetType = UNSET


class BrakeState(msgspec.Struct, frozen=True):
    """State of the brakes, and whether they follow a request or their fallback policy."""

    stage: int
    stage_name: str
    fallback: int
    fallback_name: str
    deceleration_ms2: float
    demanded_ms2: float


class LeadTarget(msgspec.Struct, frozen=True):
    """The target in front; only `in_sight` if there is none. Relative speed is negative when closing."""

    in_sight: bool
    gap_m: float | UnsetType = UNSET
    relative_speed_ms: float | UnsetType = UNSET
    speed_ms: float | UnsetType = UNSET
    lateral_offset_m: float | UnsetType = UNSET
    ttc_s: float | UnsetType = UNSET


class BrakeDemand(msgspec.Struct, frozen=True):
    """Demand of the protected function on the brakes; `ttc_s` and `target` only with a threat."""

    stage: int
    stage_name: str
    demand_ms2: float
    sequence: int
    ttc_s: float | UnsetType = UNSET
    target: int | UnsetType = UNSET


class CanFrame(msgspec.Struct, frozen=True):
    """A frame; `name` and `intact` (its CRC is right) for frames that aftbed's DBC defines and protects."""

    id: int
    interface: str
    length: int
    data: Annotated[str, Meta(description="Hexadecimal.")]
    name: str | UnsetType = UNSET
    intact: bool | UnsetType = UNSET


class FtmEvent(msgspec.Struct, frozen=True):
    """An event that a node recorded: its category, node, name, and the fields of its record."""

    kind: str
    node: str
    event: str
    text: Text
    request: int
    detail: int
    run_ms: RunMs


class FoxgloveTime(msgspec.Struct, frozen=True):
    """A time in Foxglove's schemas."""

    sec: int
    nsec: int


class FoxgloveLog(msgspec.Struct, frozen=True):
    """Foxglove's schema of a log line: level 2 is information, 3 a warning."""

    timestamp: FoxgloveTime
    level: int
    message: str
    name: str = "aftbed"
    file: str = ""
    line: int = 0


Message = EgoMotion | BrakeState | LeadTarget | BrakeDemand | CanFrame | FtmEvent | FoxgloveLog
TOPICS: Final[dict[str, type[Message]]] = {
    "/ego": EgoMotion,
    "/brake": BrakeState,
    "/lead": LeadTarget,
    "/function": BrakeDemand,
    "/can": CanFrame,
    "/ftm": FtmEvent,
    "/ftm/requests": FtmEvent,
    "/log": FoxgloveLog,
}
SCHEMA_NAMES: Final[dict[type[Message], str]] = {
    EgoMotion: "aftbed.Ego",
    BrakeState: "aftbed.Brake",
    LeadTarget: "aftbed.Lead",
    BrakeDemand: "aftbed.Function",
    CanFrame: "aftbed.Can",
    FtmEvent: "aftbed.Ftm",
    FoxgloveLog: "foxglove.Log",  # Foxglove's log panel shows messages of this schema
}


class TimedMessage(NamedTuple):
    """A message on a topic, at a time of the axis."""

    t_ns: int
    topic: str
    message: Message


def schema_of(kind: type[Message]) -> bytes:
    """The JSON schema of a kind of message, with references resolved: readers do not follow them."""
    _, parts = msgspec.json.schema_components([kind])
    return msgspec.json.encode(_resolved(parts[kind.__name__], parts))


def _resolved(schema: object, parts: dict[str, dict[str, object]]) -> object:
    if isinstance(schema, list):
        return [_resolved(one, parts) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if isinstance(name := schema.get("$ref"), str):
        return _resolved(parts[name.rpartition("/")[2]], parts)
    return {key: _resolved(value, parts) for key, value in schema.items()}


# -- the file -------------------------------------------------------------------------------------


def write(run: RunRecord, path: Path) -> int:
    """Write all messages of `run` by time; their number. Raises ConfigError without the extra, or OSError."""
    require_mcap()
    from mcap.writer import Writer  # noqa: PLC0415 - an extra

    messages = sorted(messages_of(run), key=lambda one: one.t_ns)
    encode = msgspec.json.Encoder().encode
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="aftbed")
        channels = {}
        for topic, kind in TOPICS.items():
            schema = writer.register_schema(SCHEMA_NAMES[kind], "jsonschema", schema_of(kind))
            channels[topic] = writer.register_channel(topic, "json", schema)
        for number, (t_ns, topic, message) in enumerate(messages):
            writer.add_message(channels[topic], t_ns, encode(message), t_ns, number)
        options = run.options
        about = {"ftm": options.ftm, "placement": options.placement, "seed": str(options.seed)}
        writer.add_metadata("aftbed", about)
        writer.finish()  # type: ignore[no-untyped-call]  # the library has no type here
    return len(messages)


def require_mcap() -> None:
    """Raises ConfigError without the extra."""
    if find_spec("mcap") is None:
        raise ConfigError('MCAP needs the library mcap: pip install "aftbed[mcap]"')


def messages_of(run: RunRecord) -> Iterator[TimedMessage]:
    """All messages, source by source."""
    axis, work = TimeAxis(run), run.options.work
    if isinstance(work, CarRun | ReplayRun):
        yield from _bus(run.path / BUS_NAME, load_dbc(), own=isinstance(work, CarRun))
    if isinstance(work, ReplayRun):
        for _, request in sent_requests(run):
            yield from _request(request)
    for node, _, records in node_journals(run):
        for one in records:
            category = category_of(one)
            topic = "/ftm/requests" if category is Category.REQUEST else "/ftm"
            run_ms = (one.t_ns - run.started_ns) / 1e6
            text = describe(one, run.faults)
            event = FtmEvent(category.value, node, str(one.event), text, one.request_id, one.detail, run_ms)
            yield TimedMessage(axis.at(one.t_ns), topic, event)
    for logged in logged_events(run):
        t_ns = axis.at(logged.t_ns)
        level = WARNING if logged.event == ALARM else INFORMATION
        stamp = FoxgloveTime(t_ns // 10**9, t_ns % 10**9)
        yield TimedMessage(t_ns, "/log", FoxgloveLog(stamp, level, f"{logged.event}: {logged.text}"))


# -- the bus --------------------------------------------------------------------------------------


def _bus(path: Path, codec: Codec, *, own: bool) -> Iterator[TimedMessage]:
    """The frames of the log, and what those say that are whole."""
    ego_ms: float | None = None
    for one in decoded_log(path, codec, own=own):
        frame, name = one.frame, one.name
        shown, whole = UNSET if name is None else name, UNSET if one.whole is None else one.whole
        data = frame.data.hex().upper()
        can = CanFrame(frame.can_id, one.interface, len(frame.data), data, shown, whole)
        yield TimedMessage(one.t_ns, "/can", can)
        if name is None or (signals := one.signals) is None:
            continue
        if name == "EGO_STATE":
            ego_ms = signals["SPEED"] if signals["SPEED_VALID"] else None
        yield from _decoded(one.t_ns, name, signals, ego_ms)


def _decoded(t_ns: int, name: str, signals: dict[str, float], ego_ms: float | None) -> Iterator[TimedMessage]:
    match name:
        case "EGO_STATE":
            yield TimedMessage(t_ns, "/ego", _ego(ego_ms, signals["ACCELERATION"]))
        case "RADAR_TRACK":
            lead = LeadTarget(False)
            if signals["VALID"]:
                lead = _lead(signals["RANGE"], signals["RELATIVE_SPEED"], ego_ms, signals["LATERAL_OFFSET"])
            yield TimedMessage(t_ns, "/lead", lead)
        case "AEB_REQ":
            stage, threat = int(signals["STAGE"]), bool(signals["TTC_VALID"])
            demand = BrakeDemand(
                stage,
                STAGES[stage],
                signals["DECELERATION"],
                int(signals["SEQUENCE"]),
                signals["TTC"] if threat else UNSET,
                int(signals["TARGET"]) if threat else UNSET,
            )
            yield TimedMessage(t_ns, "/function", demand)
        case "BRAKE_STATUS":
            stage, fallback = int(signals["STAGE_APPLIED"]), int(signals["FALLBACK"])
            actual_ms2, demanded_ms2 = signals["DECELERATION_ACTUAL"], signals["DECELERATION_DEMANDED"]
            names = STAGES[stage], FALLBACKS[fallback]
            brake = BrakeState(stage, names[0], fallback, names[1], actual_ms2, demanded_ms2)
            yield TimedMessage(t_ns, "/brake", brake)
        case _:
            return


def _ego(speed_ms: float | None, acceleration_ms2: float | UnsetType = UNSET) -> EgoMotion:
    if speed_ms is None:
        return EgoMotion(acceleration_ms2=acceleration_ms2)
    return EgoMotion(round(speed_ms, 6), round(speed_ms * 3.6, 6), acceleration_ms2)


def _lead(
    gap_m: float, relative_ms: float, ego_ms: float | None, lateral_m: float | UnsetType = UNSET
) -> LeadTarget:
    return LeadTarget(
        in_sight=True,
        gap_m=gap_m,
        relative_speed_ms=relative_ms,
        speed_ms=UNSET if ego_ms is None else round(ego_ms + relative_ms, 6),
        lateral_offset_m=lateral_m,
        ttc_s=round(-gap_m / relative_ms, 6) if relative_ms < 0 else UNSET,
    )


def _request(request: AebInput) -> Iterator[TimedMessage]:
    """The car and its target in a request of a replay, whose frames only its map can decode."""
    t_ns = request.t_ms * 1_000_000
    ego_ms = request.ego_speed_ms if request.ego_valid else None
    yield TimedMessage(t_ns, "/ego", _ego(ego_ms))
    nearest = min(request.targets, key=lambda target: target.range_m, default=None)
    lead = LeadTarget(False) if nearest is None else _lead(nearest.range_m, nearest.rel_speed_ms, ego_ms)
    yield TimedMessage(t_ns, "/lead", lead)
