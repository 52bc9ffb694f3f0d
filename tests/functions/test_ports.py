"""The map of a model's ports: what it refuses, and the bytes that it reads and writes."""

import re
import struct
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aftbed.core.application import Characteristics, Field, approximate
from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.yaml_file import read_yaml
from aftbed.functions.ports import FIELDS_MAX, Kind, Ports, PortsFile, Variable, bind

MODEL: Final = Path("car.fmu")
CODES: Final = dict(
    zip(
        ("u8", "u16", "u32", "u64", "i8", "i16", "i32", "i64", "f32", "f64", "bool"),
        "BHIQbhiqfd?",
        strict=True,
    )
)
INT32: Final = (-(2**31), 2**31 - 1)


def variable(name: str, of_type: str, kind: Kind, role: str) -> Variable:
    low, high = INT32 if kind == "integer" else (float("-inf"), float("inf"))
    tunable, inward = "tunable" in role, role.endswith("input")
    startable = inward or role.endswith("parameter")
    return Variable(
        name, 0, of_type, kind, role, low, high, inward or tunable, startable, role.endswith("output")
    )


VARIABLES: Final = (
    variable("speed", "Real", "real", "continuous input"),
    variable("gear", "Integer", "integer", "discrete input"),
    variable("enabled", "Boolean", "boolean", "discrete input"),
    variable("row", "Float64", "array", "continuous input"),
    variable("gain", "Real", "real", "tunable parameter"),
    variable("mass", "Real", "real", "fixed parameter"),
    variable("road", "String", "text", "fixed parameter"),
    variable("brake", "Real", "real", "continuous output"),
    variable("state", "Integer", "integer", "discrete output"),
    variable("active", "Boolean", "boolean", "discrete output"),
)
GOOD: Final = """\
request:
- {type: f64, variable: speed}
- {type: i32, variable: gear}
reply:
- {type: f64, variable: brake}
step_s: 0.01
"""
INPUTS: Final = "an input or a tunable parameter of car.fmu (enabled, gain, gear, row, speed)"
OUTPUTS: Final = "an output of car.fmu (active, brake, state)"
STARTS: Final = (
    "a parameter or another variable with a start value of car.fmu"
    " (enabled, gain, gear, mass, road, row, speed)"
)
NUMBERS: Final = "f32, f64, u8, u16, u32, u64, i8, i16, i32, i64"


