"""What a map may say of messages, signals and units, in a radar of two tracks made for each case."""

from collections.abc import Callable

import pytest
from puredrive import CODEC

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.messages import AebInput, decode_request
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import bind, find_dbc, find_map
from aftbed.vehicle.replay.mapped_gateway import MappedGateway
from aftbed.vehicle.replay.units import Dimension, unit_names, unit_of

SIGNALS = """\
 SG_ RANGE{n} : 7|16@0+ ({scale},0) [0|0] "{distance}" X
 SG_ SPEED{n} : 23|16@0- ({scale},0) [0|0] "{speed}" X
 SG_ ANGLE{n} : 39|8@0- (0.5,0) [-64|63.5] "{angle}" X
 SG_ SIDE{n} : 47|8@0- (1,0) [-128|127] "{distance}" X
 SG_ VALID{n} : 49|2@0+ (1,0) [0|3] "" X
 SG_ COUNT{n} : 63|8@0+ (1,0) [0|255] "" X
"""

MAP = """\
description: a radar of two tracks
cycle_ms: 50
cycle_end: END
ego: {message: EGO, length: 2, speed: {signal: EGO_SPEED}}
tracks:
  messages: MESSAGES
  length: 8
  range: {signal: RANGE}
  relative_speed: {signal: SPEED}
  lateral_offset: {signal: SIDE}
  valid: VALID
others: [{messages: [END], length: 1}]
"""

Make = Callable[..., MappedGateway]


@pytest.fixture
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """A gateway; `names` of the two track messages, `digits` in the names of their signals."""

    def build(
        messages: str,
        *changes: tuple[str, str],
        names: tuple[str, str] = ("T1", "T2"),
        digits: tuple[str, str] = ("", ""),
        distance: str = "m",
        speed: str = "m/s",
        angle: str = "deg",
        scale: float = 1,
        id_: int = 0x600,
    ) -> MappedGateway:
        folder = tmp_path_factory.mktemp("map")
        text = f'BU_: X\nBO_ 1 EGO: 2 X\n SG_ EGO_SPEED : 7|16@0+ (0.1,0) [0|0] "{speed}" X\nBO_ 2 END: 1 X\n'
        for number, (name, digit) in enumerate(zip(names, digits, strict=True)):
            text += f"BO_ {id_ + number} {name}: 8 X\n"
            text += SIGNALS.format(n=digit, scale=scale, distance=distance, speed=speed, angle=angle)
        (folder / "radar.dbc").write_text(text)
        found = MAP.replace("MESSAGES", messages)
        for old, new in changes:
            assert old in found
            found = found.replace(old, new)
        (folder / "radar.yaml").write_text(found)
        return MappedGateway(CODEC, bind(folder / "radar.yaml", folder / "radar.dbc"))

    return build


def cycle(gateway: MappedGateway, raw_range: int = 300, raw_speed: int = -20, side: int = 0) -> AebInput:
    """The request of one cycle: ego speed 100, one target in the second message."""
    data = raw_range.to_bytes(2, "big") + raw_speed.to_bytes(2, "big", signed=True)
    data += bytes([side & 0xFF, side & 0xFF, 1, 9])
    frames = [
        Frame(0, 1, (1000).to_bytes(2, "big")),
        Frame(1, 0x600, bytes(8)),
        Frame(2, 0x601, data),
        Frame(3, 2, b"\0"),
    ]
    made = [gateway.on_frame(frame) for frame in frames]
    assert gateway.counts.refused == {}
    assert made[:3] == [None] * 3
    assert made[3] is not None
    return decode_request(made[3])


@pytest.mark.parametrize(
    ("messages", "names"),
    [
        ("[LEFT, RIGHT]", ("LEFT", "RIGHT")),
        ("{name: 'R_{n:x}', first: 0x5ff, last: 0x600}", ("R_5ff", "R_600")),
        ("{name: 'R_{n:X}hex', first: 0x31C, last: 0x31F, step: 3}", ("R_31Chex", "R_31Fhex")),
        ("{name: 'R{n:04x}', first: 300, last: 301}", ("R012c", "R012d")),
    ],
)
def test_messages_by_list_and_by_hexadecimal_numbers(
    make: Make, messages: str, names: tuple[str, str]
) -> None:
    (target,) = cycle(make(messages, names=names)).targets
    assert (target.slot, target.range_m, target.rel_speed_ms) == (1, 300.0, -20.0)


