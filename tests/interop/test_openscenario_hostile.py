"""Hostile or broken XML, random changes, expressions that are no arithmetic: scenarios or a ConfigError."""

import math
import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from reartest import rear_test
from xoscfiles import LEAD_BRAKES, SLOW_LEAD, VALUES, imported

from aftbed.core.errors import ConfigError
from aftbed.core.yaml_file import read_yaml
from aftbed.interop.openscenario import document
from aftbed.interop.openscenario.document import parse_tree
from aftbed.interop.openscenario.expression import EXPRESSION_CHARACTERS_MAX, FUNCTIONS, evaluate
from aftbed.interop.openscenario.importer import ImportOptions, import_scenario
from aftbed.vehicle.scenarios.scenario import ScenarioKeys

REAR, ORIGINAL = "rear.xosc", "rear-original.xml"
LAUGHS = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY lol "lol"><!ENTITY lol2 "&lol;&lol;&lol;&lol;&lol;&lol;&lol;&lol;&lol;">]>
<OpenSCENARIO>&lol2;</OpenSCENARIO>"""
OUTSIDE = """<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>
<OpenSCENARIO>&x;</OpenSCENARIO>"""


# -- XML


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (LAUGHS.encode(), "f: line 2: DOCTYPE: not allowed, it may define entities"),
        (OUTSIDE.encode(), "f: line 1: DOCTYPE: not allowed"),
        (b"<a>&x;</a>", "f: line 1: not XML: undefined entity"),
        (b"", "f: line 1: not XML: no element found"),
        (b"<a>\n<b></a>", "f: line 2: not XML: mismatched tag"),
        (b"<a/>\n<b/>", "f: line 2: not XML: junk after document element"),
        (b"<a b='1' b='2'/>", "f: line 1: not XML: duplicate attribute"),
        (b'<?xml version="1.0" encoding="nonsense"?><a/>', "f: line 1: not XML: unknown encoding"),
        (b'<?xml version="1.0" encoding="utf-7"?><a/>', "f: line 1: not XML: "),
        (b"\xff\xfe<\x00a\x00", "not XML"),
        (b"\x00", "not XML"),
        (b"<a>" * 61 + b"</a>" * 61, "f: line 1: a: deeper than the 60 levels that are allowed"),
        (b"<a>" + b"\n<b/>" * 100_000 + b"</a>", "b: more than the 100000 elements that are allowed"),
        (b"<a>" + b" " * 4_000_000 + b"</a>", "f: more than the 4000000 bytes that are allowed"),
    ],
)
def test_hostile_and_broken_xml_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_tree(data, "f")
    assert reason in str(error.value)


def test_the_limits_are_limits_of_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    assert parse_tree(b"<a>" * 60 + b"</a>" * 60, "f").tag == "a"
    monkeypatch.setattr(document, "ELEMENTS_MAX", 3)
    assert len(list(parse_tree(b"<a><b/><b/></a>", "f").walk())) == 3
    with pytest.raises(ConfigError, match="more than the 3 elements"):
        parse_tree(b"<a><b/><b/><b/></a>", "f")


@given(st.binary(max_size=200))
def test_any_bytes(data: bytes) -> None:
    try:
        parse_tree(data, "f")
    except ConfigError as error:
        assert str(error).startswith("f: ")


# -- files that were changed


def import_bytes(folder: Path, name: str, data: bytes) -> None:
    """Import a changed file; what it becomes can be read as a scenario."""
    wanted = ImportOptions(expect="stop")
    if name == SLOW_LEAD.name:
        wanted = ImportOptions(ego="Host")
    path = folder / name
    path.write_bytes(data)
    try:
        if name == VALUES.name:
            found = import_scenario(LEAD_BRAKES, path, wanted)
        else:
            found = import_scenario(path, None, wanted)
    except ConfigError as error:
        assert str(error)
        return
    for one in found.variations[:3]:
        written = folder / "written.yaml"
        written.write_text(one.text)
        read_yaml(written, ScenarioKeys)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("hostile")
    (made / "catalogs").symlink_to(SLOW_LEAD.parent / "catalogs")
    (made / ORIGINAL).write_text(rear_test(made).read_text().replace("><", ">\n<"))
    return made


SOURCES = st.sampled_from([LEAD_BRAKES.name, SLOW_LEAD.name, VALUES.name, REAR])


def content(folder: Path, name: str) -> bytes:
    """The bytes of a source before it is changed."""
    return (folder / ORIGINAL if name == REAR else LEAD_BRAKES.parent / name).read_bytes()


ODD = [
    "",
    "0",
    "-1",
    "1e309",
    "nan",
    "inf",
    "-inf",
    "1e-300",
    "1e300",
    "-0",
    "true",
    "Ego",
    "Lead",
    "Host",
    "$Gap",
] + [
    "${",
    "${}",
    "${1/0}",
    "${$Gap}",
    "$Nobody",
    "é\u2028",
    "x" * 300,
    "1_0",
    "0x1",
    "\N{ARABIC-INDIC DIGIT ONE}",
    "${9**9**9}",
    "../..",
]
ATTRIBUTE = re.compile(r'"([^"<]*)"')


@given(SOURCES, st.data())
def test_any_attribute_may_be_anything(folder: Path, source: str, data: st.DataObject) -> None:
    text = content(folder, source).decode()
    places = list(ATTRIBUTE.finditer(text))[3:]  # behind what XML says of itself
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.sampled_from(places))
        value = data.draw(st.sampled_from(ODD) | st.floats().map(str) | st.integers().map(str))
        text = (
            text.replace(place[0], f'"{value}"', 1) if data.draw(st.booleans()) else _at(text, place, value)
        )
    import_bytes(folder, source, text.encode())


def _at(text: str, place: re.Match[str], value: str) -> str:
    return f'{text[: place.start()]}"{value}"{text[place.end() :]}'


@given(SOURCES, st.data())
def test_any_element_may_be_missing_doubled_or_elsewhere(
    folder: Path, source: str, data: st.DataObject
) -> None:
    lines = content(folder, source).decode().splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        first = data.draw(st.integers(2, len(lines) - 2))
        block = _block(lines, first)
        rest = [line for i, line in enumerate(lines) if i not in block]
        place = data.draw(st.integers(2, max(2, len(rest) - 1)))
        match data.draw(st.sampled_from(["missing", "doubled", "elsewhere"])):
            case "missing":
                lines = rest
            case "doubled":
                lines = lines[: block.stop] + [lines[i] for i in block] + lines[block.stop :]
            case _:
                lines = rest[:place] + [lines[i] for i in block] + rest[place:]
        if len(lines) < 6:
            break
    import_bytes(folder, source, "\n".join(lines).encode())


def _block(lines: list[str], first: int) -> range:
    """The element that begins in a line, by its indentation; one line if none does."""
    line = lines[first]
    indent = len(line) - len(line.lstrip())
    if line.strip().startswith("</") or line.rstrip().endswith("/>"):
        return range(first, first + 1)
    for last in range(first + 1, len(lines)):
        if lines[last].strip().startswith("</") and len(lines[last]) - len(lines[last].lstrip()) == indent:
            return range(first, last + 1)
    return range(first, first + 1)


@given(SOURCES, st.data())
def test_any_bytes_in_a_file(folder: Path, source: str, data: st.DataObject) -> None:
    changed = bytearray(content(folder, source))
    for _ in range(data.draw(st.integers(1, 5))):
        place = data.draw(st.integers(0, len(changed) - 1))
        changed[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    import_bytes(folder, source, bytes(changed))


def test_paths_that_are_none(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere.xosc"):
        with pytest.raises(ConfigError, match="cannot be read"):
            imported(path)


# -- expressions


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 + 2 * 3", 7),
        ("(1 + 2) * 3", 9),
        ("-$a / 4", -2.5),
        ("7 % 4 - +1", 2),
        ("-7 % 4", -3),
        ("round(2.5) + round(-2.5) + round(1.4)", 1),
        ("floor(-0.5) + ceil(0.5)", 0),
        ("sqrt(16) + pow(2, 3) + abs(-1)", 13),
        ("max($a, $ramp_p_0) - min(1, 2)", 9),
        ("sign(-3) + sign(0) + sign(9)", 0),
        ("cos(0) + sin(0) + tan(0) + acos(1) + asin(0) + atan(0)", 1),
        (".5e1 + 5. + 1E0", 11),
        ("$a*$a", 100),
        ("180*2*pi/180", 2 * math.pi),
    ],
)
def test_arithmetic(text: str, value: float) -> None:
    assert evaluate(text, {"a": "10", "ramp_p_0": "3"}) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("not $no", True),
        ("$no or not $no and true", True),
        ("not ($no or true)", False),
        ("false", False),
    ],
)
def test_truth(text: str, value: bool) -> None:
    assert evaluate(text, {"no": "false"}) is value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("__import__('os').system('true')", "allowed are numbers"),
        ("().__class__", "allowed are numbers"),
        ("(lambda: 1)()", "allowed are numbers"),
        ("[1]", "allowed are numbers"),
        ("'1'", "allowed are numbers"),
        ("1 if 1 else 2", "IfExp is no arithmetic"),
        ("1 and 2", "and takes true or false, found 1"),
        ("true or $a", "or takes true or false, found 10"),
        ("not 1", "not takes true or false, found 1"),
        ("~1", "allowed are numbers"),
        ("true + 1", "found true, allowed is a number"),
        ("max($yes, 1)", "found true, allowed is a number"),
        ("pie", "the name 'pie'"),
        ("1, 2", "Tuple is no arithmetic"),
        ("True", "Constant is no arithmetic"),
        ("max(*(1, 2))", "Starred is no arithmetic"),
        ("9**9", "the operator Pow is none of"),
        ("9//2", "the operator FloorDiv is none of"),
        ("a", "the name 'a': a parameter is written $a"),
        ("eval(1)", "unknown function 'eval'"),
        ("sqrt(1)(2)", "Call is no arithmetic"),
        ("sqrt", "the name 'sqrt'"),
        ("sqrt(1, 2)", "sqrt takes 1 arguments, found 2"),
        ("max(1)", "max takes 2 arguments, found 1"),
        ("$b", "unknown parameter 'b'"),
        ("$text", "$text is 'fast', allowed is a number"),
        ("1 / (2 - 2)", "division by zero"),
        ("1 % 0", "division by zero"),
        ("sqrt(-1)", "outside of the function's domain"),
        ("acos(2)", "outside of the function's domain"),
        ("pow(-8, 0.5)", "outside of the function's domain"),
        ("pow(10, 400)", "the result is too large"),
        ("1e308 * 10", "the result is not a finite number"),
        ("floor(1e308 * 10)", "the result is too large"),
        ("0x10", "allowed are numbers"),
        ("1_000", "allowed are numbers"),
        ("1j", "allowed are numbers"),
        ("0or 1", "allowed are numbers"),
        ("007", "not understood as arithmetic"),
        ("(1", "not understood as arithmetic"),
        ("", "not understood as arithmetic"),
        ("1 2", "not understood as arithmetic"),
        ("(" * 500 + "1" + ")" * 500, "1001 characters, allowed are 1000"),
        ("\n1", "allowed are numbers"),
        ("é0", "allowed are numbers"),
    ],
)
def test_an_expression_that_is_no_arithmetic_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        evaluate(text, {"a": "10", "text": "fast", "yes": "true"})
    assert reason in str(error.value)


WORDS = st.sampled_from(
    [
        "1",
        "0",
        "pi",
        "true",
        " and ",
        " or ",
        "2.5",
        "1e300",
        "$a",
        "$b",
        "+",
        "-",
        "*",
        "/",
        "%",
        "(",
        ")",
        ",",
        "**",
        " ",
        "if",
        "lambda",
    ]
    + ["not", "in", ":=", "await", "print", "é", "\x00", *FUNCTIONS]
)


@given(st.text(max_size=EXPRESSION_CHARACTERS_MAX + 1) | st.lists(WORDS, max_size=60).map("".join))
@example("-" * 999 + "1")
@example("not " * 249 + "true")
@example("(" * 499 + "1" + ")" * 499)
@example("1" * 1_000)
def test_any_expression_is_a_finite_number_or_refused(text: str) -> None:
    try:
        found = evaluate(text, {"a": "1.5"})
    except ConfigError:
        return
    assert math.isfinite(found)


PLAIN = st.recursive(
    st.integers(0, 99).map(str) | st.sampled_from(["$a", "0.5"]),
    lambda inner: st.tuples(inner, st.sampled_from("+-*"), inner).map(
        lambda one: f"({one[0]} {one[1]} {one[2]})"
    ),
    max_leaves=8,
)


@given(PLAIN)
def test_arithmetic_is_that_of_python(text: str) -> None:
    assert evaluate(text, {"a": "3.25"}) == eval(text.replace("$a", "3.25"))
