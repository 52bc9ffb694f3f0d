"""Bad input to `aftbed run`: exit code 2, one message, and nothing is started.

The command is called in this process, which takes milliseconds. `test_app_process.py` calls a few of the same
in a process of their own.
"""

import socket
from pathlib import Path
from typing import Final

import pytest
from fakerun import Output

SCENARIO: Final = """
description: a car that stands
duration_s: 9
ego: {speed_kmh: 50}
lead: {ttc_s: 4.0, speed_kmh: 0}
expect: {outcome: stop}
"""
DBC: Final = """
BU_: X
BO_ 528 TRACK_0: 8 X
 SG_ COUNTER : 7|8@0+ (1,0) [0|255] "" X
 SG_ RANGE : 15|16@0+ (0.01,0) [0|300] "m" X
 SG_ SPEED : 31|12@0- (0.025,0) [-100|100] "m/s" X
 SG_ SIDE : 47|8@0- (0.1,0) [-10|10] "m" X
 SG_ VALID : 48|1@0+ (1,0) [0|1] "" X
 SG_ NEW : 49|1@0+ (1,0) [0|1] "" X
"""
MAP: Final = """
description: a small radar
cycle_ms: 50
cycle_end: TRACK_0
ego: {can_id: 0x0B4, length: 8, checksum: toyota, speed:
  {unit: km/h, raw: {start_bit: 47, length_bits: 16, byte_order: big_endian, scale: 0.01}}}
tracks:
  messages: {name: "TRACK_{n}", first: 0, last: 0}
  length: 8
  counter: {signal: COUNTER, modulo: 256}
  range: {signal: RANGE, unit: m}
  relative_speed: {signal: SPEED, unit: m/s}
  lateral_offset: {signal: SIDE, unit: m}
  valid: VALID
  new: NEW
"""
LOG: Final = "(0000000001.000000) can0 210#0102030405060708\n"


