"""Radars of other makes by their DBCs: with shipped and proposed maps it brakes where it must, else never."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
import pytest
import yaml
from foreignradars import FOREIGN, TESLA, foreign_drive, messages, saved
from hypothesis import given
from hypothesis import strategies as st
from puredrive import CODEC, DATA
from radarlogs import EGO_MS, FAR, STANDING, Car, drive, write

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import STAGE_FULL, AebOutput, decode_reply
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import (
    BoundMap,
    MapFile,
    Messages,
    bind,
    find_dbc,
    find_map,
    numbered,
    shipped_maps,
)
from aftbed.vehicle.replay.map_proposal import MapProposal, name_pattern, propose, words_of
from aftbed.vehicle.replay.map_trial import try_out
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

APPROACH: Final = (STANDING, *FAR)
PROPOSED: Final = ("esr", "hyundai", "tesla", "ford")
BY_HAND: Final = ("toyota-tss2", "esr")


def dbcs(radar: str, folder: Path, real: bool) -> list[Path]:
    """Those made by the tests, or the radar's real one, which may not be here."""
    path = DATA / "dbc" / FOREIGN[radar].file
    if real and not path.is_file():
        pytest.skip(f"{path.name} is not here")
    return saved(radar, folder, path if real else None)


def proposed(paths: Sequence[Path], frames: Sequence[Frame] = ()) -> MapProposal:
    return propose([load_dbc(path, strict=False) for path in paths], frames)


def bound(proposal: MapProposal) -> BoundMap:
    assert proposal.bound is not None, proposal.problems
    return proposal.bound


def braking(mapped: BoundMap, frames: Sequence[Frame]) -> list[tuple[float, AebOutput]]:
    """When, in seconds, the function decided what; all frames are accepted."""
    gateway, function = MappedGateway(CODEC, mapped), AebFunction()
    made = [(frame.t_us / 1e6, gateway.on_frame(frame)) for frame in frames]
    assert (gateway.counts.refused, gateway.counts.ignored) == ({}, 0)
    return [(t_s, decode_reply(function.execute(one))) for t_s, one in made if one is not None]


def check_drives(mapped: BoundMap, radar: str, dbc: Path) -> None:
    found = braking(mapped, foreign_drive(radar, APPROACH, 4.0, dbc))
    full_s = next(t_s for t_s, output in found if output.stage == STAGE_FULL)
    assert 1.2 < STANDING.ahead_m / EGO_MS - full_s < 2.0
    found = braking(mapped, foreign_drive(radar, FAR, 6.0, dbc))
    assert {output.stage for _, output in found} == {0}


@pytest.mark.simulation
@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize("radar", BY_HAND)
def test_a_shipped_map_brakes_for_a_standing_car_and_for_no_other(
    radar: str, real: bool, tmp_path: Path
) -> None:
    (dbc,) = dbcs(radar, tmp_path, real)
    check_drives(bind(find_map(radar), dbc), radar, dbc)


@pytest.mark.simulation
@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize("radar", PROPOSED)
def test_a_proposed_map_does_the_same(radar: str, real: bool, tmp_path: Path) -> None:
    paths = dbcs(radar, tmp_path, real)
    mapped = bound(proposed(paths, foreign_drive(radar, APPROACH, 2.0, paths[0])))
    check_drives(mapped, radar, paths[0])


# -- what is proposed, by names, units and the log ------------------------------------------------


@cache
def plain(radar: str, seconds: float = 0.5) -> tuple[dict[str, object], tuple[str, ...]]:
    """The map that is proposed from the made DBCs and a log, as it is read again, and the problems."""
    with tempfile.TemporaryDirectory() as folder:
        paths = saved(radar, Path(folder))
        proposal = proposed(paths, foreign_drive(radar, APPROACH, seconds, paths[0]) if seconds else ())
    return yaml.safe_load(proposal.text()), proposal.problems


