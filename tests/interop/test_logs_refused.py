"""A file that is no log, or a torn one, is one clear error; no file is written."""

import re
import resource
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.interop import logs
from aftbed.interop.logs import READERS, SKIP_BAD, WRITERS, CanLog, LoggedFrame, convert
from aftbed.vehicle.can.python_can import can

FRAMES: Final = tuple(LoggedFrame(1000 * n, "can0", 0x100 + n % 64, bytes(8)) for n in range(200))
WITH_FILES: Final = (HealthCheck.function_scoped_fixture, HealthCheck.too_slow)
MF4: Final = CanLog(FRAMES[:20])


def refusal(source: Path, sink: Path, **options: str) -> str:
    """How `convert` refuses; `sink` is not there afterwards, nor anything else that is new."""
    before = sorted(source.parent.iterdir())
    with pytest.raises(ConfigError) as refused:
        convert(source, sink, **options)  # type: ignore[arg-type]
    assert sorted(source.parent.iterdir()) == before
    return str(refused.value)


def made(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


ASC_HEAD: Final = "date Thu Jan 01 00:00:00.0 1970\nbase hex  timestamps absolute\ninternal events logged\n"
TRC_HEAD: Final = ";$FILEVERSION=2.1\n;$STARTTIME=25569.0\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.log", "", "a.log: the file is empty"),
        ("a.log", "(1.000000) can0 130#01\nhello\n", "a.log: line 2: not a candump line: 'hello', expected"),
        ("a.log", "(1.000000) can0 130#01", "no frame in it, read as candump (1 times torn last line)"),
        ("a.asc", "hello\n", "a.asc: no frame in it, read as asc"),
        ("a.asc", ASC_HEAD + " 0.1 1  123  Rx  d 8 01 02\n", "a.asc: line 4: a frame of 8 bytes with 2"),
        ("a.asc", ASC_HEAD + " 0.1 1  123  Rx  d 2 01 XY\n", "a.asc: line 4: cannot be read"),
        ("a.asc", ASC_HEAD + " 0.1 1  923  Rx  d 1 01\n", "a.asc: line 4: CAN id 0x923, allowed is"),
        (
            "a.asc",
            ASC_HEAD.replace("absolute", "relative") + " 0.1 1  123  Rx  d 1 01\n",
            "a.asc: its times count from frame to frame; `timestamps absolute` is allowed",
        ),
        ("a.trc", "hello\n", "a.trc: line 1: cannot be read: TRCReader: Failed to parse message 'hello'"),
        ("a.trc", TRC_HEAD + "1 0.1 DT 1 0130 Rx - 8 01 02\n", "a.trc: line 4: a frame of 8 bytes with 2"),
        ("a.trc", TRC_HEAD + "1 0.1 DT 1 0130 Rx\n", "a.trc: line 4: cannot be read: TRCReader: Failed"),
        ("a.trc", TRC_HEAD + "1 -5 DT 1 0130 Rx - 0\n", "a.trc: line 4: time -0.005000 s, allowed is"),
        ("a.blf", b"LOGG", "a.blf: not a BLF: it does not begin with a header and its LOGG"),
        ("a.blf", b"hello" * 100, "a.blf: not a BLF"),
        ("a.mf4", b"hello" * 100, "a.mf4: not an MF4: it does not begin with MDF"),
        ("a.mf4", b"MDF     4.10    " + bytes(50), "a.mf4: not an MF4 that can be read"),
    ],
)
def test_a_malformed_log_is_refused_with_file_and_position(
    name: str, content: bytes | str, reason: str, tmp_path: Path
) -> None:
    assert reason in refusal(made(tmp_path / name, content), tmp_path / "out.log2", to_format="candump")


