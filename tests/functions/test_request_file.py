"""Files of requests and of expected replies: what they hold, and what each error tells its author."""

import json
import math
import os
import struct
from pathlib import Path
from types import ModuleType
from typing import Final

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.functions import request_file
from aftbed.functions.load import NO_CODE, OWN_CODE, Code
from aftbed.functions.request_file import (
    REQUEST_BYTES_MAX,
    ExpectedReplies,
    FieldCodec,
    RequestList,
    generated,
    names_function,
    read_replies,
    read_requests,
)

RADAR: Final = "t_us:u64,distance:f64,flag:u8"
CODEC: Final = FieldCodec.parse(RADAR)
TYPES: Final = ("u8", "u16", "u32", "u64", "i8", "i16", "i32", "i64", "f32", "f64", "bool")
PACKED: Final = struct.Struct("<QdB")


def values_of(kind: str) -> st.SearchStrategy[object]:
    if kind == "bool":
        return st.booleans()
    if kind[0] == "f":
        return st.floats(width=int(kind[1:]), allow_nan=False, allow_infinity=False)  # type: ignore[arg-type]
    bits = int(kind[1:])
    least = 0 if kind[0] == "u" else -(2 ** (bits - 1))
    return st.integers(least, least + 2**bits - 1)


@st.composite
def coded(draw: st.DrawFn) -> tuple[FieldCodec, list[dict[str, object]]]:
    """A codec, and some values of it."""
    kinds = draw(st.lists(st.sampled_from(TYPES), min_size=1, max_size=6))
    names = [f"v{number}.x[{number}]" for number in range(len(kinds))]
    codec = FieldCodec.parse(",".join(f"{n}:{k}" for n, k in zip(names, kinds, strict=True)))
    row = st.fixed_dictionaries({n: values_of(k) for n, k in zip(names, kinds, strict=True)})
    return codec, draw(st.lists(row, min_size=1, max_size=3))


def file(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "requests"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


# -- the codec


@given(coded())
def test_a_codec_gives_back_what_it_was_given(case: tuple[FieldCodec, list[dict[str, object]]]) -> None:
    codec, rows = case
    for row in rows:
        data = codec.encode(row)
        assert len(data) == codec.size_bytes
        assert codec.decode(data) == row
    assert FieldCodec.parse(str(codec)) == codec


def test_fields_are_little_endian_without_padding() -> None:
    data = CODEC.encode({"flag": 2, "t_us": 1, "distance": 1.5})
    assert data == b"\x01\0\0\0\0\0\0\0" + struct.pack("<d", 1.5) + b"\x02"


@pytest.mark.parametrize("kind", TYPES)
def test_each_type_has_its_size_and_its_limits(kind: str) -> None:
    codec = FieldCodec.parse(f"x:{kind}")
    assert codec.size_bytes == (1 if kind == "bool" else int(kind[1:]) // 8)
    wrong: list[object] = ["1", None, math.nan, math.inf, 10**400, [1]]
    if kind == "bool":
        wrong += [1, 0.0]
    elif kind[0] == "f":
        wrong += [True, 10**309] + ([1e39] if kind == "f32" else [])
    else:
        bits = int(kind[1:])
        wrong += [True, 1.0, -1 if kind[0] == "u" else -(2 ** (bits - 1)) - 1]
        wrong += [2**bits if kind[0] == "u" else 2 ** (bits - 1)]
    for value in wrong:
        with pytest.raises(ConfigError, match=r"^column x: found .+, allowed is "):
            codec.encode({"x": value})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "column 1: found '', NAME:TYPE is allowed, as t_us:u64"),
        ("a:u8,b", "column 2: found 'b', NAME:TYPE is allowed"),
        ("a:u8;b:u8", "column 1, a: unknown type 'u8;b:u8'"),
        ("a:u9", "column 1, a: unknown type 'u9'; did you mean 'u8'? (one of: bool, f32, "),
        ("a:u8,b:u8,a:f64", "column 3: a is there already; each name is allowed once"),
        ("9a:u8", "column 1: found '9a:u8', NAME:TYPE is allowed"),
        (",".join(f"a{n}:u64" for n in range(8000)), "columns of 64000 bytes, allowed are 61440"),
    ],
)
def test_what_is_no_codec_is_told(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as found:
        FieldCodec.parse(text)
    assert words in str(found.value)


@given(st.text(max_size=40) | st.text(":,abu816f32 []._-", max_size=40))
def test_any_text_is_a_codec_or_an_error_of_the_user(text: str) -> None:
    try:
        codec = FieldCodec.parse(text)
    except ConfigError:
        return
    assert FieldCodec.parse(str(codec)) == codec


# -- files


def rows_of(*rows: tuple[int, float, int]) -> tuple[bytes, ...]:
    return tuple(PACKED.pack(*row) for row in rows)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (f"{RADAR}\n1,2.5,3\n2,-.5e1,4\n", RequestList(rows_of((1, 2.5, 3), (2, -5.0, 4)), CODEC)),
        ('\ufeff"t_us:u64", distance:f64 ,flag:u8\r\n"1",2,3\r\n', RequestList(rows_of((1, 2, 3)), CODEC)),
        ("a:bool,b:i8\nTrue,-1\n0,+7\n", RequestList((b"\1\xff", b"\0\7"), FieldCodec.parse("a:bool,b:i8"))),
        ('hex\n00ff\n""\n', RequestList((b"\0\xff", b""))),
        (
            f'{{"codec": "{RADAR}"}}\n{{"flag": 3, "t_us": 1, "distance": 2}}\n{{"hex": ""}}\n',
            RequestList((*rows_of((1, 2.0, 3)), b""), CODEC),
        ),
        ('{"hex": "00 FF"}\n{"text": "h\u00e9"}\r\n', RequestList((b"\0\xff", b"h\xc3\xa9"))),
        ('{"codec": "hex:u8"}\n{"hex": 7}\n', RequestList((b"\7",), FieldCodec.parse("hex:u8"))),
    ],
    ids=["csv", "csv of a spreadsheet", "bool", "csv of hex", "json", "json of bytes", "a field called hex"],
)
def test_a_file_of_requests_is_read(tmp_path: Path, text: str, found: RequestList) -> None:
    assert read_requests(file(tmp_path, text)) == found


