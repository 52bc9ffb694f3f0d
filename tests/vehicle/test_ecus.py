"""The radar's frames, and what the brakes do with good, bad, late and missing requests."""

import pytest
from puredrive import CODEC

from aftbed.vehicle.can.bus_model import FALLBACK, GOOD_AGAIN, Notice
from aftbed.vehicle.can.e2e import protect
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.ecus import BrakeEcu, BrakePolicy, Fallback, RadarEcu, Sender
from aftbed.vehicle.plant import LeadCar, Plant, PlantSetup

FULL, WARN, NONE = (3, 9.0), (1, 0.0), (0, 0.0)


class Bench:
    """A brake ECU on a car at 20 m/s; `request` sends AEB_REQ, `run` lets time pass."""

    def __init__(self, policy: BrakePolicy = "latch", speed_ms: float = 20.0) -> None:
        self.plant = Plant(PlantSetup(speed_ms, LeadCar(200.0)))
        self.brake = BrakeEcu(CODEC, policy)
        self.counter = 0

    def request(self, stage: tuple[int, float], *, damage: int = 0) -> None:
        signals = dict.fromkeys(CODEC.signal_names("AEB_REQ"), 0.0)
        signals |= {"STAGE": stage[0], "DECELERATION": stage[1]}
        data = bytearray(protect(CODEC.encode("AEB_REQ", signals), CODEC.data_id("AEB_REQ"), self.counter))
        data[3] ^= damage
        self.counter = (self.counter + 1) % 15
        self.brake.on_frame(Frame(self.plant.t_us, 0x100, bytes(data)))

    def run(self, t_ms: int) -> float:
        for _ in range(t_ms):
            demand_ms2 = self.brake.demand_ms2(self.plant)
            self.plant.step(demand_ms2)
        return self.brake.demand_ms2(self.plant)

    def requests(self, stage: tuple[int, float], count: int, *, damage: int = 0) -> float:
        demand_ms2 = 0.0
        for _ in range(count):
            self.request(stage, damage=damage)
            demand_ms2 = self.run(20)
        return demand_ms2


def test_without_any_request_the_brakes_do_nothing() -> None:
    bench = Bench()
    assert bench.run(500) == 0.0
    assert bench.brake.fallback is Fallback.NONE


def test_the_first_request_of_a_sequence_is_not_believed_yet_the_second_is() -> None:
    bench = Bench()
    assert bench.requests(FULL, 1) == 0.0
    assert bench.requests(FULL, 1) == 9.0
    assert (bench.brake.accepted, bench.brake.refused) == (1, 1)


def test_other_frames_are_ignored() -> None:
    bench = Bench()
    bench.brake.on_frame(Frame(0, 0x130, bytes(8)))
    assert (bench.brake.accepted, bench.brake.refused) == (0, 0)


@pytest.mark.parametrize("policy", ["hold", "release", "latch"])
@pytest.mark.parametrize("invalid", [False, True])
def test_the_last_request_is_held_for_60_ms_then_the_policy_decides(
    policy: BrakePolicy, invalid: bool
) -> None:
    bench = Bench(policy)
    bench.requests(FULL, 5)
    believed_us = bench.plant.t_us - 20_000
    after = {"hold": (9.0, Fallback.HOLD), "release": (0.0, Fallback.RELEASE), "latch": (9.0, Fallback.LATCH)}
    while bench.plant.t_us <= believed_us + 60_000:
        if invalid and bench.plant.t_us % 20_000 == 0:
            bench.request(NONE, damage=1)
        assert bench.brake.demand_ms2(bench.plant) == 9.0
        late = bench.plant.t_us > believed_us + 30_000
        assert bench.brake.fallback is (Fallback.HOLD if late else Fallback.NONE)
        bench.plant.step(9.0)
    assert (bench.run(0), bench.brake.fallback) == after[policy]


def test_latch_releases_what_was_not_full_braking() -> None:
    bench = Bench()
    assert bench.requests((2, 4.0), 5) == 4.0
    assert (bench.run(100), bench.brake.fallback) == (0.0, Fallback.RELEASE)


def test_a_latch_brakes_to_standstill_whatever_weaker_is_asked_for_in_between() -> None:
    bench = Bench()
    bench.requests(FULL, 5)
    assert bench.run(200) == 9.0
    assert bench.requests(NONE, 10) == 9.0
    assert (bench.brake.fallback, bench.brake.stage) == (Fallback.LATCH, 3)
    while not bench.plant.stopped():
        assert bench.requests(NONE, 1) == 9.0 or bench.plant.stopped()
    assert bench.requests(NONE, 1) == 0.0
    assert bench.brake.fallback is Fallback.NONE