def bound(path: Path, text: str, has_state: bool = True) -> Ports:
    path.write_text(text)
    return bind(path, read_yaml(path, PortsFile), MODEL, VARIABLES, has_state)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        # the shape of the file, by its line
        ("", "key 'reply' is missing"),
        (GOOD + "stop_s: 1\n", "unknown key 'stop_s'; did you mean 'step_s'?"),
        (
            GOOD.replace("variable: gear", "varable: gear"),
            "request[1]: unknown key 'varable'; did you",
        ),
        (
            GOOD.replace("i32", "int"),
            "request[1].type: found 'int', allowed is one of bool, f32, f64, i16,",
        ),
        (
            GOOD.replace("0.01", "0"),
            "step_s: found 0, allowed is a number more than 0 and at most 3600",
        ),
        (GOOD.replace("0.01", ".nan"), "step_s: found nan, allowed is a number more than 0"),
        (GOOD.replace("0.01", ".inf"), "step_s: found inf, allowed is a number more than 0"),
        (GOOD.replace("0.01", "-1"), "step_s: found -1, allowed is a number more than 0"),
        (
            GOOD + "characteristics: {state_access: some}\n",
            "characteristics.state_access: found 'some', allowed is",
        ),
        (
            GOOD + "characteristics: {state_access: {approximate: 0}}\n",
            "characteristics.state_access.approximate: found 0, allowed is a number more than 0",
        ),
        (
            GOOD + "characteristics: {state_access: {approximate: .inf}}\n",
            "characteristics.state_access: approximate(inf): a tolerance is more than 0 and finite",
        ),
        # the ports, against the FMU
        (
            GOOD.replace("variable: speed", "variable: sped"),
            f"request[0].variable: found 'sped', allowed is {INPUTS}; did you mean 'speed'?",
        ),
        (
            GOOD.replace("variable: speed", "variable: mass"),
            f"request[0].variable: found 'mass', which is a fixed parameter, allowed is {INPUTS}",
        ),
        (
            GOOD.replace("variable: brake", "variable: speed"),
            f"reply[0].variable: found 'speed', which is a continuous input, allowed is {OUTPUTS}",
        ),
        (
            GOOD.replace("type: i32", "type: f32"),
            "request[1].type: found f32, allowed is u8, u16, u32, u64, i8, i16, i32, i64 for gear, which is"
            " Integer",
        ),
        (
            GOOD.replace("type: f64, variable: speed", "type: bool, variable: speed"),
            f"request[0].type: found bool, allowed is {NUMBERS} for speed, which is Real",
        ),
        (
            GOOD.replace("type: f64, variable: speed", "type: u8, variable: enabled"),
            "request[0].type: found u8, allowed is bool for enabled, which is Boolean",
        ),
        (
            GOOD.replace("variable: speed", "variable: row"),
            "request[0].type: found f64, allowed is none for row, which is Float64, an array",
        ),
        (
            GOOD.replace("type: f64, variable: brake", "type: u8, variable: brake"),
            "reply[0].type: found u8, allowed is f32, f64 for brake, which is Real",
        ),
        (
            GOOD.replace("variable: gear", "skip: false"),
            "request[1]: found none, allowed is one of variable,",
        ),
        (
            GOOD.replace("variable: gear", "variable: gear, time: ms"),
            "request[1]: found variable and time, allowed is one of variable, time, step and skip",
        ),
        (
            GOOD.replace("i32, variable: gear", "f64, variable: speed"),
            "request: found 'speed' more than once, allowed is a variable once",
        ),
        ("step_s: 1\nreply: []\n", "reply: found 0 fields, allowed is 1 to 1000"),
        (
            "step_s: 1\nreply:\n" + "- {type: f64, variable: brake}\n" * (FIELDS_MAX + 1),
            "reply: found 1001 fields, allowed is 1 to 1000",
        ),
        # the step
        (
            GOOD.replace("step_s: 0.01\n", ""),
            "step_s: found none, allowed is a step in s, of the first request at least",
        ),
        (
            GOOD.replace("variable: gear", "step: ms"),
            "step_s: found 0.01, allowed is none beside a field with step",
        ),
        (
            GOOD.replace("variable: gear", "step: ms").replace("variable: speed", "time: ms"),
            "request: found 2 fields with time or step, allowed is one",
        ),
        (
            GOOD.replace("i32, variable: gear", "bool, time: ms"),
            f"request[1].type: found bool, allowed is for time: {NUMBERS}",
        ),
        # the values at the start
        (GOOD + "start: {mas: 1}\n", f"start: found 'mas', allowed is {STARTS}; did you mean 'mass'?"),
        (GOOD + "start: {1: 2}\n", f"start: found '1', allowed is {STARTS}"),
        (GOOD + "start: [1]\n", "start: found [1], allowed is keys and values"),
        (GOOD + "start: {mass: heavy}\n", "start.mass: found 'heavy', allowed is a finite number, for Real"),
        (GOOD + "start: {mass: true}\n", "start.mass: found True, allowed is a finite number, for Real"),
        (GOOD + "start: {mass: .nan}\n", "start.mass: found nan, allowed is a finite number, for Real"),
        (GOOD + f"start: {{mass: 1{'0' * 400}}}\n", "start.mass: found 1000"),
        (GOOD + "start: {gear: 1.5}\n", "start.gear: found 1.5, allowed is a whole number, for Integer"),
        (GOOD + "start: {gear: 3000000000}\n", "start.gear: found 3000000000, allowed is a whole number"),
        (GOOD + "start: {enabled: 1}\n", "start.enabled: found 1, allowed is true or false, for Boolean"),
        (GOOD + "start: {road: 1}\n", "start.road: found 1, allowed is a text, for String"),
        (GOOD + "start: {row: [1]}\n", "start.row: found [1], allowed is no value, for Float64"),
        # what is acceptable
        (
            GOOD.replace("variable: brake", "variable: brake, min: 1, max: 0"),
            "reply[0].min and max: found 1.0 and 0.0, allowed is a range",
        ),
        (
            GOOD.replace("variable: brake", "variable: brake, min: .nan"),
            "reply[0].min and max: found nan and",
        ),
        (
            GOOD.replace("variable: brake", "variable: brake, min: .inf"),
            "reply[0].min and max: found inf and",
        ),
    ],
)
def test_a_map_is_refused(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "ports.yaml"
    with pytest.raises(ConfigError) as caught:
        bound(path, text)
    place = re.match(f"{re.escape(str(path))}: line [0-9]+, column [0-9]+: ", str(caught.value))
    assert place is not None and str(caught.value).startswith(why, place.end()), caught.value


def test_a_model_with_many_ports_is_not_listed_as_a_whole(tmp_path: Path) -> None:
    many = [variable(f"u{number:02}", "Real", "real", "input") for number in range(50)]
    path = tmp_path / "ports.yaml"
    path.write_text(GOOD)
    with pytest.raises(ConfigError, match=r"\(u00, u01, .*, u19, and 30 more\)$"):
        bind(path, read_yaml(path, PortsFile), MODEL, many, True)


def test_the_example_of_the_page_is_a_map(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "functions.md").read_text()
    of_a_car, example = re.findall(r"```yaml\n(request:.*?)```", page, re.DOTALL)
    path = tmp_path / "ports.yaml"
    path.write_text(of_a_car)
    fields = [port.type for port in read_yaml(path, PortsFile).request]
    assert fields == ["u8", "u64", "f64", "u8", "u8", "u8", "f64", "f64"], "the fixed layout of a radar cycle"
    path.write_text(example)
    mode = variable("mode", "Integer", "integer", "discrete output")
    ports = bind(path, read_yaml(path, PortsFile), MODEL, [*VARIABLES, mode], True)
    assert ports.read_request(struct.pack("<IdBH", 7, 25.0, 1, 0), b"").values == [25.0, True]
    assert ports.characteristics == Characteristics(state_access=approximate(1e-9))
    reply = ports.write_reply([1.5, 2])
    assert reply == struct.pack("<fB", 1.5, 2) and not ports.acceptable(reply)


VALUES: Final = {
    **{f"u{bits}": st.integers(0, 2**bits - 1) for bits in (8, 16, 32)},
    **{f"i{bits}": st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32)},
    "f32": st.floats(width=32, allow_nan=False, allow_infinity=False),
    "f64": st.floats(allow_nan=False, allow_infinity=False),
    "bool": st.booleans(),
}
TYPE_OF: Final = {"speed": ("f32", "f64", "u16", "i32"), "gear": ("i8", "u16", "i32"), "enabled": ("bool",)}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_request_is_read_as_it_is_packed(tmp_path: Path, data: st.DataObject) -> None:
    names = data.draw(st.permutations(list(TYPE_OF)))
    types = [data.draw(st.sampled_from(TYPE_OF[name])) for name in names]
    values = [data.draw(VALUES[one]) for one in types]
    text = "".join(f"- {{type: {t}, variable: {n}}}\n" for t, n in zip(types, names, strict=True))
    rest = "step_s: 1\nreply: [{type: f64, variable: brake}]\nrequest:\n"
    ports = bound(tmp_path / "ports.yaml", rest + text)
    packed = struct.pack("<" + "".join(CODES[one] for one in types), *values)
    read = ports.read_request(packed, b"")
    assert [one.name for one in ports.inputs] == names
    assert (read.values, read.step_s) == (values, 1.0)
    with pytest.raises(PeerError):
        ports.read_request(packed + b"\0", b"")


