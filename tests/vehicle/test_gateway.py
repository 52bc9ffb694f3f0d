"""The gateway on our own bus: what it believes, what it makes of it, and what it refuses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from puredrive import CODEC

from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.messages import (
    FIXED_REPLY,
    FIXED_REQUEST,
    RANGE_MAX_M,
    SPEED_MAX_MS,
    T_MS_MAX,
    AebInput,
    AebOutput,
    AebTarget,
    decode_request,
    encode_fixed,
    encode_reply,
)
from aftbed.vehicle.can.e2e import intact, protect
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.gateway import LANE_HALF_M, Gateway

EGO = {"SPEED_VALID": 1.0, "SPEED": 14.0}
TRACK = {"VALID": 1.0, "TRACK_ID": 5.0, "RANGE": 40.0, "RELATIVE_SPEED": -3.0}


def frame(name: str, t_ms: int, counter: int, signals: dict[str, float]) -> Frame:
    data = CODEC.encode(name, dict.fromkeys(CODEC.signal_names(name), 0.0) | signals)
    return Frame(t_ms * 1000, CODEC.can_id(name), protect(data, CODEC.data_id(name), counter))


class Feed:
    """A gateway and its two senders, in step."""

    def __init__(self) -> None:
        self.gateway = Gateway(CODEC)
        self.t_ms = 0
        self.cycle = 0

    def request(self, ego: dict[str, float] | None = EGO, track: dict[str, float] = TRACK) -> AebInput | None:
        """Two EGO_STATE and one RADAR_TRACK: one radar cycle."""
        self.t_ms += 20
        self.cycle += 1
        if ego is not None:
            self.gateway.on_frame(frame("EGO_STATE", self.t_ms - 10, self.cycle * 2 % 15, ego))
            self.gateway.on_frame(frame("EGO_STATE", self.t_ms, (self.cycle * 2 + 1) % 15, ego))
        made = self.gateway.on_frame(frame("RADAR_TRACK", self.t_ms, self.cycle % 15, track))
        return None if made is None else decode_request(made)


def running() -> Feed:
    feed = Feed()
    for _ in range(3):
        feed.request()
    return feed


def test_a_believed_track_makes_a_request() -> None:
    assert running().request() == AebInput(80, 14.0, True, True, (AebTarget(5, 40.0, -3.0, False),))


def test_the_first_track_only_starts_the_sequence_and_its_request_has_no_radar() -> None:
    feed = Feed()
    first, second = feed.request(), feed.request()
    assert first == AebInput(20, 14.0, True, False, ())
    assert second is not None
    assert second.radar_valid
    assert feed.gateway.counts.refused == {"sequence": 2}


@pytest.mark.parametrize(
    ("signals", "count"),
    [
        ({"VALID": 0.0}, 0),
        ({"LATERAL_OFFSET": LANE_HALF_M}, 1),
        ({"LATERAL_OFFSET": -LANE_HALF_M}, 1),
        ({"LATERAL_OFFSET": LANE_HALF_M + 0.05}, 0),
        ({"LATERAL_OFFSET": -LANE_HALF_M - 0.05}, 0),
    ],
)
def test_only_valid_targets_in_our_path_are_in_the_request(signals: dict[str, float], count: int) -> None:
    request = running().request(track=TRACK | signals)
    assert request is not None
    assert request.radar_valid
    assert len(request.targets) == count


@pytest.mark.parametrize("ego", [None, EGO | {"SPEED_VALID": 0.0}])
def test_an_ego_speed_that_is_missing_or_invalid_is_unknown(ego: dict[str, float] | None) -> None:
    feed = running()
    for _ in range(4):
        request = feed.request(ego=ego)
    assert request is not None
    assert (request.ego_valid, request.ego_speed_ms, request.radar_valid) == (False, 0.0, True)


def track(t_ms: int, counter: int) -> Frame:
    return frame("RADAR_TRACK", t_ms, counter, TRACK)


def damaged(good: Frame, byte: int) -> Frame:
    data = bytearray(good.data)
    data[byte] ^= 0x10
    return Frame(good.t_us, good.can_id, bytes(data))


NEXT = track(80, 4)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (damaged(NEXT, 0), "checksum"),
        (damaged(NEXT, 4), "checksum"),
        (Frame(80_000, 0x130, NEXT.data[:7]), "length"),
        (track(80, 3), "repeated"),
        (track(80, 10), "sequence"),
    ],
)
def test_a_refused_track_is_counted_and_the_request_is_blind(bad: Frame, reason: str) -> None:
    """Blind, not empty: a radar that cannot be believed is no sign of an empty road."""
    feed = running()
    before = feed.gateway.counts.refused.get(reason, 0)
    made = feed.gateway.on_frame(bad)
    assert made is not None
    assert decode_request(made) == AebInput(80, 14.0, True, False, ())
    assert feed.gateway.counts.refused[reason] == before + 1


def test_bad_frames_do_not_drive_the_function_faster() -> None:
    feed = running()
    assert all(feed.gateway.on_frame(track(60 + n, 3)) is None for n in range(15))
    assert feed.gateway.on_frame(track(75, 3)) is not None
    assert all(feed.gateway.on_frame(damaged(track(76 + n, 4), 3)) is None for n in range(4))


def test_three_bad_frames_make_the_channel_invalid_until_good_ones_prevail() -> None:
    feed = running()
    for n in range(3):
        feed.gateway.on_frame(damaged(track(80 + 20 * n, 4), 0))
    feed.t_ms, feed.cycle = 120, 3
    believed = [request.radar_valid for _ in range(5) if (request := feed.request()) is not None]
    assert believed[-1]
    assert not believed[0]
    assert "channel" in feed.gateway.counts.refused


def test_time_running_backwards_is_refused_and_changes_nothing() -> None:
    feed = running()
    assert feed.gateway.on_frame(track(59, 4)) is None
    assert feed.gateway.on_frame(frame("EGO_STATE", 59, 8, EGO | {"SPEED": 1.0})) is None
    assert feed.gateway.counts.refused["time"] == 2
    assert feed.request() == running().request()


def test_a_range_beyond_any_sensor_is_refused() -> None:
    feed = running()
    wild = bytearray(frame("RADAR_TRACK", 80, 4, TRACK).data)
    wild[4:7] = bytes([wild[4] | 0xF0, 0xFF, 0x01])  # all ones but the sign: 163.82 m/s
    data = protect(bytes(wild), CODEC.data_id("RADAR_TRACK"), 4)
    made = feed.gateway.on_frame(Frame(80_000, 0x130, data))
    assert made is not None
    assert not decode_request(made).radar_valid
    assert feed.gateway.counts.refused["range"] == 1


@given(st.sampled_from([0x120, 0x130]), st.binary(max_size=8), st.integers(0, 200_000))
def test_whatever_arrives_nothing_is_raised_and_nothing_unknown_is_believed(
    can_id: int, data: bytes, t_us: int
) -> None:
    feed = running()
    accepted = feed.gateway.counts.accepted
    feed.gateway.on_frame(Frame(t_us, can_id, data))
    name = "EGO_STATE" if can_id == 0x120 else "RADAR_TRACK"
    if len(data) != 8 or not intact(data, CODEC.data_id(name)):
        assert feed.gateway.counts.accepted == accepted


def test_other_frames_are_ignored() -> None:
    feed = running()
    assert feed.gateway.on_frame(Frame(80_000, 0x555, bytes(8))) is None
    assert feed.gateway.counts.ignored == 1


# -- the way out

REPLY = encode_reply(AebOutput(2, 4.0, 1.25, 5, 7))


def test_a_reply_becomes_a_protected_request_to_the_brakes() -> None:
    gateway = Gateway(CODEC)
    heartbeat, request = gateway.reply_frames(REPLY, 100_000, 2, 3, 0x1_0004)
    assert (heartbeat.can_id, request.can_id) == (0x702, 0x100)
    assert CODEC.decode("FTM_HEARTBEAT_2", heartbeat.data) == {"REPLICA": 2, "EPOCH": 3, "ANSWERED": 0x1_0004}
    assert intact(request.data, CODEC.data_id("AEB_REQ"))
    told = CODEC.decode("AEB_REQ", request.data)
    assert (told["STAGE"], told["DECELERATION"], told["TTC"], told["TTC_VALID"]) == (2, 4.0, 1.25, 1)
    assert (told["TARGET"], told["COUNTER"], told["SEQUENCE"]) == (5, 7, 4)


@pytest.mark.parametrize(
    ("demand_ms2", "stage"), [(0.0, 0), (0.1, 2), (5.9, 2), (6.0, 3), (12.0, 3)], ids=str
)
def test_a_reply_may_be_a_deceleration_alone(demand_ms2: float, stage: int) -> None:
    gateway = Gateway(CODEC)
    told = [
        CODEC.decode("AEB_REQ", gateway.reply_frames(FIXED_REPLY.pack(demand_ms2), 0, 1, 1, n)[-1].data)
        for n in (14, 15, 16)
    ]
    assert [one["COUNTER"] for one in told] == [14, 0, 1], "the gateway counts, the brake misses none"
    assert {(one["STAGE"], one["TTC_VALID"]) for one in told} == {(stage, 0)}
    assert told[0]["DECELERATION"] == pytest.approx(demand_ms2, abs=0.05)


@given(
    st.integers(0, T_MS_MAX),
    st.floats(0, SPEED_MAX_MS),
    st.booleans(),
    st.booleans(),
    st.lists(st.tuples(st.floats(0, RANGE_MAX_M), st.floats(-SPEED_MAX_MS, SPEED_MAX_MS)), max_size=3),
)
def test_the_fixed_layout_has_the_nearest_target(
    t_ms: int, speed_ms: float, ego: bool, radar: bool, seen: list[tuple[float, float]]
) -> None:
    targets = tuple(AebTarget(slot, *one) for slot, one in enumerate(seen))
    request = encode_fixed(AebInput(t_ms, speed_ms, ego, radar, targets))
    nearest = min(seen, key=lambda one: one[0], default=None)
    assert len(request) == 36 and request[0] == 1
    expected = () if nearest is None else (AebTarget(0, *nearest),)
    assert decode_request(request) == AebInput(t_ms, speed_ms, ego, radar, expected)


def test_a_function_that_is_no_class_is_asked_in_the_fixed_layout() -> None:
    gateway = Gateway(CODEC, encode_fixed)
    gateway.on_frame(frame("EGO_STATE", 40, 0, EGO))
    gateway.on_frame(frame("EGO_STATE", 50, 1, EGO))
    gateway.on_frame(frame("RADAR_TRACK", 60, 0, TRACK))
    made = gateway.on_frame(frame("RADAR_TRACK", 80, 1, TRACK))
    assert made is not None and FIXED_REQUEST.unpack(made) == (1, 80, 14.0, 1, 1, 1, 40.0, -3.0)


def test_without_a_threat_there_is_no_time_to_collision() -> None:
    reply = encode_reply(AebOutput(0, 0.0, None, None, 0))
    told = CODEC.decode("AEB_REQ", Gateway(CODEC).reply_frames(reply, 0, 1, 1, 1)[-1].data)
    assert (told["TTC_VALID"], told["TTC"], told["TARGET"]) == (0, 0, 0)


@pytest.mark.parametrize("ttc_s", [40.95, 1e6])
def test_a_time_to_collision_beyond_the_signal_is_cut(ttc_s: float) -> None:
    reply = encode_reply(AebOutput(0, 0.0, ttc_s, 0, 0))
    told = CODEC.decode("AEB_REQ", Gateway(CODEC).reply_frames(reply, 0, 1, 1, 1)[-1].data)
    assert told["TTC"] == pytest.approx(40.95)


def test_heartbeats_come_50_ms_apart_and_before_the_request() -> None:
    gateway = Gateway(CODEC)
    ids = [
        [f.can_id for f in gateway.reply_frames(REPLY, t_us, 1, 1, 1)] for t_us in range(0, 120_000, 10_000)
    ]
    assert ids == [[0x701, 0x100] if n in (0, 5, 10) else [0x100] for n in range(12)]


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (b"", "not a braking demand"),
        (bytes(65), "reply of 65 bytes, allowed are 64"),
        (encode_reply(AebOutput(4, 0.0, None, None, 0)), "stage 4"),
        (encode_reply(AebOutput(3, 12.1, None, None, 0)), "with 12.1 m/s2"),
        (encode_reply(AebOutput(3, float("nan"), None, None, 0)), "with nan m/s2"),
        (encode_reply(AebOutput(3, 9.0, None, None, 15)), "counter 15, allowed is 0 to 14"),
        (encode_reply(AebOutput(3, 9.0, None, None, None)), "counter None, allowed is 0 to 14"),
        (FIXED_REPLY.pack(-0.1), r"-0\.1 m/s2, allowed is 0 to 12"),
        (FIXED_REPLY.pack(12.1), r"12\.1 m/s2, allowed is 0 to 12"),
        (FIXED_REPLY.pack(float("nan")), "nan m/s2, allowed is 0 to 12"),
        (encode_reply(AebOutput(3, 9.0, None, 16, 0)), "slot 16"),
        (encode_reply(AebOutput(3, 9.0, -1.0, 1, 0)), "ttc_s -1.0"),
    ],
)
def test_a_reply_that_is_none_is_refused_and_sends_nothing(reply: bytes, reason: str) -> None:
    gateway = Gateway(CODEC)
    with pytest.raises(PeerError, match=reason):
        gateway.reply_frames(reply, 0, 1, 1, 1)
    assert len(gateway.reply_frames(REPLY, 0, 1, 1, 1)) == 2  # the heartbeat is still due


def test_a_client_s_gateway_stamps_and_counts_the_replies_and_raises_nothing() -> None:
    gateway = Gateway(CODEC)
    gateway.on_frame(frame("EGO_STATE", 40, 0, EGO))
    gateway.on_frame(frame("EGO_STATE", 30, 1, EGO))
    assert gateway.on_reply(b"", 1, 1) == []
    sent = gateway.on_reply(REPLY, 2, 7)
    assert [(one.t_us, one.can_id) for one in sent] == [(40_000, 0x702), (40_000, 0x100)]
    assert CODEC.decode("AEB_REQ", sent[1].data)["SEQUENCE"] == gateway.answered == 2
    assert gateway.replies_refused == 1
    assert gateway.counts.refused == {"sequence": 1, "time": 1}