def test_a_latch_holds_the_brakes_at_standstill_while_nothing_is_asked() -> None:
    bench = Bench()
    bench.requests(FULL, 5)
    assert bench.run(4000) == 9.0
    assert bench.plant.stopped()
    assert bench.brake.fallback is Fallback.LATCH


def test_a_full_request_ends_a_latch_and_rules_again() -> None:
    bench = Bench()
    bench.requests(FULL, 5)
    bench.run(200)
    assert bench.requests(FULL, 2) == 9.0
    assert bench.brake.fallback is Fallback.NONE
    assert bench.requests(NONE, 1) == 0.0


def test_requests_are_good_again_when_the_brakes_follow_them() -> None:
    bench = Bench()
    bench.requests(FULL, 5)
    assert bench.run(200) == 9.0
    bench.requests(NONE, 10)  # taken in, but the latch rules
    words = [notice.word for notice in bench.brake.noticed]
    assert words == [FALLBACK, FALLBACK, "wrongsequence"]
    assert bench.requests(FULL, 1) == 9.0
    assert bench.brake.noticed[-1] == Notice(0x100, GOOD_AGAIN, bench.plant.t_us - 20_000)


def test_no_latch_where_full_braking_was_only_asked_for_at_standstill() -> None:
    bench = Bench(speed_ms=0.0)
    bench.requests(FULL, 5)
    assert (bench.run(100), bench.brake.fallback) == (0.0, Fallback.RELEASE)


def test_the_status_has_what_the_brakes_do() -> None:
    bench = Bench()
    bench.requests(FULL, 20)
    status, ego = bench.brake.frames(bench.plant)
    told = CODEC.decode("BRAKE_STATUS", status.data)
    assert (told["STAGE_APPLIED"], told["FALLBACK"], told["DECELERATION_DEMANDED"]) == (3, 0, 9.0)
    assert told["DECELERATION_ACTUAL"] == pytest.approx(-bench.plant.acceleration_ms2, abs=0.006)
    moved = CODEC.decode("EGO_STATE", ego.data)
    assert moved["SPEED"] == pytest.approx(bench.plant.speed_ms, abs=0.0006)
    assert moved["ACCELERATION"] == pytest.approx(bench.plant.acceleration_ms2, abs=0.0006)


def test_every_message_comes_in_its_cycle_and_the_track_last() -> None:
    plant = Plant(PlantSetup(10.0, LeadCar(100.0)))
    brake, radar = BrakeEcu(CODEC, "latch"), RadarEcu(CODEC, 1)
    seen: dict[int, list[int]] = {}
    for _ in range(1000):
        batch = brake.frames(plant) + radar.frames(plant)
        assert [frame.can_id for frame in batch] == sorted(frame.can_id for frame in batch)
        for frame in batch:
            seen.setdefault(frame.can_id, []).append(frame.t_us)
        plant.step(0.0)
    assert seen == {
        0x110: list(range(0, 1_000_000, 10_000)),
        0x120: list(range(0, 1_000_000, 10_000)),
        0x130: list(range(0, 1_000_000, 20_000)),
        0x131: list(range(5_000, 1_000_000, 100_000)),
    }


def test_the_radar_sees_the_truth_through_bounded_noise_and_marks_what_is_new() -> None:
    plant, radar = Plant(PlantSetup(10.0, LeadCar(155.0))), RadarEcu(CODEC, 3)
    new_at_m = []
    while plant.gap_m is not None and plant.gap_m > 20.0:
        for frame in radar.frames(plant):
            if frame.can_id != CODEC.can_id("RADAR_TRACK"):
                continue
            track = CODEC.decode("RADAR_TRACK", frame.data)
            assert track["VALID"] == (plant.gap_m <= 150.0)
            if track["VALID"]:
                assert track["RANGE"] == pytest.approx(plant.gap_m, abs=0.11)
                assert track["RELATIVE_SPEED"] == pytest.approx(-10.0, abs=0.12)
            if track["NEW_TRACK"]:
                new_at_m.append(plant.gap_m)
        plant.step(0.0)
    assert new_at_m == [pytest.approx(150.0, abs=0.2)]


def test_the_noise_comes_from_the_seed_alone() -> None:
    plant = Plant(PlantSetup(10.0, LeadCar(50.0)))
    same, again, other = (RadarEcu(CODEC, seed).frames(plant) for seed in (1, 1, 2))
    assert same == again != other


@pytest.mark.parametrize(("name", "offset_us"), [("RADAR_TRACK", 0), ("RADAR_STATUS", 5000)])
def test_the_next_time_of_a_message_is_the_first_at_which_it_is_due(name: str, offset_us: int) -> None:
    sender = Sender(CODEC, name, offset_us)
    for from_us in range(0, 250_000, 1000):
        first_us = next(t_us for t_us in range(from_us, from_us + 200_000, 1000) if sender.due(t_us))
        assert sender.next_us(from_us) == first_us
