"""The car in virtual time: the real drive to the last bit, late and missing replies, and any way to advance.

A real drive here is `car.drive` in lockstep over a hub on 127.0.0.1, with the gateway and the bare function
behind it; and, among the process tests, `aftbed run` itself. Nothing is compared with recorded numbers.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from functools import cache
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from busharness import FunctionGateway, running_hub
from puredrive import CODEC
from sampling import every, sampled

from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubOptions
from aftbed.vehicle.drive_real import CarBuses, DriveOptions, DriveReport
from aftbed.vehicle.drive_real import drive as drive_on_hub
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.ecus import BrakePolicy
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names
from aftbed.vehicle.scenarios.scenario import broken_expectations

pytestmark = pytest.mark.simulation

MS = 1_000_000  # nanoseconds
AEB_REQ = 0x100
BRAKING_MS = 2900  # in ccrs-50 partial braking is being asked for, and in 60 ms full braking will be
FULL_BRAKING_MS = 3000  # now it is

When = Callable[[int], int | None]  # of a reply, by the time of its request, both in ns; None is never


def at_once(now_ns: int) -> int | None:
    return now_ns


def after(delay_ns: int) -> When:
    return lambda now_ns: now_ns + delay_ns


def outage(start_ms: int, length_ms: int) -> When:
    """Nobody takes requests for `length_ms`."""
    return lambda now_ns: None if start_ms * MS <= now_ns < (start_ms + length_ms) * MS else now_ns


class Drive(msgspec.Struct):
    """A virtual drive, to its end."""

    car: VirtualCar
    frames: list[Frame]
    requests: int = 0

    @property
    def result(self) -> VehicleResult:
        return self.car.result()

    def log(self) -> str:
        return "".join(log_line(frame, "can0") for frame in self.frames)


def drive(
    scenario: str = "ccrs-50",
    when: When = at_once,
    *,
    policy: BrakePolicy = "latch",
    seed: int = 0,
    tick_ns: int | None = None,
) -> Drive:
    """Drive before the bare function. `tick_ns` advances the car that often as well."""
    frames: list[Frame] = []
    car = VirtualCar(
        load_scenario(scenario), brake_policy=policy, seed=seed, codec=CODEC, on_frame=frames.append
    )
    done = Drive(car, frames)
    function = default_application()
    late: list[tuple[int, int, bytes]] = []
    now_ns = 0
    while (due_ns := car.due_ns()) is not None:
        tick_at_ns = due_ns if tick_ns is None else now_ns + tick_ns
        now_ns = min(due_ns, tick_at_ns, late[0][0] if late else due_ns)
        while late and late[0][0] <= now_ns:
            car.deliver(heappop(late)[2], now_ns)
        for payload in car.advance(now_ns):
            done.requests += 1
            reply_ns = when(now_ns)
            if reply_ns == now_ns:
                car.deliver(function.execute(payload), now_ns)
            elif reply_ns is not None:
                heappush(late, (reply_ns, done.requests, function.execute(payload)))
    return done


# -- the real drive ------------------------------------------------------------------------------


def real_drive(log: Path, scenario: str, policy: BrakePolicy, seed: int) -> DriveReport:
    """In lockstep, over a real hub."""
    with (
        running_hub(log, HubOptions(lockstep=True)) as hub,
        FunctionGateway(hub.options, CODEC),
        closing(CarBuses(hub.options)) as buses,
    ):
        options = DriveOptions(pace=None, brake_policy=policy, seed=seed)
        return drive_on_hub(
            load_scenario(scenario), CODEC, buses, options, report=lambda _: None, stop=lambda: False
        )


@pytest.mark.parametrize(
    ("scenario", "policy", "seed"),
    every(3, [("ccrb-50-12m", "hold", 7), ("ccrs-50", "latch", 0), ("ccrm-50", "release", 3)]),
)
def test_with_replies_at_once_it_is_the_lockstep_drive_frame_by_frame(
    scenario: str, policy: BrakePolicy, seed: int, tmp_path: Path
) -> None:
    log = tmp_path / "bus.log"
    real = real_drive(log, scenario, policy, seed)
    virtual = drive(scenario, policy=policy, seed=seed)
    assert virtual.result == real.result
    assert (virtual.car.end, virtual.car.t_us, virtual.requests) == (real.end, real.t_us, real.tracks)
    assert virtual.log() == log.read_text()


@pytest.mark.process
@pytest.mark.parametrize("scenario", every(3, scenario_names()))
def test_with_replies_at_once_it_is_a_real_run(scenario: str, tmp_path: Path) -> None:
    command = ["run", "--ftm", "none", "--scenario", scenario, "--pace", "max", "--seed", "5", "--json"]
    with tempfile.TemporaryDirectory(prefix="aft-", dir="/tmp") as home:  # a socket's path may be 108 bytes
        done = subprocess.run(
            [sys.executable, "-m", "aftbed", *command, "--record", str(tmp_path / "record")],
            env=os.environ | {"XDG_RUNTIME_DIR": home},
            capture_output=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    virtual = drive(scenario, seed=5)
    found = msgspec.json.decode(done.stdout)
    assert msgspec.convert(found["vehicle"], VehicleResult) == virtual.result
    assert found["requests"]["sent"] == virtual.requests
    log = (tmp_path / "record" / "bus.log").read_text()
    assert virtual.log() == log


# -- every drive ---------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", every(2, scenario_names()))
def test_every_scenario_comes_to_its_end_and_to_what_it_expects(scenario: str) -> None:
    done = drive(scenario)
    assert done.car.end in ("standstill", "duration")
    assert done.car.due_ns() is None
    assert broken_expectations(load_scenario(scenario), done.result) == []
    assert done.car.counts.refused == {"sequence": 2}  # the first frame of each of the two
    assert done.requests == -(-done.car.t_us // 20_000)


@pytest.mark.parametrize("when", [at_once, after(33 * MS + 700), outage(BRAKING_MS, 300)])
def test_two_drives_are_the_same_drive(when: When) -> None:
    first, second = drive(when=when, seed=7), drive(when=when, seed=7)
    assert first.frames == second.frames
    assert first.result == second.result
    assert first.frames != drive(when=when, seed=8).frames


@cache
def seldom_advanced(delay_ns: int) -> Drive:
    """Only when it asks for it; the same whatever it is compared with."""
    return drive("ccrs-20", after(delay_ns))


@pytest.mark.parametrize(
    ("delay_ns", "tick_ns"),
    sampled((0, 5 * MS, 13 * MS + 400_000, 20 * MS, 33 * MS + 1), (MS, 7 * MS, 370_001)),
)
def test_how_often_it_is_advanced_makes_no_difference(delay_ns: int, tick_ns: int) -> None:
    lazy, busy = seldom_advanced(delay_ns), drive("ccrs-20", after(delay_ns), tick_ns=tick_ns)
    assert busy.frames == lazy.frames
    assert busy.result == lazy.result


def test_the_frames_of_the_bus_are_in_the_order_of_their_times() -> None:
    times_us = [frame.t_us for frame in drive("ccrs-20", after(13 * MS + 400_500)).frames]
    assert times_us == sorted(times_us)
    assert 13_401 in times_us  # whole microseconds, rounded up: never earlier than it came


def test_an_advance_over_several_cycles_gives_all_their_requests() -> None:
    car = VirtualCar(load_scenario("ccrs-50"), codec=CODEC)
    assert car.due_ns() == 0
    assert len(car.advance(100 * MS)) == 6
    assert car.due_ns() == 120 * MS
    assert car.advance(100 * MS) == car.advance(119 * MS) == []
    assert len(car.advance(120 * MS)) == 1


def test_a_scenario_may_end_between_two_cycles() -> None:
    short = msgspec.structs.replace(load_scenario("ccrs-50"), duration_ms=30)
    car = VirtualCar(short, codec=CODEC)
    assert len(car.advance(20 * MS)) == 2
    assert car.due_ns() == 30 * MS
    assert car.advance(40 * MS) == []
    assert (car.end, car.t_us, car.due_ns()) == ("duration", 30_000, None)


# -- replies that are late, lost or wrong --------------------------------------------------------


def gaps_m(drives: list[Drive]) -> list[float]:
    """To the car ahead, at standstill; less than nothing is the impact, in km/h."""
    return [
        -(one.result.impact_speed_kmh or 0.0) if one.result.collision else one.result.stop_gap_m or 0.0
        for one in drives
    ]


def test_the_later_the_replies_the_smaller_the_gap_until_it_is_none() -> None:
    drives = [drive(when=after(delay_ms * MS)) for delay_ms in (100, 200, 500, 2000)]
    found_m = gaps_m(drives)
    assert all(later_m < sooner_m for sooner_m, later_m in pairwise(found_m))
    assert [one.car.end for one in (drives[0], drives[-1])] == ["standstill", "collision"]


def test_a_short_delay_is_made_up_for() -> None:
    """The loop is closed: where partial braking is late, the function asks for full braking sooner."""
    prompt_m, *late_m = gaps_m([drive(when=after(delay_ms * MS)) for delay_ms in (0, 1, 20, 80)])
    assert late_m == pytest.approx([prompt_m] * len(late_m), abs=0.5)


@pytest.mark.parametrize("seed", every(3, range(3)))
def test_the_longer_an_outage_the_smaller_the_gap_until_it_is_none(seed: int) -> None:
    """Before full braking: one that comes earlier can be made up for, one that comes later is bridged."""
    lengths_ms = (0, 60, 200, 400, 800, 5000)
    drives = [drive(when=outage(BRAKING_MS, length_ms), seed=seed) for length_ms in lengths_ms]
    found_m = gaps_m(drives)
    assert all(longer_m < shorter_m for shorter_m, longer_m in pairwise(found_m))
    assert [one.car.end for one in (drives[0], drives[-1])] == ["standstill", "collision"]


def test_without_answers_the_brake_policy_decides() -> None:
    latched, released = (
        drive(when=outage(FULL_BRAKING_MS, 60_000), policy=policy) for policy in ("latch", "release")
    )
    assert latched.result == drive().result  # full braking goes on to standstill
    assert released.result.collision


def test_without_any_reply_the_car_drives_on() -> None:
    done = drive(when=lambda _: None)
    assert (done.car.end, done.result.braked) == ("collision", False)
    assert AEB_REQ not in {frame.can_id for frame in done.frames}


def test_a_reply_between_two_steps_is_received_in_the_next() -> None:
    """So a delay of 0.2 ms and one of 1 ms are the same drive but for the time stamps; none is not."""
    between, one_ms = drive(when=after(200_000)), drive(when=after(MS))
    assert between.result == one_ms.result != drive().result


def test_a_reply_after_the_end_changes_nothing() -> None:
    done = drive("ccrs-20")
    before = done.result
    frames = len(done.frames)
    late = default_application().execute(VirtualCar(load_scenario("ccrs-20"), codec=CODEC).advance(0)[0])
    end_ns = done.car.t_us * 1000 + 20 * MS
    done.car.deliver(late, end_ns)
    assert done.car.advance(end_ns + MS) == []
    assert (done.result, len(done.frames)) == (before, frames)


def test_what_is_no_reply_to_the_brakes_sends_nothing() -> None:
    frames: list[Frame] = []
    car = VirtualCar(load_scenario("ccrs-20"), codec=CODEC, on_frame=frames.append)
    assert len(car.advance(0)) == 1
    car.deliver(b"\xff", 0)
    car.advance(15 * MS)
    assert AEB_REQ not in {frame.can_id for frame in frames}


def test_a_heartbeat_has_the_replica_and_the_epoch_of_the_reply() -> None:
    frames: list[Frame] = []
    car = VirtualCar(load_scenario("ccrs-20"), codec=CODEC, on_frame=frames.append)
    function = default_application()
    for payload in car.advance(0):
        car.deliver(function.execute(payload), 0, replica=2, epoch=9)
    car.advance(MS)
    heartbeat = next(frame for frame in frames if frame.can_id == CODEC.can_id("FTM_HEARTBEAT_2"))
    assert CODEC.decode("FTM_HEARTBEAT_2", heartbeat.data) == {"REPLICA": 2, "EPOCH": 9, "ANSWERED": 1}


def test_time_does_not_go_back() -> None:
    car = VirtualCar(load_scenario("ccrs-20"), codec=CODEC)
    car.advance(20 * MS)
    with pytest.raises(AssertionError, match="time goes back"):
        car.advance(20 * MS - 1)
    with pytest.raises(AssertionError, match="time goes back"):
        car.deliver(b"", 20 * MS - 1)


def test_it_brings_no_socket_along() -> None:
    found = "import sys, aftbed.vehicle.drive_virtual; print(*sorted(sys.modules))"
    names = subprocess.run([sys.executable, "-c", found], capture_output=True, text=True, check=True).stdout
    assert not {"socket", "select", "can", "aftbed.vehicle.can.bus", "aftbed.vehicle.can.hub"} & set(
        names.split()
    )
