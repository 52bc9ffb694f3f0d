"""The car of a simulated run: when it began, faults of its bus, and the conditions at which faults begin.

The car (`vehicle.drive_virtual`) is advanced on demand, which is once in a cycle of its radar. While a
condition is waited for, it is driven step by step: what begins on that condition begins at the very virtual
time of that step and, as in lockstep, before anything else that belongs to the step.
"""

from collections.abc import Callable
from typing import Final

from aftbed.inject.bus import BusFault
from aftbed.inject.bus_disturber import Disturber
from aftbed.inject.kind import FaultKind
from aftbed.inject.receipts import BusReport
from aftbed.runtime.interface import Met
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.givens import car_in, own_codec
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.plant import STEP_US, VehicleResult

STEP_NS: Final = STEP_US * 1000


class Drive:
    """Of `scenario`. It begins with the first client that there is."""

    def __init__(self, scenario: str, seed: int, clock: Clock) -> None:
        self._car, self._clock = car_in(scenario, seed), clock
        self._faults = Disturber()  # of its bus
        self._began_ns = 0
        self._wake: Callable[[], None] = lambda: None
        self._under_way = self._stepping = False

    def seat(self, wake: Callable[[], None]) -> tuple[VirtualCar, int]:
        """For a client, which is woken where there may be requests: the car, and when its drive began."""
        self._wake, self._began_ns = wake, self._began_ns or self._clock.ns
        return self._car, self._began_ns

    def go(self) -> None:
        """The run is launched."""
        self._under_way = True
        self._step_by_step()

    def result(self) -> VehicleResult:
        """What it came to, so far."""
        return self._car.result()

    def disturb(self, number: int, fault: FaultKind, draw: int) -> None:
        """Arm `fault` in the car's bus. Raises ConfigError where it names what does not exist."""
        assert isinstance(fault, BusFault), fault
        fault = fault if fault.targets is not None else fault.resolved([own_codec()])
        now_us = self._car.before(self._t_ns() if self._under_way else 0)
        self._faults.arm(number, fault, draw, now_us)
        self._car.disturb(self._faults)

    def report(self, number: int) -> BusReport | None:
        """What has become of a fault of the car's bus."""
        return next((one for one in self._faults.reports() if one.number == number), None)

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> None:
        """See `runtime.interface.Runtime`."""

        def held(t_us: int) -> None:  # somebody is at work now, perhaps the one who is to be struck
            self._clock.at(self._clock.ns, lambda: self._met(met, t_us))

        self._car.watch(number, condition, held)
        if self._under_way:
            self._step_by_step()

    def _met(self, met: Callable[[Met], None], t_us: int) -> None:
        met(Met(t_us, 0, self._go_on))
        self._clock.watch_jobs()

    def _go_on(self) -> None:
        self._car.go_on(self._t_ns())
        self._clock.at(self._clock.ns, self._wake)

    def _t_ns(self) -> int:
        return self._clock.ns - self._began_ns

    def _step_by_step(self) -> None:
        if self._car.watched and not self._stepping:
            self._stepping = True
            self._clock.at(self._began_ns + -(-self._t_ns() // STEP_NS) * STEP_NS, self._step)

    def _step(self) -> None:
        self._car.pass_time(self._t_ns())
        self._stepping = self._car.watched
        if self._stepping:
            self._clock.at(self._clock.ns + STEP_NS, self._step)
