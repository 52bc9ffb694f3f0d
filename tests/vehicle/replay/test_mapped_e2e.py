"""The mapped gateway on a bus whose frames are protected by E2E: every profile, by a map."""

from collections.abc import Callable

import pytest
from puredrive import CODEC

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.messages import decode_request
from aftbed.vehicle.can.e2e import P01, P02, P05, P11, Profile
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import bind
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

Make = Callable[..., MappedGateway]

IDS = bytes([0x3C, 0x91, 0x07, 0xE2, 0x5D, 0xA8, 0x14, 0xFB, 0x66, 0xC9, 0x20, 0x8E, 0x73, 0xD5, 0x4A, 0xB1])
E2E_DBC = """
BU_: X
BO_ 528 TRACK_0: 8 X
 SG_ RANGE : 39|16@0+ (0.01,0) [0|300] "m" X
 SG_ SPEED : 55|8@0- (0.4,0) [-100|100] "m/s" X
 SG_ VALID : 63|1@0+ (1,0) [0|1] "" X
 SG_ SIDE : 59|4@0- (0.5,0) [-4|3.5] "m" X
BO_ 529 TRACK_1: 8 X
 SG_ RANGE : 39|16@0+ (0.01,0) [0|300] "m" X
 SG_ SPEED : 55|8@0- (0.4,0) [-100|100] "m/s" X
 SG_ VALID : 63|1@0+ (1,0) [0|1] "" X
 SG_ SIDE : 59|4@0- (0.5,0) [-4|3.5] "m" X
BO_ 180 EGO: 8 X
 SG_ SPEED : 39|16@0+ (0.01,0) [0|600] "km/h" X
"""
E2E_MAP = """
description: a radar whose frames are protected by E2E
cycle_ms: 50
cycle_end: TRACK_1
ego:
  message: EGO
  length: 8
  checksum: {profile: p05, data_id: 0x77, cycle_ms: 10}
  speed: {signal: SPEED, unit: km/h}
tracks:
  messages: {name: "TRACK_{n}", first: 0, last: 1}
  length: 8
  checksum: {profile: p01, data_ids: [0x100, 0x101], mode: nibble}
  range: {signal: RANGE, unit: m}
  relative_speed: {signal: SPEED, unit: m/s}
  lateral_offset: {signal: SIDE, unit: m}
  valid: VALID
"""
TRACKS_PROFILE = "{profile: p01, data_ids: [0x100, 0x101], mode: nibble}"
PROFILES: list[tuple[str, tuple[Profile, Profile]]] = [
    (TRACKS_PROFILE, (P01(0x100, "nibble"), P01(0x101, "nibble"))),
    ("{profile: p01, data_ids: [0x100, 0x101]}", (P01(0x100), P01(0x101))),
    ("{profile: p01, data_id: 0x9, mode: alt, offset: 2}", (P01(9, "alt", 2),) * 2),
    ("{profile: p01, data_id: 0x9, mode: low}", (P01(9, "low"),) * 2),
    (f"{{profile: p02, data_ids: {list(IDS)}}}", (P02(IDS),) * 2),
    ("{profile: p05, data_id: 65535, offset: 1}", (P05(65535, offset=1),) * 2),
    ("{profile: p11, data_id: 0x123, mode: nibble, offset: 1}", (P11(0x123, "nibble", 1),) * 2),
    ("{profile: p11, data_id: 0x123, timeout_ms: 700}", (P11(0x123),) * 2),
]


