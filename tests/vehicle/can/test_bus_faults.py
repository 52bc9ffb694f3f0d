"""Faults of the bus of a driving car: over real sockets and in virtual time the same, bitten and healed.

Who judges whether one has bitten are the receivers: the gateway's E2E checks, the brake ECU's, the car.
"""

import itertools
import math
import threading
import time
from pathlib import Path

import msgspec
import pytest
from busharness import DEADLINE_S, RawClient, RunningHub, running_hub
from buslog import read_log
from disturbed import FIRST_NUMBER, Disturbed, fault, real, virtual
from puredrive import CODEC
from sampling import every

from aftbed.inject.receipts import BusTimes
from aftbed.vehicle.can.bus import HubLine, open_bus
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubOptions

pytestmark = pytest.mark.process

TRACK, AEB_REQ, EGO, STATUS = (
    CODEC.can_id(name) for name in ("RADAR_TRACK", "AEB_REQ", "EGO_STATE", "BRAKE_STATUS")
)
HEARTBEAT = CODEC.can_id("FTM_HEARTBEAT_1")  # comes by its own time
PACES = (2.0, 2.0, 1.0, 1.0, 0.5, 0.25)  # of the tries of a paced drive
HOLDS_US = 1_501_000  # the first step with ttc < 2.5: ccrs-50 begins at 4 s, and does not brake before
TRACK_MS = 20.0  # between two frames
LAG_MS_MAX = 40.0  # of the bus; the slower the drive, the more of the clock it is
FIRST = {"sequence": 2}  # what every gateway refuses: the first frame of each of its two


@pytest.fixture(scope="module")
def sound() -> Disturbed:
    return virtual()


def fallbacks(drive: Disturbed) -> set[int]:
    return {int(CODEC.decode("BRAKE_STATUS", frame.data)["FALLBACK"]) for frame in drive.of(STATUS)}


def healed(drive: Disturbed) -> list[tuple[int, int]]:
    """What came when on the bus, a second after a fault began and before the car brakes."""
    return sorted((f.t_us, f.can_id) for f in drive.frames if 2_000_000 <= f.t_us < 2_500_000)


ALIKE = [
    "omission bus RADAR_TRACK nth 5",
    "omission bus from gateway when ttc < 1.2 permanent",
    "omission bus from radar intermittent p 0.1",
    "corrupt bus RADAR_TRACK bit 21 permanent",
    "corrupt bus RADAR_TRACK bit 34 crc good permanent",
    "corrupt bus AEB_REQ signal DECELERATION=9 crc good nth 30 permanent",
    "delay bus RADAR_TRACK by 33ms for 500ms",
    "delay bus RADAR_TRACK by 55ms nth 20",
    "delay bus AEB_REQ by 45ms after 3s for 300ms",
    "duplicate bus RADAR_TRACK nth 7",
    "duplicate bus AEB_REQ for 1s",
    "reorder bus RADAR_TRACK nth 7",
    "reorder bus EGO_STATE permanent",
    "masquerade bus RADAR_TRACK as EGO_STATE nth 50 for 300ms",
    "stuck-counter bus AEB_REQ after 1s for 500ms",
    "babbling radar after 1s for 100ms",
    "bus-off gateway when gap < 10 for 100ms",
    "partition brake|gateway after 1s for 200ms",
]


@pytest.mark.parametrize("words", every(4, ALIKE))
def test_a_hub_in_lockstep_and_a_bus_in_virtual_time_are_alike(words: str, tmp_path: Path) -> None:
    """Each frame to the last bit, by identifier and time, the car, what was noticed; without a wait."""
    over_hub, in_virtual_time = real(tmp_path / "bus.log", words), virtual(words)
    for can_id in sorted(over_hub.ids | in_virtual_time.ids):
        assert over_hub.of(can_id) == in_virtual_time.of(can_id), hex(can_id)
    assert over_hub.result == in_virtual_time.result
    assert over_hub.struck == in_virtual_time.struck
    assert over_hub.struck[0].receipt.state.value == "activated"
    assert over_hub.refused == in_virtual_time.refused
    assert over_hub.report is not None and over_hub.report.missing_answers == 0


