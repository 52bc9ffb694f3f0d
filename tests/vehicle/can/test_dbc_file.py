"""The DBC says what the design says, and a bad one is refused with its file, reason and line."""

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from cantools.database import EncodeError
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.replay.map_file import find_dbc

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


@pytest.mark.parametrize(
    "wrong", [{"RANGE": 400.0}, {"RELATIVE_SPEED": -1000.0}, {"TRACK_ID": 16}, {"RANG": 1.0}], ids=str
)
def test_what_the_file_does_not_allow_is_not_encoded(wrong: dict[str, float]) -> None:
    signals = dict.fromkeys(CODEC.signal_names("RADAR_TRACK"), 0.0)
    for _ in range(2):  # a message that was encoded before is checked as the first one
        with pytest.raises(EncodeError):
            CODEC.encode("RADAR_TRACK", signals | wrong)
        CODEC.encode("RADAR_TRACK", signals)
    with pytest.raises((EncodeError, KeyError)):
        CODEC.encode("RADAR_TRACK", {name: 0.0 for name in signals if name != "RANGE"})


@pytest.mark.parametrize("length", [0, 7])
def test_a_frame_of_the_wrong_length_is_the_peers_error(length: int) -> None:
    with pytest.raises(PeerError, match=f"AEB_REQ of {length} bytes, expected 8"):
        CODEC.decode("AEB_REQ", bytes(length))


def test_unknown_names_come_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"aftbed\.dbc: unknown message 'RADAR_TRACKS'.*'RADAR_TRACK'"):
        CODEC.can_id("RADAR_TRACKS")
    with pytest.raises(ConfigError, match=r"unknown signal of RADAR_TRACK 'RANG'.*'RANGE'"):
        CODEC.unit("RADAR_TRACK", "RANG")


OUTSIDE = (
    'BU_: X\nBO_ 2 Y: 8 V\n\nBO_ 1 X: 2 V\n SG_ A : 0|8@1+ (1,0) [0|1] "" V\n'
    ' SG_ B : 12|8@1+ (1,0) [0|1] "" V\n'
)
OVERLAP = (
    'BU_: X\nBO_ 1 X: 2 V\n SG_ A : 0|8@1+ (1,0) [0|1] "m" V\n SG_ B : 4|8@1- (0.5,1) [0|1] "" V\n'
    'BO_ 2 Y: 1 V\n SG_ B : 0|8@1+ (1,0) [0|1] "" V\n'
)
SIZE = "a length, a start bit or a range of multiplexer values is"
MULTIPLEXED = """\
BU_: X
BO_ 1 X: 8 V
 SG_ A m0 : 0|8@1+ (1,0) [0|1] "" V
 SG_ B M : 8|8@1+ (1,0) [0|1] "" V
SG_MUL_VAL_ 1 A B 0-3, 5 - 99999999999;
"""
WAY_OUT = " (a map with `strict: false` takes it as it is)"


def saved(folder: Path, text: str) -> Path:
    (folder / "bad.dbc").write_text(text)
    return folder / "bad.dbc"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("BU_: X\nBO_ 1 X 8 V\n", "line 2"),
        ("", "Invalid syntax at line 1"),
        (
            "BU_: X\nBO_ 2048 X: 8 V\n",
            "line 2: not a DBC that can be read: Standard frame id 0x800 is more than 11",
        ),
        ("BU_: X\nBO_ 1 X: 99999999999999 V\n", f"line 2: {SIZE} 99999999999999, allowed"),
        ('BU_: X\nBO_ 1 X: 8 V\n SG_ A : 0|99999999999@1+ (1,0) [0|1] "" V\n', f"line 3: {SIZE} 99999999999"),
        ('BU_: X\nBO_ 1 X: 8 V\n SG_ A m0 : -1|8@0+ (1,0) [0|1] "" V\n', f"line 3: {SIZE} -1"),
        (MULTIPLEXED, f"line 5: {SIZE} 99999999994"),
        ("BU_: X\n", "holds no message"),
        ("(0000000012.345678) can0 130#01020304\n", "Invalid syntax at line 1"),
        ("BU_: X\n\0", "not text, at byte 7"),
    ],
)
def test_a_bad_dbc_is_refused_with_the_reason_and_the_line(tmp_path: Path, text: str, reason: str) -> None:
    path = saved(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_dbc(path)
    assert str(error.value).startswith(f"{path}: ")
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (OUTSIDE, f"line 6: The signal B does not fit in message X.{WAY_OUT}"),
        (
            OVERLAP,
            f"line 4: The signals B and A are overlapping in message X.{WAY_OUT}",
        ),
        ("BU_: X\nBO_ 1 X: 64 V\n", "line 2: message X has 64 bytes, allowed is 0 to 8"),
        ("BU_: X\nBO_ 1 X: -8 V\n", "line 2: message X has -8 bytes, allowed is 0 to 8"),
        ("BU_: X\nBO_ 1 X: 8 V\nBO_ 2 X: 8 V\n", "line 2: message X stands twice, allowed is once"),
    ],
)
def test_a_message_that_cannot_be_used_is_refused_when_it_is_asked_for(
    tmp_path: Path, text: str, reason: str
) -> None:
    codec = load_dbc(saved(tmp_path, text + 'BO_ 7 GOOD: 1 V\n SG_ A : 0|8@1+ (1,0) [0|1] "" V\n'))
    assert codec.decode("GOOD", b"\x07") == {"A": 7.0}
    assert codec.flaw("GOOD") is None
    assert codec.sent_by("v")[-1] == "GOOD"
    assert "X" not in codec.sent_by("v")
    with pytest.raises(ConfigError) as error:
        codec.length("X")
    assert str(error.value) == f"{codec.path}: {reason}"
    assert codec.flaw("X") == reason