@pytest.mark.parametrize(
    ("source", "sink", "options", "reason"),
    [
        ("a.txt", "b.asc", {}, "a.txt: the ending '.txt' says no format; --from does (one of: asc, blf, can"),
        (
            "a",
            "b.asc",
            {},
            "a: a name without an ending says no format; --from does (one of: asc, blf, candu",
        ),
        ("a.csv", "b.asc", {}, "a.csv: cannot be read: No such file or directory"),
        (
            "a.log",
            "b",
            {},
            "b: a name without an ending says no format; --to does (one of: asc, blf, candump, csv",
        ),
        (
            "a.log",
            "b",
            {"to_format": "acs"},
            "unknown format of --to 'acs'; did you mean 'csv'? (one of",
        ),
        ("a.log", "b.asc", {"from_format": "xls"}, "unknown format of --from 'xls'"),
        (
            "a.log",
            "b.asc",
            {"dbc": "x.dbc"},
            "--dbc says what is in the frames, which only csv asks: asc keeps",
        ),
        ("a.log", "b.csv", {"dbc": "x.dbc"}, "x.dbc: cannot be read: No such file or directory"),
        ("a.log", "a.log", {}, "a.log: would be written over itself"),
        ("no.log", "b.asc", {}, "no.log: cannot be read: No such file or directory"),
        ("a.log", "no/b.asc", {}, "no/b.asc: cannot be written: No such file or directory"),
        ("a.log", "a.log/b.asc", {}, "a.log/b.asc: cannot be written: Not a directory"),
    ],
)
def test_an_impossible_conversion_is_refused(
    source: str,
    sink: str,
    options: dict[str, str],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    made(tmp_path / "a.log", "(1.000000) can0 130#01\n")
    paths = {key: Path(value) if key == "dbc" else value for key, value in options.items()}
    assert reason in refusal(Path(source), Path(sink), **paths)  # type: ignore[arg-type]


def test_an_error_keeps_the_previous_file(tmp_path: Path) -> None:
    sink = made(tmp_path / "out.asc", "of yesterday")
    refusal(made(tmp_path / "a.log", "hello\n"), sink)
    assert sink.read_text() == "of yesterday"


@contextmanager
def small_disk() -> Iterator[None]:
    """No file can have more than 100 bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", ["candump", "asc", "blf", "trc", "csv"])
def test_a_full_disk_leaves_no_partial_file(name: str, tmp_path: Path) -> None:
    source = made(tmp_path / "a.log", "(1.000000) can0 120#1B10413600000000\n" * 20)
    with small_disk():
        said = refusal(source, tmp_path / "out", to_format=name)
    assert said == f"{tmp_path}/out: cannot be written: File too large"


# -- torn and malformed binary files ---------------------------------------------------------------


def blf(tmp_path: Path) -> bytes:
    WRITERS["blf"](CanLog(FRAMES), tmp_path / "whole.blf")
    return (tmp_path / "whole.blf").read_bytes()


def test_a_blf_that_is_cut_off_anywhere_is_torn(tmp_path: Path) -> None:
    whole = blf(tmp_path)
    for length in range(1, len(whole) - 3):  # the last bytes may be padding
        path = made(tmp_path / "torn.blf", whole[:length])
        with pytest.raises(ConfigError, match=r"torn|not a BLF"):
            READERS["blf"](path)


def test_a_blf_whose_header_was_never_completed_is_walked_to_where_it_is_torn(tmp_path: Path) -> None:
    whole = bytearray(blf(tmp_path))
    whole[16:24] = (144).to_bytes(8, "little")  # the size of the file, which a logger writes last
    assert READERS["blf"](made(tmp_path / "killed.blf", bytes(whole))).frames == FRAMES
    path = made(tmp_path / "torn.blf", bytes(whole[:-40]))
    with pytest.raises(ConfigError, match=r"torn.blf: byte 144: torn: \d+ of the \d+ bytes of an object"):
        READERS["blf"](path)


@pytest.mark.parametrize(("size", "head"), [(0, 16), (8, 16), (48, 60)])
def test_a_blf_object_of_length_0_is_refused(size: int, head: int, tmp_path: Path) -> None:
    inner = struct.pack("<4sHHLL", b"LOBJ", head, 1, size, 1) + bytes(32)
    packed = zlib.compress(inner)
    outer = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(packed), 10)
    outer += struct.pack("<H6xL4x", 2, len(inner)) + packed
    path = made(tmp_path / "a.blf", blf(tmp_path)[:144][:16] + bytes(8) + blf(tmp_path)[24:144] + outer)
    with pytest.raises(
        ConfigError, match=f"unpacked byte 0: an object of {size} bytes with a head of {head}"
    ):
        READERS["blf"](path)


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where programs that are asked put their temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.mark.parametrize("packed", [b"\0\0", pytest.param(b"x\x9c\xff", marks=pytest.mark.deep)])
def test_an_mf4_whose_blocks_cannot_be_unpacked_is_malformed_and_leaves_no_file(
    packed: bytes, tmp_path: Path, temporary: Path
) -> None:
    WRITERS["mf4"](CanLog(FRAMES), tmp_path / "whole.mf4")
    whole = bytearray((tmp_path / "whole.mf4").read_bytes())
    data = whole.index(b"##DZ") + 48  # behind the head of a block of packed data (ASAM MDF 4.1, DZBLOCK)
    whole[data : data + len(packed)] = packed
    with pytest.raises(ConfigError, match=r"a.mf4: not an MF4 that can be read: torn or malformed: "):
        READERS["mf4"](made(tmp_path / "a.mf4", bytes(whole)))
    assert list(temporary.iterdir()) == []


def test_an_mf4_reader_that_exceeds_its_deadline_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """asammdf may follow a wild pointer in a malformed file; here the deadline is 1 ms."""
    limits = msgspec.structs.replace(logs.MF4_LIMITS, seconds=0.001)
    monkeypatch.setattr(logs, "MF4_LIMITS", limits)
    WRITERS["mf4"](MF4, tmp_path / "a.mf4")
    with pytest.raises(ConfigError, match=r"malformed: its reader takes more than 0\.001 s"):
        READERS["mf4"](tmp_path / "a.mf4")


@pytest.mark.parametrize("name", sorted(READERS.keys() - {"mf4"}))
@settings(suppress_health_check=WITH_FILES, deadline=None)
@given(data=st.data())
def test_any_bytes_give_frames_or_one_error(name: str, data: st.DataObject, tmp_path: Path) -> None:
    answers_any_bytes(name, data, tmp_path)


@pytest.mark.process  # each MF4 is read by a process of its own
@settings(max_examples=settings.default.max_examples // 8, suppress_health_check=WITH_FILES, deadline=None)
@given(data=st.data())
def test_any_bytes_of_an_mf4_give_frames_or_one_error(data: st.DataObject, tmp_path: Path) -> None:
    answers_any_bytes("mf4", data, tmp_path)


def by_frame(log: CanLog, path: Path) -> None:
    """As CSV of python-can."""
    with can.CSVWriter(path) as writer:
        for frame in log.frames:
            writer(can.Message(frame.t_us / 1e6, frame.can_id, False, data=frame.data))


def answers_any_bytes(name: str, data: st.DataObject, tmp_path: Path) -> None:
    whole = tmp_path / f"whole.{name}"
    if not whole.exists():
        {**WRITERS, "csv": by_frame}[name](MF4, whole)
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(content)))
    path = made(tmp_path / "changed", bytes(content[:cut]) + data.draw(st.binary(max_size=20)))
    read = refused = None
    try:
        read = READERS[name](path)
    except ConfigError as error:
        refused = str(error)
        assert refused.startswith(f"{path}: ")
    try:
        skipping = READERS[name](path, skip_bad=True)
    except ConfigError as error:
        assert read is None and SKIP_BAD not in str(error)
    else:
        assert read == skipping if refused is None else skipping.skipped > 0
        if refused is not None:
            assert refused == f"{path}: {skipping.first_skipped}; {SKIP_BAD} leaves out such parts"


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    source = made(tmp_path / "a.log", "(1.000000) can0 130#01\n")
    said = re.escape('MF4 needs asammdf: pip install "aftbed[mf4]"')
    with pytest.raises(ConfigError, match=said):
        convert(source, tmp_path / "a.mf4")
    with pytest.raises(ConfigError, match=said):
        convert(made(tmp_path / "a.mf4", b"MDF     4.10    "), tmp_path / "b.log")