def test_several_at_once_are_alike_too(tmp_path: Path) -> None:
    words = ("reorder bus RADAR_TRACK permanent", "duplicate bus AEB_REQ permanent", "bus-off brake for 1s")
    over_hub, in_virtual_time = real(tmp_path / "bus.log", *words), virtual(*words)
    assert {i: over_hub.of(i) for i in over_hub.ids} == {
        i: in_virtual_time.of(i) for i in in_virtual_time.ids
    }
    assert over_hub.struck == in_virtual_time.struck


def test_a_drive_whose_fault_never_comes_is_the_sound_one(sound: Disturbed, tmp_path: Path) -> None:
    drive = real(tmp_path / "bus.log", "omission bus RADAR_TRACK nth 100000")
    assert drive.result == sound.result
    assert drive.struck[0].receipt.state.value == "armed"
    assert {i: drive.of(i) for i in drive.ids} == {i: sound.of(i) for i in sound.ids}


# -- what the receivers make of it


@pytest.mark.parametrize(
    ("words", "reason", "count"),
    [
        ("corrupt bus RADAR_TRACK bit 21 nth 50", "checksum", 1),
        ("corrupt bus RADAR_TRACK bit 3 after 1s for 100ms", "checksum", 5),
        ("masquerade bus RADAR_TRACK as EGO_STATE nth 50", "checksum", 1),
        ("stuck-counter bus RADAR_TRACK nth 50", "repeated", 1),
        ("duplicate bus RADAR_TRACK nth 50", "repeated", 1),
        ("duplicate bus EGO_STATE nth 50", "repeated", 1),
    ],
)
def test_what_e2e_can_see_is_refused_counted_and_over(
    words: str, reason: str, count: int, sound: Disturbed
) -> None:
    drive = virtual(words)
    assert drive.refused[reason] == count
    assert drive.struck[0].noticed == f"gateway ({reason})"
    assert not drive.result.collision
    assert drive.refused.keys() - {reason, "channel"} == sound.refused.keys() == FIRST.keys()


@pytest.mark.parametrize(
    ("words", "node"),
    [
        ("corrupt bus RADAR_TRACK signal RANGE=300 crc good permanent", "gateway"),
        ("corrupt bus AEB_REQ signal STAGE=0 crc good permanent", "brake"),
    ],
)
def test_what_has_a_good_crc_is_believed_by_all(words: str, node: str) -> None:
    drive = virtual(words)
    assert drive.refused == FIRST
    assert (drive.struck[0].noticed, drive.struck[0].believed) == ("", node)
    assert drive.struck[0].receipt.state.value == "activated"


def test_a_radar_that_sees_far_and_well_protected_is_a_crash(sound: Disturbed) -> None:
    drive = virtual("corrupt bus RADAR_TRACK signal RANGE=300 crc good permanent")
    assert drive.result.collision and not sound.result.collision


def test_a_frame_that_no_node_uses_is_struck_and_that_is_all() -> None:
    drive = virtual("corrupt bus BRAKE_STATUS bit 40 permanent")
    assert drive.struck[0].receipt.state.value == "applied"
    assert drive.struck[0].receipt.detail.endswith("not noticed")


def test_the_brake_ecu_refuses_a_stuck_counter_and_falls_back() -> None:
    drive = virtual("stuck-counter bus AEB_REQ after 1s for 500ms")
    assert drive.struck[0].noticed == "brake (repeated)"
    assert fallbacks(drive) > {0}
    assert not drive.result.collision


def test_a_request_that_is_followed_ends_the_handling_though_its_duplicate_is_refused() -> None:
    drive = virtual("duplicate bus AEB_REQ after 1s for 500ms")
    assert drive.struck[0].times == BusTimes(1_000_000, 1_000_000, 1_020_000)


def test_a_request_that_is_held_back_too_long_is_bridged_and_then_followed_again(sound: Disturbed) -> None:
    drive = virtual("omission bus AEB_REQ after 1s for 200ms")
    assert fallbacks(drive) > {0} == fallbacks(sound)
    late = [f for f in drive.of(STATUS) if f.t_us >= 1_400_000]
    assert {int(CODEC.decode("BRAKE_STATUS", frame.data)["FALLBACK"]) for frame in late} == {0}, "healed"