GOOD_MESSAGE = 'BU_: X\nBO_ 1 X: 8 V\n SG_ A : 7|8@0- (0.5,1) [0|1] "m" V\n'


@pytest.mark.parametrize(
    "tail",
    [
        'BA_ "Cycle" BO_ 1 10;\n',
        'VAL_ 1 SPED 1 "a";\n',
        'CM_ SG_ 304 "no name";\n',
        "BO_ 2 Y 8 V\n",
        'BO_ 2 Y 8 V\n SG_ B : 0|8@1+ (1,0) [0|1] "" V\n',
        'BO_ 2 Y: 8 V\n SG_ B C D : 0|8@1+ (1,0) [0|1] "" V\n',
        'BO_ 2 Y: 8 V\n SG_ B : 0|8@1+ [0|1] "" V\n',
        'BO_ 2 Y: 8 V\n SG_ B : 0|0@1+ (1,0) [0|1] "" V\n',
        'CM_ "a comment\nBO_ 1 X: 3 V\nends";\nBA_ "Cycle" BO_ 1 10;\n',
        'BA_DEF_ BO_ "Cycle" INT 0 ;\n',
        'CM_ BO_ 1 "\u2014";\nBA_ "Cycle" BO_ 1 10;\n',
    ],
)
def test_what_cantools_refuses_is_read_by_canmatrix(tmp_path: Path, tail: str) -> None:
    codec = load_dbc(saved(tmp_path, GOOD_MESSAGE + tail))
    assert codec.decode("X", bytes([0xFE, *bytes(7)])) == {"A": 0.0}
    assert (codec.can_id("X"), codec.unit("X", "A"), codec.signal_names("X")) == (1, "m", ["A"])
    assert "read by canmatrix, as cantools refuses it: " in codec.notes[0]
    with pytest.raises(ConfigError, match=r"unknown message 'Z'.*read by canmatrix"):
        codec.can_id("Z")


def test_what_was_left_out_is_named_with_its_line(tmp_path: Path) -> None:
    text = GOOD_MESSAGE + 'BO_ 2 Y 8 V\n SG_ B : 0|8@1+ (1,0) [0|1] "" V\nBO_ 3 Z: 1 V\n SG_ C : ?\n'
    codec = load_dbc(saved(tmp_path, text))
    assert codec.names() == ["X", "Z"]
    assert codec.notes[1:] == (
        "line 4: message left out, cannot be read",
        "line 7: left out, cannot be read",
    )


READERS_AGREE = """\
BU_: V W
BO_ 1 X: 8 V
 SG_ A : 7|12@0- (0.025,-4) [-100|100] "m/s" V,W
 SG_ B : 16|11@1+ (0.1,0) [0|204.7] "m" W
 SG_ C : 32|32@1- (1,0) [0|0] "" W
BO_ 2147484000 WIDE: 4 W
 SG_ M M : 0|4@1+ (1,0) [0|15] "" V
 SG_ D m1 : 8|8@1+ (1,0) [0|255] "" V
 SG_ E m2 : 8|8@1+ (2,0) [0|255] "" V
SIG_VALTYPE_ 1 C : 1;
BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;
BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;
BA_DEF_DEF_ "SystemSignalLongSymbol" "";
BA_DEF_DEF_ "SystemMessageLongSymbol" "";
BA_ "SystemSignalLongSymbol" SG_ 1 A "A_NAME_OF_MORE_THAN_32_CHARACTERS_OF_A_SIGNAL";
BA_ "SystemMessageLongSymbol" BO_ 1 "A_NAME_OF_MORE_THAN_32_CHARACTERS_OF_A_MESSAGE";
"""


