"""Insufficiencies of the radar: their words, and what a radar with them reports."""

from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.inject.bus import Opening
from aftbed.inject.grammar import Lasting, Permanent, Trigger
from aftbed.inject.model import Fault, parse
from aftbed.inject.radar import EFFECTS, RADAR, FieldOfView, Ghost, Missed, RadarFault, RadarFaults
from aftbed.inject.receipts import Receipt, ReceiptState
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.radar import Target

CYCLE_US = 20_000
CAR = Target(40.0, -10.0, 0.5)

Reported = dict[int, Target | None]  # by ms


class Radar:
    """A radar with faults; what it reports each 20 ms. `sees`: the target in that millisecond."""

    def __init__(self, *faults: str) -> None:
        self.faults = RadarFaults()
        self._t_ms = 0
        for words in faults:
            self.arm(words)

    def arm(self, words: str) -> None:
        action = parse(words).action
        assert isinstance(action, RadarFault)
        self.faults.arm(1, action, 7)

    def run(self, sees: Iterable[Target | None], gap_m: float | None = None) -> Reported:
        found: Reported = {}
        for target in sees:
            t_us = 1000 * self._t_ms
            self.faults.step(t_us, target, lambda condition: condition.holds(None, gap_m, 0.0))
            if t_us % CYCLE_US == 0:
                found[self._t_ms] = self.faults.reported(t_us, target)
            self._t_ms += 1
        return found

    def receipt(self) -> Receipt:
        (report,) = self.faults.reports()
        return report.receipt


def still(ms: int, target: Target | None = CAR) -> list[Target | None]:
    return [target] * ms