def test_numbers_in_hexadecimal_and_units_that_the_dbc_lacks() -> None:
    found, problems = plain("hyundai")
    assert found["tracks"] == {
        "messages": {"name": "RADAR_TRACK_{n:x}", "first": 0x500, "last": 0x51F},
        "length": 8,
        "range": {"signal": "LONG_DIST", "unit": "m"},
        "relative_speed": {"signal": "REL_SPEED", "unit": "m/s"},
        "angle": {"signal": "AZIMUTH", "unit": "deg"},
        "valid": {"signal": "STATE", "values": [3]},
    }
    assert (found["cycle_ms"], found["cycle_end"]) == (50, "RADAR_TRACK_51f")
    assert "tracks.range: LONG_DIST has no unit in the DBC; m is taken" in problems
    assert any(problem.startswith("read by canmatrix, as cantools refuses it: ") for problem in problems)


def test_the_ego_speed_comes_from_a_dbc_of_its_own() -> None:
    ego = plain("tesla")[0]["ego"]
    raw = {"start_bit": 47, "length_bits": 16, "byte_order": "big_endian", "signed": False}
    raw |= {"scale": 0.01, "offset": 0.0}
    assert ego == {"can_id": 341, "length": 8, "speed": {"unit": "km/h", "raw": raw}}
    assert plain("esr")[0]["ego"] == {
        "message": "Vehicle_Data",
        "length": 8,
        "speed": {"signal": "CAN_RX_VEHICLE_SPEED", "unit": "m/s"},
    }


def test_the_dbcs_may_come_in_any_order(tmp_path: Path) -> None:
    paths = saved("tesla", tmp_path)
    assert proposed(paths[::-1]).map == proposed(paths).map
    assert bound(proposed(paths[::-1])).codec.path == paths[0]


def test_signals_with_the_number_of_their_message() -> None:
    tracks = plain("ford")[0]["tracks"]
    assert isinstance(tracks, dict)
    assert tracks["messages"] == {"name": "MRR_Detection_{n:03}", "first": 1, "last": 64}
    assert tracks["range"] == {"signal": "CAN_DET_RANGE_{n:02}", "unit": "m"}
    assert tracks["angle"] == {"signal": "CAN_DET_AZIMUTH_{n:02}", "unit": "rad"}
    assert tracks["valid"] == "CAN_DET_VALID_LEVEL_{n:02}"


def test_a_log_shows_the_counter_and_the_checksum() -> None:
    found, problems = plain("toyota-tss2")
    tracks = found["tracks"]
    assert isinstance(tracks, dict)
    assert (tracks["checksum"], tracks["counter"]) == ("toyota", {"signal": "COUNTER", "modulo": 256})
    assert found["cycle_end"] == "TRACK_B_15"
    assert found["others"] == [{"messages": {"name": "TRACK_B_15"}, "length": 8}]
    assert "ego" not in found
    assert problems == (
        "ego: no message that is in the log has the ego's speed; give its DBC with another --dbc",
    )


def test_without_a_log_what_cannot_be_known_is_named() -> None:
    found, problems = plain("toyota-tss2", 0.0)
    tracks = found["tracks"]
    assert isinstance(tracks, dict)
    assert not {"checksum", "counter"} & tracks.keys()
    assert [problem.partition(":")[0] for problem in problems] == [
        "tracks.checksum",
        "tracks.counter",
        "cycle_end",
        "cycle_ms",
        "ego",
    ]


def test_objects_that_are_announced_are_found() -> None:
    log = drive("ars408-like", APPROACH, 3.5)
    mapped = bound(proposed([find_dbc("ars408-like")], log))
    by_hand = bind(find_map("ars408-like"), find_dbc("ars408-like")).map
    tracks = mapped.map.tracks
    assert (tracks.slot, tracks.count, mapped.map.cycle_ms) == ("Obj_ID", by_hand.tracks.count, 75)
    assert any(output.stage == STAGE_FULL for _, output in braking(mapped, log))