@given(st.binary(min_size=8, max_size=8))
def test_both_readers_read_the_same(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        first, second = (
            load_dbc(saved(path, READERS_AGREE)),
            load_dbc(saved(path, READERS_AGREE + 'VAL_ 1 Z 1 "a";\n')),
        )
    assert (first.notes == ()) is (second.notes != ())
    name = "A_NAME_OF_MORE_THAN_32_CHARACTERS_OF_A_MESSAGE"
    assert str(first.decode(name, data)) == str(second.decode(name, data))  # nan is not nan
    assert "A_NAME_OF_MORE_THAN_32_CHARACTERS_OF_A_SIGNAL" in first.signal_names(name)
    for codec in (first, second):
        assert (codec.can_id("WIDE"), codec.extended("WIDE"), codec.multiplexed("WIDE")) == (352, True, True)
        assert (codec.senders(), codec.whole(name, "B")) == (["v", "w"], False)
    chosen = bytes([1 + data[0] % 2]) + data[1:4]
    assert first.decode("WIDE", chosen) == second.decode("WIDE", chosen)


@pytest.fixture
def lenient(tmp_path: Path) -> Callable[[str], Codec]:
    """A DBC that contradicts itself, read all the same."""

    def load(text: str) -> Codec:
        (tmp_path / "bad.dbc").write_text(text)
        return load_dbc(tmp_path / "bad.dbc", strict=False)

    return load


def test_signals_that_overlap_are_read_each_as_the_file_has_it(lenient: Callable[[str], Codec]) -> None:
    codec = lenient(OVERLAP)
    assert codec.decode("X", bytes([0xFF, 0x0A])) == {"A": 255.0, "B": -81 * 0.5 + 1.0}
    assert codec.misfits("X") == codec.misfits("Y") == frozenset()
    assert codec.patch("X", "B", 1.0) == (bytes([0xF0, 0x0F]), bytes(2))
    assert codec.decode("Y", b"\x07") == {"B": 7.0}
    with pytest.raises(PeerError, match="X of 1 bytes, expected 2"):
        codec.decode("X", b"\x07")


def test_a_signal_outside_its_message_is_not_there(lenient: Callable[[str], Codec]) -> None:
    codec = lenient(OUTSIDE)
    assert codec.decode("X", bytes([7, 0xFF])) == {"A": 7.0}
    assert codec.misfits("X") == {"B"}
    with pytest.raises(ConfigError, match=r"X\.B has no bits that stand for a value"):
        codec.patch("X", "B", 1.0)


def test_a_scale_of_zero_stands_for_no_value(lenient: Callable[[str], Codec]) -> None:
    codec = lenient('BU_: X\nBO_ 1 X: 8 V\n SG_ A : 0|8@1+ (0,0) [0|1] "" V\n')
    with pytest.raises(ConfigError, match=r"X\.A has no bits that stand for a value"):
        codec.patch("X", "A", 1.0)


PIECES = (
    "BO_",
    "SG_",
    "1",
    "99999999999999",
    "-1",
    "1e999",
    ":",
    "|",
    "@",
    "(0,0)",
    "m0",
    "M",
    "VAL_",
    "BA_",
    '"',
    ";",
)
WORDS = re.findall(r"\w+|\W", Path(CODEC.path).read_text())


@given(
    st.lists(st.tuples(st.integers(0, len(WORDS) - 1), st.sampled_from(["", *PIECES])), max_size=4),
    st.booleans(),
)
def test_a_damaged_dbc_is_loaded_or_refused(changes: list[tuple[int, str]], strict: bool) -> None:
    words = list(WORDS)
    for place, word in changes:
        words[place] = word
    with tempfile.NamedTemporaryFile("w", suffix=".dbc") as file:
        file.write("".join(words))
        file.flush()
        try:
            codec = load_dbc(Path(file.name), strict=strict)
        except ConfigError as error:
            assert str(error).startswith(f"{file.name}: ")
            return
        for name in codec.names():
            if codec.flaw(name) is None and not codec.multiplexed(name):
                codec.decode(name, bytes(codec.length(name)))


def test_a_shipped_dbc_is_found_by_name_and_a_file_by_its_path(tmp_path: Path) -> None:
    assert find_dbc("ars408-like").name == "ars408-like.dbc"
    assert find_dbc("./esr-like") == Path("./esr-like")
    assert find_dbc("mine.dbc") == Path("mine.dbc")
    with pytest.raises(ConfigError, match="unknown DBC 'ars408'; did you mean 'ars408-like'"):
        find_dbc("ars408")


def test_a_dbc_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.dbc: cannot be read: No such file"):
        load_dbc(tmp_path / "none.dbc")


def test_cantools_is_not_imported_before_a_dbc_is_loaded() -> None:
    code = (
        "import sys, aftbed.vehicle.can.dbc_file, aftbed.vehicle.gateway,"
        " aftbed.vehicle.replay.mapped_gateway, aftbed.vehicle.ecus,"
        " aftbed.vehicle.aeb.function; assert 'cantools' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)
