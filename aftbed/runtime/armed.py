"""A fault of a run that is armed: where it waits, what it has hit, and what has become of it so far."""

from collections.abc import Iterable

from aftbed.core.events import event_named
from aftbed.core.fault import Disturb, Fault
from aftbed.core.journal import Record
from aftbed.runtime import control
from aftbed.runtime.cells import Hit
from aftbed.runtime.interface import Met, Process
from aftbed.runtime.receipts import ARMED, NOT_ACTIVATED, Receipt


class Armed:
    """A fault and what has become of it; `hit` are the processes that the executive struck."""

    def __init__(self, number: int, fault: Fault, draw: int) -> None:
        self.number, self.fault, self.draw = number, fault, draw
        self.receipt = Receipt()
        self.hit: list[Process] = []
        self.left = fault.trigger.nth  # of the occurrences of its event, since it came to its host
        self.waits = False  # for its event: in its host, or, while nobody emits it, in none
        self.host: Process | None = None
        self.flipped: Hit | None = None  # in memory
        self.brick = ""
        self.itself = False
        self.journals: set[str] = set()
        self.unmet = fault.trigger.when  # what it waits for first
        self.met: Met | None = None
        self._lag_ns = 0  # from there to the effect
        self._since_ns = 0
        self._share = 1  # how many bricks of the host emit the event

    def move_in(self, host: Process, brick: str, share: int, now_ns: int, *, itself: bool) -> None:
        """Wait in `host` from now on."""
        assert host.journal, host.name
        self.host, self.brick, self._share, self.itself = host, brick, share, itself
        self.journals.add(host.journal)
        self._since_ns = now_ns

    def move_out(self, records: Iterable[Record]) -> None:
        """What happened in the host has been counted there, by its records, and is not forgotten.

        But messages are in no record: for them the count begins anew.
        """
        if self.fault.event:
            event = event_named(self.fault.event)
            happened = sum(r.event is event and r.t_ns >= self._since_ns for r in records)
            self.left = max(1, self.left - happened // self._share)
        self.host = None

    def order(self, token: int, nth: int) -> control.Arm | control.Interfere:
        """What the host is told; `nth` 0: to wait no longer."""
        fault = self.fault
        blow = control.Blow(
            self.number, self.brick, nth, fault.action, self.itself, self.draw, fault.persistence
        )
        if isinstance(fault.action, Disturb):
            return control.Interfere(token, blow)
        return control.Arm(token, fault.event, (blow,))

    def begun(self, now_ns: int) -> None:
        """What its condition led to is done: the car goes on, if it waited."""
        assert self.met is not None
        self._lag_ns = now_ns - self.met.since_ns if self.met.since_ns else 0
        self.met.go_on()

    def report(self) -> Receipt:
        """Its receipt, with what there is to say about its condition. One that never held has its own."""
        if self.unmet is not None and self.receipt.state == ARMED:
            return Receipt(NOT_ACTIVATED, f"{self.unmet} never held")
        if self.met is None:
            return self.receipt
        held = f"{self.fault.trigger.when} at {self.met.t_us / 1e6:.6f} s"
        held += f", {self._lag_ns / 1e6:.2f} ms before" if self._lag_ns else ""
        return Receipt(self.receipt.state, "; ".join(filter(None, (self.receipt.detail, held))))
