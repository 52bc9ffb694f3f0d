"""A log survives the way through every format, except for what the format lacks."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import msgspec
import pytest
from buslog import read_log
from hypothesis import HealthCheck, assume, given, settings
from loggedframes import LOGS, NOW_US
from sampling import sampled

from aftbed.core.errors import ConfigError, PeerError
from aftbed.interop import logs
from aftbed.interop.logs import (
    READERS,
    WRITERS,
    CanLog,
    FdFlags,
    FrameKind,
    LoggedFrame,
    channels_of,
    convert,
)
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.python_can import with_asammdf

REAL_LOG: Final = Path(__file__).resolve().parents[3] / "shared" / "data" / "rav4_following_50kmh.log"
KEPT_IN_FIXTURE: Final = (HealthCheck.function_scoped_fixture, HealthCheck.too_slow)
FORMATS: Final = ("candump", "asc", "blf", "trc", "mf4")
FEW: Final = settings.default.max_examples // 8  # of what takes half a second
ZONES: Final = ("America/New_York", "Asia/Kolkata", "Pacific/Auckland")
DATES_US: Final = (0, 5_123_456, NOW_US + 5_001)
# python-can has seconds as floats. A time is rounded four times on its way through a BLF: until 2038 by less
# than half a microsecond in all; later, if the log spans decades, by more.
BLF_EXACT_US_MAX: Final = 2**31 * 1_000_000 - 1
Frames = tuple[LoggedFrame, ...]
EIGHT: Final = LoggedFrame(1_000_002, "can0", 0x130, bytes.fromhex("0102030405060708"))


def without_direction(frames: Frames) -> Frames:
    return tuple(msgspec.structs.replace(frame, sent=False) for frame in frames)


def without_errors_content(frames: Frames) -> Frames:
    def bare(frame: LoggedFrame) -> LoggedFrame:
        if frame.kind is not FrameKind.ERROR:
            return frame
        return LoggedFrame(frame.t_us, frame.interface, 0, extended=True, kind=FrameKind.ERROR)

    return tuple(bare(frame) for frame in frames)


def data_only(frames: Frames) -> Frames:
    return tuple(frame for frame in frames if frame.kind is FrameKind.DATA)


def by_time(frames: Frames) -> Frames:
    order = (FrameKind.DATA, FrameKind.ERROR, FrameKind.REMOTE)
    return tuple(sorted(frames, key=lambda frame: (frame.t_us, order.index(frame.kind))))


COMES_BACK: Final[dict[str, Callable[[Frames], Frames]]] = {
    "candump": without_direction,
    "asc": without_errors_content,
    "blf": lambda frames: frames,
    "trc": data_only,
    "mf4": by_time,
}


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "mf4"])
@settings(suppress_health_check=KEPT_IN_FIXTURE, deadline=None)
@given(frames=LOGS)
def test_every_frame_comes_back_to_the_microsecond(name: str, frames: Frames, tmp_path: Path) -> None:
    assume(name != "blf" or max(frame.t_us for frame in frames) <= BLF_EXACT_US_MAX)
    comes_back(name, frames, tmp_path)


@pytest.mark.process  # each MF4 is read by a process of its own
@settings(max_examples=FEW, suppress_health_check=KEPT_IN_FIXTURE, deadline=None)
@given(frames=LOGS)
def test_every_frame_of_an_mf4_comes_back_too(frames: Frames, tmp_path: Path) -> None:
    comes_back("mf4", frames, tmp_path)


def comes_back(name: str, frames: Frames, tmp_path: Path) -> None:
    path = tmp_path / "there"
    WRITERS[name](CanLog(frames), path)
    assert READERS[name](path).frames == COMES_BACK[name](frames)


@pytest.fixture
def set_zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    def to(name: str) -> None:
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield to
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    ("name", "zone", "t_us"),
    [
        *sampled([name for name in FORMATS if name != "mf4"], ZONES, DATES_US),
        pytest.param("mf4", ZONES[1], DATES_US[1], marks=pytest.mark.process),  # as above
        *(pytest.param("mf4", ZONES[n], DATES_US[n], marks=pytest.mark.deep) for n in (0, 2)),
    ],
)
def test_a_log_of_any_zone_comes_back(
    name: str, t_us: int, zone: str, tmp_path: Path, set_zone: Callable[[str], None]
) -> None:
    set_zone(zone)
    frames = (LoggedFrame(t_us, "can0", 0x123, b"\x01"), LoggedFrame(t_us + 1, "can0", 0x124, b""))
    WRITERS[name](CanLog(frames), tmp_path / "there")
    assert READERS[name](tmp_path / "there").frames == frames


def test_a_log_without_a_date_has_none_in_another_zone(
    tmp_path: Path, set_zone: Callable[[str], None]
) -> None:
    frames = (LoggedFrame(1_500_000, "can0", 0x123, b"\x01"),)
    WRITERS["asc"](CanLog(frames), tmp_path / "there")
    set_zone("Pacific/Auckland")
    assert READERS["asc"](tmp_path / "there").frames == frames


def test_interfaces_keep_their_numbers_and_names_get_free_ones() -> None:
    def seen(*names: str) -> dict[str, int]:
        return channels_of(LoggedFrame(0, name, 1) for name in names)

    assert seen("can3", "can0") == {"can3": 3, "can0": 0}
    assert seen("vcan0", "can0", "bus", "can1") == {"vcan0": 2, "can0": 0, "bus": 3, "can1": 1}
    assert seen("can256") == {"can256": 0}
    with pytest.raises(ConfigError, match="256 interfaces in one log, allowed are 255"):
        seen(*(f"bus{n}x" for n in range(256)))


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (b"(0000000001.000002) can0 130#0102", LoggedFrame(1_000_002, "can0", 0x130, b"\x01\x02")),
        (b"(1.000002) vcan0 130# T", LoggedFrame(1_000_002, "vcan0", 0x130, sent=True)),
        (b"(1.000002) can0 00000130#ff R\r", LoggedFrame(1_000_002, "can0", 0x130, b"\xff", extended=True)),
        (b"(1.1000000) can0 130# R", LoggedFrame(2_000_000, "can0", 0x130)),  # of asc2log
        (b"(1.000002) can0 130#R", LoggedFrame(1_000_002, "can0", 0x130, kind=FrameKind.REMOTE)),
        (b"(1.000002) can0 130#r8", LoggedFrame(1_000_002, "can0", 0x130, kind=FrameKind.REMOTE, length=8)),
        (
            b"(1.000002) can0 20000004#0010000000000000",
            LoggedFrame(1_000_002, "can0", 4, bytes.fromhex("0010000000000000"), True, FrameKind.ERROR),
        ),
        (b"(1.000002) can0 130##1AABB", LoggedFrame(1_000_002, "can0", 0x130, b"\xaa\xbb", fd=FdFlags(True))),
        (b"(1.000002) can0 130##2", LoggedFrame(1_000_002, "can0", 0x130, fd=FdFlags(False, True))),
        (
            b"(1.000002) can0 130##4" + b"00" * 64,
            LoggedFrame(1_000_002, "can0", 0x130, bytes(64), fd=FdFlags()),
        ),
        (b"(1.000002) can0 130#0102030405060708_9", EIGHT),
        (b"(1.000002) can0 130#0102030405060708_F R", EIGHT),
        (
            b"(1.000002) can0 130#R8_A",
            LoggedFrame(1_000_002, "can0", 0x130, kind=FrameKind.REMOTE, length=8),
        ),
    ],
)
def test_a_candump_line_is_parsed_as_by_can_utils(line: bytes, found: LoggedFrame) -> None:
    assert logs.parse_candump(line) == found


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "not a candump line: '', expected"),
        (b"hello", "not a candump line: 'hello', expected"),
        (b"(1.000002) can0 130#010", "not a candump line"),
        (b"(1.000002) can0 130#0102030405060708_8", "not a candump line"),
        (b"(1.000002) can0 130#01020304050607_9", "not a candump line"),
        (b"(1.000002) can0 130#R7_9", "not a candump line"),
        (b"(1.000002) can0 130##", "not a candump line"),
        (b"(1.000002) can0 130##0" + b"00" * 9, "a CAN FD frame of 9 bytes, allowed are 0 to 8, 12, 16"),
        (b"(1.000002) can0 20000004##0", "error frame: it cannot be a CAN FD frame"),
        (b"(1.000002) can0 900#01", "CAN id 0x900, allowed is 0 to 0x7ff"),
        (b"(1.000002) can0 40000000#01", "CAN id 0x40000000, allowed is 0 to 0x1fffffff"),
        (b"(1.000002) can0 130#010203040506070809", "9 bytes, allowed are 0 to 8"),
        (b"(1.000002) can0 130#R9", "a remote frame for 9 bytes, allowed are 0 to 8"),
        (b"(1.000002) can0 20000004#R", "cannot be an error frame and a remote frame"),
        (b"(9999999999.000002) can0 130#", "time 9999999999.000002 s, allowed is 0 to 4294967295 s"),
    ],
)
def test_a_line_that_is_no_candump_is_refused_with_its_reason(line: bytes, reason: str) -> None:
    with pytest.raises(PeerError, match=re.escape(reason)):
        logs.parse_candump(line)


def test_a_log_of_the_hub_is_read_as_by_a_replay(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text("(0000000000.005000) can0 131#1410010100000000\n(0000000000.010000) can0 110#85\n")
    replayed, _ = read_log(path)
    read = logs.read_candump(path).frames
    assert [Frame(f.t_us, f.can_id, f.data) for f in read] == [logged.frame for logged in replayed]


@pytest.mark.parametrize(("first_us", "date_s"), [(5_123_456, 0), (NOW_US + 5_001, NOW_US // 1_000_000)])
def test_an_mf4_has_the_date_of_its_log_and_times_from_there(
    first_us: int, date_s: int, tmp_path: Path
) -> None:
    """python-can's own writer dates it with the time of writing: older frames lie before its beginning."""
    with_asammdf()
    from asammdf import MDF  # noqa: PLC0415

    WRITERS["mf4"](CanLog((LoggedFrame(first_us, "can0", 0x123, b"\x01"),)), tmp_path / "a.mf4")
    with MDF(tmp_path / "a.mf4") as mdf:
        assert mdf.header.start_time.timestamp() == date_s
        times_s = mdf.get("CAN_DataFrame", group=0).timestamps
        assert times_s.tolist() == [pytest.approx(first_us / 1e6 - date_s, abs=1e-6)]


@pytest.mark.skipif(not REAL_LOG.exists(), reason="the real drive is not on this machine")
@pytest.mark.parametrize("name", [f for f in FORMATS if f != "candump"])
def test_a_real_drive_comes_back_byte_for_byte(name: str, tmp_path: Path) -> None:
    there, back = tmp_path / "there", tmp_path / "back.log"
    done = convert(REAL_LOG, there, to_format=name)
    assert (done.frames, done.left_out) == (6920, {})
    convert(there, back, from_format=name)
    assert back.read_bytes() == REAL_LOG.read_bytes()


def test_frames_left_out_are_counted(tmp_path: Path) -> None:
    log = tmp_path / "all.log"
    log.write_text(
        "(1.000000) can0 130#01\n(1.000001) can0 130#R2\n(1.000002) can0 20000080#\n"
        "(1.000004) can0 131#02\n(1.000005) can0 13"
    )
    kept = {"torn last line": 1}
    assert convert(log, tmp_path / "all.blf").left_out == kept
    done = convert(log, tmp_path / "all.trc")
    assert done.frames == 2
    assert done.left_out == kept | {"remote frame": 1, "error frame": 1}
    assert convert(tmp_path / "all.trc", tmp_path / "back.log").frames == 2
