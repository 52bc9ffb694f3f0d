"""What a fault does to frames, by frames alone; and what names mean on the bus of aftbed's own DBC."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.inject.bus import BusFault, read_bus_fault
from aftbed.inject.bus_disturber import FLOOD_ID, REORDER_US_MAX, Disturber
from aftbed.inject.receipts import BusReport, BusTimes
from aftbed.vehicle.can.bus_model import FALLBACK, GOOD_AGAIN, CarriedFrame, Notice
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.e2e import intact, protect
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.condition import Condition

CODEC = load_dbc()
TRACK, AEB_REQ, EGO = (CODEC.can_id(name) for name in ("RADAR_TRACK", "AEB_REQ", "EGO_STATE"))
DATA_ID, EGO_DATA_ID = CODEC.data_id("RADAR_TRACK"), CODEC.data_id("EGO_STATE")
CYCLE_US = 20_000


def armed(*faults: str, now_us: int = 0) -> Disturber:
    disturber = Disturber()
    for number, words in enumerate(faults, 1):
        disturber.arm(number, read_bus_fault(words).resolved([CODEC]), 7, now_us)
    return disturber


def track(number: int, t_us: int | None = None) -> Frame:
    data = protect(bytes([0, 0x10, 0, number, 1, 2, 3, 4]), DATA_ID, number % 15)
    return Frame(number * CYCLE_US if t_us is None else t_us, TRACK, data)


def passed(disturber: Disturber, count: int, sender: str = "radar") -> list[list[Frame]]:
    """What comes of so many tracks, each in its cycle, with what is released then in front."""
    found = []
    for number in range(count):
        one = track(number)
        sent = disturber.release(one.t_us) + disturber.carry(one, sender)
        found.append([out.frame for out in sent])
    return found


def lengths(disturber: Disturber, count: int) -> list[int]:
    return [len(frames) for frames in passed(disturber, count)]


def test_an_omitted_frame_does_not_come_and_the_next_one_does() -> None:
    disturber = armed("omission bus RADAR_TRACK nth 3")
    assert lengths(disturber, 6) == [1, 1, 0, 1, 1, 1]
    assert disturber.idle
    (struck,) = disturber.reports()
    assert (struck.frames, struck.first_us, struck.first_id, struck.receipt.state.value) == (
        1,
        2 * CYCLE_US,
        TRACK,
        "applied",
    )


def test_other_frames_are_left_alone_and_not_counted() -> None:
    disturber = armed("omission bus RADAR_TRACK nth 1 permanent")
    other = Frame(0, EGO, bytes(8))
    assert disturber.carry(other, "brake") == [CarriedFrame(other, "brake")]
    assert disturber.reports() == [BusReport(1)]


def test_a_delayed_frame_comes_when_it_is_due() -> None:
    disturber = armed("delay bus RADAR_TRACK by 25ms nth 2")
    assert lengths(disturber, 2) == [1, 0]
    assert disturber.due_us() == CYCLE_US + 25_000
    assert disturber.release(CYCLE_US + 24_999) == []
    (late,) = disturber.release(CYCLE_US + 25_000)
    assert late.frame == track(1, CYCLE_US + 25_000)
    assert disturber.idle and disturber.due_us() is None


def test_what_is_delayed_for_a_time_keeps_its_order_and_all_of_it_comes() -> None:
    disturber = armed("delay bus RADAR_TRACK by 45ms for 60ms")
    frames = [frame for out in passed(disturber, 8) for frame in out]
    assert [frame.data for frame in frames if frame.data in {track(n).data for n in range(3)}] == [
        track(n).data for n in range(3)
    ]
    assert len(frames) == 8 and disturber.idle


def test_a_duplicate_is_the_same_frame_twice() -> None:
    found = passed(armed("duplicate bus RADAR_TRACK nth 2"), 4)
    assert found[1] == [track(1), track(1)] and found[2] == [track(2)]


def test_a_reordered_frame_comes_behind_its_successor() -> None:
    found = passed(armed("reorder bus RADAR_TRACK nth 2"), 4)
    assert found == [[track(0)], [], [track(2), track(1, 2 * CYCLE_US)], [track(3)]]


def test_a_frame_without_a_successor_is_not_swallowed() -> None:
    disturber = armed("reorder bus RADAR_TRACK")
    assert disturber.carry(track(0), "radar") == []
    assert disturber.due_us() == REORDER_US_MAX
    assert [sent.frame for sent in disturber.release(REORDER_US_MAX)] == [track(0, REORDER_US_MAX)]
    assert disturber.idle


def test_a_flipped_bit_breaks_the_crc_unless_it_is_made_good() -> None:
    ((bad,),) = passed(armed("corrupt bus RADAR_TRACK bit 37"), 1)
    ((good,),) = passed(armed("corrupt bus RADAR_TRACK bit 37 crc good"), 1)
    assert bad.data[4] == good.data[4] == track(0).data[4] ^ 1 << 5
    assert not intact(bad.data, DATA_ID) and intact(good.data, DATA_ID)
    assert bad.data[1] == good.data[1] == track(0).data[1], "the counter stays"


def test_a_signal_has_the_value_that_it_is_given() -> None:
    ((frame,),) = passed(armed("corrupt bus RADAR_TRACK signal RELATIVE_SPEED=-20 crc good"), 1)
    before, after = CODEC.decode("RADAR_TRACK", track(0).data), CODEC.decode("RADAR_TRACK", frame.data)
    assert after["RELATIVE_SPEED"] == -20.0 and intact(frame.data, DATA_ID)
    same = {"CRC", "RELATIVE_SPEED"}
    assert {k: v for k, v in after.items() if k not in same} == {
        k: v for k, v in before.items() if k not in same
    }


def test_a_signal_that_has_the_value_already_is_not_struck() -> None:
    disturber = armed("corrupt bus RADAR_TRACK signal VALID=1 crc good")
    assert passed(disturber, 1) == [[track(0)]]
    assert disturber.reports()[0].receipt.state.value == "armed" and not disturber.idle


def test_a_masquerade_is_right_for_another_message_and_wrong_for_this_one() -> None:
    ((frame,),) = passed(armed("masquerade bus RADAR_TRACK as EGO_STATE"), 1)
    assert not intact(frame.data, DATA_ID) and intact(frame.data, EGO_DATA_ID)
    assert frame.data[1:] == track(0).data[1:]


def test_a_stuck_counter_stays_what_it_was_before_and_is_well_protected() -> None:
    frames = [out[0] for out in passed(armed("stuck-counter bus RADAR_TRACK nth 3 for 60ms"), 8)]
    assert [frame.data[1] & 0xF for frame in frames] == [0, 1, 1, 1, 1, 5, 6, 7]
    assert all(intact(frame.data, DATA_ID) for frame in frames)


def test_an_intermittent_fault_is_of_its_seed() -> None:
    one, again = (lengths(armed("omission bus RADAR_TRACK intermittent p 0.5"), 200) for _ in range(2))
    assert one == again and 60 < sum(one) < 140


def test_every_third_frame_from_the_second_on() -> None:
    assert lengths(armed("omission bus RADAR_TRACK nth 2 intermittent every 3"), 9) == [
        *(1, 0, 1),
        *(1, 0, 1),
        *(1, 0, 1),
    ]


def test_a_fault_for_a_time_begins_with_its_first_frame_and_ends() -> None:
    disturber = armed("omission bus RADAR_TRACK after 30ms nth 2 for 40ms")
    assert lengths(disturber, 8) == [1, 1, 1, 0, 0, 1, 1, 1]
    assert disturber.idle


def test_a_condition_opens_it_when_it_is_met_and_not_before() -> None:
    disturber = armed("omission bus RADAR_TRACK when ttc < 1.2")
    assert disturber.conditions() == [(1, Condition("ttc", True, 1.2))]
    assert lengths(disturber, 3) == [1, 1, 1]
    disturber.met(1, 3 * CYCLE_US)
    assert disturber.conditions() == []
    assert disturber.carry(track(3), "radar") == [] and disturber.idle


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        (Condition("ttc", True, 1.2), [False, True, False]),
        (Condition("gap", False, 9.0), [True, False, False]),
        (Condition("speed", True, 5.0), [False, True, True]),
    ],
)
def test_conditions_of_a_car(condition: Condition, holds: list[bool]) -> None:
    cars = [(2.0, 10.0, 5.0), (1.0, 5.0, 4.0), (None, None, 0.0)]
    assert [condition.holds(*car) for car in cars] == holds


def test_a_babbling_idiot_lets_nobody_through_and_ends_with_the_latest_of_each() -> None:
    disturber = armed("babbling brake after 10ms for 50ms")
    found = passed(disturber, 3)
    assert found[0] == [track(0)]
    assert {frame.can_id for out in found[1:] for frame in out} == {FLOOD_ID}
    own = Frame(59_000, EGO, bytes(8))
    assert disturber.carry(own, "brake") == [], "its own frames do not get through either"
    waited = [sent.frame for sent in disturber.release(60_000)]
    assert waited == [Frame(60_000, EGO, bytes(8)), track(2, 60_000)], "the latest of each, by priority"
    assert disturber.carry(track(3), "radar") == [CarriedFrame(track(3), "radar")]
    assert disturber.reports()[0].frames == 3


def test_the_flood_is_one_frame_in_each_millisecond() -> None:
    disturber = armed("babbling radar for 5ms")
    floods = [len(disturber.release(t_us)) for t_us in range(0, 8000, 500)]
    assert floods == [1, 0] * 5 + [0] * 6
    assert disturber.idle


def test_a_bus_off_node_is_neither_heard_nor_hears_until_it_is_back() -> None:
    disturber = armed("bus-off radar after 30ms for 40ms")
    assert lengths(disturber, 6) == [1, 1, 0, 0, 1, 1]
    disturber = armed("bus-off radar for 40ms")
    assert disturber.cut_off("brake", "radar", 0) and not disturber.cut_off("radar", "brake", 0)
    assert not disturber.cut_off("brake", "radar", 40_000) and disturber.idle


def test_a_partition_cuts_both_ways_and_only_between_its_sides() -> None:
    disturber = armed("partition radar|gateway for 40ms")
    nodes = ("radar", "gateway", "brake", "client 9")
    deaf = {(s, n) for s in nodes for n in nodes if disturber.cut_off(s, n, 0)}
    assert deaf == {("radar", "gateway"), ("gateway", "radar")}
    assert lengths(disturber, 1) == [1], "it is on the bus, and in the log"
    assert not any(disturber.cut_off(s, n, 40_000) for s in nodes for n in nodes)


def test_what_is_forgotten_gives_back_what_it_holds() -> None:
    disturber = armed("delay bus RADAR_TRACK by 1s permanent")
    assert disturber.carry(track(0), "radar") == []
    disturber.forget(1, 100)
    assert [sent.frame for sent in disturber.release(100)] == [track(0, 100)]
    assert disturber.carry(track(1), "radar") == [CarriedFrame(track(1), "radar")] and disturber.idle


def test_two_faults_strike_one_behind_the_other() -> None:
    found = passed(armed("duplicate bus RADAR_TRACK nth 2", "omission bus RADAR_TRACK nth 2"), 3)
    assert found == [[track(0)], [track(1)], [track(2)]]


def test_who_notices_makes_it_activated() -> None:
    disturber = armed("omission bus RADAR_TRACK nth 2", "omission bus AEB_REQ nth 9")
    disturber.noticed("gateway", Notice(TRACK, "lost", 60_000))
    assert [s.receipt.state.value for s in disturber.reports()] == ["armed", "armed"], (
        "it was not because of the fault"
    )
    passed(disturber, 3)
    disturber.noticed("gateway", Notice(EGO, "lost", 60_000))
    assert disturber.reports()[0].receipt.state.value == "applied"
    disturber.noticed("gateway", Notice(TRACK, "lost", 60_000))
    first, second = disturber.reports()
    assert (first.receipt.state.value, second.receipt.state.value) == ("activated", "armed")
    assert first.receipt.detail == "1 frame, at 0.020000 s, id 130; noticed by gateway (lost)"


def test_a_fallback_has_noticed_whatever_there_was() -> None:
    disturber = armed("omission bus RADAR_TRACK")
    passed(disturber, 1)
    disturber.noticed("brake", Notice(AEB_REQ, "fallback", 30_000))
    assert disturber.reports()[0].receipt.state.value == "activated"


def test_who_takes_a_struck_frame_in_has_believed_it() -> None:
    disturber = armed("corrupt bus RADAR_TRACK bit 40 crc good")
    (sent,) = disturber.carry(track(0), "radar")
    disturber.reached(sent.by, "gateway", 0)
    assert disturber.reports()[0].receipt.detail == "1 frame, at 0.000000 s, id 130; believed by gateway"


FAULTS = st.sampled_from(
    [
        "omission bus RADAR_TRACK nth 2",
        "delay bus RADAR_TRACK by 33ms for 100ms",
        "duplicate bus RADAR_TRACK intermittent p 0.3",
        "reorder bus from radar intermittent p 0.3",
        "corrupt bus RADAR_TRACK bit 20 crc good permanent",
        "stuck-counter bus RADAR_TRACK after 50ms for 80ms",
        "babbling gateway after 30ms for 70ms",
        "bus-off radar after 100ms for 50ms",
        "partition radar|brake",
    ]
)


@given(st.lists(FAULTS, max_size=4), st.lists(st.integers(1, 30_000), min_size=1, max_size=40))
def test_no_frame_is_lost_for_good_by_what_only_holds_it_back(faults: list[str], steps: list[int]) -> None:
    """Whatever is mixed: a release leaves nothing that is due, and in the end nothing is held."""
    disturber, now_us, came, sent = armed(*faults), 0, 0, 0
    loses = any(word in fault for fault in faults for word in ("omission", "bus-off", "babbling"))
    doubles = sum("duplicate" in fault for fault in faults)
    for number, step_us in enumerate(steps):
        now_us += step_us
        came += sum(s.frame.can_id == TRACK for s in disturber.release(now_us))
        due_us = disturber.due_us()
        assert due_us is None or due_us > now_us
        came += len(disturber.carry(track(number, now_us), "radar"))
        sent += 1
    end_us = now_us + 10 * REORDER_US_MAX
    came += sum(s.frame.can_id == TRACK for s in disturber.release(end_us))
    if not loses:
        assert sent <= came <= sent * 2**doubles


# -- aiming


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("omission bus RADAR_TRAC", "unknown message 'RADAR_TRAC'; did you mean 'RADAR_TRACK'?"),
        ("omission bus from rador", "unknown sender of frames 'rador'; did you mean 'radar'?"),
        ("bus-off rader", "unknown node of the bus 'rader'; did you mean 'radar'?"),
        ("partition radar|brakes", "unknown node of the bus 'brakes'; did you mean 'brake'?"),
        ("corrupt bus RADAR_TRACK bit 5 crc good", "bits 0 to 7 of RADAR_TRACK are the CRC itself"),
        ("corrupt bus FTM_HEARTBEAT_1 bit 9 crc good", "FTM_HEARTBEAT_1 has no E2EDataID"),
        (
            "corrupt bus RADAR_TRACK signal RANG=3",
            "unknown signal of RADAR_TRACK 'RANG'; did you mean 'RANGE'?",
        ),
        ("corrupt bus RADAR_TRACK signal RANGE=400", "RADAR_TRACK.RANGE=400: its bits hold 0 to 327.675"),
        ("corrupt bus RADAR_TRACK signal RELATIVE_SPEED=-200", "its bits hold -163.84 to 163.82"),
        ("masquerade bus RADAR_TRACK as RADAR_TRACK", "both have the data id"),
        ("masquerade bus RADAR_TRACK as FTM_HEARTBEAT_1", "FTM_HEARTBEAT_1 has no E2EDataID"),
        ("stuck-counter bus from gateway", "FTM_HEARTBEAT_1 has no E2EDataID"),
    ],
)
def test_a_name_that_does_not_exist_is_refused(words: str, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        read_bus_fault(words).resolved([CODEC])
    assert says in str(refused.value)


def test_a_bit_that_a_short_message_lacks_is_refused(tmp_path: Path) -> None:
    dbc = tmp_path / "short.dbc"
    dbc.write_text('VERSION ""\nBU_: X\nBO_ 256 SHORT: 2 X\n SG_ A : 0|8@1+ (1,0) [0|255] "" X\n')
    with pytest.raises(ConfigError, match="bit 16: SHORT has the bits 0 to 15"):
        read_bus_fault("corrupt bus SHORT bit 16").resolved([load_dbc(dbc)])


def test_a_replay_has_no_car_to_look_at_and_other_nodes() -> None:
    with pytest.raises(ConfigError, match="'when' looks at the car, and a replay has none"):
        read_bus_fault("omission bus RADAR_TRACK when gap < 3").resolved([CODEC], ("player",), car=False)
    with pytest.raises(ConfigError, match="unknown node of the bus 'radar'"):
        read_bus_fault("bus-off radar").resolved([CODEC], ("player",), car=False)


def test_an_aim_is_no_part_of_the_words() -> None:
    fault: BusFault = read_bus_fault("omission bus from radar nth 5").resolved([CODEC])
    assert fault.targets is not None
    assert {mark.can_id for mark in fault.targets} == {TRACK, CODEC.can_id("RADAR_STATUS")}
    assert str(fault) == "omission bus from radar nth 5"


# -- how long it took


def times(disturber: Disturber) -> BusTimes:
    found = disturber.reports()[0].receipt.bus
    assert found is not None
    return found


def struck_at_20ms(words: str = "omission bus RADAR_TRACK nth 2") -> Disturber:
    disturber = armed(words)
    passed(disturber, 3)
    return disturber


def test_it_is_handled_when_all_that_objected_use_the_frames_again() -> None:
    disturber = struck_at_20ms()
    assert times(disturber) == BusTimes(20_000)
    disturber.noticed("gateway", Notice(TRACK, "lost", 40_000))
    disturber.noticed("brake", Notice(AEB_REQ, FALLBACK, 50_000))
    disturber.noticed("gateway", Notice(TRACK, GOOD_AGAIN, 60_000))
    assert times(disturber) == BusTimes(20_000, 40_000, None, 50_000)
    disturber.noticed("brake", Notice(AEB_REQ, GOOD_AGAIN, 80_000))
    disturber.noticed("brake", Notice(AEB_REQ, FALLBACK, 90_000))  # for another reason
    disturber.noticed("brake", Notice(AEB_REQ, GOOD_AGAIN, 95_000))
    assert times(disturber) == BusTimes(20_000, 40_000, 80_000, 50_000)


def test_what_one_node_reports_may_be_heard_behind_what_another_one_reports_later() -> None:
    disturber = struck_at_20ms()
    disturber.noticed("gateway", Notice(TRACK, "lost", 40_000))
    disturber.noticed("gateway", Notice(TRACK, GOOD_AGAIN, 60_000))
    assert times(disturber) == BusTimes(20_000, 40_000, 60_000)
    disturber.noticed("brake", Notice(AEB_REQ, FALLBACK, 31_000))
    assert times(disturber) == BusTimes(20_000, 31_000, None, 31_000)
    assert disturber.reports()[0].noticed == "brake (fallback)"
    disturber.noticed("brake", Notice(AEB_REQ, GOOD_AGAIN, 55_000))
    assert times(disturber) == BusTimes(20_000, 31_000, 60_000, 31_000), "the last one to use them again"


def test_frames_that_are_good_again_after_another_defect_end_nothing() -> None:
    disturber = struck_at_20ms()
    disturber.noticed("gateway", Notice(EGO, "lost", 30_000))
    disturber.noticed("gateway", Notice(EGO, GOOD_AGAIN, 40_000))
    disturber.noticed("gateway", Notice(TRACK, GOOD_AGAIN, 40_000))  # it had objected before
    assert times(disturber) == BusTimes(20_000)


def test_what_was_wrong_before_the_fault_is_not_its_work() -> None:
    disturber = struck_at_20ms()
    disturber.noticed("gateway", Notice(TRACK, "lost", 19_000))
    assert times(disturber) == BusTimes(20_000)


def test_what_comes_late_and_right_is_handled_when_it_comes() -> None:
    for words, good_us in (("delay bus RADAR_TRACK by 9ms", 9_000), ("corrupt bus RADAR_TRACK bit 40", None)):
        disturber = armed(words)
        (sent,) = disturber.carry(track(0), "radar") or disturber.release(9_000)
        disturber.reached(sent.by, "gateway", sent.frame.t_us)
        assert times(disturber) == BusTimes(0, good_us=good_us, believed=True), words