@pytest.fixture(scope="module")
def make_e2e(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """A gateway by E2E_DBC and E2E_MAP, in which one text was replaced by another."""

    def build(old: str = "", new: str = "") -> MappedGateway:
        folder = tmp_path_factory.mktemp("e2e")
        assert old in E2E_MAP
        (folder / "radar.dbc").write_text(E2E_DBC)
        (folder / "radar.yaml").write_text(E2E_MAP.replace(old, new, 1) if old else E2E_MAP)
        return MappedGateway(CODEC, bind(folder / "radar.yaml", folder / "radar.dbc"))

    return build


def sealed(t_ms: float, can_id: int, profile: Profile, counter: int, range_m: float = 30.0) -> Frame:
    """A frame whose signals stand in its last four bytes, protected."""
    payload = round(range_m * 100).to_bytes(2, "big") + bytes(
        [-5 & 0xFF, 0]
    )  # -2 m/s, in the middle, not valid
    data = profile.protect(bytes(4) + payload, counter % profile.counter_count)
    return Frame(round(t_ms * 1000), can_id, data)


def protected_cycles(profiles: tuple[Profile, Profile], count: int, first: int = 0) -> list[Frame]:
    """Cycles with two tracks that are not valid, and ten milliseconds between two ego speeds."""
    frames = []
    for n in range(first, first + count):
        frames += [sealed(50 * n + 10 * k, 0x0B4, P05(0x77), 5 * n + k, 36.0) for k in range(5)]
        frames += [sealed(50 * n + 41 + k, 0x210 + k, profile, n) for k, profile in enumerate(profiles)]
    return frames


@pytest.mark.parametrize(("checksum", "profiles"), PROFILES, ids=[text for text, _ in PROFILES])
def test_frames_protected_by_any_profile_are_believed(
    make_e2e: Make, checksum: str, profiles: tuple[Profile, Profile]
) -> None:
    gateway = make_e2e(TRACKS_PROFILE, checksum)
    made = [request for f in protected_cycles(profiles, 20) if (request := gateway.on_frame(f)) is not None]
    assert gateway.counts.refused == {"sequence": 3}  # the first frame of each of the three
    assert len(made) == 19
    assert decode_request(made[-1]).ego_speed_ms == pytest.approx(10.0)
    assert decode_request(made[-1]).radar_valid


@pytest.mark.parametrize(("checksum", "profiles"), PROFILES, ids=[text for text, _ in PROFILES])
def test_no_flipped_bit_of_a_protected_frame_is_believed(
    make_e2e: Make, checksum: str, profiles: tuple[Profile, Profile]
) -> None:
    gateway = make_e2e(TRACKS_PROFILE, checksum)
    for n in range(70):
        frame = sealed(50 * n, 0x210, profiles[0], n)
        if n >= 3:
            damaged = bytearray(frame.data)
            damaged[(n - 3) // 8 % 8] ^= 1 << (n - 3) % 8
            refused = dict(gateway.counts.refused)
            assert gateway.on_frame(Frame(frame.t_us, 0x210, bytes(damaged))) is None
            assert gateway.counts.refused != refused
        gateway.on_frame(frame)
    assert gateway.counts.refused["checksum"] == 67


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (sealed(541, 0x210, P01(0x100, "nibble"), 9), "repeated"),
        (sealed(541, 0x210, P01(0x100, "nibble"), 14), "sequence"),
        (sealed(541, 0x210, P01(0x101, "nibble"), 10), "checksum"),
        (Frame(541_000, 0x210, sealed(541, 0x210, P01(0x100, "nibble"), 10).data[:7]), "length"),
        (sealed(541 + 15 * 50, 0x210, P01(0x100, "nibble"), 25), "sequence"),
        (sealed(541, 0x0B4, P05(0x77), 50, 600.0), "range"),
    ],
)
def test_a_protected_frame_that_is_not_to_be_believed_is_counted(
    make_e2e: Make, bad: Frame, reason: str
) -> None:
    """Ten cycles, then one bad frame; the last but one is exactly one turn of the counter later."""
    gateway = make_e2e()
    for frame in protected_cycles((P01(0x100, "nibble"), P01(0x101, "nibble")), 10):
        gateway.on_frame(frame)
    assert gateway.on_frame(bad) is None
    assert gateway.counts.refused == {"sequence": 3} | {reason: 1 + 3 * (reason == "sequence")}


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (
            "profile: p01",
            "profile: p03",
            "checksum.profile: found 'p03', allowed is one of p01, p02, p05, p11",
        ),
        (
            "data_ids: [0x100, 0x101], ",
            "",
            "tracks.checksum: found data_id and data_ids, allowed is exactly one",
        ),
        (
            "data_ids: [0x100, 0x101]",
            "data_ids: [1]",
            "data_ids: found 1 numbers, allowed is 2, one for each",
        ),
        (
            "[0x100, 0x101]",
            "[0x100, 0x1101]",
            "found data id 0x1101, allowed is at most 0x0fff with mode nibble",
        ),
        ("data_id: 0x77", "data_id: 65536", "allowed is a whole number at least 0 and at most 65535"),
        ("data_id: 0x77", "data_id: 1, mode: alt", "ego.checksum.mode: found alt, allowed is both, in p05"),
        (
            "p01",
            "p11, timeout_ms: 800",
            "timeout_ms: found 800, allowed is more than 50, a cycle, and less than 750",
        ),
        (
            "mode: nibble",
            "mode: nibble, offset: 7",
            "offset: found 7, allowed is a whole number at least 0 and at",
        ),
        (
            "data_id: 0x77",
            "data_id: 1, offset: 6",
            "checksum.offset: found 6, allowed is at most 5, by the length",
        ),
        ("p01", "p02", "checksum.data_ids: found [256, 257], allowed is a list of 16 numbers from 0 to 255"),
        (
            TRACKS_PROFILE,
            f"{{profile: p02, data_ids: {[7] * 16}, offset: 1}}",
            "tracks.checksum: found mode or offset, allowed is neither, in p02",
        ),
        (
            TRACKS_PROFILE,
            "{profile: p11, data_id: 1, mode: low}",
            "mode: found low, allowed is both or nibble",
        ),
        (
            "  valid: VALID",
            "  counter: {signal: VALID, modulo: 15}",
            "counter: found a signal, allowed is none, as p01",
        ),
        (TRACKS_PROFILE, "{data_id: 1}", "tracks.checksum: key 'profile' is missing"),
        (TRACKS_PROFILE, "{profile: p01, data: 1}", "unknown key 'data'; did you mean 'data_id'"),
        (
            TRACKS_PROFILE,
            "sum",
            "found 'sum', allowed is one of none, toyota or keys and values: profile, data_id",
        ),
    ],
)
def test_a_protection_that_cannot_be_is_refused(make_e2e: Make, old: str, new: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        make_e2e(old, new)
    assert "radar.yaml: " in str(error.value)
    assert reason in str(error.value)
