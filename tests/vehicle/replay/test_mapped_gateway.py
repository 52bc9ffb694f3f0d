"""The mapped gateway: Toyota's radar, the real drive, and maps that do not fit."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from puredrive import CODEC

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.messages import AebInput, AebTarget, decode_request
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import RawSignal, bind
from aftbed.vehicle.replay.mapped_gateway import MappedGateway, toyota_checksum

DBC = """
BU_: X
BO_ 528 TRACK_0: 8 X
 SG_ COUNTER : 7|8@0+ (1,0) [0|255] "" X
 SG_ RANGE : 15|16@0+ (0.01,0) [0|300] "m" X
 SG_ SPEED : 31|12@0- (0.025,0) [-100|100] "m/s" X
 SG_ SIDE : 47|8@0- (0.1,0) [-10|10] "m" X
 SG_ VALID : 48|1@0+ (1,0) [0|1] "" X
 SG_ NEW : 49|1@0+ (1,0) [0|1] "" X
 SG_ SUM : 63|8@0+ (1,0) [0|255] "" X
BO_ 529 TRACK_1: 8 X
 SG_ COUNTER : 7|8@0+ (1,0) [0|255] "" X
 SG_ RANGE : 15|16@0+ (0.01,0) [0|300] "m" X
 SG_ SPEED : 31|12@0- (0.025,0) [-100|100] "m/s" X
 SG_ SIDE : 47|8@0- (0.1,0) [-10|10] "m" X
 SG_ VALID : 48|1@0+ (1,0) [0|1] "" X
 SG_ NEW : 49|1@0+ (1,0) [0|1] "" X
BO_ 559 END: 2 X
 SG_ COUNTER : 7|8@0+ (1,0) [0|255] "" X
"""

MAP = """
description: a small radar
cycle_ms: 50
cycle_end: END
ego: {can_id: 0x0B4, length: 8, checksum: toyota, speed:
  {unit: km/h, raw: {start_bit: 47, length_bits: 16, byte_order: big_endian, scale: 0.01}}}
tracks:
  messages: {name: "TRACK_{n}", first: 0, last: 1}
  length: 8
  checksum: toyota
  counter: {signal: COUNTER, modulo: 256}
  range: {signal: RANGE, unit: m}
  relative_speed: {signal: SPEED, unit: m/s}
  lateral_offset: {signal: SIDE, unit: m}
  valid: VALID
  new: NEW
others:
  - {messages: {name: END}, length: 2, counter: {signal: COUNTER, modulo: 256}}
"""

Make = Callable[..., MappedGateway]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """A gateway by DBC and MAP, in each of which one text was replaced by another."""

    def build(old: str = "", new: str = "", *, dbc: tuple[str, str] = ("", "")) -> MappedGateway:
        folder = tmp_path_factory.mktemp("map")
        assert old in MAP
        assert dbc[0] in DBC
        (folder / "radar.dbc").write_text(DBC.replace(*dbc, 1))
        (folder / "radar.yaml").write_text(MAP.replace(old, new, 1) if old else MAP)
        return MappedGateway(CODEC, bind(folder / "radar.yaml", folder / "radar.dbc"))

    return build


def signed(t_ms: int, can_id: int, data: bytes) -> Frame:
    """A frame with Toyota's checksum in the place of its last byte."""
    return Frame(t_ms * 1000, can_id, data[:-1] + bytes([toyota_checksum(can_id, data)]))


def ego(t_ms: int, speed_kmh: float = 36.0) -> Frame:
    return signed(t_ms, 0x0B4, bytes(5) + round(speed_kmh * 100).to_bytes(2, "big") + b"\0")


def track(
    t_ms: int,
    slot: int,
    counter: int,
    range_m: float = 30.0,
    speed_ms: float = -2.0,
    flags: int = 1,
    side: int = 0,
) -> Frame:
    raw_range, raw_speed = round(range_m * 100), round(speed_ms / 0.025) & 0xFFF
    data = bytes([counter, raw_range >> 8, raw_range & 0xFF, raw_speed >> 4, (raw_speed & 0xF) << 4])
    return signed(t_ms, 0x210 + slot, data + bytes([side, flags, 0]))


def end(t_ms: int, counter: int) -> Frame:
    return Frame(t_ms * 1000, 0x22F, bytes([counter, 0]))


def feed(gateway: MappedGateway, *frames: Frame) -> AebInput | None:
    """The request that the last of the frames makes."""
    made = [gateway.on_frame(frame) for frame in frames]
    assert not any(made[:-1])
    return None if made[-1] is None else decode_request(made[-1])


