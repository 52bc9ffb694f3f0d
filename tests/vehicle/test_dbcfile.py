"""The DBC says what the design says, and a bad one is refused with its file, reason and line."""

import subprocess
import sys
from pathlib import Path

import pytest

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.dbcfile import load_dbc

CODEC = load_dbc()

MESSAGES = [  # name, id, cycle in ms
    ("AEB_REQ", 0x100, 20),
    ("BRAKE_STATUS", 0x110, 10),
    ("EGO_STATE", 0x120, 10),
    ("RADAR_TRACK", 0x130, 20),
    ("RADAR_STATUS", 0x131, 100),
    ("FTM_HEARTBEAT_1", 0x701, 50),
    ("FTM_HEARTBEAT_2", 0x702, 50),
]
PROTECTED = [name for name, _, _ in MESSAGES if not name.startswith("FTM")]


def test_no_other_messages() -> None:
    assert CODEC.names() == sorted(name for name, _, _ in MESSAGES)


@pytest.mark.parametrize(("name", "can_id", "cycle_ms"), MESSAGES)
def test_id_length_and_cycle(name: str, can_id: int, cycle_ms: int) -> None:
    assert (CODEC.can_id(name), CODEC.length(name), CODEC.cycle_us(name)) == (can_id, 8, cycle_ms * 1000)


def test_every_safety_message_has_its_own_data_id_and_no_other_has_one() -> None:
    assert len({CODEC.data_id(name) for name in PROTECTED}) == len(PROTECTED)
    with pytest.raises(ConfigError, match="message FTM_HEARTBEAT_1 has no E2EDataID"):
        CODEC.data_id("FTM_HEARTBEAT_1")


@pytest.mark.parametrize("name", PROTECTED)
def test_crc_and_counter_stand_where_profile_11_has_them(name: str) -> None:
    zeros = dict.fromkeys(CODEC.signal_names(name), 0.0)
    assert CODEC.encode(name, zeros | {"CRC": 255}) == bytes([0xFF, 0, 0, 0, 0, 0, 0, 0])
    assert CODEC.encode(name, zeros | {"COUNTER": 14}) == bytes([0, 0x0E, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("signal", "value", "step"),
    [("RANGE", 0.0, 0.005), ("RANGE", 299.995, 0.005), ("RELATIVE_SPEED", -100.0, 0.02), ("TRACK_ID", 15, 1)],
)
def test_a_signal_comes_back_within_half_a_step(signal: str, value: float, step: float) -> None:
    signals = dict.fromkeys(CODEC.signal_names("RADAR_TRACK"), 0.0) | {signal: value}
    assert CODEC.decode("RADAR_TRACK", CODEC.encode("RADAR_TRACK", signals))[signal] == pytest.approx(
        value, abs=step / 2
    )


@pytest.mark.parametrize("length", [0, 7])
def test_a_frame_of_the_wrong_length_is_the_peers_error(length: int) -> None:
    with pytest.raises(PeerError, match=f"AEB_REQ of {length} bytes, expected 8"):
        CODEC.decode("AEB_REQ", bytes(length))


def test_unknown_names_come_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"aftbed\.dbc: unknown message 'RADAR_TRACKS'.*'RADAR_TRACK'"):
        CODEC.can_id("RADAR_TRACKS")
    with pytest.raises(ConfigError, match=r"unknown signal of RADAR_TRACK 'RANG'.*'RANGE'"):
        CODEC.unit("RADAR_TRACK", "RANG")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("BU_: X\nBO_ 1 X 8 V\n", "Invalid syntax at line 2"),
        ("", "Invalid syntax at line 1"),
        ('BO_ 1 X: 8 V\n SG_ A : 60|8@1+ (1,0) [0|1] "" V\n', "The signal A does not fit in message X"),
        ("BO_ 1 X: 64 V\n", "message X has 64 bytes, allowed is 0 to 8"),
        ("BU_: X\n", "holds no message"),
    ],
)
def test_a_bad_dbc_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "bad.dbc"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_dbc(path)
    assert str(error.value).startswith(f"{path}: ")
    assert reason in str(error.value)


def test_a_dbc_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.dbc: cannot be read: No such file"):
        load_dbc(tmp_path / "none.dbc")


def test_cantools_is_not_imported_before_a_dbc_is_loaded() -> None:
    code = (
        "import sys, aftbed.vehicle.dbcfile, aftbed.vehicle.gateway, aftbed.vehicle.mapped,"
        " aftbed.vehicle.ecus, aftbed.vehicle.function; assert 'cantools' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)
