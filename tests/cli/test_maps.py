"""`aftbed map`: what it prints and writes, and what it refuses."""

import json
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call, Output

from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.replay.map_file import find_map, read_map

DBC: Final = """\
BU_: X
BO_ 1 EGO: 2 X
 SG_ VehicleSpeed : 7|16@0+ (0.01,0) [0|300] "KPH" X
BO_ 512 OBJ_0: 8 X
 SG_ LongDist : 7|16@0+ (0.01,0) [0|300] "meters" X
 SG_ RelSpeed : 23|16@0- (0.01,0) [-100|100] "m/sec" X
 SG_ LatDist : 39|8@0- (0.1,0) [-12|12] "meters" X
 SG_ Status : 41|2@0+ (1,0) [0|3] "" X
BO_ 513 OBJ_1: 8 X
 SG_ LongDist : 7|16@0+ (0.01,0) [0|300] "meters" X
 SG_ RelSpeed : 23|16@0- (0.01,0) [-100|100] "m/sec" X
 SG_ LatDist : 39|8@0- (0.1,0) [-12|12] "meters" X
 SG_ Status : 41|2@0+ (1,0) [0|3] "" X
BO_ 900 FD_ELSEWHERE: 64 X
 SG_ A : 0|8@1+ (1,0) [0|1] "" X
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With a DBC, and a log of ten cycles at 36 km/h towards what stands in front."""
    monkeypatch.chdir(tmp_path)
    Path("radar.dbc").write_text(DBC)
    codec = load_dbc(Path("radar.dbc"))
    lines = []
    for cycle in range(10):
        seen = {"LongDist": 30.0 - 0.5 * cycle, "RelSpeed": -10.0, "LatDist": 0.0, "Status": 2}
        frames = [(1, codec.encode("EGO", {"VehicleSpeed": 36.0}))]
        frames += [(512, codec.encode("OBJ_0", seen)), (513, codec.encode("OBJ_1", dict.fromkeys(seen, 0.0)))]
        lines += [
            f"(0000000100.{50_000 * cycle + place:06}) can0 {can_id:03X}#{data.hex()}\n"
            for place, (can_id, data) in enumerate(frames)
        ]
    Path("drive.log").write_text("".join(lines))
    return tmp_path


def test_the_shipped_maps_are_listed(output: Output) -> None:
    lines = output("map", "list").splitlines()
    assert [line.split()[0] for line in lines] == ["ars408-like", "esr", "esr-like", "toyota", "toyota-tss2"]
    assert [line.endswith("(needs its DBC)") for line in lines] == [False, True, False, True, True]
    found = json.loads(output("map", "list", "--json"))["maps"]
    assert found[0] == {
        "name": "ars408-like",
        "description": read_map(find_map("ars408-like")).description,
        "cycle_ms": 75,
        "dbc_shipped": True,
    }


def test_a_proposed_map_is_written_and_shows_what_it_decodes(folder: Path, output: Output) -> None:
    found = output("map", "new", "--dbc", "radar.dbc", "--log", "drive.log", "--out", "map.yaml")
    assert found == (
        "map.yaml: written\n"
        "  dbc     radar.dbc\n"
        "  tracks  2 messages, OBJ_0 to OBJ_1, Cartesian\n"
        "  values  range LongDist, relative_speed RelSpeed, lateral_offset LatDist\n"
        "  ego     EGO: speed VehicleSpeed\n"
        "  cycle   50 ms, ends with OBJ_1\n"
        "  log     30 frames: 30 accepted, 0 of others, none refused\n"
        "  cycles  10: 10 with the ego's speed, 10 with targets in our path, 1 at most\n"
        "  ego     36.0 km/h\n"
        "  range   25.5 to 30.0 m\n"
        "  speed   -10.0 m/s, relative\n"
        "  0.00 s  ego 36.0 km/h; 30.0 m -10.0 m/s\n"
        "  0.15 s  ego 36.0 km/h; 28.5 m -10.0 m/s\n"
        "  0.30 s  ego 36.0 km/h; 27.0 m -10.0 m/s\n"
        "  0.45 s  ego 36.0 km/h; 25.5 m -10.0 m/s\n"
        "to be looked at\n"
        "  tracks.valid: Status has 4 values; taken for valid: 2 (seen with a distance in the log)\n"
    )
    checked = output("map", "check", "./map.yaml", "--dbc", "radar.dbc", "--log", "drive.log")
    assert checked.splitlines()[1:15] == found.splitlines()[1:15]


def test_what_is_printed_without_out_is_a_map(folder: Path, output: Output) -> None:
    Path("map.yaml").write_text(output("map", "new", "--dbc", "radar.dbc", "--log", "drive.log"))
    found = json.loads(
        output("map", "check", "./map.yaml", "--dbc", "radar.dbc", "--log", "drive.log", "--json")
    )
    assert (found["map"], found["dbc"], found["tracks"], found["problems"]) == (
        "./map.yaml",
        "radar.dbc",
        2,
        [],
    )
    assert found["messages"] == [
        {"name": "EGO", "can_id": 1, "use": "ego"},
        {"name": "OBJ_0", "can_id": 512, "use": "track"},
        {"name": "OBJ_1", "can_id": 513, "use": "track"},
    ]
    decoded = found["decoded"]
    assert (decoded["frames"], decoded["accepted"], decoded["cycles"]) == (30, 30, 10)
    assert (decoded["range_m"], decoded["ego_kmh"]) == ([25.5, 30.0], [36.0, 36.0])