@pytest.mark.parametrize(
    "words",
    [
        "bus-off gateway after 1s for 300ms",
        "partition radar,brake|gateway after 1s for 300ms",
        "babbling brake after 1s for 300ms",
        "bus-off radar after 1s for 300ms",
    ],
)
def test_a_bus_that_is_cut_for_a_while_carries_all_again(words: str, sound: Disturbed) -> None:
    drive = virtual(words)
    assert fallbacks(drive) > {0}, "while it was cut, the brakes had no request"
    assert [p for p in healed(drive) if p[1] < HEARTBEAT] == [p for p in healed(sound) if p[1] < HEARTBEAT]
    assert not drive.result.collision


def test_a_bus_off_while_braking_is_a_crash_or_none_by_its_length() -> None:
    short = virtual("bus-off gateway when ttc < 2 for 100ms")
    long = virtual("bus-off gateway when ttc < 2 permanent")
    assert not short.result.collision and long.result.collision


@pytest.mark.parametrize(
    "words",
    [
        "omission bus AEB_REQ when gap < 12.3 for 50ms",
        "delay bus AEB_REQ by 7ms permanent",
        "delay bus RADAR_TRACK by 13ms permanent",
        "babbling gateway after 1s for 100ms",
    ],
)
def test_how_often_a_disturbed_car_is_advanced_makes_no_difference(words: str) -> None:
    """A reply comes between two steps, and what opens a fault may have been in any step before."""
    lazy = virtual(words, late_ns=13_400_000)
    for tick_ns in (1_000_000, 370_001):
        busy = virtual(words, late_ns=13_400_000, tick_ns=tick_ns)
        assert (busy.frames, busy.result, busy.struck) == (lazy.frames, lazy.result, lazy.struck)


# -- in real time


def test_a_paced_drive_meets_its_condition_and_heals(tmp_path: Path) -> None:
    """The car reports its condition to the hub: the fault begins no sooner, holds for its time, and heals.

    How much later it begins is a matter of the machine's load; in lockstep it is exact, see above. A car that
    lags makes up for it: it may be at its end before 100 ms of the hub's time are over, so it drives again,
    more slowly.
    """
    for pace in PACES:
        drive = real(tmp_path / "bus.log", "omission bus AEB_REQ when ttc < 2.5 for 100ms", pace=pace)
        carried_us = [frame.t_us for frame in drive.of(TRACK)]
        gap_us = max(after - before for before, after in itertools.pairwise(carried_us))  # of the hub
        lag_ms = math.inf if drive.report is None else drive.report.lag_ms_max * pace  # of the car
        if max(lag_ms, gap_us / 1e3 - TRACK_MS) < LAG_MS_MAX:
            break
    (struck,) = drive.struck
    assert struck.first_us >= HOLDS_US
    assert struck.frames >= 1 and struck.receipt.state.value == "activated"
    carried_us = [frame.t_us for frame in drive.of(AEB_REQ)]
    assert not [t for t in carried_us if struck.first_us <= t < struck.first_us + 100_000]
    assert carried_us[-1] >= struck.first_us + 100_000, "healed"
    times = struck.times
    assert times is not None and times.noticed_us is not None and times.good_us is not None
    assert struck.first_us < times.noticed_us < struck.first_us + 100_000 <= times.good_us
    assert not drive.result.collision


def test_a_fault_is_armed_and_forgotten_while_the_car_drives(tmp_path: Path) -> None:
    def then(hub: RunningHub, t_ms: int) -> None:
        if t_ms == 500:
            hub.arm(FIRST_NUMBER, fault("omission bus AEB_REQ permanent"))
        if t_ms == 1000:
            hub.forget(FIRST_NUMBER)

    drive = real(tmp_path / "bus.log", then=then)
    times_us = [frame.t_us for frame in drive.of(AEB_REQ)]
    assert not [t for t in times_us if 520_000 <= t < 1_000_000]
    assert [t for t in times_us if t >= 1_000_000] == list(range(1_020_000, times_us[-1] + 1, 20_000))
    assert drive.struck[0].frames == 25
    assert drive.report is not None and drive.report.missing_answers == 0