def all_words(error: str, *words: str) -> bool:
    """Whether `error` has each of `words`."""
    return all(word in error for word in words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scenario", "ccrs50"), ("unknown scenario 'ccrs50'", "did you mean 'ccrs-50'", "free-drive")),
        (("--scenario", ""), ("unknown scenario ''", "ccrs-50")),
        (("--ftti", "19ms"), ("--ftti 19ms: shorter than a cycle of 20ms",)),
        (("--load", "10@100", "--ftti", "9ms"), ("--ftti 9ms: shorter than a cycle of 10ms",)),
        (("--ftti", "100"), ("--ftti '100': a positive number with its unit is allowed",)),
        (("--ftti", "0ms"), ("--ftti '0ms': a positive number",)),
        (("--scenario", "absent.yaml"), ("absent.yaml", "No such file")),
        (("--scenario", "/"), ("/", "directory")),
        (("--ftm", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'", "none")),
        (("--ftm", "pbx"), ("unknown FTM 'pbx'; did you mean 'pbr'?", "none, pbr")),
        (("--placement", "replicas"), ("unknown placement", "did you mean 'replica'", "process")),
        (("--placement", "double"), ("unknown placement 'double'", "single")),
        (("--brake-policy", "latched"), ("unknown brake policy", "did you mean 'latch'", "hold")),
        (("--pace", "fast"), ("--pace fast", "real, max, or a factor")),
        (("--pace", "0"), ("--pace 0", "0.01 to 100")),
        (("--pace", "-1"), ("--pace -1", "0.01 to 100")),
        (("--pace", "nan"), ("--pace nan",)),
        (("--pace", "inf"), ("--pace inf",)),
        (("--seed", "9" * 30), ("--seed",)),
        (("--load", "0"), ("--load 0", "COUNT@RATE")),
        (("--load", "-5"), ("--load -5",)),
        (("--load", "10@-1"), ("--load 10@-1",)),
        (("--load", "10@nan"), ("--load 10@nan",)),
        (("--load", "ten"), ("--load ten", "10000000")),
        (("--load", "99999999999"), ("--load 99999999999",)),
        (("--load", "10", "--replay", "x.log"), ("--replay and --load", "one of them")),
        (("--bus-port", "65536"), ("--bus-port 65536", "0 to 65535")),
        (("--bus-port", "-1"), ("--bus-port -1", "0 to 65535")),
        (("--bus-open", "--load", "10"), ("--load: there is no bus: leave out --bus-open",)),
        (("--bitrate", "9999"), ("--bitrate 9999: 10000 to 1000000 are allowed",)),
        (("--loop",), ("only with --replay LOG: leave out --loop",)),
        (("--replay", "x", "--loop", "--pace", "max"), ("--loop with --pace max", "give --duration too")),
        (("--duration", "0s"), ("--duration '0s': a positive number with its unit is allowed",)),
        (("--duration", "2h"), ("--duration '2h'",)),
        (("--duration", "2s", "--load", "10"), ("--duration: a run of --load ends with its last request",)),
        (("--duration", "2s", "--requests", "x.csv"), ("leave out --duration",)),
        (("--dbc", "x.dbc"), ("only with --replay LOG: leave out --dbc",)),
        (("--load", "10", "--scenario", "ccrs-20"), ("--load: there is no car: leave out --scenario",)),
        (("--load", "10", "--pace", "max"), ("--load: there is no car: leave out --pace",)),
        (("--load", "10", "--skip-bad"), ("--load: there is no car: leave out --skip-bad",)),
        (("--replay", "x", "--scenario", "ccrs-20"), ("--replay: there is no car: leave out --scenario",)),
        (("--replay", "x.log"), ("--replay LOG needs --dbc FILE and --map FILE",)),
        (("--replay", "x.log", "--dbc", "x.dbc"), ("needs --dbc FILE and --map FILE",)),
    ],
)
def test_options_of_run(refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    assert all_words(refused("run", *arguments), *words)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("crush primary", ("unknown fault 'crush'", "did you mean 'crash'")),
        ("kill primary", ("unknown fault 'kill'; did you mean 'crash'?",)),
        ("freeze backup", ("unknown fault 'freeze'; did you mean 'hang'?",)),
        ("drop pxy2pro", ("unknown fault 'drop'; did you mean 'omission'?",)),
        ("crash primary at 3s", ("'at' is followed by an event, 'after 3s' by a time",)),
        ("crash", ("expected crash|hang|slow TARGET",)),
        ("", ("expected crash|hang|slow TARGET",)),
        ("crash primry", ("unknown target 'primry'", "did you mean 'primary'", "a/server")),
        ("crash a/servr", ("did you mean 'a/server'",)),
        ("crash c/server", ("unknown target 'c/server'",)),
        ("crash primary at checkpoint.send", ("unknown event", "did you mean 'checkpoint.sent'")),
        ("crash primary at node.died", ("cannot trigger a fault under --ftm pbr", "checkpoint.sent")),
        ("crash primary on reply.sent", ("unknown word in fault", "at")),
        ("crash primary at", ("'at' lacks its value",)),
        ("crash primary at reply.sent nth 0", ("nth '0'", "from 1 on")),
        ("crash primary at reply.sent nth -1", ("nth '-1'",)),
        ("crash primary at reply.sent nth two", ("nth 'two'",)),
        ("crash primary at reply.sent nth ²", ("nth '²'",)),
        ("crash primary at reply.sent nth " + "9" * 30, ("nth",)),
        ("crash primary after ²ms", ("duration '²ms'",)),
        ("crash primary after 9999999s", ("duration '9999999s'",)),
        ("crash primary nth 2", ("'at EVENT nth 2' is allowed",)),
        ("crash primary for 50ms", ("a crash has no duration",)),
        ("hang primary for 50", ("duration '50'", "50ms or 2s")),
        ("hang primary for 0ms", ("duration '0ms'", "positive")),
        ("hang primary for -5ms", ("duration '-5ms'",)),
        ("crash primary at reply.sent after 5ms", ("one of them is allowed",)),
        ("crash primary after 5ms after 6ms", ("'after' twice",)),
        ("bitflip memory", ("say --unsafe-memory if that is wanted",)),
        ("omission bus RADAR_TRAC", ("unknown message 'RADAR_TRAC'", "did you mean 'RADAR_TRACK'?")),
        ("bus-off wheel", ("unknown node of the bus 'wheel'",)),
        ("delay bus AEB_REQ", ("'by' is missing",)),
    ],
)
def test_faults(refused: Output, fault: str, words: tuple[str, ...]) -> None:
    assert all_words(refused("run", "--inject", fault), *words)