def test_a_cycle_becomes_one_request(make: Make) -> None:
    gateway = make()
    request = feed(gateway, ego(0), track(0, 0, 1), track(0, 1, 1, 50.0, -3.0, flags=3), end(10, 1))
    targets = (AebTarget(0, 30.0, -2.0, False), AebTarget(1, 50.0, -3.0, True))
    assert request == AebInput(10, 10.0, True, True, targets)
    assert gateway.counts.accepted == 4


@pytest.mark.parametrize(("side", "count"), [(15, 1), (16, 0), (0x100 - 15, 1), (0x100 - 16, 0)])
def test_targets_beside_the_lane_are_left_out(make: Make, side: int, count: int) -> None:
    request = feed(make(), ego(0), track(0, 0, 1, side=side), end(10, 1))
    assert request is not None
    assert (len(request.targets), request.radar_valid) == (count, True)


GOOD = track(60, 0, 2, 20.0)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (Frame(60_000, 0x210, GOOD.data[:7]), "length"),
        (Frame(60_000, 0x210, GOOD.data[:7] + bytes([GOOD.data[7] ^ 1])), "checksum"),
        (track(60, 0, 1, 20.0), "repeated"),
        (track(9, 0, 2, 20.0), "time"),
        (Frame(60_000, 0x0B4, bytes(7) + b"\x01"), "checksum"),
        (ego(60, 600.0), "range"),
    ],
)
def test_a_bad_frame_is_counted_and_changes_nothing(make: Make, bad: Frame, reason: str) -> None:
    first, second = make(), make()
    for gateway in (first, second):
        feed(gateway, ego(0), track(0, 0, 1), end(10, 1))
    assert first.on_frame(bad) is None
    assert first.counts.refused == {reason: 1}
    after = (ego(65), GOOD, end(70, 2))
    assert feed(first, *after) == feed(second, *after)


def test_a_refused_track_is_a_miss_and_never_an_old_value(make: Make) -> None:
    gateway = make()
    feed(gateway, ego(0), track(0, 0, 1), track(0, 1, 1), end(10, 1))
    request = feed(gateway, ego(50), Frame(50_000, 0x210, bytes(8)), track(50, 1, 2), end(60, 2))
    assert request is not None
    assert [target.slot for target in request.targets] == [1]


def test_a_lost_end_makes_no_request_and_the_next_one_has_no_old_tracks(make: Make) -> None:
    gateway = make()
    feed(gateway, ego(0), track(0, 0, 1), end(10, 1))
    assert feed(gateway, track(50, 0, 2)) is None
    request = feed(gateway, ego(150), track(150, 1, 3), end(160, 4))
    assert request is not None
    assert [target.slot for target in request.targets] == [1]


def test_a_cycle_without_any_track_frame_is_unknown_not_empty(make: Make) -> None:
    request = feed(make(), ego(0), end(10, 1))
    assert request == AebInput(10, 10.0, True, False, ())


def test_an_old_ego_speed_is_unknown(make: Make) -> None:
    for age_ms, known in ((200, True), (201, False)):
        request = feed(make(), ego(0), track(age_ms, 0, 1), end(age_ms, 1))
        assert request is not None
        assert request.ego_valid is known


def test_a_counter_that_wraps_goes_on(make: Make) -> None:
    gateway = make()
    for n in range(600):
        assert feed(gateway, track(n, 0, n % 256), end(n, n % 256)) is not None
    assert gateway.counts.refused == {}


@given(st.sampled_from([0x210, 0x211, 0x22F, 0x0B4, 0x100]), st.binary(max_size=8), st.integers(0, 10**6))
def test_whatever_arrives_is_accepted_or_refused(make: Make, can_id: int, data: bytes, t_us: int) -> None:
    gateway = _shared(make)
    before = (gateway.counts.accepted, sum(gateway.counts.refused.values()), gateway.counts.ignored)
    gateway.on_frame(Frame(t_us, can_id, data))
    after = (gateway.counts.accepted, sum(gateway.counts.refused.values()), gateway.counts.ignored)
    assert sum(after) == sum(before) + 1


_kept: list[MappedGateway] = []


