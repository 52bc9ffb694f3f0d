"""Faults of the bus, as the supervisor has them: the hub arms them, and reports what has become of them.

The hub also passes on the conditions of the car at which other faults begin: the car is connected to it.
"""

import contextlib
from collections.abc import Callable, Generator

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.inject.bus import BusFault
from aftbed.inject.kind import FaultKind
from aftbed.inject.receipts import BusReport, ReceiptState
from aftbed.runtime import control
from aftbed.runtime.interface import Met
from aftbed.runtime.tasks import Key, Wait
from aftbed.runtime.unix.process_pool import UnixProcess, UnixProcessPool
from aftbed.vehicle.condition import Condition

Steps = Generator[Wait, dict[Key, bytes], None]


class BusFaults:
    """Of one run. `settle` wakes the tasks that wait for the hub; `log` writes a line for people."""

    def __init__(
        self, pool: UnixProcessPool, settle: Callable[[Key], None], log: Callable[[str, str], None]
    ) -> None:
        self._pool, self._settle, self._log = pool, settle, log
        self._hub: UnixProcess | None = None
        self._faults: dict[int, BusFault] = {}
        self._struck: dict[int, BusReport] = {}
        self._met: dict[int, Callable[[Met], None]] = {}

    def serve(self, hub: UnixProcess) -> None:
        """The hub is there."""
        self._hub = hub

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Steps:
        """Return when the hub has armed the fault. Raises StepFailed."""
        assert isinstance(fault, BusFault), fault
        if self._hub is None or not self._hub.alive:
            raise StepFailed(f"{fault}: this run has no bus")
        if fault.targets is None:
            raise StepFailed(f"{fault}: its names were not resolved")
        self._faults[number] = fault
        self._pool.order(self._hub, control.DisturbBus(number, fault, draw))
        yield Wait(frozenset({(control.BUS_FAULT_ARMED, control.HUB, number)}), frozenset({control.HUB}))

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Steps:
        """Return when the car watches for it. Raises StepFailed."""
        if self._hub is None or not self._hub.alive:
            raise StepFailed(f"when {condition}: this run has no car")
        self._met[number] = met
        self._pool.order(self._hub, control.WatchCar(number, condition))
        yield Wait(frozenset({(control.CONDITION_WATCHED, control.HUB, number)}), frozenset({control.HUB}))

    def _is_met(self, number: int, t_us: int, since_ns: int) -> None:
        hub, met = self._hub, self._met.pop(number, None)
        if met is not None and hub is not None:
            met(Met(t_us, since_ns, lambda: self._pool.order(hub, control.Ack(number))))

    def ask(self) -> Steps:
        """Ask the hub what has become of all faults by now."""
        if self._faults and self._hub is not None and self._hub.alive:
            with contextlib.suppress(StepFailed):  # then what it has said before has to do
                self._pool.order(self._hub, control.Stats(control.UNANSWERED))
                yield Wait(frozenset({(control.BUS_FAULTS_ASKED, control.HUB, 0)}), frozenset({control.HUB}))

    def on_report(self, kind: str, data: bytes) -> None:
        """What the hub says."""
        if kind in (control.BUS_FAULT_ARMED, control.CONDITION_WATCHED):
            self._settle((kind, control.HUB, int(data)))
            return
        if kind == control.CONDITION_MET:
            self._is_met(*msgspec.msgpack.decode(data, type=tuple[int, int, int]))
            return
        for struck in msgspec.msgpack.decode(data, type=list[BusReport]):
            before, self._struck[struck.number] = self._struck.get(struck.number), struck
            state = before.receipt.state if before is not None else ReceiptState.ARMED
            if struck.receipt.state is not state:
                found = struck.receipt
                self._log("fault", f"{self._faults[struck.number]}: {found.state.value}, {found.detail}")
        if kind == control.BUS_FAULTS_ASKED:
            self._settle((control.BUS_FAULTS_ASKED, control.HUB, 0))

    def struck(self, number: int) -> BusReport | None:
        """The latest that is known of a fault."""
        return self._struck.get(number)
