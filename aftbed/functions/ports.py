"""The ports of a model: which bytes of a request and of a reply mean which variables of an FMU.

`ports.yaml` is written by the user; `PortsFile` is its shape, key by key:

    request          the fields of a request in order, little-endian, without gaps: a `type`, and one of
        variable     an input, or a parameter that may be changed between steps (tunable)
        time         the time of the request, in this unit: the step is the difference to the request before
        step         the step, in this unit
        skip         true: the bytes mean nothing to the model
    reply            the fields of a reply: `type`, `variable` (an output); `min`, `max`: what is acceptable
    step_s           the step of each request, in s; with a field `time` that of the first request
    start            values of variables before the first step
    characteristics  what the function declares, where that is not what the FMU says of itself

`bind` checks the map against the variables of the FMU: what binds cannot fail later, except by what a request
or an output holds.
"""

import difflib
import struct
from collections.abc import Iterable, Mapping, Sequence
from math import inf, isfinite
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.application import (
    CODES,
    EXACT,
    NONE,
    Characteristics,
    Field,
    Width,
    WrittenAccess,
    access_of,
)
from aftbed.core.errors import ConfigError, FileKeyError, PeerError
from aftbed.core.yaml_file import in_file

Unit = Literal["s", "ms", "us", "ns"]
Value = bool | int | float
Kind = Literal["real", "integer", "boolean", "text", "array", "other"]

FIELDS_MAX: Final = 1000  # so that a reply of them fits into a packet
STEP_S_MAX: Final = 3600.0  # a request that asks for more is refused: the replica would hang
NAMES_SHOWN_MAX: Final = 20

_FLOATS: Final = ("f32", "f64")
_INTEGERS: Final = ("u8", "u16", "u32", "u64", "i8", "i16", "i32", "i64")
_TO_MODEL: Final[
    Mapping[Kind, tuple[str, ...]]
] = {  # types of a request's field, by the kind of the variable
    "real": _FLOATS + _INTEGERS,
    "integer": _INTEGERS,
    "boolean": ("bool",),
}
_FROM_MODEL: Final[Mapping[Kind, tuple[str, ...]]] = {**_TO_MODEL, "real": _FLOATS}
_START: Final[Mapping[Kind, str]] = {
    "real": "a finite number",
    "integer": "a whole number",
    "boolean": "true or false",
    "text": "a text",
}
_PER_SECOND: Final[Mapping[Unit, int]] = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}

StepSeconds = Annotated[float, Meta(gt=0, le=STEP_S_MAX)]


# -- the file -------------------------------------------------------------------------------------