def test_a_fault_that_this_mechanism_does_not_know(refused: Output) -> None:
    assert "unknown target 'backup'" in refused("run", "--ftm", "none", "--inject", "crash backup")
    at = "crash primary at checkpoint.sent"
    assert "under --ftm none" in refused("run", "--ftm", "none", "--inject", at)
    replica = ("--placement", "replica", "--inject", "crash a/server")
    assert "unknown target 'a/server'" in refused("run", *replica)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("duration_s: 9", "duration: 9", ("duration",)),
        ("duration_s: 9", "duration_s: 9\nweather: rain", ("weather",)),
        ("speed_kmh: 50", "speed_ms: 14", ("ego", "speed_ms")),
        ("speed_kmh: 50", "speed_kmh: -50", ("speed_kmh",)),
        ("speed_kmh: 50", "speed_kmh: fast", ("speed_kmh",)),
        ("ttc_s: 4.0", "gap_m: -10", ("gap_m",)),
        ("ttc_s: 4.0", "gap_m: 0", ("gap_m", "more than 0")),
        ("ttc_s: 4.0", "gap_m: 10, ttc_s: 4.0", ("both", "gap_m, ttc_s")),
        ("ttc_s: 4.0", "ttc_s: 4.0m", ("ttc_s",)),
        ("outcome: stop", "outcome: fly", ("outcome",)),
        ("description", "descripton", ("descripton",)),
        ("ego: {speed_kmh: 50}", "ego: [", ("yaml",)),
        ("duration_s: 9", "duration_s: 9\nduration_s: 8", ("duration_s",)),
    ],
)
def test_scenario_files(refused: Output, tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "mine.yaml"
    assert old in SCENARIO
    path.write_text(SCENARIO.replace(old, new, 1))
    assert all_words(refused("run", "--scenario", path), str(path), *words)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"- a list\n", b"42\n", b"\0" * 100])
def test_files_that_are_no_scenario(refused: Output, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    assert str(path) in refused("run", "--scenario", path)


class Replay:
    """The three files of a replay; a test damages one of them."""

    def __init__(self, folder: Path) -> None:
        self.log, self.dbc, self.map = folder / "x.log", folder / "x.dbc", folder / "x.yaml"
        self.log.write_text(LOG)
        self.dbc.write_text(DBC)
        self.map.write_text(MAP)

    def arguments(self) -> tuple[str | Path, ...]:
        """For the command."""
        return ("run", "--replay", self.log, "--dbc", self.dbc, "--map", self.map, "--pace", "max")


@pytest.fixture
def replay(tmp_path: Path) -> Replay:
    """Three good files."""
    return Replay(tmp_path)


@pytest.mark.parametrize("content", ["BO_ 528 TRACK", 'VERSION "1', "not a DBC at all\n", "\0\1\2"])
def test_a_dbc_that_does_not_parse(refused: Output, replay: Replay, content: str) -> None:
    replay.dbc.write_text(content)
    assert str(replay.dbc) in refused(*replay.arguments())


def test_a_dbc_that_lacks_what_is_mapped(refused: Output, replay: Replay) -> None:
    replay.dbc.write_text(DBC.replace("RANGE", "DISTANCE"))
    assert all_words(refused(*replay.arguments()), str(replay.map), "RANGE")
    replay.dbc.write_text(DBC.replace("TRACK_0", "TRACK_9"))
    assert all_words(refused(*replay.arguments()), "TRACK_0")


def test_a_dbc_that_is_not_there(refused: Output, replay: Replay) -> None:
    replay.dbc.unlink()
    assert all_words(refused(*replay.arguments()), str(replay.dbc), "No such file")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cycle_ms", "cycle_s", ("cycle_s",)),
        ("unit: m}", "unit: km}", ("range.unit", "km", "m, cm")),
        ("unit: m/s", "unit: mph", ("unit",)),
        ("modulo: 256", "modulo: -1", ("modulo",)),
        ("checksum: toyota", "checksum: honda", ("checksum",)),
        ("description: a small radar", "description: a small radar\ncolour: red", ("colour",)),
        ("length: 8", "length: 9", ("length",)),
    ],
)
def test_map_files(refused: Output, replay: Replay, old: str, new: str, words: tuple[str, ...]) -> None:
    assert old in MAP
    replay.map.write_text(MAP.replace(old, new, 1))
    assert all_words(refused(*replay.arguments()), str(replay.map), *words)


