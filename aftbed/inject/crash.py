"""`crash TARGET [at EVENT [nth N] | after 200ms | when ttc < 1.2]`: SIGKILL to all processes of the target.

A node that emits the event and belongs to the target kills itself, so the point is exact. Any other emitter
waits until the supervisor has seen the target dead.
"""

from collections.abc import Sequence
from typing import ClassVar

from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.inject import targets
from aftbed.inject.grammar import WHEN_KEYS, FaultWords
from aftbed.inject.kind import AnyFault, FaultKind, Injection, ReadFault, RunControl, Steps, strike
from aftbed.inject.receipts import Receipt, ReceiptState
from aftbed.inject.timing import read_trigger


class Crash(FaultKind, frozen=True, tag="crash"):
    """SIGKILL."""

    NAMES: ClassVar = ("crash",)
    KEYS: ClassVar = ("for", *WHEN_KEYS)

    stops_process: ClassVar = True
    has_worst_instant: ClassVar = True
    emitter_may_act: ClassVar = True

    @classmethod
    def read(cls, words: Sequence[str]) -> ReadFault:
        """See the top of this file."""
        found = FaultWords(words, cls.KEYS)
        if "for" in found:
            raise ConfigError(f"'for {found['for']}': a crash has no duration; a hang and a slow have")
        found.nth_needs_event()
        return ReadFault(cls(), found.subject, read_trigger(found))

    def subject(self, target: str) -> list[str]:
        """The target alone."""
        return [target]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """Any process of the run can be killed."""
        targets.check_process(fault.target, fault.event, graph)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Kill, and wait until the target is seen dead: a process lives on for a while after the signal."""
        processes = strike(injection, run)
        for process in processes:
            process.kill()
        if processes:
            injection.receipt = Receipt(ReceiptState.APPLIED)
            yield from run.until_dead(processes)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when the target is dead."""
        if injection.by_itself and run.records_about(injection):
            alive = injection.host is not None and injection.host.alive
            return Receipt(ReceiptState.APPLIED if alive else ReceiptState.ACTIVATED)
        if injection.receipt.state is ReceiptState.APPLIED and not any(p.alive for p in injection.struck):
            return Receipt(ReceiptState.ACTIVATED)
        return injection.receipt