@pytest.fixture(scope="module")
def timed(tmp_path_factory: pytest.TempPathFactory) -> Ports:
    path = tmp_path_factory.mktemp("ports") / "ports.yaml"
    return bound(path, GOOD.replace("i32, variable: gear", "f32, time: ms"))


@given(request=st.binary(min_size=12, max_size=12), before=st.just(b"") | st.binary(min_size=4, max_size=4))
def test_whatever_a_request_holds_is_read_or_refused(timed: Ports, request: bytes, before: bytes) -> None:
    """What is read is a step that a model can take, and a time that the next request can refer to."""
    if not timed.is_time(before):
        return
    try:
        read = timed.read_request(request, before)
    except PeerError:
        return
    assert 0 < read.step_s <= 3600
    assert timed.is_time(read.time) and read.time == request[8:]
    assert read.values == list(struct.unpack("<d", request[:8]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_reply_is_packed_as_its_fields_say(tmp_path: Path, data: st.DataObject) -> None:
    types = {
        "brake": data.draw(st.sampled_from(["f32", "f64"])),
        "state": data.draw(st.sampled_from(["u8", "i16", "u32", "i64"])),
        "active": "bool",
    }
    names = data.draw(st.permutations(list(types)))
    text = "".join(f"- {{type: {types[name]}, variable: {name}}}\n" for name in names)
    ports = bound(tmp_path / "ports.yaml", f"step_s: 1\nreply:\n{text}")
    whole = {"brake": 0.5, "state": data.draw(st.integers(0, 127)), "active": data.draw(st.booleans())}
    reply = ports.write_reply([whole[name] for name in names])
    for field in ports.reply_fields:
        assert field == Field(field.name, types[field.name], field.offset_bytes)  # type: ignore[arg-type]
        (found,) = struct.unpack_from("<" + CODES[field.kind], reply, field.offset_bytes)
        assert found == whole[field.name]
    assert [field.name for field in ports.reply_fields] == names
