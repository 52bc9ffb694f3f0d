"""Logs as other programs write them: their CSVs, length codes above 8, CAN FD; and what --skip-bad does."""

from pathlib import Path
from typing import Final

import pytest

from aftbed.core.errors import ConfigError
from aftbed.interop.logs import (
    READERS,
    WRITERS,
    FdFlags,
    FrameKind,
    LoggedFrame,
    convert,
    read_for_replay,
)
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.python_can import can

ASC_HEAD: Final = "date Thu Jan 01 00:00:00.0 1970\nbase hex  timestamps absolute\ninternal events logged\n"
TRC_HEAD: Final = ";$FILEVERSION=2.1\n;$STARTTIME=25569.0\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
EIGHT: Final = bytes.fromhex("0102030405060708")
OF_EIGHT: Final = LoggedFrame(100_000, "can0", 0x123, EIGHT)


def made(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


# -- CSV by frame


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (
            "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
            "0.1,0x123,0,0,0,8,AQIDBAUGBwg=\n1483389946.197,0xdadada,1,0,0,2,WzQ=\n2.5,0x7,0,1,0,3,\n",
            (
                OF_EIGHT,
                LoggedFrame(1_483_389_946_197_000, "can0", 0xDADADA, b"[4", extended=True),
                LoggedFrame(2_500_000, "can0", 7, kind=FrameKind.REMOTE, length=3),
            ),
        ),
        (
            "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
            "100000,00000123,false,Rx,0,8,01,02,03,04,05,06,07,08,\n166064001,18FEF100,true,Tx,1,1,FF,,,,,,,,\n",
            (OF_EIGHT, LoggedFrame(166_064_001, "can1", 0x18FEF100, b"\xff", extended=True, sent=True)),
        ),
        (  # an older one, without the direction
            "Time Stamp,ID,Extended,Bus,LEN,D1,D2\r\n5,00000021,false,1,2,0A,0B,\r\n",
            (LoggedFrame(5, "can1", 0x21, b"\x0a\x0b"),),
        ),
        (
            "time,addr,bus,data\n0.1,0x123,0,0x0102030405060708\n0.2,291,1,00\n0.3,0x800,0,0x\n",
            (
                OF_EIGHT,
                LoggedFrame(200_000, "can1", 0x123, b"\0"),
                LoggedFrame(300_000, "can0", 0x800, extended=True),
            ),
        ),
        (
            "time,addr,bus,data\n0.1,0x123,0,0x" + "00" * 12 + "\n",
            (LoggedFrame(100_000, "can0", 0x123, bytes(12), fd=FdFlags()),),
        ),
    ],
    ids=["python-can", "SavvyCAN", "SavvyCAN-old", "cabana", "cabana-fd"],
)
def test_a_csv_with_a_frame_in_each_row_is_read(
    text: str, found: tuple[LoggedFrame, ...], tmp_path: Path
) -> None:
    assert READERS["csv"](made(tmp_path / "a.csv", text)).frames == found
    assert READERS["csv"](made(tmp_path / "bom.csv", "\ufeff" + text)).frames == found


