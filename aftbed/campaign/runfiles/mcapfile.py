"""A run as MCAP, which Foxglove opens without a plugin: JSON messages, with their JSON schemas in the file.

| topic | of | from |
|---|---|---|
| `/ego` | the car: speed, acceleration | EGO_STATE; in a replay, what the function was told |
| `/brake` | the brake ECU: what it follows and does | BRAKE_STATUS |
| `/lead` | the target in front: gap, speeds, time to collision | RADAR_TRACK; in a replay, the nearest one |
| `/function` | what the function asks for | AEB_REQ |
| `/can` | every frame on the bus | the bus log |
| `/ftm` | faults, failures, recovery, adaptations | the journals |
| `/ftm/requests` | the events on the path of requests | the journals |
| `/log` | what people were told | `events.jsonl` |

Nothing in a frame is believed before its E2E protection is checked, here as on the bus: a frame whose CRC
is wrong is on `/can`, with `intact` false, and makes no other message. The true state of the car is not on
the bus, so not here.

All times are on one axis, see `axis`; `run_ms`, where there is one, is the time of the processes. The extra
`mcap` brings the library.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
from msgspec import UNSET

from aftbed.campaign.runfiles.axis import Axis, asked_in
from aftbed.campaign.runfiles.happened import Kind, journals, kind_of, told_in, words_of
from aftbed.campaign.runfiles.topics import (
    TOPICS,
    Brake,
    Can,
    Ego,
    Ftm,
    Function,
    Lead,
    LogLine,
    Message,
    Stamp,
    schema_of,
)
from aftbed.core.errors import ConfigError, PeerError
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix.options import CarRun, ReplayRun
from aftbed.vehicle.aeb.messages import AebInput
from aftbed.vehicle.can.candump import LogCounts, LogFrame, parse_lines
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.e2e import intact
from aftbed.vehicle.can.python_can import lean

BUS_NAME: Final = "bus.log"
STAGES: Final = ("NONE", "WARN", "PARTIAL", "FULL")
FALLBACKS: Final = ("NONE", "HOLD", "RELEASE", "LATCH")
INFORMATION, WARNING = 2, 3  # levels of `/log`
ALARM: Final = "alarm"  # what is told with a warning


class Timed(NamedTuple):
    """A message on a topic, and when it was, by the axis."""

    t_ns: int
    topic: str
    message: Message


def write(record: RunRecord, path: Path) -> int:
    """All messages of `record`, by time; how many. Raises ConfigError without the extra, or OSError."""
    needed()
    from mcap.writer import Writer  # noqa: PLC0415 - an extra

    messages = sorted(messages_of(record), key=lambda one: one.t_ns)
    encode = msgspec.json.Encoder().encode
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="aftbed")
        channels = {}
        for topic, kind in TOPICS.items():
            name, schema = schema_of(kind)
            channels[topic] = writer.register_channel(
                topic, "json", writer.register_schema(name, "jsonschema", schema)
            )
        for number, (t_ns, topic, message) in enumerate(messages):
            writer.add_message(channels[topic], t_ns, encode(message), t_ns, number)
        options = record.options
        about = {"ftm": options.ftm, "placement": options.placement, "seed": str(options.seed)}
        writer.add_metadata("aftbed", about)
        writer.finish()  # type: ignore[no-untyped-call]  # the library says no type here
    return len(messages)


def needed() -> None:
    """Raises ConfigError without the extra."""
    try:
        import mcap  # noqa: F401, PLC0415
    except ImportError:
        raise ConfigError('MCAP needs the library mcap: pip install "aftbed[mcap]"') from None


def messages_of(record: RunRecord) -> Iterator[Timed]:
    """Everything, in the order of its sources."""
    axis, work = Axis(record), record.options.work
    if isinstance(work, CarRun | ReplayRun):
        lean()
        yield from _bus(record.path / BUS_NAME, load_dbc(), own=isinstance(work, CarRun))
    if isinstance(work, ReplayRun):
        for _, request in asked_in(record):
            yield from _told_to_the_function(request)
    for node, _, records in journals(record):
        for one in records:
            kind = kind_of(one)
            topic = "/ftm/requests" if kind is Kind.REQUEST else "/ftm"
            run_ms = (one.t_ns - record.started_ns) / 1e6
            text = words_of(one, record)
            noted = Ftm(kind.value, node, str(one.event), text, one.request_id, one.detail, run_ms)
            yield Timed(axis.at(one.t_ns), topic, noted)
    for told in told_in(record):
        t_ns = axis.at(told.t_ns)
        level = WARNING if told.event == ALARM else INFORMATION
        line = LogLine(Stamp(t_ns // 10**9, t_ns % 10**9), level, f"{told.event}: {told.text}")
        yield Timed(t_ns, "/log", line)


# -- the bus --------------------------------------------------------------------------------------


def _bus(path: Path, codec: Codec, *, own: bool) -> Iterator[Timed]:
    """The frames. On a bus of others only what the gateway sends is ours to read."""
    readable = set(codec.names()) if own else set(codec.sent_by("gateway"))
    names = {codec.can_id(name): name for name in codec.names() if name in readable}
    data_ids = {name: _data_id(codec, name) for name in readable}
    ego_ms: float | None = None
    for frame in _logged(path):
        t_ns, can_id, data = frame.frame.t_us * 1000, frame.frame.can_id, frame.frame.data
        name = names.get(can_id)
        data_id = data_ids[name] if name is not None else None
        whole = None if data_id is None else intact(data, data_id)
        yield Timed(
            t_ns,
            "/can",
            Can(
                can_id,
                frame.interface,
                len(data),
                data.hex().upper(),
                UNSET if name is None else name,
                UNSET if whole is None else whole,
            ),
        )
        if name is None or not whole:
            continue
        try:
            signals = codec.decode(name, data)
        except PeerError:
            continue
        if name == "EGO_STATE":
            ego_ms = signals["SPEED"] if signals["SPEED_VALID"] else None
        yield from _decoded(t_ns, name, signals, ego_ms)


def _logged(path: Path) -> Iterator[LogFrame]:
    """What is whole in the log of the bus; there is none, if the run did not come so far."""
    content = path.read_bytes() if path.exists() else b""
    return parse_lines(io.BytesIO(content), LogCounts())


def _data_id(codec: Codec, name: str) -> int | None:
    try:
        return codec.data_id(name)
    except ConfigError:
        return None


def _decoded(t_ns: int, name: str, signals: dict[str, float], ego_ms: float | None) -> Iterator[Timed]:
    match name:
        case "EGO_STATE":
            yield Timed(t_ns, "/ego", _ego(ego_ms, signals["ACCELERATION"]))
        case "RADAR_TRACK":
            if signals["VALID"]:
                lead = _lead(signals["RANGE"], signals["RELATIVE_SPEED"], ego_ms, signals["LATERAL_OFFSET"])
            else:
                lead = Lead(False)
            yield Timed(t_ns, "/lead", lead)
        case "AEB_REQ":
            yield Timed(t_ns, "/function", _function(signals))
        case "BRAKE_STATUS":
            yield Timed(t_ns, "/brake", _brake(signals))
        case _:
            return


def _rounded(value: float) -> float:
    return round(value, 6)


def _ego(speed_ms: float | None, acceleration_ms2: float | None = None) -> Ego:
    acceleration = UNSET if acceleration_ms2 is None else acceleration_ms2
    if speed_ms is None:
        return Ego(acceleration_ms2=acceleration)
    return Ego(_rounded(speed_ms), _rounded(speed_ms * 3.6), acceleration)


def _lead(gap_m: float, relative_ms: float, ego_ms: float | None, lateral_m: float | None = None) -> Lead:
    return Lead(
        in_sight=True,
        gap_m=gap_m,
        relative_speed_ms=relative_ms,
        speed_ms=UNSET if ego_ms is None else _rounded(ego_ms + relative_ms),
        lateral_offset_m=UNSET if lateral_m is None else lateral_m,
        ttc_s=_rounded(-gap_m / relative_ms) if relative_ms < 0 else UNSET,
    )


def _function(signals: dict[str, float]) -> Function:
    stage, threat = int(signals["STAGE"]), bool(signals["TTC_VALID"])
    return Function(
        stage,
        STAGES[stage],
        signals["DECELERATION"],
        int(signals["SEQUENCE"]),
        signals["TTC"] if threat else UNSET,
        int(signals["TARGET"]) if threat else UNSET,
    )


def _brake(signals: dict[str, float]) -> Brake:
    stage, fallback = int(signals["STAGE_APPLIED"]), int(signals["FALLBACK"])
    return Brake(
        stage,
        STAGES[stage],
        fallback,
        FALLBACKS[fallback],
        signals["DECELERATION_ACTUAL"],
        signals["DECELERATION_DEMANDED"],
    )


def _told_to_the_function(request: AebInput) -> Iterator[Timed]:
    """In a replay, whose frames only its map can read."""
    t_ns = request.t_ms * 1_000_000
    ego_ms = request.ego_speed_ms if request.ego_valid else None
    yield Timed(t_ns, "/ego", _ego(ego_ms))
    nearest = min(request.targets, key=lambda target: target.range_m, default=None)
    lead = Lead(False) if nearest is None else _lead(nearest.range_m, nearest.rel_speed_ms, ego_ms)
    yield Timed(t_ns, "/lead", lead)
