"""`hang TARGET [for 50ms] [at EVENT [nth N] | after 200ms | when ttc < 1.2]`: SIGSTOP, and SIGCONT after a
while.

Without `for` the target stays stopped. The end of a stop is recorded in the run's undo log before the stop,
so the cleanup process thaws the target even if the supervisor has died (`runtime.unix.cleanup`).
"""

from collections.abc import Iterable
from typing import Final, Self

from msgspec import structs

from aftbed.core.graph import Graph
from aftbed.core.units import whole_milliseconds
from aftbed.inject import targets
from aftbed.inject.grammar import WHEN_KEYS, FaultWords
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, strike
from aftbed.inject.receipts import Receipt, ReceiptState

FOREVER_MS: Final = 0
STOP_NS_MAX: Final = 500_000_000  # from the signal until the process is seen stopped


class Hang(FaultKind, frozen=True, tag="hang"):
    """SIGSTOP, and SIGCONT after `for_ms` milliseconds, if that is not FOREVER_MS."""

    for_ms: int = FOREVER_MS

    NAMES = ("hang",)
    KEYS = ("for", *WHEN_KEYS)

    stops_process = True
    takes_real_time = True
    has_worst_instant = True

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        return cls(whole_milliseconds("duration", words["for"]) if "for" in words else FOREVER_MS)

    @classmethod
    def subjects(cls, graph: Graph) -> Iterable[str]:
        return (*super().subjects(graph), *targets.OTHERS)

    def subject(self, target: str) -> list[str]:
        return [target, f"for {self.for_ms}ms" if self.for_ms else ""]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        targets.check_process(fault.target, fault.event, graph)

    @property
    def lasts_ms(self) -> int:
        """Until SIGCONT."""
        return self.for_ms

    def lasting(self, lasts_ms: int) -> Self:
        return structs.replace(self, for_ms=lasts_ms)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Stop, and wait until the target is seen stopped: that takes the kernel some microseconds."""
        processes = strike(injection, run)
        for process in processes:
            process.freeze(self.for_ms)
        limit_ns = run.now_ns() + STOP_NS_MAX
        while not all(p.stopped() for p in processes) and run.now_ns() < limit_ns:
            run.pause()
        running = [p.name for p in processes if not p.stopped()]
        if running:
            detail = f"not seen stopped within {STOP_NS_MAX / 1e9} s: {', '.join(running)}"
            injection.receipt = Receipt(ReceiptState.INJECT_ERROR, detail)
        elif processes:
            injection.receipt = Receipt(ReceiptState.APPLIED)
        yield from ()

    def undo(self, injection: Injection, run: RunControl) -> None:
        """Continue what is still stopped."""
        ran_on = [process.thaw() for process in injection.struck]
        if any(ran_on) and injection.receipt.state is ReceiptState.APPLIED:
            injection.receipt = Receipt(ReceiptState.ACTIVATED)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when the target has run on, or was killed for it."""
        if injection.receipt.state is ReceiptState.APPLIED and not all(p.alive for p in injection.struck):
            return Receipt(ReceiptState.ACTIVATED)
        return injection.receipt