@pytest.mark.parametrize(
    ("messages", "names", "digits"),
    [
        ("{name: 'D_{n:03}', first: 63, last: 64}", ("D_063", "D_064"), ("_63", "_64")),
        ("{name: 'D{n:x}', first: 10, last: 11}", ("Da", "Db"), ("_10", "_11")),
        ("[LEFT, RIGHT]", ("LEFT", "RIGHT"), ("_00", "_01")),
    ],
)
def test_the_number_stands_in_the_signals_as_well(
    make: Make, messages: str, names: tuple[str, str], digits: tuple[str, str]
) -> None:
    changes = [(f"{name}}}", f"'{name}_{{n:02}}'}}") for name in ("RANGE", "SIDE")]
    changes += [("{signal: SPEED}", "{signal: 'SPEED_{n:02}'}")]
    changes += [("valid: VALID", "valid: {signal: 'VALID_{n:02}', values: [1]}\n  new: 'VALID_{n:02}'")]
    changes += [("  length: 8\n", "  length: 8\n  counter: {signal: 'COUNT_{n:02}', modulo: 256}\n")]
    gateway = make(messages, *changes, names=names, digits=digits)
    (target,) = cycle(gateway).targets
    assert (target.slot, target.new, target.range_m, target.rel_speed_ms) == (1, True, 300.0, -20.0)
    assert [gateway.on_frame(Frame(4, 0x601, bytes([0] * 7 + [count]))) for count in (9, 10)] == [None] * 2
    assert gateway.counts.refused == {"repeated": 1}


@pytest.mark.parametrize(
    ("distance", "speed", "range_m", "speed_ms", "ego_ms"),
    [
        ("meters", "meters/sec", 300.0, -20.0, 100.0),
        ("Meter", "KPH", 300.0, -20.0 / 3.6, 100.0 / 3.6),
        ("cm", "km/h", 3.0, -20.0 / 3.6, 100.0 / 3.6),
        ("Unit_Meter", "Unit_KiloMeterPerHour", 300.0, -20.0 / 3.6, 100.0 / 3.6),
        (" metres", "MPH", 300.0, -8.9408, 44.704),
        ("feet", "m/S", 91.44, -20.0, 100.0),
    ],
)
def test_units_are_those_of_the_dbc(
    make: Make, distance: str, speed: str, range_m: float, speed_ms: float, ego_ms: float
) -> None:
    request = cycle(make("[T1, T2]", distance=distance, speed=speed))
    (target,) = request.targets
    assert target.range_m == pytest.approx(range_m, abs=0.001)
    assert target.rel_speed_ms == pytest.approx(speed_ms, abs=0.001)
    assert request.ego_speed_ms == pytest.approx(ego_ms, abs=0.001)


@pytest.mark.parametrize(
    ("angle", "unit", "count"),
    [("deg", "", 1), ("", ", unit: degrees", 1), ("rad", "", 0), ("°", "", 1), ("", ", unit: mrad", 1)],
)
def test_polar_tracks_take_the_angle_in_the_units_of_the_dbc(
    make: Make, angle: str, unit: str, count: int
) -> None:
    change = ("lateral_offset: {signal: SIDE}", f"angle: {{signal: ANGLE{unit}}}")
    request = cycle(make("[T1, T2]", change, angle=angle), 50, side=2)  # 1 degree is 0.9 m, 1 rad 42 m
    assert len(request.targets) == count
    if count and unit != ", unit: mrad":
        assert request.targets[0].range_m == pytest.approx(49.99, abs=0.01)