# -- words ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "action"),
    [
        ("radar missed", RadarFault(Missed())),
        (
            "radar ghost range 30 speed 10 for 200ms",
            RadarFault(Ghost(30, 10), persistence=Lasting(200_000)),
        ),
        ("radar ghost for 1s range 0.5 after 2s", RadarFault(Ghost(0.5), Opening(2_000_000), Lasting(10**6))),
        (
            "radar fov angle 20 when gap < 30 permanent",
            RadarFault(
                FieldOfView(angle_deg=20), Opening(when=Condition("gap", True, 30)), persistence=Permanent()
            ),
        ),
    ],
)
def test_the_words(text: str, action: RadarFault) -> None:
    assert parse(text) == Fault(action, RADAR, Trigger())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("radar gost", "unknown insufficiency of the radar 'gost'; did you mean 'ghost'"),
        ("radar ghost", "fault 'radar ghost': 'range' with its value is missing"),
        (
            "radar ghost range 200",
            "range '200': a number above 0 and up to 150 m (the radar sees no farther) is allowed",
        ),
        ("radar ghost range -3", "range '-3': a number above 0 and up to 150 m"),
        ("radar ghost range nan", "range 'nan': a number above 0 and up to 150 m"),
        ("radar ghost range 30 speed 400", "speed '400': a number from -100 to 100 m/s is allowed"),
        ("radar ghost range 30 for -5ms", "duration '-5ms': a positive number with its unit is allowed"),
        ("radar missed for 0.0001ms", "duration '0.0001ms': a microsecond is the least"),
        ("radar missed range 3", "unknown word in fault 'radar missed range 3': 'range'"),
        ("radar missed nth 3", "unknown word in fault 'radar missed nth 3': 'nth'"),
        ("radar missed for 1s permanent", "'for 1s' and 'permanent': one of them is allowed"),
        ("radar missed after 1s when ttc < 1", "'after 1s' and 'when ttc < 1': one of them is allowed"),
        ("radar bias", "'by' with its value is missing"),
        ("radar bias by 0", "by '0': a number from -150 to 150 m, but not 0, is allowed"),
        ("radar drift by 101", "by '101': a number from -100 to 100 m/s, but not 0, is allowed"),
        ("radar latency by 3s", "by 3s: up to 2000ms is allowed"),
        ("radar latency by 3", "latency '3': a positive number with its unit is allowed"),
        ("radar fov", "'range' in m or 'angle' in degrees is missing"),
        ("radar fov angle 180", "angle '180': a number above 0 and up to 179 degrees is allowed"),
    ],
)
def test_what_is_refused_and_why(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(text)
    assert message in str(refused.value)


@given(
    st.lists(
        st.sampled_from(
            [*EFFECTS, "range", "speed", "by", "angle", "for", "after", "when", "permanent", "intermittent"]
            + ["every", "p", "30", "-5", "0.1", "200ms", "ttc", "<", "1.2"]
        )
        | st.text(max_size=6),
        max_size=10,
    )
)
def test_whatever_is_typed_is_a_fault_or_refused(typed: list[str]) -> None:
    try:
        fault = parse(" ".join(["radar", *typed]))
    except ConfigError:
        return
    assert parse(str(fault)) == fault


def test_a_fault_counts_no_tracks() -> None:
    with pytest.raises(ValueError, match="no nth track"):
        RadarFault(Missed(), Opening(nth=2))


# -- what is reported -------------------------------------------------------------------------------


def test_a_ghost_comes_closer_and_ends() -> None:
    found = Radar("radar ghost range 30 speed 10 after 20ms for 40ms").run(still(81, None))
    assert found == {
        0: None,
        20: Target(30.0, -10.0, 0.0, 1),
        40: Target(29.8, -10.0, 0.0, 1),
        60: None,
        80: None,
    }


def test_a_ghost_hides_what_is_behind_it_and_is_hidden_by_what_is_before_it() -> None:
    assert Radar("radar ghost range 39").run(still(1))[0] == Target(39.0, 0.0, 0.0, 1)
    radar = Radar("radar ghost range 41")
    assert radar.run(still(41)) == {0: CAR, 20: CAR, 40: CAR}
    assert radar.receipt() == Receipt(ReceiptState.NOT_ACTIVATED, "it changed none of 3 tracks")


def test_a_ghost_is_gone_when_it_has_come_to_the_car() -> None:
    found = Radar("radar ghost range 1 speed 50").run(still(41, None))
    assert found == {0: Target(1.0, -50.0, 0.0, 1), 20: None, 40: None}


def test_a_missed_target_and_a_ghost_are_armed_in_order() -> None:
    radar = Radar("radar missed", "radar ghost range 100")
    assert radar.run(still(1)) == {0: Target(100.0, 0.0, 0.0, 1)}
    swapped = Radar("radar ghost range 100", "radar missed")
    assert swapped.run(still(1)) == {0: None}


def test_a_biased_range_is_off_and_never_negative() -> None:
    assert Radar("radar bias by -5").run(still(1)) == {0: CAR._replace(range_m=35.0)}
    assert Radar("radar bias by -50").run(still(1)) == {0: CAR._replace(range_m=0.0)}
    assert Radar("radar bias by 5").run(still(1, None)) == {0: None}


def test_a_drifting_range_is_off_by_more_and_more() -> None:
    found = Radar("radar drift by 2").run(still(1001))
    assert found[0] == CAR and found[500] == CAR._replace(range_m=41.0)
    assert found[1000] == CAR._replace(range_m=42.0)


def test_a_late_track_has_what_was_there_before() -> None:
    approach = [CAR._replace(range_m=40.0 - ms) for ms in range(41)]
    found = Radar("radar latency by 30ms").run(approach)
    assert found == {0: approach[0], 20: approach[0], 40: approach[10]}
    live = Radar("radar latency by 10ms after 30ms").run(approach)
    assert live == {0: approach[0], 20: approach[20], 40: approach[30]}


@pytest.mark.parametrize(
    ("words", "lateral_m", "seen"),
    [
        ("range 40", 0.0, True),
        ("range 39.9", 0.0, False),
        ("angle 90", 39.9, True),
        ("angle 90", -40.1, False),
        ("range 50 angle 10", 3.0, True),
        ("range 50 angle 10", 4.0, False),
    ],
)
def test_the_field_of_view(words: str, lateral_m: float, seen: bool) -> None:
    target = CAR._replace(lateral_m=lateral_m)
    assert Radar(f"radar fov {words}").run(still(1, target)) == {0: target if seen else None}


def test_a_fault_repeats_each_nth_cycle_or_by_chance() -> None:
    found = Radar("radar missed intermittent every 3 after 20ms").run(still(141))
    assert [ms for ms, target in found.items() if target is None] == [20, 80, 140]
    chance = "radar missed intermittent p 0.5"
    first, again = Radar(chance).run(still(2001)), Radar(chance).run(still(2001))
    assert first == again
    assert 30 < sum(target is None for target in first.values()) < 70


# -- receipts ---------------------------------------------------------------------------------------


def test_a_fault_that_never_began_is_armed() -> None:
    radar = Radar("radar missed after 1s")
    radar.run(still(100))
    assert radar.receipt() == Receipt()
    (report,) = radar.faults.reports()
    assert not report.waits


def test_a_fault_begins_so_long_after_it_was_armed() -> None:
    radar = Radar()
    radar.run(still(100))
    radar.arm("radar missed after 30ms")
    assert radar.run(still(41)) == {100: CAR, 120: CAR, 140: None}


def test_a_condition_that_never_held_is_waited_for() -> None:
    radar = Radar("radar missed when gap < 30")
    assert radar.run(still(41), gap_m=40.0) == {0: CAR, 20: CAR, 40: CAR}
    (waiting,) = radar.faults.reports()
    assert waiting.waits and waiting.receipt.state is ReceiptState.ARMED
    radar.run(still(1), gap_m=29.0)
    (begun,) = radar.faults.reports()
    assert not begun.waits


def test_a_target_that_is_not_there_cannot_be_missed() -> None:
    radar = Radar("radar missed")
    radar.run(still(1, None))
    assert radar.receipt() == Receipt(ReceiptState.NOT_ACTIVATED, "it changed none of 1 track")


def test_a_wrong_track_is_applied_and_activated_when_the_brakes_have_an_answer() -> None:
    radar = Radar("radar missed for 30ms")
    radar.faults.answered()  # to what came before
    radar.run(still(41))
    first = "2 tracks, the first at 0.000000 s"
    assert radar.receipt() == Receipt(ReceiptState.APPLIED, f"{first}; not answered")
    radar.faults.answered()
    assert radar.receipt() == Receipt(ReceiptState.ACTIVATED, f"{first}; answered")
