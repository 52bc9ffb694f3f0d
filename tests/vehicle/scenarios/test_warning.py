"""Warning and demand in the result of a drive, and a driver that brakes after the warning."""

import msgspec
import pytest

from aftbed.core.application import Application
from aftbed.core.journal import EntryKind
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import STAGE_WARN, AebOutput, decode_reply, encode_reply
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.plant import Driver, VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import Scenario

CODEC = load_dbc()
CYCLE_NS = 20_000_000

pytestmark = pytest.mark.simulation


class WarnsOnly(AebFunction):
    """Never asks for braking."""

    def execute(self, request: bytes) -> bytes:
        output = decode_reply(super().execute(request))
        stage = min(output.stage, STAGE_WARN)
        return encode_reply(AebOutput(stage, 0.0, output.ttc_s, output.slot, output.counter))


class Silent(AebFunction):
    """Neither warns nor brakes."""

    def execute(self, request: bytes) -> bytes:
        output = decode_reply(super().execute(request))
        return encode_reply(AebOutput(0, 0.0, None, None, output.counter))


class Startled(AebFunction):
    """Brakes in full from its first warning on."""

    def execute(self, request: bytes) -> bytes:
        output = decode_reply(super().execute(request))
        if output.stage < STAGE_WARN:
            return encode_reply(output)
        return encode_reply(AebOutput(3, 9.0, output.ttc_s, output.slot, output.counter))


def drive_with(function: Application, scenario: Scenario) -> VehicleResult:
    car = VirtualCar(scenario, codec=CODEC)
    now_ns = 0
    while car.end is None:
        for request in car.advance(now_ns):
            car.deliver(function.execute(request), now_ns)
        now_ns += CYCLE_NS
    return car.result()


def test_the_warning_is_timed_from_its_first_sign_to_the_first_braking() -> None:
    """Against what the function itself has said, and when."""
    run = simulate(Setup("none", scenario="r152:m1-50", seed=4))
    result = run.vehicle
    assert result is not None
    replies = [
        decode_reply(entry.payload) for entry in run.history.dialogue if entry.kind is EntryKind.ANSWERED
    ]
    warned = next(n for n, output in enumerate(replies) if output.stage >= STAGE_WARN)
    braked = next(n for n, output in enumerate(replies) if output.deceleration_ms2 > 0.0)
    assert result.warning_s == pytest.approx((braked - warned) * 0.02, abs=0.001)
    assert result.demand_max_ms2 == max(output.deceleration_ms2 for output in replies) == 9.0


def test_who_brakes_with_the_warning_has_not_warned_before() -> None:
    result = drive_with(Startled(), load_scenario("r152:m1-50"))
    assert (result.warning_s, result.demand_max_ms2) == (0.0, 9.0)


@pytest.mark.parametrize("function", [WarnsOnly(), Silent()])
def test_without_braking_there_is_no_time_from_the_warning_to_it(function: Application) -> None:
    result = drive_with(function, load_scenario("r152:m1-50"))
    assert (result.warning_s, result.demand_max_ms2, result.collision) == (None, 0.0, True)


def test_an_empty_road_has_neither() -> None:
    result = simulate(Setup("none", scenario="free-drive")).vehicle
    assert result is not None
    assert (result.warning_s, result.demand_max_ms2, result.braked) == (None, 0.0, False)
    assert result.fallback_s is None, "a request came in every cycle"


def test_a_driver_brakes_when_warned_and_not_before() -> None:
    scenario = load_scenario("ncap:ccrs-warning-60")
    silent, warned = (drive_with(function, scenario) for function in (Silent(), WarnsOnly()))
    assert silent.impact_speed_kmh == pytest.approx(60.0)
    assert not silent.braked
    assert warned.braked
    assert warned.demand_max_ms2 == 0.0, "the driver's, and not the function's"
    assert warned.max_deceleration_ms2 == pytest.approx(4.0, abs=0.3)
    # Warned 3.06 s before contact and braking 1.2 s later, less the brakes' dead time and lag.
    left_m = 60 / 3.6 * (3.06 - 1.2 - 0.2)
    expected_ms = ((60 / 3.6) ** 2 - 2 * 4.15 * left_m) ** 0.5
    assert warned.impact_speed_kmh == pytest.approx(expected_ms * 3.6, abs=1.5)


def test_a_slower_driver_brakes_later() -> None:
    scenario = load_scenario("ncap:ccrs-warning-60")
    plant = msgspec.structs.replace(scenario.plant, driver=Driver(2000, 4.0))
    slow = drive_with(WarnsOnly(), msgspec.structs.replace(scenario, plant=plant))
    usual = drive_with(WarnsOnly(), scenario)
    assert slow.impact_speed_kmh is not None
    assert usual.impact_speed_kmh is not None
    assert slow.impact_speed_kmh > usual.impact_speed_kmh + 5.0