def test_the_csv_of_python_cans_logger_is_read(tmp_path: Path) -> None:
    with can.Logger(tmp_path / "theirs.csv") as logger:
        logger(can.Message(1.5, 0x7FF, False, data=b"ab"))
        logger(can.Message(2.5, 0x12345, True, is_remote_frame=True, dlc=4))
        logger(can.Message(3.5, 0x1, False, is_fd=True, data=bytes(12)))
    assert READERS["csv"](tmp_path / "theirs.csv").frames == (
        LoggedFrame(1_500_000, "can0", 0x7FF, b"ab"),
        LoggedFrame(2_500_000, "can0", 0x12345, extended=True, kind=FrameKind.REMOTE, length=4),
        LoggedFrame(3_500_000, "can0", 0x1, bytes(12), fd=FdFlags()),
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "time,EGO_STATE.SPEED\n0.1,3\n",
            "a.csv: line 1: its columns 'time,ego_state.speed' are not those of a",
        ),
        (
            "time,addr,bus,data\n0.1,0x1,0,0xA\n",
            "a.csv: line 2: not a row of cabana: '0.1,0x1,0,0xA'; --skip-bad",
        ),
        ("time,addr,bus,data\n0.1,0x1,0\n", "line 2: not a row of cabana"),
        ("time,addr,bus,data\ninf,0x1,0,00\n", "line 2: not a row of cabana"),
        (
            "time,addr,bus,data\n-1,0x1,0,00\n",
            "line 2: time -1.000000 s, allowed is 0 to 4294967295 s: '-1,0x1",
        ),
        ("time stamp,id,extended,bus,len,d1\n1,1,false,0,2,01\n", "line 2: not a row of SavvyCAN"),
        (
            "timestamp,arbitration_id,extended,remote,error,dlc,data\n1,1,0,0,0,2,AA==\n",
            "a frame of 2 bytes with 1",
        ),
    ],
)
def test_what_is_no_log_of_frames_is_refused(text: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        READERS["csv"](made(tmp_path / "a.csv", text))
    assert reason in str(refused.value)


# -- length codes of classic frames: 9 to 15 mean 8 bytes


def blf_with_code(tmp_path: Path, code: int) -> bytes:
    """python-can writes the code that a message has, and 8 bytes."""
    with can.BLFWriter(tmp_path / "theirs.blf", compression_level=0) as writer:
        writer.start_timestamp = 0.0
        writer(can.Message(0.1, 0x123, False, data=EIGHT, dlc=code, channel=0))
    return (tmp_path / "theirs.blf").read_bytes()


@pytest.mark.parametrize("code", [9, 15])
def test_a_classic_frame_with_a_length_code_above_8_has_8_bytes(code: int, tmp_path: Path) -> None:
    asc = f"{ASC_HEAD} 0.1 1  123  Rx  d {code:x} {EIGHT.hex(' ')}\n"
    assert READERS["asc"](made(tmp_path / "a.asc", asc)).frames == (OF_EIGHT,)
    trc = f"{TRC_HEAD}1 100.0 DT 1 0123 Rx - {code} {EIGHT.hex(' ')}\n"
    assert READERS["trc"](made(tmp_path / "a.trc", trc)).frames == (OF_EIGHT,)
    assert READERS["blf"](made(tmp_path / "a.blf", blf_with_code(tmp_path, code))).frames == (OF_EIGHT,)


# -- CAN FD


def test_fd_frames_are_carried_where_the_format_can(tmp_path: Path) -> None:
    """All of them can but the CSV by signal, which has what the DBC describes."""
    log = made(
        tmp_path / "a.log",
        f"(0000000000.100000) can0 120#1B10413600000000\n(0000000000.200000) can0 123##3{'AB' * 64}\n",
    )
    for name in sorted(WRITERS.keys() - {"mf4"}):
        done = convert(log, tmp_path / "there", to_format=name)
        assert (done.frames, done.left_out) == (2, {})
        convert(tmp_path / "there", tmp_path / "back.log", from_format=name)
        assert (tmp_path / "back.log").read_bytes() == log.read_bytes()
    assert convert(log, tmp_path / "a.csv").left_out == {"frame that the DBC does not have": 1}


def test_an_asc_has_fd_frames_without_data(tmp_path: Path) -> None:
    """python-can takes them for remote frames, which CAN FD does not have."""
    line = " 0.1 CANFD   1 Rx 123 1 0 0 0 0 0 303000 0 0 0 0 0\n"
    (frame,) = READERS["asc"](made(tmp_path / "a.asc", ASC_HEAD + line)).frames
    assert frame == LoggedFrame(100_000, "can0", 0x123, fd=FdFlags(True))


# -- a replay


def test_a_replay_has_the_same_frames_from_every_format(tmp_path: Path) -> None:
    log = made(tmp_path / "a", "(0000000001.100000) can0 123#01\n(0000000001.200000) can1 7FF#\n")
    found = read_for_replay(log).frames
    assert found == (Frame(1_100_000, 0x123, b"\1"), Frame(1_200_000, 0x7FF, b""))
    for name in sorted(WRITERS.keys() - {"mf4"}):
        convert(log, tmp_path / f"a.{name}", "candump", name)
        assert read_for_replay(tmp_path / f"a.{name}").frames == found


@pytest.mark.parametrize("ending", ["asc", "blf", "csv", "log", "trc"])
def test_a_replay_reads_what_python_can_has_logged(ending: str, tmp_path: Path) -> None:
    """But for the date of an ASC, whose start python-can writes anew."""
    sent = [(1_700_000_000_001_000 + 50_000 * n, 0x300 + n % 3, bytes([n] * (n % 9))) for n in range(20)]
    with can.Logger(tmp_path / f"theirs.{ending}") as logger:
        for t_us, can_id, data in sent:
            logger(can.Message(t_us / 1e6, can_id, False, data=data, channel="can0", is_rx=True))
    found = read_for_replay(tmp_path / f"theirs.{ending}")
    first_us = found.frames[0].t_us if ending == "asc" else sent[0][0]
    assert [(one.t_us - first_us, one.can_id, one.data) for one in found.frames] == [
        (t_us - sent[0][0], can_id, data) for t_us, can_id, data in sent
    ]
    assert found.report.frames == 20 and not found.report.left_out


# -- what cannot be read is skipped


@pytest.mark.parametrize(
    ("name", "content", "first"),
    [
        (
            "candump",
            "(0.100000) can0 123#01\nhello\n(0.2) can0\n(0.300000) can0 124#02\n",
            "line 2: not a candump",
        ),
        (
            "asc",
            ASC_HEAD + " 0.1 1  123  Rx  d 1 01\n 0.2 1  123  Rx  d 2 01 XY\n 0.2 1  923  Rx  d 1 01\n"
            " 0.3 1  124  Rx  d 1 02\n",
            "line 5: cannot be read: invalid literal",
        ),
        (
            "trc",
            TRC_HEAD + "1 100 DT 1 0123 Rx - 1 01\n2 200 DT 1 0123 Rx\n\n;\n3 200 DT 1 0123 Rx - 8 01\n"
            "4 300 DT 1 0124 Rx - 1 02\n",
            "line 5: cannot be read: TRCReader: Failed to parse message '2 200",
        ),
        (
            "csv",
            "time,addr,bus,data\n0.1,0x123,0,0x01\nhello\n0.2,0x123,x,00\n0.3,0x124,0,0x02\n",
            "line 3: not a row of cabana: 'hello'",
        ),
    ],
)
def test_bad_lines_are_skipped_and_counted(name: str, content: str, first: str, tmp_path: Path) -> None:
    path = made(tmp_path / "a", content)
    with pytest.raises(ConfigError, match="--skip-bad leaves out such parts"):
        READERS[name](path)
    log = READERS[name](path, skip_bad=True)
    assert log.frames == (
        LoggedFrame(100_000, "can0", 0x123, b"\1"),
        LoggedFrame(300_000, "can0", 0x124, b"\2"),
    )
    assert log.skipped == 2
    assert log.first_skipped.startswith(first)


def test_a_log_with_nothing_but_bad_parts_is_refused(tmp_path: Path) -> None:
    path = made(tmp_path / "a.log", "hello\nworld\n")
    with pytest.raises(
        ConfigError, match=r"no frame in it, read as candump \(2 parts cannot be read, the first: line 1"
    ):
        convert(path, tmp_path / "a.asc", skip_bad=True)


def test_of_a_damaged_blf_what_is_whole_is_read(tmp_path: Path) -> None:
    """In three containers: the second one is damaged, and the last one torn."""
    frames = tuple(LoggedFrame(1000 * n, "can0", 0x100, bytes(8)) for n in range(90))
    size = 30 * 48
    with can.BLFWriter(tmp_path / "whole.blf", max_container_size=size) as writer:
        writer.start_timestamp = 0.0
        for frame in frames:
            writer(can.Message(frame.t_us / 1e6, frame.can_id, False, data=frame.data, channel=0))
    whole = bytearray((tmp_path / "whole.blf").read_bytes())
    assert READERS["blf"](tmp_path / "whole.blf").frames == frames
    second = whole.index(b"LOBJ", whole.index(b"LOBJ") + 1)
    whole[second + 40] ^= 0xFF
    path = made(tmp_path / "damaged.blf", bytes(whole[:-20]))
    log = READERS["blf"](path, skip_bad=True)
    assert log.frames == frames[:30]
    assert log.skipped >= 3 and log.first_skipped.startswith("its end: torn: ")


def test_an_object_of_a_blf_that_is_too_short_for_a_frame_is_bad(tmp_path: Path) -> None:
    """python-can would end there without a word."""
    with can.BLFWriter(tmp_path / "plain.blf", compression_level=0) as writer:
        writer.start_timestamp = 0.0
        for _ in range(3):
            writer(can.Message(0.1, 0x123, False, data=EIGHT, channel=0))
    content = bytearray((tmp_path / "plain.blf").read_bytes())
    second = content.index(b"LOBJ", 144 + 32 + 1)
    content[second + 8 : second + 12] = (40).to_bytes(4, "little")
    path = made(tmp_path / "a.blf", bytes(content))
    with pytest.raises(ConfigError, match="unpacked byte 48: a frame of 40 bytes, it has at least 48"):
        READERS["blf"](path)
    assert READERS["blf"](path, skip_bad=True).frames == (OF_EIGHT, OF_EIGHT)
