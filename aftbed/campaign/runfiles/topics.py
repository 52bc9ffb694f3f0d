"""The topics of an MCAP file: a struct for the messages of each, and the JSON schema that is made from it.

What is not known is left out of a message, since a plot knows no null: a field that can be unknown is UNSET
then. The schema of `/log` is called as Foxglove's own, so that its log panel shows it.
"""

from typing import Annotated, Final

import msgspec
from msgspec import UNSET, Meta, UnsetType

Text = Annotated[str, Meta(description="In words.")]
RunMs = Annotated[float, Meta(description="Time of the processes since the launch of the run, in ms.")]


class Ego(msgspec.Struct, frozen=True):
    """Motion of the car, as its wheels measure it. Without a speed, that is not known."""

    speed_ms: float | UnsetType = UNSET
    speed_kmh: float | UnsetType = UNSET
    acceleration_ms2: float | UnsetType = UNSET


class Brake(msgspec.Struct, frozen=True):
    """What the brakes do, and whether they follow a request or their fallback policy."""

    stage: int
    stage_name: str
    fallback: int
    fallback_name: str
    deceleration_ms2: float
    demanded_ms2: float


class Lead(msgspec.Struct, frozen=True):
    """The target in front; without one, only that. Relative speed is negative when closing."""

    in_sight: bool
    gap_m: float | UnsetType = UNSET
    relative_speed_ms: float | UnsetType = UNSET
    speed_ms: float | UnsetType = UNSET
    lateral_offset_m: float | UnsetType = UNSET
    ttc_s: float | UnsetType = UNSET


class Function(msgspec.Struct, frozen=True):
    """What the protected function asks the brakes for; `ttc_s` and `target` with a threat only."""

    stage: int
    stage_name: str
    demand_ms2: float
    sequence: int
    ttc_s: float | UnsetType = UNSET
    target: int | UnsetType = UNSET


class Can(msgspec.Struct, frozen=True):
    """A frame; `name` and `intact` (its CRC fits) where aftbed's DBC says what it is and protects it."""

    id: int
    interface: str
    length: int
    data: Annotated[str, Meta(description="Hexadecimal.")]
    name: str | UnsetType = UNSET
    intact: bool | UnsetType = UNSET


class Ftm(msgspec.Struct, frozen=True):
    """Something that a node noted: what it belongs to, who it was, the event, and what its journal has."""

    kind: str
    node: str
    event: str
    text: Text
    request: int
    detail: int
    run_ms: RunMs


class Stamp(msgspec.Struct, frozen=True):
    """As Foxglove has it."""

    sec: int
    nsec: int


class LogLine(msgspec.Struct, frozen=True):
    """Foxglove's: level 2 is information, 3 a warning."""

    timestamp: Stamp
    level: int
    message: str
    name: str = "aftbed"
    file: str = ""
    line: int = 0


Message = Ego | Brake | Lead | Function | Can | Ftm | LogLine
TOPICS: Final[dict[str, type[Message]]] = {
    "/ego": Ego,
    "/brake": Brake,
    "/lead": Lead,
    "/function": Function,
    "/can": Can,
    "/ftm": Ftm,
    "/ftm/requests": Ftm,
    "/log": LogLine,
}
NAMES: Final[dict[type[Message], str]] = {LogLine: "foxglove.Log"}


def schema_of(kind: type[Message]) -> tuple[str, bytes]:
    """The name and the JSON schema of a kind of message, in one piece: readers do not follow references."""
    _, parts = msgspec.json.schema_components([kind])
    schema = _inlined(parts[kind.__name__], parts)
    return NAMES.get(kind, f"aftbed.{kind.__name__}"), msgspec.json.encode(schema)


def _inlined(schema: object, parts: dict[str, dict[str, object]]) -> object:
    if isinstance(schema, list):
        return [_inlined(one, parts) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if isinstance(name := schema.get("$ref"), str):
        return _inlined(parts[name.rpartition("/")[2]], parts)
    return {key: _inlined(value, parts) for key, value in schema.items()}