def test_where_nothing_says_what_is_valid_a_range_of_0_is_no_target(tmp_path: Path) -> None:
    (dbc,) = saved("esr", tmp_path)
    log = foreign_drive("esr", APPROACH, 0.2, dbc)
    dbc.write_text(dbc.read_text().replace("CAN_TX_TRACK_STATUS", "CAN_TX_TRACK_X"))
    decoded = try_out(bound(proposed([dbc], log)), log)
    assert (decoded.targets, decoded.range_m) == (3, (55.0, 140.4))


def test_the_shipped_maps_with_their_dbcs_are_proposed_again() -> None:
    """For the radar of the ESR's kind, whose ego speed no DBC has, all but that."""
    proposal = proposed([find_dbc("esr-like")], drive("esr-like", APPROACH, 0.5))
    found, by_hand = yaml.safe_load(proposal.text()), yaml.safe_load(find_map("esr-like").read_text())
    for key in ("messages", "length", "range", "angle", "relative_speed"):
        assert found["tracks"][key] == by_hand["tracks"][key]
    assert found["cycle_end"] == by_hand["cycle_end"]


@pytest.mark.parametrize(
    ("factor", "unit", "scale"),
    [
        (1.0, "m/s", None),
        (-1.0, "m/s", -1),
        (3.6, "km/h", None),
        (-3.6, "km/h", -1),
        (1 / 0.44704, "mph", None),
    ],
)
def test_how_the_range_changes_shows_unit_and_sign_of_the_speed(
    factor: float, unit: str, scale: int | None, tmp_path: Path
) -> None:
    """A radar whose DBC has no unit; its speed is what the range says, times `factor`."""
    layout = TESLA.replace('"meters/sec"', '""').replace("(0.0625,-128) [-128|128]", "(0.0625,-128) [0|0]")
    names = {0x200 + n: (f"T{n}", n) for n in range(4)}
    ego = 'BO_ 1 EGO: 2 X\n SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|0] "km/h" X\n'
    (tmp_path / "radar.dbc").write_text("BU_: X\n" + messages(layout, names) + ego)
    codec = load_dbc(tmp_path / "radar.dbc")
    empty = dict.fromkeys(codec.signal_names("T0"), 0.0)
    log = []
    for cycle in range(20):
        log.append(Frame(cycle * 50_000, 1, (5000).to_bytes(2, "little")))
        for n in range(4):
            values = (
                {"LongDist": 50.0 - 0.25 * cycle, "LongSpeed": -5.0 * factor, "Valid": 1} if n == 1 else {}
            )
            log.append(Frame(cycle * 50_000 + n, 0x200 + n, codec.encode(f"T{n}", empty | values)))
    proposal = propose([codec], log)
    speed = {"signal": "LongSpeed", "unit": unit} | ({"scale": scale} if scale else {})
    tracks = yaml.safe_load(proposal.text())["tracks"]
    assert tracks["relative_speed"] == speed
    decoded = try_out(bound(proposal), log)
    assert decoded.relative_speed_ms == (pytest.approx(-5.0, abs=0.02),) * 2
    assert decoded.problems() == []


def test_a_message_that_does_not_always_come_ends_no_cycle(tmp_path: Path) -> None:
    paths = saved("ford", tmp_path)
    log = foreign_drive("ford", APPROACH, 1.0, paths[0])
    once, pause = range(250_000, 300_000), range(300_000, 400_000)
    sparse = [
        one
        for one in log
        if (one.can_id < 0x150 or one.can_id == 1045 or one.t_us in once) and one.t_us not in pause
    ]
    mapped = bound(proposed(paths, sparse)).map
    assert (mapped.cycle_end, mapped.cycle_ms) == ("MRR_Detection_048", 50)
    assert mapped.tracks.messages == Messages("MRR_Detection_{n:03}", 1, 64)