def test_the_document_of_a_proposal(folder: Path, output: Output) -> None:
    found = json.loads(output("map", "new", "--dbc", "radar.dbc", "--log", "drive.log", "--json"))
    assert (found["written"], found["dbc"]) == (None, "radar.dbc")
    assert "messages: {name: 'OBJ_{n}', first: 0, last: 1}" in found["map"]
    assert (found["tracks"], len(found["messages"]), found["decoded"]["cycles"]) == (2, 3, 10)
    assert found["problems"] == [
        "tracks.valid: Status has 4 values; taken for valid: 2 (seen with a distance in the log)"
    ]


def test_the_document_of_a_map_that_is_written(folder: Path, output: Output) -> None:
    found = json.loads(output("map", "new", "--dbc", "radar.dbc", "--out", "map.yaml", "--json"))
    assert (found["written"], found["map"], found["decoded"]) == (
        "map.yaml",
        Path("map.yaml").read_text(),
        None,
    )


def test_a_map_that_makes_nothing_of_the_log_ends_with_1(folder: Path, call: Call) -> None:
    Path("other.log").write_text("(0000000100.000000) can0 7FF#00\n")
    code, out, _ = call("map", "check", "esr-like", "--log", "other.log")
    assert (code, out.splitlines()[-1]) == (1, "  no frame of the log is one of the map's messages")
    Path("half.log").write_text("(0000000100.000000) can0 4F0#0000000000000000\n")
    code, out, _ = call("map", "check", "esr-like", "--log", "half.log")
    assert (code, out.splitlines()[-1]) == (
        1,
        "  no radar cycle ends in the log: nothing is asked of the function",
    )


def test_cycles_without_ego_speed_or_targets_end_with_1(folder: Path, call: Call) -> None:
    Path("empty.log").write_text("(0000000100.000000) can0 53F#0000000000000000\n")
    code, out, _ = call("map", "check", "esr-like", "--log", "empty.log")
    assert (code, out.splitlines()[-2:]) == (
        1,
        ["  no cycle knows the ego's speed", "  no cycle has a target in our path"],
    )


def test_a_proposal_that_is_not_whole_ends_with_1(folder: Path, call: Call) -> None:
    Path("radar.dbc").write_text(DBC.replace('"KPH"', '"%"'))
    code, out, _ = call("map", "new", "--dbc", "radar.dbc")
    assert (code, "# - ego: no message in the DBC has the ego's speed; give" in out) == (1, True)
    Path("radar.dbc").write_text(DBC.replace("LongDist", "Height"))
    code, out, _ = call("map", "new", "--dbc", "radar.dbc", "--out", "map.yaml")
    assert (code, out.splitlines()[0], Path("map.yaml").exists()) == (1, "no map", False)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("check", "toyota"), "map check toyota: its DBC is not shipped; --dbc FILE is needed\n"),
        (("check", "toyotta", "--dbc", "radar.dbc"), "unknown map 'toyotta'; did you mean 'toyota'? "),
        (
            ("check", "toyota", "--dbc", "radar.dbc"),
            "toyota.yaml: line 18, column 20: tracks.messages.name: unknown message 'TRACK_A_0' (one",
        ),
        (
            ("check", "ars408-like", "--dbc", "esr-like"),
            "ars408-like.yaml: line 9, column 12: ego.message: unknown message 'SpeedInformation'",
        ),
        (("check", "esr-like", "--log", "none.log"), "none.log: cannot be read: No such file"),
        (("check", "esr-like", "--log", "radar.dbc"), "radar.dbc: no frame in it, read as candump ("),
        (("new", "--dbc", "drive.log"), "drive.log: not a DBC that can be read: Invalid syntax at line 1"),
        (
            ("new", "--dbc", "radar.dbc", "--out", "drive.log"),
            "--out drive.log: exists; --force overwrites it\n",
        ),
        (
            ("new", "--dbc", "radar.dbc", "--out", "no/map.yaml"),
            "--out no/map.yaml: a file in a directory that",
        ),
        (("new",), "map new: --dbc FILE is needed, the DBC of the radar\n"),
    ],
)
def test_what_does_not_fit_is_refused(
    folder: Path, refused: Output, words: tuple[str, ...], error: str
) -> None:
    assert error in refused("map", *words)


def test_a_replay_by_a_map_of_another_radar_is_refused_before_the_start(
    folder: Path, refused: Output
) -> None:
    found = refused("run", "--replay", "drive.log", "--dbc", "radar.dbc", "--map", "esr")
    assert "esr.yaml: line 10, column 12: ego.message: unknown message 'Vehicle_Data'" in found
    found = refused("run", "--replay", "drive.log", "--dbc", "radar.dbc", "--map", "toyota-tss2")
    assert "toyota-tss2.yaml: line 18, column 20: tracks.messages.name: unknown message 'TRACK_A_0'" in found


def test_a_file_is_overwritten_with_force(folder: Path, output: Output) -> None:
    for _ in range(2):
        output("map", "new", "--dbc", "radar.dbc", "--out", "map.yaml", "--force")
    assert Path("map.yaml").read_text().startswith("# Proposed by `aftbed map new`")