@pytest.mark.parametrize("pace", [1.0, 4.0])
def test_a_paced_notice_is_of_the_time_at_which_the_node_noticed(tmp_path: Path, pace: float) -> None:
    """By the clock: not of when the hub hears of it, nor by the time of the drive, which has another zero."""
    origin_ns = time.monotonic_ns()
    with (
        running_hub(tmp_path / "bus.log", HubOptions(pace=pace, origin_ns=origin_ns)) as hub,
        Node(hub.port, "radar") as radar,
        Node(hub.port, "brake", 0x100) as brake,
    ):
        arm(hub, "omission bus RADAR_TRACK")
        before_ns = time.monotonic_ns()
        radar.send(0x130)
        radar.fence()
        after_ns = time.monotonic_ns()
        for word, clock_ns in (("fallback", before_ns), ("fallback", after_ns), ("good_again", 10**19)):
            brake.write(f"< aftbed noticed 100 {word} 5000 {clock_ns} >")
        brake.fence()
        heard_ns = time.monotonic_ns()
        (struck,) = hub.struck()
    times = struck.times
    assert times is not None and times.good_us is not None
    assert times.noticed_us == int((after_ns - origin_ns) // 1000 * pace), "the first one was not its work"
    assert times.noticed_us < times.good_us <= (heard_ns - origin_ns) / 1000 * pace, "not in the future"


# -- the hub itself


def arm(hub: RunningHub, words: str, number: int = FIRST_NUMBER) -> None:
    hub.arm(number, fault(words))


class Node(RawClient):
    """A client with a name; what it hears while it waits for the hub is kept."""

    _kept: list[int]

    def __init__(self, port: int, name: str, *uses: int) -> None:
        super().__init__(port, ours=True)
        self._kept = []
        self.write(f"< aftbed node {name}{''.join(f' {i:03X}' for i in uses)} >")
        self.fence()

    def send(self, can_id: int) -> None:
        self.write(f"< send {can_id:03x} 1 1 >")
        self._kept = self.heard()

    def heard(self) -> list[int]:
        """The identifiers that have come by now."""
        self.write("< echo >")
        found, self._kept = self._kept, []
        while (element := self.read()) != "< echo >":
            found.append(int(element.split()[2], 16))
        return found


def test_frames_sent_before_a_fault_ends_are_struck_however_late_the_hub_carries_them(tmp_path: Path) -> None:
    """Two hundred come in one read, so a fault ends between the times of two that are carried together."""
    sent, lasting_us = f"< send {TRACK:03x} 1 1 >", list[int]()
    with running_hub(tmp_path / "bus.log", HubOptions()) as hub, Node(hub.port, "radar") as radar:
        for number in range(20):
            lasting_us.append(300 + 100 * number)
            arm(hub, f"omission bus RADAR_TRACK for {lasting_us[-1] / 1000}ms", FIRST_NUMBER + number)
            radar.write(sent)  # here it begins
            radar.fence()
            radar.write(sent * 200)
            radar.fence()
        struck = hub.struck()
    carried_us = [entry.frame.t_us for entry in read_log(tmp_path / "bus.log")[0]]
    for one, for_us in zip(struck, lasting_us, strict=True):
        assert one.frames > 0
        assert not [t_us for t_us in carried_us if one.first_us <= t_us < one.first_us + for_us]


def test_a_partition_that_ends_gives_all_their_traffic_back(hub: RunningHub) -> None:
    with (
        Node(hub.port, "radar") as radar,
        Node(hub.port, "gateway", 0x130) as gateway,
        Node(hub.port, "brake") as brake,
        RawClient(hub.port) as tool,
    ):
        arm(hub, "partition radar|gateway")
        radar.send(0x130)
        gateway.send(0x100)
        assert (radar.heard(), gateway.heard(), brake.heard()) == ([], [], [0x130, 0x100])
        assert [tool.read().split()[2] for _ in range(2)] == ["130", "100"], "a tool hears both sides"
        hub.forget(FIRST_NUMBER)
        radar.send(0x130)
        gateway.send(0x100)
        assert (radar.heard(), gateway.heard(), brake.heard()) == ([0x100], [0x130], [0x130, 0x100])
    assert hub.stop().frames == 4


def test_a_babbling_idiot_in_real_time_starts_and_ends_by_itself(hub: RunningHub) -> None:
    with Node(hub.port, "radar") as radar, Node(hub.port, "brake") as brake:
        arm(hub, "babbling radar for 50ms")
        radar.send(0x130)
        found = []
        while not found or found[-1] != 0x130:
            found.append(int(brake.read().split()[2], 16))
        assert 20 <= found.count(0) <= 51 and found[-1] == 0x130, "then what had to wait comes"
        radar.send(0x131)
        assert brake.heard() == [0x131]
        assert radar.heard() == []


def test_a_delayed_frame_comes_in_its_time_though_nothing_else_happens(hub: RunningHub) -> None:
    with Node(hub.port, "radar") as radar, Node(hub.port, "brake") as brake:
        arm(hub, "delay bus RADAR_TRACK by 30ms")
        sent_s = time.monotonic()
        radar.send(0x130)
        radar.send(0x131)
        second, first = brake.read().split(), brake.read().split()
        assert (second[2], first[2]) == ("131", "130")
        assert time.monotonic() - sent_s >= 0.03, "however busy the machine is"


def test_when_all_is_over_the_hub_looks_at_nothing_any_more(hub: RunningHub) -> None:
    seen: list[bool] = []
    with Node(hub.port, "radar") as radar, Node(hub.port, "brake") as brake:
        arm(hub, "omission bus RADAR_TRACK")
        hub.order(lambda it: seen.append(it.disturbed))
        radar.send(0x130)
        hub.order(lambda it: seen.append(it.disturbed))
        radar.send(0x130)
        assert brake.heard() == [0x130]
    assert seen == [True, False]
    assert [struck.frames for struck in hub.struck()] == [1]


def test_the_hub_reports_what_becomes_of_a_fault(hub: RunningHub) -> None:
    with Node(hub.port, "radar") as radar, Node(hub.port, "gateway", 0x130) as gateway:
        arm(hub, "omission bus RADAR_TRACK nth 2")
        for _ in range(3):
            radar.send(0x130)
        gateway.write(f"< aftbed noticed 130 lost 60000 {time.monotonic_ns()} >")
        gateway.fence()
    hub.stop()
    assert hub.link.receipts == ["armed", "applied", "activated"]


def test_the_latest_client_with_a_name_has_it(hub: RunningHub) -> None:
    """A gateway that was replaced is cut off like the one before it."""
    with Node(hub.port, "gateway"), Node(hub.port, "gateway") as successor, Node(hub.port, "radar") as radar:
        arm(hub, "bus-off gateway")
        radar.send(0x130)
        assert successor.heard() == []


def test_the_car_gets_the_conditions_whenever_it_comes(tmp_path: Path) -> None:
    with running_hub(tmp_path / "bus.log", HubOptions(lockstep=True)) as hub:
        arm(hub, "omission bus RADAR_TRACK when ttc < 1.2")
        line = HubLine(hub.options)
        line.request_conditions()
        arm(hub, "omission bus AEB_REQ when gap > 30.5", 8)
        line.set_time(0)
        assert {n: str(c.quantity) for n, c in line.conditions.items()} == {FIRST_NUMBER: "ttc", 8: "gap"}
        line.met(8, 0)
        assert list(line.conditions) == [FIRST_NUMBER] and line.disturbed
        line.close()


def test_await_is_answered_when_the_frames_have_been_carried(tmp_path: Path) -> None:
    with running_hub(tmp_path / "bus.log", HubOptions(lockstep=True)) as hub:
        line, bus = HubLine(hub.options), open_bus(msgspec.structs.replace(hub.options, node="radar"))
        done = threading.Event()

        def wait() -> None:
            line.carried("radar", 2)
            done.set()

        waiting = threading.Thread(target=wait, daemon=True)
        waiting.start()
        bus.send(Frame(0, TRACK, b""))
        hub.order(lambda _: None)
        assert not done.is_set()
        bus.send(Frame(0, TRACK, b""))
        assert done.wait(DEADLINE_S)
        line.close()
        bus.close()


@pytest.mark.parametrize(
    "element",
    [
        "< aftbed node >",
        "< aftbed node Radar >",
        "< aftbed node radar 1234 >",
        "< aftbed node two words >",
        "< aftbed await radar >",
        "< aftbed met x >",
        "< aftbed met 7 2000 123 >",
        "< aftbed noticed 130 >",
        "< aftbed noticed 130 lost >",
        "< aftbed noticed 130 lost 60000 >",
        "< aftbed unasked 1 >",
        "< aftbed sing >",
    ],
)
def test_a_malformed_word_beside_the_bus_is_refused(hub: RunningHub, element: str) -> None:
    with RawClient(hub.port, ours=True) as client:
        assert client.ask(element).startswith("< error 20000000 ")
    assert hub.stop().refused == 1