def test_of_two_radars_the_one_whose_ranges_move_is_taken(tmp_path: Path) -> None:
    """The other one has units, and so the better names."""
    still = {0x600 + n: (f"STILL_{n}", n) for n in range(8)}
    paths = saved("hyundai", tmp_path)
    paths[0].write_text(paths[0].read_text() + messages(TESLA, still))
    log = list(foreign_drive("hyundai", APPROACH, 0.5, paths[0]))
    again = [Frame(t_us, can_id, bytes(8)) for t_us in range(0, 500_000, 50_000) for can_id in still]
    assert bound(proposed(paths, log + again)).map.tracks.range.signal == "LONG_DIST"
    assert yaml.safe_load(proposed(paths).text())["tracks"]["range"]["signal"] == "LongDist"


def test_a_message_that_contradicts_itself_makes_the_map_say_so(tmp_path: Path) -> None:
    paths = saved("hyundai", tmp_path)
    log = foreign_drive("hyundai", APPROACH, 0.25, paths[0])
    paths[0].write_text(paths[0].read_text().replace("UNKNOWN_1 : 7|8@0-", "UNKNOWN_1 : 12|8@0-"))
    proposal = proposed(paths, log)
    assert "strict: signals of messages that are used overlap, or lie outside" in proposal.problems
    file = tmp_path / "map.yaml"
    file.write_text(proposal.text())
    assert bind(file, paths[0]).map.strict is False
    file.write_text(proposal.text().replace("strict: false", "strict: true"))
    with pytest.raises(ConfigError, match="overlapping"):
        bind(file, paths[0])


def test_a_dbc_without_a_radar_makes_no_map(tmp_path: Path) -> None:
    proposal = proposed([saved("tesla", tmp_path)[1]])
    assert (proposal.map, proposal.bound) == (None, None)
    assert (
        proposal.problems[-1]
        == "no message has a distance, a relative speed and a lateral offset or an angle"
    )


def test_what_no_map_may_have_is_among_the_problems(tmp_path: Path) -> None:
    paths = saved("tesla", tmp_path)
    paths[1].write_text('BU_: X\nBO_ 341 ESP_B: 8 X\n SG_ VehicleSpeed : 0|40@1+ (0.01,0) [0|0] "kph" X\n')
    proposal = proposed(paths)
    assert proposal.bound is None
    assert "length_bits" in proposal.problems[-1]


def test_a_log_of_another_radar_is_named(tmp_path: Path) -> None:
    paths = saved("esr", tmp_path)
    proposal = proposed(paths, [Frame(0, 0x001, b"\0")])
    assert "the log has no frame of the radar: none of Target1, ..." in proposal.problems


@pytest.mark.parametrize("name", shipped_maps())
def test_shipped_maps_have_the_shape_of_a_map(name: str) -> None:
    assert isinstance(msgspec.convert(yaml.safe_load(find_map(name).read_text()), MapFile), MapFile)


# -- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("CAN_DET_RANGE_RATE_04", {"can", "det", "range", "rate", "04"}),
        ("TrkRangeRate", {"trk", "range", "rate"}),
        ("Obj_VrelLong", {"obj", "vrel", "long"}),
        ("ESP_vehicleSpeed", {"esp", "vehicle", "speed"}),
        ("DI_vehicleSpeed2nd", {"di", "vehicle", "speed", "2", "nd"}),
        ("VehVActlBrk", {"veh", "v", "actl", "brk"}),
    ],
)
def test_words_of_a_name(name: str, words: set[str]) -> None:
    assert words_of(name) == words


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (["TRACK_0", "TRACK_1", "TRACK_2"], ("TRACK_{n}", range(3))),
        ([f"T{n:02}" for n in range(1, 12)], ("T{n:02}", range(1, 12))),
        ([f"T{n}" for n in range(8, 12)], ("T{n}", range(8, 12))),
        (["R_510", "R_511"], ("R_{n}", range(510, 512))),
        ([f"R_{n:x}" for n in range(0x500, 0x520)], ("R_{n:x}", range(0x500, 0x520))),
        ([f"M_{n:X}hex" for n in range(0x310, 0x36E, 3)], ("M_{n:X}hex", range(0x310, 0x36E, 3))),
        (["Point0_A", "Point1_A"], ("Point{n}_A", range(2))),
        (["T10", "T20", "T30"], ("T{n}", range(10, 31, 10))),
        (["LEFT", "RIGHT"], None),
        (["T1", "T2", "T4"], None),
        (["T1", "T02"], None),
        (["T65536", "T65537"], None),
        (["T2", "T1"], None),
    ],
)
def test_a_pattern_for_names(names: list[str], pattern: tuple[str, range] | None) -> None:
    found = name_pattern(names)
    assert (found and (found[0], [*found[1]])) == (pattern and (pattern[0], [*pattern[1]]))


