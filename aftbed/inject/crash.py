"""`crash TARGET [at EVENT [nth N] | after 200ms | when ttc < 1.2]`: SIGKILL to all processes of the target.

A node that emits the event and belongs to the target kills itself, so the point is exact. Any other emitter
waits until the supervisor has seen the target dead.
"""

from collections.abc import Iterable
from typing import Self

from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.inject import targets
from aftbed.inject.grammar import WHEN_KEYS, FaultWords
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, strike
from aftbed.inject.receipts import Receipt, ReceiptState


class Crash(FaultKind, frozen=True, tag="crash"):
    """SIGKILL."""

    NAMES = ("crash",)
    KEYS = ("for", *WHEN_KEYS)
    REFUSED = ("for",)

    stops_process = True
    has_worst_instant = True
    emitter_may_act = True

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        if "for" in words:
            raise ConfigError(f"'for {words['for']}': a crash has no duration; a hang and a slow have")
        return cls()

    @classmethod
    def subjects(cls, graph: Graph) -> Iterable[str]:
        return (*super().subjects(graph), *targets.OTHERS)

    def subject(self, target: str) -> list[str]:
        return [target]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        targets.check_process(fault.target, fault.event, graph)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Kill, and wait until the target is seen dead: a process lives on for a while after the signal."""
        processes = strike(injection, run)
        for process in processes:
            process.kill()
        if processes:
            injection.receipt = Receipt(ReceiptState.APPLIED)
            yield from run.until_dead(processes)
            injection.receipt = Receipt(ReceiptState.ACTIVATED)
            injection.struck = ()  # dead: a run of many crashes would keep them all

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when the target is dead."""
        if injection.by_itself and run.records_about(injection):
            alive = injection.host is not None and injection.host.alive
            return Receipt(ReceiptState.APPLIED if alive else ReceiptState.ACTIVATED)
        if injection.receipt.state is ReceiptState.APPLIED and not any(p.alive for p in injection.struck):
            return Receipt(ReceiptState.ACTIVATED)
        return injection.receipt
