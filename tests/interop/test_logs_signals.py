"""CSV by signal: its columns have the values of the frames."""

import csv
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.errors import ConfigError
from aftbed.interop.logs import LoggedFrame, candump_line, convert
from aftbed.vehicle.can.dbc_file import Codec, load_dbc

CODEC: Final[Codec] = load_dbc()
MULTIPLEXED: Final = """VERSION ""
NS_ :
BS_:
BU_: RADAR
BO_ 2566834709 LONG: 2 RADAR
 SG_ MODE M : 0|8@1+ (1,0) [0|255] "" RADAR
 SG_ COLD m0 : 8|8@1- (0.5,0) [-64|63] "C" RADAR
 SG_ FAST m1 : 8|8@1+ (2,0) [0|510] "m/s" RADAR
"""


def frame(t_us: int, name: str, interface: str = "can0", **signals: float) -> LoggedFrame:
    values = dict.fromkeys(CODEC.signal_names(name), 0.0) | signals
    return LoggedFrame(t_us, interface, CODEC.can_id(name), CODEC.encode(name, values))


def table(tmp_path: Path, *frames: LoggedFrame, dbc: Path | None = None) -> tuple[list[dict[str, str]], str]:
    """The rows without their empty fields, and the head line."""
    (tmp_path / "bus.log").write_text("".join(map(candump_line, frames)))
    convert(tmp_path / "bus.log", tmp_path / "bus.csv", dbc=dbc)
    with (tmp_path / "bus.csv").open(newline="") as file:
        rows = [{key: value for key, value in row.items() if value} for row in csv.DictReader(file)]
    return rows, (tmp_path / "bus.csv").read_text().splitlines()[0]


def test_a_row_has_a_time_and_the_signals_of_one_frame(tmp_path: Path) -> None:
    rows, head = table(
        tmp_path,
        frame(1_000_250, "EGO_STATE", SPEED=13.889, ACCELERATION=-1.5, SPEED_VALID=1),
        frame(2_000_000, "AEB_REQ", STAGE=3, DECELERATION=9.0, TTC=0.85, TTC_VALID=1),
    )
    assert head.startswith("time,AEB_REQ.CRC,AEB_REQ.COUNTER,AEB_REQ.STAGE,")
    assert rows[0]["time"] == "1.000250"
    assert float(rows[0]["EGO_STATE.SPEED"]) == 13.889
    assert rows[0]["EGO_STATE.ACCELERATION"] == "-1.5"
    assert "AEB_REQ.STAGE" not in rows[0], "no new value of it"
    assert (rows[1]["AEB_REQ.STAGE"], rows[1]["AEB_REQ.DECELERATION"]) == ("3", "9")
    assert [len(row) for row in rows] == [6, 9]


def test_rows_are_in_the_order_of_time(tmp_path: Path) -> None:
    rows, _ = table(tmp_path, frame(2_000_000, "EGO_STATE"), frame(1_000_000, "EGO_STATE"))
    assert [row["time"] for row in rows] == ["1.000000", "2.000000"]


def test_a_message_on_two_interfaces_has_its_columns_twice(tmp_path: Path) -> None:
    rows, _ = table(
        tmp_path,
        frame(1, "EGO_STATE", "can0", SPEED=10),
        frame(2, "EGO_STATE", "can1", SPEED=20),
        frame(3, "AEB_REQ", "can1", STAGE=2),
    )
    assert rows[0]["can0.EGO_STATE.SPEED"] == "10"
    assert rows[1]["can1.EGO_STATE.SPEED"] == "20"
    assert rows[2]["AEB_REQ.STAGE"] == "2"


def test_a_multiplexed_message_fills_the_signals_that_it_has(tmp_path: Path) -> None:
    dbc = tmp_path / "long.dbc"
    dbc.write_text(MULTIPLEXED)
    can_id = 2566834709 - 0x80000000
    rows, _ = table(
        tmp_path,
        LoggedFrame(1, "can0", can_id, b"\x00\xfe", extended=True),
        LoggedFrame(2, "can0", can_id, b"\x01\x10", extended=True),
        dbc=dbc,
    )
    assert rows[0] == {"time": "0.000001", "LONG.MODE": "0", "LONG.COLD": "-1"}
    assert rows[1] == {"time": "0.000002", "LONG.MODE": "1", "LONG.FAST": "32"}


def test_frames_that_are_not_in_the_dbc_are_counted(tmp_path: Path) -> None:
    short = LoggedFrame(3, "can0", CODEC.can_id("EGO_STATE"), b"\x00")
    other = LoggedFrame(2, "can0", 0x7FF)
    long = LoggedFrame(4, "can0", CODEC.can_id("EGO_STATE"), bytes(8), extended=True)
    log = tmp_path / "bus.log"
    log.write_text("".join(map(candump_line, (frame(1, "EGO_STATE"), other, short, long))))
    done = convert(log, tmp_path / "bus.csv")
    assert done.frames == 1
    assert done.left_out == {
        "frame that the DBC does not have": 2,
        "frame of another length than the DBC says": 1,
    }


def test_a_log_without_any_message_of_the_dbc_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bus.log").write_text("(1.000000) can0 7FF#\n")
    with pytest.raises(ConfigError, match=r"aftbed.dbc: describes none of the 1 frames"):
        convert(tmp_path / "bus.log", tmp_path / "bus.csv")
    assert not (tmp_path / "bus.csv").exists()


def test_messages_that_cannot_be_used_are_left_out_and_nothing_else_is(tmp_path: Path) -> None:
    """Of CAN FD, or twice under one name; the file has values of no signal, so cantools refuses it."""
    path = tmp_path / "car.dbc"
    path.write_text(
        'BU_: X\nBO_ 1 FD: 64 X\n SG_ A : 0|8@1+ (1,0) [0|1] "" X\nBO_ 2 TWICE: 1 X\nBO_ 3 TWICE: 1 X\n'
        'BO_ 288 SPEED: 8 X\n SG_ SPEED : 0|16@1+ (0.01,0) [0|100] "m/s" X\nVAL_ 7 SPEED 1 "one";\n'
    )
    frames = [LoggedFrame(n, "can0", can_id, bytes([9] * 8)) for n, can_id in enumerate((1, 2, 288))]
    rows, head = table(tmp_path, *frames, dbc=path)
    assert head == "time,SPEED.SPEED"
    assert rows == [{"time": "0.000002", "SPEED.SPEED": "23.13"}]