def _shared(make: Make) -> MappedGateway:
    if not _kept:
        _kept.append(make())
    return _kept[0]


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        (RawSignal(47, 16, "big_endian"), 0x0607),
        (RawSignal(39, 4, "big_endian"), 0x0),
        (RawSignal(35, 4, "big_endian"), 0x5),
        (RawSignal(40, 16, "little_endian"), 0x0706),
        (RawSignal(63, 8, "big_endian", signed=True), 0x88 - 0x100),
        (RawSignal(56, 8, "little_endian", scale=0.5, offset=1.0), 0x88 * 0.5 + 1.0),
        (RawSignal(63, 1, "big_endian"), 1),
    ],
)
def test_raw_signals_count_bits_as_a_dbc_does(raw: RawSignal, value: float) -> None:
    assert raw.read(bytes.fromhex("0102030405060788")) == value


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("cycle_ms: 50", "cycle_ms: -50", "cycle_ms: found -50, allowed is a whole number at least 1"),
        ("cycle_ms: 50\n", "", "key 'cycle_ms' is missing"),
        ("cycle_ms", "cycle_s", "unknown key 'cycle_s'; did you mean 'cycle_ms'"),
        ("cycle_end: END", "cycle_end: ENDE", "cycle_end: unknown mapped message 'ENDE'; did you mean 'END'"),
        ("unit: km/h", "unit: knots", "ego.speed.unit: found knots, allowed is a speed, in m/s, km/h, mph"),
        ("unit: km/h", "unit: m", "ego.speed.unit: found m, allowed is a speed, in m/s, km/h, mph"),
        (
            "unit: km/h",
            "scale: 1",
            "ego.speed.unit: found none, allowed is a speed, in m/s, km/h, mph, as raw",
        ),
        ("RANGE, unit: m}", "RANGE, unit: cm}", "tracks.range.unit: found cm, allowed is m, as RANGE has"),
        (
            "signal: RANGE",
            "signal: RANG",
            "tracks.range.signal: unknown signal of TRACK_0 'RANG'; did you mean",
        ),
        (
            "valid: VALID",
            "valid: VALIDE",
            "tracks.valid: unknown signal of TRACK_0 'VALIDE'; did you mean 'VALID'",
        ),
        ("TRACK_{n}", "TRAK_{n}", "tracks.messages.name: unknown message 'TRAK_0'; did you mean 'TRACK_0'"),
        ("last: 1}", "last: 2}", "tracks.messages.name: unknown message 'TRACK_2'"),
        ("first: 0", "first: 2", "tracks.messages.last: found 1, allowed is 2 (first) or more"),
        ("  length: 8\n", "  length: 7\n", "tracks.length: found 7, allowed is 8, as TRACK_0 has in the DBC"),
        (
            "length: 2",
            "length: 9",
            "others[0].length: found 9, allowed is a whole number at least 1 and at most 8",
        ),
        ("checksum: toyota", "checksum: xor", "ego.checksum: found 'xor', allowed is one of none, toyota"),
        (
            "start_bit: 47",
            "start_bit: 63, signed: 1",
            "ego.speed.raw.signed: found 1, allowed is true or false",
        ),
        ("start_bit: 47", "start_bit: 58", "ego.speed.raw: found 77 bits, allowed is at most 64"),
        ("can_id: 0x0B4,", "", "ego: found message and can_id, allowed is exactly one of them"),
        ("name: END", "name: TRACK_1", "others[0].length: found 2, allowed is 8, as TRACK_1 has in the DBC"),
        (
            "SPEED, unit: m/s",
            "SPEED, raw: 1, unit: m/s",
            "tracks.relative_speed.raw: found 1, allowed is keys",
        ),
        ("range: {signal: RANGE, ", "range: {", "tracks.range: found signal and raw, allowed is exactly one"),
        ("description: a small radar", "description: [", "line "),
        ("cycle_ms: 50", "cycle_ms: 50\ncycle_ms: 40", "line 4, column 1: key 'cycle_ms' stands twice"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(make: Make, old: str, new: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        make(old, new)
    assert "radar.yaml: " in str(error.value)
    assert reason in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (
            "last: 1}",
            "last: 1}\n  slot: COUNTER",
            "tracks.slot: found a signal, for 2 messages, allowed is one for",
        ),
        (
            "  valid: VALID",
            "  valid: VALID\n  slot: COUNT",
            "unknown signal of TRACK_0 'COUNT'; did you mean",
        ),
        ("  valid: VALID", "  valid: VALID\n  slot: RANGE", "tracks.slot: found RANGE, which has a scale"),
        (
            "  valid: VALID",
            "  valid: VALID\n  count: {message: END, signal: COUNTER}",
            "tracks.count: found count without slot, allowed is both, or neither",
        ),
        (
            "  valid: VALID",
            "  slot: COUNTER\n  count: {message: END, signal: COUNTER}",
            "cycle_end: found cycle_end and tracks.count, allowed is exactly one of them",
        ),
        (
            "cycle_end: END\n",
            "",
            "cycle_end: found cycle_end and tracks.count, allowed is exactly one of them",
        ),
        (
            "  lateral_offset: {signal: SIDE, unit: m}\n",
            "",
            "tracks: found lateral_offset and angle, allowed is exactly one of them",
        ),
        (
            "  valid: VALID",
            "  angle: {signal: SIDE, unit: deg}",
            "tracks: found lateral_offset and angle, allowed is exactly one of them",
        ),
        (
            "lateral_offset: {signal: SIDE, unit: m}",
            "angle: {signal: SIDE, unit: m}",
            "found m, allowed is an angle, in deg, rad, mrad",
        ),
        (
            "lateral_offset: {signal: SIDE, unit: m}",
            "angle: {signal: SIDE, unit: deg}",
            "found deg, allowed is m, as",
        ),
        (
            "valid: VALID",
            "valid: {signal: VALIDE, values: [1]}",
            "tracks.valid.signal: unknown signal of TRACK_0",
        ),
        ("valid: VALID", "valid: {signal: VALID, values: []}", "tracks.valid.values: found []"),
        (
            "valid: VALID",
            "valid: {signal: RANGE, values: [1]}",
            "tracks.valid.signal: found RANGE, which has a scale",
        ),
        (
            "modulo: 256}\n  range",
            "modulo: 2}\n  range",
            "modulo: found 2, allowed is a whole number at least 3",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(make: Make, old: str, new: str, reason: str) -> None:
    """Of one message only, where `slot` is what is refused, since of two it cannot be right."""
    with pytest.raises(ConfigError) as error:
        _make_one(make, old, new) if "slot" in new and "2 messages" not in reason else make(old, new)
    assert "radar.yaml: " in str(error.value)
    assert reason in str(error.value)


def _make_one(make: Make, old: str, new: str) -> MappedGateway:
    """The map with one message of tracks, and one more text replaced."""
    one = MAP.replace('name: "TRACK_{n}", first: 0, last: 1', "name: TRACK_0")
    return make(MAP, one.replace(old, new, 1))


_VALID_TO_SUM = DBC[DBC.index("SG_ VALID") : DBC.index("SUM :")]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("COUNTER : 7|8@0+ (1,0)", "COUNTER : 7|8@0+ (0.5,0)", "COUNTER, which has a scale"),
        (f"{_VALID_TO_SUM}SUM", _VALID_TO_SUM.replace("VALID", "VALID M") + "SUM m0", "which is multiplexed"),
        ("BO_ 529", "BO_ 180", "TRACK_1 (0x0b4) mapped twice"),
    ],
)
def test_a_dbc_that_does_not_fit_is_refused(make: Make, old: str, new: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        make(dbc=(old, new))
    assert reason in str(error.value)


OVERLAPPING = ("NEW : 49|1@0+ (1,0) [0|1]", "NEW : 48|1@0+ (1,0) [0|1]")
OUTSIDE = ("SG_ NEW : 49|1@0+", "SG_ NEW : 64|1@0+")


def test_a_dbc_that_contradicts_itself_is_read_if_the_map_allows_it(make: Make) -> None:
    with pytest.raises(
        ConfigError, match=r"radar\.dbc: line 9: .*NEW and VALID are overlapping in message TRACK_0"
    ):
        make(dbc=OVERLAPPING)
    gateway = make("cycle_ms: 50", "cycle_ms: 50\nstrict: false", dbc=OVERLAPPING)
    request = feed(gateway, ego(0), track(0, 0, 1), end(10, 1))
    assert request is not None
    assert request.targets == (AebTarget(0, 30.0, -2.0, True),)  # the one bit says both


def test_a_signal_outside_its_message_cannot_be_mapped(make: Make) -> None:
    with pytest.raises(ConfigError, match=r"radar\.dbc: line 9: .*NEW does not fit in message TRACK_0"):
        make(dbc=OUTSIDE)
    with pytest.raises(
        ConfigError, match=r"tracks\.new: found NEW, which does not lie in TRACK_0, allowed is"
    ):
        make("cycle_ms: 50", "cycle_ms: 50\nstrict: false", dbc=OUTSIDE)
    unused = MAP.replace("  new: NEW\n", "").replace("cycle_ms: 50", "cycle_ms: 50\nstrict: false")
    gateway = make(MAP, unused, dbc=OUTSIDE)
    assert feed(gateway, ego(0), track(0, 0, 1), end(10, 1)) is not None