@given(coded())
def test_both_formats_hold_the_same(
    tmp_path_factory: pytest.TempPathFactory, case: tuple[FieldCodec, list[dict[str, object]]]
) -> None:
    codec, rows = case
    path = tmp_path_factory.getbasetemp() / "both"
    path.write_text(
        f"{codec}\n" + "".join(",".join(str(row[name]) for name, _ in codec.fields) + "\n" for row in rows)
    )
    of_csv = read_requests(path)
    path.write_text("".join(json.dumps(one) + "\n" for one in ({"codec": str(codec)}, *rows)))
    assert of_csv == read_requests(path) == RequestList(tuple(map(codec.encode, rows)), codec)


BAD_FILES: Final = {
    "empty": ("", "empty; a header and a line for each request are required"),
    "header alone": (f"{RADAR}\n", "a header, and no request below it; at least one is required"),
    "json header alone": (f'{{"codec": "{RADAR}"}}\n', "a header, and no request below it"),
    "torn": (f"{RADAR}\n1,2,3\n1,2,", "line 3: cut off: found '1,2,' without a newline behind it"),
    "torn, and whole by chance": (f"{RADAR}\n1,2,3", "line 2: cut off: found '1,2,3' without a newline"),
    "torn json": ('{"hex": "00"}\n{"hex": ', "line 2: cut off"),
    "too few columns": (f"{RADAR}\n1,2,3\n1,2\n", "line 3: 2 columns, allowed are 3: t_us, distance, flag"),
    "too many columns": (f"{RADAR}\n1,2,3,4\n", "line 2: 4 columns, allowed are 3: t_us, distance, flag"),
    "unknown column": (
        f'{{"codec": "{RADAR}"}}\n{{"t_us": 1, "distance": 1, "flag": 1, "speed": 1}}\n',
        "line 2: unknown column 'speed'; allowed are t_us, distance, flag",
    ),
    "missing column": (
        f'{{"codec": "{RADAR}"}}\n{{"t_us": 1, "flag": 1}}\n',
        "line 2: column distance is missing; required are t_us, distance, flag",
    ),
    "range": (f"{RADAR}\n1,2,3\n1,2,300\n", "line 3: column flag: found 300, allowed is 0 to 255 (u8)"),
    "no integer": (
        f"{RADAR}\n1_0,2,3\n",
        "line 2: column t_us: found '1_0', allowed is 0 to 1844674407370955161",
    ),
    "nan": (f"{RADAR}\n1,nan,3\n", "line 2: column distance: found 'nan', allowed is a finite number (f64)"),
    "too large": (f"{RADAR}\n1,1e999,3\n", "line 2: column distance: found inf, allowed is a finite number"),
    "json nan": ('{"codec": "x:f64"}\n{"x": NaN}\n', "line 2: found NaN, a finite number is allowed"),
    "no bool": ("a:bool\nyes\n", "line 2: column a: found 'yes', allowed is true, false, 1 or 0"),
    "json bool": (
        '{"codec": "a:u8"}\n{"a": true}\n',
        "line 2: column a: found True, allowed is 0 to 255 (u8)",
    ),
    "header": ("t_us:u64,distance\n1,2\n", "line 1: column 2: found 'distance', NAME:TYPE is allowed"),
    "type": ("t_us:u65\n1\n", "line 1: column 1, t_us: unknown type 'u65'"),
    "blank line": (f"{RADAR}\n1,2,3\n\n", "line 3: empty; no line may be"),
    "quote": (f'{RADAR}\n1,2,"3\n', "line 2: not CSV: "),
    "hex": ("hex\n0g\n", "line 2: column hex: found '0g', allowed is pairs of hexadecimal digits"),
    "json hex": ('{"hex": 7}\n', "line 1: column hex: found 7, allowed is a text"),
    "surrogate": (
        '{"text": "\\ud800"}\n',
        "line 1: column text: found '\\ud800', allowed is a text of whole",
    ),
    "no codec": (
        '{"t_us": 1}\n',
        'line 1: found the keys \'t_us\', allowed is {"hex": "..."} or {"text": "..."}; others need'
        ' {"codec": "name:type,..."} in line 1',
    ),
    "codec, later": ('{"hex": ""}\n{"codec": "x:u8"}\n', "line 2: found the keys 'codec', allowed is"),
    "codec of no text": ('{"codec": 7}\n', "line 1: codec: found 7, a text is allowed"),
    "tolerance of requests": (
        '{"codec": "x:u8", "tolerance": 1}\n',
        "line 1: unknown key 'tolerance' beside codec",
    ),
    "twice": (
        '{"codec": "x:u8"}\n{"x": 1, "x": 2}\n',
        "line 2: key 'x' is there twice; each is allowed once",
    ),
    "no json": ('{"hex": "00"}\n{"hex" 1}\n', "line 2: column 8: not JSON: Expecting ':' delimiter"),
    "no object": ('{"hex": "00"}\n[1]\n', "line 2: found [1], a JSON object is allowed"),
    "digits": ('{"codec": "x:u8"}\n{"x": ' + "9" * 5000 + "}\n", "line 2: not JSON: Exceeds the limit"),
    "deep": ('{"hex": ' + "[" * 100_000 + "\n", "line 1: not JSON: maximum recursion"),
    "no UTF-8": (b"hex\n00\n\xff\n", "line 3: not UTF-8: byte 0xff"),
    "too long": (
        f"hex\n{'00' * (REQUEST_BYTES_MAX + 1)}\n",
        "line 2: a request of 61441 bytes, allowed are 61440",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_what_is_wrong_in_a_file_is_told_with_its_line(tmp_path: Path, case: str) -> None:
    text, words = BAD_FILES[case]
    path = file(tmp_path, text)
    with pytest.raises(ConfigError) as found:
        read_requests(path)
    assert str(found.value).startswith(f"{path}: {words}")


def test_no_more_requests_than_are_allowed_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_file, "REQUESTS_MAX", 3)
    assert len(read_requests(file(tmp_path, "hex\n" + "00\n" * 3)).requests) == 3
    with pytest.raises(ConfigError, match="4 lines with a request, allowed are 3"):
        read_requests(file(tmp_path, "hex\n" + "00\n" * 4))
    monkeypatch.setattr(request_file, "FILE_BYTES_MAX", 20)
    with pytest.raises(ConfigError, match="24 bytes in all, allowed are 20"):
        read_requests(file(tmp_path, "a:u64,b:u32\n1,2\n2,3\n"[:12] + "1,2\n3,4\n"))


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="pipe: cannot be read: not a regular file"):
        read_requests(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="gone: cannot be read: No such file"):
        read_requests(tmp_path / "gone")