def test_a_scale_makes_up_for_one_that_the_dbc_lacks(make: Make) -> None:
    changes = (
        ("range: {signal: RANGE}", "range: {signal: RANGE, unit: m, scale: 0.0625}"),
        ("relative_speed: {signal: SPEED}", "relative_speed: {signal: SPEED, scale: -1}"),
    )
    side = ("{signal: SIDE}", "{signal: SIDE, unit: m}")
    (target,) = cycle(make("[T1, T2]", *changes, side, distance=""), 800, 20).targets
    assert (target.range_m, target.rel_speed_ms) == (50.0, -20.0)


@pytest.mark.parametrize(
    ("old", "new", "options", "reason"),
    [
        (
            "",
            "",
            {"distance": ""},
            "tracks.range.unit: found none, allowed is a distance, in m, cm, mm, ft, as",
        ),
        ("", "", {"speed": "speed"}, "EGO_SPEED has the unit 'speed' in the DBC"),
        (
            "",
            "",
            {"distance": "m/s"},
            "tracks.range.unit: found m/s, as RANGE has in the DBC, allowed is a dis",
        ),
        (
            "signal: RANGE",
            "signal: RANGE, unit: yards",
            {},
            "found yards, allowed is a distance, in m, cm, mm",
        ),
        (
            "signal: SPEED",
            "signal: SPEED, unit: kph",
            {},
            "found kph, allowed is m/s, as SPEED has in the DBC",
        ),
        ("[T1, T2]", "[T1, T3]", {}, "tracks.messages: unknown message 'T3'; did you mean 'T"),
        ("[T1, T2]", "[]", {}, "tracks.messages: found [], allowed is"),
        ("[T1, T2]", "[T1, T1]", {}, "tracks: found T1 (0x600) mapped twice"),
        ("[T1, T2]", "{name: 'T{n}', first: 1, last: 300}", {}, "found 300 messages, allowed is at most 256"),
        (
            "[T1, T2]",
            "{name: 'T{n}', first: 1, last: 70000}",
            {},
            "last: found 70000, allowed is a whole number",
        ),
        ("signal: RANGE", "signal: 'RANGE_{n}'", {}, "tracks.range.signal: unknown signal of T1 'RANGE_0'"),
        ("", "", {"id_": 0x8000_0600}, "tracks: found T1 (0x600, of 29 bits), allowed is an id of 11 bits"),
    ],
)
def test_what_the_dbc_does_not_have_is_refused(
    make: Make, old: str, new: str, options: dict[str, object], reason: str
) -> None:
    with pytest.raises(ConfigError) as error:
        make("[T1, T2]", *([(old, new)] if old else []), **options)
    assert reason in str(error.value)


def test_a_unit_that_is_not_known_is_a_problem_where_the_map_has_one(make: Make) -> None:
    gateway = make("[T1, T2]", ("SPEED}", "SPEED, unit: kph}"), speed="speed")
    assert cycle(gateway).ego_speed_ms == pytest.approx(100 / 3.6, abs=0.001)
    assert gateway._bound.problems == (
        "ego.speed.unit: EGO_SPEED has the unit 'speed' in the DBC, which aftbed does not know;"
        " km/h is taken",
        "tracks.relative_speed.unit: SPEED has the unit 'speed' in the DBC, which aftbed does not know;"
        " km/h is taken",
    )


def test_every_name_of_a_unit_spells_it() -> None:
    for dimension in Dimension:
        for name in unit_names(dimension):
            unit = unit_of(name)
            assert unit is not None
            assert (unit.name, unit.dimension) == (name, dimension)
    assert unit_of("") is unit_of("%") is unit_of("m/s^2") is unit_of("deg/s") is None


def test_of_the_names_of_another_radar_the_nearest_are_shown() -> None:
    with pytest.raises(ConfigError) as error:
        bind(find_map("toyota-tss2"), find_dbc("esr-like"))
    found = str(error.value)
    assert "tracks.messages.name: unknown message 'TRACK_A_0'; did you mean 'ESR_Track" in found
    assert found.count("ESR_Track") == 11
    assert " and 54 more, by " in found