def test_a_map_that_does_not_exist(refused: Output, replay: Replay) -> None:
    arguments = ("run", "--replay", replay.log, "--dbc", replay.dbc, "--map")
    assert all_words(refused(*arguments, "toyotta"), "toyotta", "toyota")
    replay.map.unlink()
    assert all_words(refused(*arguments, replay.map), str(replay.map), "No such file")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "the file is empty"),
        ("garbage\n", "line 1: not a candump line: 'garbage'"),
        (LOG.rstrip("\n"), "no frame in it, read as candump (1 times torn last line)"),
        ("\0" * 500, "no frame in it, read as candump"),
        (LOG + "(1.0) can0 210#01\n", "line 2: not a candump line: '(1.0) can0 210#01'"),
        (
            "(1.000000) can0 00000210#01\n",
            "no frame in it that the bus carries, read as candump (1 times 29-bit",
        ),
    ],
)
def test_a_log_without_a_frame_or_with_a_bad_line(
    refused: Output, replay: Replay, content: str, reason: str
) -> None:
    replay.log.write_text(content)
    assert all_words(refused(*replay.arguments()), str(replay.log), reason)


@pytest.mark.parametrize("ending", ["asc", "blf", "trc", "mf4", "csv", "LOG"])
def test_a_log_that_is_not_of_its_format(refused: Output, replay: Replay, ending: str) -> None:
    other = replay.log.rename(replay.log.with_suffix(f".{ending}"))
    other.write_text("hello\n")
    replay.log = other
    assert str(other) in refused(*replay.arguments())


def test_what_is_about_a_replay_needs_one(refused: Output) -> None:
    assert "only with --replay LOG: leave out --dbc, --skip-bad" in refused("run", "--dbc", "x", "--skip-bad")


def test_a_log_that_is_not_there(refused: Output, replay: Replay) -> None:
    replay.log.unlink()
    assert all_words(refused(*replay.arguments()), str(replay.log), "No such file")


def test_a_record_directory_that_exists(refused: Output, tmp_path: Path) -> None:
    assert all_words(refused("run", "--record", tmp_path), f"--record {tmp_path}: exists already")
    file = tmp_path / "file"
    file.touch()
    assert all_words(refused("run", "--record", file), "exists already")
    assert all_words(refused("run", "--record", file / "below"), str(file))


def test_a_port_in_use(refused: Output) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert all_words(refused("run", "--bus-port", str(port)), f"--bus-port {port}", "in use", "0 for any")


def test_a_run_that_could_not_write_its_files_does_not_start(refused: Output) -> None:
    assert "--mcap no/run.mcap: " in refused("run", "--load", "5", "--mcap", "no/run.mcap")
    assert "--trace .: is a directory" in refused("run", "--load", "5", "--trace", ".")