@given(st.lists(st.text("aF019_", min_size=1, max_size=6), min_size=2, max_size=5, unique=True))
def test_a_pattern_gives_the_names_again(names: list[str]) -> None:
    found = name_pattern(names)
    assert found is None or [numbered(found[0], number) for number in found[1]] == names


@given(st.data())
def test_any_frames_make_a_proposal(data: st.DataObject) -> None:
    """Of the ids and lengths of the radar, or others; what is proposed binds, or says why not."""
    codecs, ids = _shared()
    frame = st.tuples(st.integers(0, 200_000), st.sampled_from(ids), st.binary(max_size=8))
    log, t_us = [], 0
    for step_us, can_id, content in data.draw(st.lists(frame, max_size=30)):
        t_us += step_us
        log.append(Frame(t_us, can_id, content))
    proposal = propose(codecs, log)
    assert proposal.map is not None
    if proposal.bound is not None:
        decoded = try_out(proposal.bound, log)
        assert decoded.accepted + decoded.ignored + sum(decoded.refused.values()) == len(log)
    else:
        assert any(problem.startswith("ego: ") for problem in proposal.problems)


@cache
def _shared() -> tuple[list[Codec], list[int]]:
    with tempfile.TemporaryDirectory() as folder:
        codecs = [load_dbc(path, strict=False) for path in saved("hyundai", Path(folder))]
    return codecs, [902, 0x500, 0x501, 0x51F, 0x7FF]


# -- real processes -------------------------------------------------------------------------------


@pytest.mark.process
@pytest.mark.parametrize("radar", PROPOSED)
def test_a_map_is_proposed_and_a_crash_in_the_midst_of_its_replay_is_masked(
    radar: str, tmp_path: Path
) -> None:
    paths = saved(radar, tmp_path)
    log = write(tmp_path / "drive.log", foreign_drive(radar, (*APPROACH, Car(100.0, 0.0)), 3.2, paths[0]))
    words = ["map", "new", *(word for path in paths for word in ("--dbc", str(path))), "--log", str(log)]
    done = _aftbed(*words, "--out", str(tmp_path / "map.yaml"))
    assert done.returncode == 0, done.stdout + done.stderr
    words = ["run", "--replay", str(log), "--dbc", str(paths[0]), "--map", str(tmp_path / "map.yaml")]
    done = _aftbed(*words, "--pace", "max", "--inject", "crash primary at server.exit nth 30", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    found = msgspec.json.decode(done.stdout)
    played, counted = found["replay"]["played"], found["replay"]["gateway"]
    assert (found["verdict"], len(found["failovers"]), counted["refused"]) == ("pass", 1, {})
    assert found["requests"]["answered"] == played["cycles"] > 50
    assert played["stage_max"] == STAGE_FULL


def _aftbed(*words: str) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryDirectory(prefix="aft-", dir="/tmp") as home:  # a socket's path may be 108 bytes
        return subprocess.run(
            [sys.executable, "-m", "aftbed", *words],
            env=os.environ | {"XDG_RUNTIME_DIR": home},
            capture_output=True,
            timeout=60,
            check=False,
            text=True,
        )