class RequestField(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A field of a request."""

    type: Width  # how it is packed
    variable: str | None = None  # of the FMU that it sets
    time: Unit | None = None  # it is the time of the request, in this unit
    step: Unit | None = None  # it is the length of the step, in this unit
    skip: bool = False  # it means nothing to the FMU


class ReplyField(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A field of a reply; `min` and `max` are allowed values."""

    type: Width  # how it is packed
    variable: str  # of the FMU that it is read from
    min: float | None = None  # a lower value is not acceptable
    max: float | None = None  # a higher value is not acceptable


class DeclaredCharacteristics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`state_access` None: as the FMU says."""

    deterministic: bool = True  # the same requests give the same replies
    state_access: WrittenAccess | None = None  # exact, none, {approximate: NUMBER}; left out: as the FMU says


class PortsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    reply: tuple[ReplyField, ...]  # its fields, in their order
    request: tuple[RequestField, ...] = ()  # its fields, in their order
    step_s: StepSeconds | None = None  # where no field has it
    start: dict[object, object] = {}  # a name may look like a number
    characteristics: DeclaredCharacteristics = DeclaredCharacteristics()  # what the function declares


# -- the model ------------------------------------------------------------------------------------


class Variable(msgspec.Struct, frozen=True):
    """A variable of the model, as its description has it.

    `type`: in the words of FMI. `role`: for messages. `low`, `high`: what the type can hold. `settable`:
    between steps. `startable`: before the first step.
    """

    name: str
    reference: int
    type: str
    kind: Kind
    role: str
    low: float = -inf
    high: float = inf
    settable: bool = False
    startable: bool = False
    output: bool = False


class Inputs(msgspec.Struct, frozen=True):
    """What a request means. `values`: in the order of `Ports.inputs`. `time`: its field, packed, or empty."""

    values: list[Value]
    step_s: float
    time: bytes


class Ports:
    """A map that was checked against its model; made by `bind`.

    `inputs` and `outputs` are the variables in the order of the fields.
    """

    def __init__(
        self,
        file: PortsFile,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        start: Sequence[tuple[Variable, Value | str]],
        characteristics: Characteristics,
    ) -> None:
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self.start, self.characteristics = tuple(start), characteristics
        self._request = struct.Struct("<" + "".join(map(_code, file.request)))
        self._reply = struct.Struct("<" + "".join(CODES[one.type] for one in file.reply))
        self._fields = tuple(one for one in file.request if not one.skip)
        self._reply_types = tuple(one.type for one in file.reply)
        self._ranges = tuple(
            (-inf if f.min is None else f.min, inf if f.max is None else f.max) for f in file.reply
        )
        self._judges = any(f.min is not None or f.max is not None for f in file.reply)
        self._step_s = file.step_s
        clock = next((one for one in file.request if one.time), None)
        self._clock = None if clock is None else struct.Struct("<" + CODES[clock.type])
        offsets = [
            struct.calcsize("<" + "".join(CODES[t] for t in self._reply_types[:n]))
            for n in range(len(outputs))
        ]
        self.reply_fields = tuple(
            Field(one.variable, one.type, offset) for one, offset in zip(file.reply, offsets, strict=True)
        )

    def read_request(self, request: bytes, time_before: bytes) -> Inputs:
        """Raises PeerError where a request has another length, or a value that the model cannot take.

        `time_before`: `Inputs.time` of the request before, empty for the first one.
        """
        if len(request) != self._request.size:
            raise PeerError(f"a request of {len(request)} bytes, {self._request.size} are required")
        step_s, time = self._step_s, b""
        values: list[Value] = []
        for field, value in zip(self._fields, self._request.unpack(request), strict=True):
            if not isfinite(value):
                raise PeerError(f"{field.variable or 'time'}: found {value}, a finite number is required")
            if field.time:
                assert self._clock is not None
                time = self._clock.pack(value)
                if time_before:
                    step_s = (value - self._clock.unpack(time_before)[0]) / _PER_SECOND[field.time]
            elif field.step:
                step_s = value / _PER_SECOND[field.step]
            else:
                values.append(_to_model(self.inputs[len(values)], value))
        assert step_s is not None
        if not 0 < step_s <= STEP_S_MAX:
            raise PeerError(f"a step of {step_s:g} s, allowed is more than 0 and at most {STEP_S_MAX:g} s")
        return Inputs(values, step_s, time)

    def is_time(self, packed: bytes) -> bool:
        """Whether it can be `Inputs.time`: empty, or a time."""
        if not packed:
            return True
        return (
            self._clock is not None
            and len(packed) == self._clock.size
            and isfinite(self._clock.unpack(packed)[0])
        )

    def write_reply(self, values: Sequence[Value]) -> bytes:
        """Of the values of `outputs`. Raises ValueError where one is not finite or does not fit."""
        for variable, kind, value in zip(self.outputs, self._reply_types, values, strict=True):
            if not isfinite(value):
                raise ValueError(f"output {variable.name}: found {value}, a finite number is required")
            try:
                struct.pack("<" + CODES[kind], value)
            except (struct.error, OverflowError):
                raise ValueError(f"output {variable.name}: {value} does not fit into {kind}") from None
        return self._reply.pack(*values)

    def acceptable(self, reply: bytes) -> bool:
        """Whether each value is in its range; with no ranges, any reply is."""
        if not self._judges:
            return True
        if len(reply) != self._reply.size:
            return False
        values = self._reply.unpack(reply)
        return all(low <= value <= high for value, (low, high) in zip(values, self._ranges, strict=True))


def _code(field: RequestField) -> str:
    code = CODES[field.type]
    return f"{struct.calcsize('<' + code)}x" if field.skip else code


def _to_model(variable: Variable, value: Value) -> Value:
    if variable.kind == "boolean":
        if value not in (0, 1):
            raise PeerError(f"{variable.name}: found {value}, allowed are 0 and 1")
        return bool(value)
    if not variable.low <= value <= variable.high:
        raise PeerError(f"{variable.name}: {value} does not fit into {variable.type}")
    return float(value) if variable.kind == "real" else value


# -- the checks -----------------------------------------------------------------------------------


def bind(path: Path, file: PortsFile, model: Path, variables: Iterable[Variable], has_state: bool) -> Ports:
    """Check the map `file`, read from `path`, against the variables of `model`.

    `has_state`: whether the FMU says that its state can be captured. Raises ConfigError.
    """
    with in_file(path):
        return _Binding(file, model, {one.name: one for one in variables}).bound(has_state)


class _Binding:
    """Each error names the key, what was found and what is allowed."""

    def __init__(self, file: PortsFile, model: Path, variables: Mapping[str, Variable]) -> None:
        self._file, self._model, self._variables = file, model, variables

    def bound(self, has_state: bool) -> Ports:
        self._check_lengths()
        self._check_step()
        inputs = [
            self._input(f"request[{number}]", field)
            for number, field in enumerate(self._file.request)
            if self._meaning(f"request[{number}]", field) == "variable"
        ]
        outputs = [self._output(f"reply[{number}]", field) for number, field in enumerate(self._file.reply)]
        for key, found in (("request", inputs), ("reply", outputs)):
            names = [one.name for one in found]
            if double := next((name for name in names if names.count(name) > 1), None):
                raise self._error(key, f"{double!r} more than once", "a variable once")
        start = [self._started(str(name), value) for name, value in self._file.start.items()]
        return Ports(self._file, inputs, outputs, start, self._characteristics(has_state))

    def _check_lengths(self) -> None:
        for key, found, least in (
            ("request", len(self._file.request), 0),
            ("reply", len(self._file.reply), 1),
        ):
            if not least <= found <= FIELDS_MAX:
                raise self._error(key, f"{found} fields", f"{least} to {FIELDS_MAX}")

    def _meaning(self, key: str, field: RequestField) -> str:
        given = [word for word in ("variable", "time", "step", "skip") if getattr(field, word)]
        if len(given) != 1:
            raise self._error(key, " and ".join(given) or "none", "one of variable, time, step and skip")
        return given[0]

    def _check_step(self) -> None:
        fields = list(enumerate(self._file.request))
        clocks = [(number, word) for number, one in fields for word in ("time", "step") if getattr(one, word)]
        if len(clocks) > 1:
            raise self._error("request", f"{len(clocks)} fields with time or step", "one")
        for number, word in clocks:
            if self._file.request[number].type == "bool":
                raise self._error(
                    f"request[{number}].type", "bool", f"for {word}: {_words(_TO_MODEL['real'])}"
                )
        from_request = [word for _, word in clocks] == ["step"]
        if from_request == (self._file.step_s is not None):
            allowed = (
                "none beside a field with step"
                if from_request
                else "a step in s, of the first request at least"
            )
            raise self._error("step_s", f"{self._file.step_s or 'none'}", allowed)

    def _input(self, key: str, field: RequestField) -> Variable:
        wanted = "an input or a tunable parameter"
        names = [one.name for one in self._variables.values() if one.settable]
        variable = self._named(f"{key}.variable", field.variable or "", wanted, names)
        self._check_type(key, field.type, variable, _TO_MODEL)
        return variable

    def _output(self, key: str, field: ReplyField) -> Variable:
        names = [one.name for one in self._variables.values() if one.output]
        variable = self._named(f"{key}.variable", field.variable, "an output", names)
        self._check_type(key, field.type, variable, _FROM_MODEL)
        low, high = (-inf if field.min is None else field.min), (inf if field.max is None else field.max)
        if not low <= high or not (low < inf and high > -inf):
            raise self._error(f"{key}.min and max", f"{field.min} and {field.max}", "a range")
        return variable

    def _started(self, name: str, value: object) -> tuple[Variable, Value | str]:
        names = [one.name for one in self._variables.values() if one.startable]
        variable = self._named("start", name, "a parameter or another variable with a start value", names)
        key = f"start.{name}"
        match value:
            case bool():
                if variable.kind == "boolean":
                    return variable, value
            case str():
                if variable.kind == "text":
                    return variable, value
            case int() if variable.kind == "integer" and variable.low <= value <= variable.high:
                return variable, value
            case int() | float() if variable.kind == "real" and _holds(variable, value):
                return variable, float(value)
        allowed = _START.get(variable.kind, "no value")
        raise self._error(key, repr(value), f"{allowed}, for {variable.type}")

    def _characteristics(self, has_state: bool) -> Characteristics:
        declared = self._file.characteristics
        access = EXACT if has_state else NONE
        if declared.state_access is not None:
            try:
                access = access_of(declared.state_access)
            except ConfigError as error:
                raise FileKeyError("characteristics.state_access", error) from None
        return Characteristics(deterministic=declared.deterministic, state_access=access)

    def _named(self, key: str, name: str, wanted: str, names: Sequence[str]) -> Variable:
        variable = self._variables.get(name)
        if variable is not None and name in names:
            return variable
        role = f", which is {_with_article(variable.role)}" if variable is not None else ""
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else ""
        more = f", and {len(names) - NAMES_SHOWN_MAX} more" if len(names) > NAMES_SHOWN_MAX else ""
        shown = ", ".join(sorted(names)[:NAMES_SHOWN_MAX]) or "none"
        allowed = f"{wanted} of {self._model.name} ({shown}{more}){hint}"
        raise self._error(key, f"{name!r}{role}", allowed)

    def _check_type(
        self, key: str, found: str, variable: Variable, allowed: Mapping[Kind, tuple[str, ...]]
    ) -> None:
        types = allowed.get(variable.kind, ())
        if found not in types:
            what = (
                f"{variable.name}, which is {variable.type}{', an array' if variable.kind == 'array' else ''}"
            )
            raise self._error(f"{key}.type", found, f"{_words(types) or 'none'} for {what}")

    def _error(self, key: str, found: str, allowed: str) -> ConfigError:
        return FileKeyError(key, f"found {found}, allowed is {allowed}")


def _holds(variable: Variable, value: float) -> bool:
    try:
        return isfinite(float(value)) and variable.low <= value <= variable.high
    except OverflowError:
        return False


def _with_article(role: str) -> str:
    return f"{'an' if role[0] in 'aeiou' else 'a'} {role}"


def _words(types: Iterable[str]) -> str:
    return ", ".join(types)