LINES: Final = st.sampled_from(
    (RADAR, "hex", "1,2,3", "00", "", '""', '{"codec": "x:f32"}', '{"x": 1}', '{"hex": "00"}', "{", "\ufeff")
)


@given(
    st.lists(LINES | st.text(max_size=20), max_size=5).map("\n".join).map(str.encode) | st.binary(max_size=60)
)
@example(b"\xef\xbb\xbf")
def test_any_bytes_are_a_file_or_an_error_of_the_user(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(data)
    for read in (read_requests, read_replies):
        try:
            read(path)
        except ConfigError as error:
            assert str(error).startswith(f"{path}: ")


# -- expected replies


def test_a_tolerance_is_that_of_the_file_or_of_the_caller(tmp_path: Path) -> None:
    header = '{"codec": "x:f32", "tolerance": 1e-3}\n{"x": 1}\n'
    one = (struct.pack("<f", 1.0),)
    assert read_replies(file(tmp_path, header)) == ExpectedReplies(one, "x:f32", 1e-3)
    assert read_replies(file(tmp_path, "x:f32\n1\n")) == ExpectedReplies(one, "x:f32", 0.0)
    assert read_replies(file(tmp_path, "x:f32\n1\n"), 0.5) == ExpectedReplies(one, "x:f32", 0.5)
    for text, given_, words in (
        (header, 0.5, "line 1 has a tolerance: leave out --tolerance"),
        ("hex\n00\n", 0.5, "has no codec, so --tolerance is about no number"),
        ("x:f32\n1\n", -1.0, "--tolerance: found -1.0, allowed is a finite number from 0 on"),
        (header.replace("1e-3", '"small"'), None, "line 1: tolerance: found 'small', allowed is a finite"),
        (header.replace("1e-3", "1e999"), None, "line 1: tolerance: found inf, allowed is a finite"),
    ):
        with pytest.raises(ConfigError) as found:
            read_replies(file(tmp_path, text), given_)
        assert words in str(found.value)


def test_the_first_difference_is_named() -> None:
    right = PACKED.pack(7, 1.5, 2)
    expected = ExpectedReplies((right, b"", b"ab"), RADAR, 0.25)
    assert expected.difference(1, right) == expected.difference(1, PACKED.pack(7, 1.75, 2)) == ""
    assert (
        expected.difference(1, PACKED.pack(7, 1.0, 3))
        == "request 1: distance: found 1.0, expected 1.5 (tolerance 0.25)"
    )
    assert expected.difference(1, PACKED.pack(8, 1.0, 3)) == "request 1: t_us: found 8, expected 7"
    assert (
        expected.difference(1, PACKED.pack(7, math.nan, 2))
        == "request 1: distance: found nan, expected 1.5 (tolerance 0.25)"
    )
    assert expected.difference(1, b"") == (
        "request 1: found an empty reply (the request was refused), expected 17 bytes"
    )
    assert expected.difference(2, b"") == ""
    assert expected.difference(3, b"ac") == "request 3: byte 1: found 0x63, expected 0x62"


def test_without_a_tolerance_a_number_differs_in_its_last_digit() -> None:
    third, next_one = 1 / 3, math.nextafter(1 / 3, 1)
    expected = ExpectedReplies((struct.pack("<d", third),), "x:f64")
    assert expected.difference(1, struct.pack("<d", third)) == ""
    assert expected.difference(1, struct.pack("<d", next_one)).startswith("request 1: x: found 0.333")


# -- functions that make requests


GENERATORS: Final = """
def count(seed):
    n = seed
    while True:
        yield b"%d" % n
        n += 1

def few(seed):
    return [b"a", b"b"]

def texts(seed):
    yield b"a"
    yield "b"

def long(seed):
    yield bytes(70000)

def breaks(seed):
    yield b"a"
    raise ValueError("no more fuel")

def leaves(seed):
    raise SystemExit(0)

def no_iterator(seed):
    return 7

number = 7
"""


def test_a_function_makes_as_many_requests_as_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(GENERATORS)
    assert generated(f"{path}:count", 3, 41, OWN_CODE) == [b"41", b"42", b"43"]
    assert generated(f"{path}:few", 2, 0, OWN_CODE) == [b"a", b"b"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("few", "ended after 2 requests, 3 are asked for (--count)"),
        ("texts", "request 2: found 'b', bytes are required"),
        ("long", "request 1: a request of 70000 bytes, allowed are 61440"),
        ("breaks", "raised ValueError: no more fuel"),
        ("leaves", "raised SystemExit: 0"),
        ("no_iterator", "raised TypeError: 'int' object is not iterable"),
        ("number", "has no function number"),
        ("gone", "has no function gone"),
    ],
)
def test_what_a_function_does_wrong_is_told(tmp_path: Path, name: str, words: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(GENERATORS)
    with pytest.raises(ConfigError) as found:
        generated(f"{path}:{name}", 3, 0, OWN_CODE)
    assert str(found.value).startswith(f"{path}:{name}: ") and str(found.value).endswith(words)


def test_a_module_that_cannot_be_imported_is_told(tmp_path: Path) -> None:
    class Broken(Code):
        def module(self, place: str) -> ModuleType:
            raise SystemExit(f"{place} ends it")

    with pytest.raises(ConfigError, match="m:f: cannot be imported: SystemExit: m ends it"):
        generated("m:f", 1, 0, Broken())
    with pytest.raises(ConfigError, match="m: no code from outside of the package is executed here"):
        generated("m:f", 1, 0, NO_CODE)
    with pytest.raises(ConfigError, match=r"gone\.py: no such file"):
        generated(f"{tmp_path}/gone.py:f", 1, 0, OWN_CODE)


def test_a_source_is_a_function_if_it_reads_like_one_and_is_no_file(tmp_path: Path) -> None:
    path = tmp_path / "odd:name"
    path.touch()
    assert [names_function(one) for one in ("m.n:f", "a.py:f", "a.csv", "C:\\a.csv", str(path))] == [
        True, True, False, False, False,
    ]  # fmt: skip
