"""`slow TARGET [by 2ms | share 25%] [for 500ms] [at EVENT [nth N] | after 200ms | when ttc < 1.2]`: longer
steps.

Each step of the target's bricks takes a fixed time longer, or as much longer as it would with that share of
a CPU. The agent in the node delays the steps; the host waits meanwhile, so the node does not hang.
"""

import contextlib
import re
from typing import Final, Self

from msgspec import structs

from aftbed.core.errors import ConfigError, StepFailed
from aftbed.core.graph import Graph
from aftbed.core.units import duration, milliseconds, number, whole_milliseconds
from aftbed.inject import targets
from aftbed.inject.grammar import WHEN_KEYS, FaultWords
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, strike
from aftbed.inject.receipts import Receipt, ReceiptState

SLOW_MS: Final = 2.0
SLOW_MS_MAX: Final = 500.0  # a step: orders are answered between two steps, and within 2 s
SHARE_MIN, SHARE_MAX = 0.01, 0.99  # of a CPU; a step of some milliseconds then stays below SLOW_MS_MAX
WHOLE_CPU: Final = 1.0
_SHARE: Final = re.compile(r"([0-9]{1,3}(?:\.[0-9]{1,3})?)%")


class Slow(FaultKind, frozen=True, tag="slow"):
    """Each step takes `by_ms` longer, or as with `share` of a CPU, for `for_ms` (0: for good)."""

    by_ms: float = SLOW_MS
    for_ms: int = 0
    share: float | None = None

    NAMES = ("slow",)
    KEYS = ("by", "share", "for", *WHEN_KEYS)

    takes_real_time = True
    has_worst_instant = True

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        for_ms = whole_milliseconds("duration", words["for"]) if "for" in words else 0
        words.not_both("by", "share")
        if "share" in words:
            return cls(0.0, for_ms, _share(words["share"]))
        by_ms = milliseconds("delay", words["by"]) if "by" in words else SLOW_MS
        if by_ms > SLOW_MS_MAX:
            raise ConfigError(f"'by {words['by']}': a step can be slower by {SLOW_MS_MAX:g}ms at most")
        return cls(by_ms, for_ms)

    def subject(self, target: str) -> list[str]:
        how = f"by {duration(self.by_ms)}" if self.share is None else f"share {number(100 * self.share)}%"
        return [target, how, f"for {self.for_ms}ms" if self.for_ms else ""]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """Only nodes have bricks, and so steps."""
        if self.share is not None:
            if not SHARE_MIN <= self.share <= SHARE_MAX:
                limits = f"{SHARE_MIN:.0%} to {SHARE_MAX:.0%} of a CPU are allowed"
                raise ConfigError(f"share {self.share:.3%}: {limits}")
        elif not 0 < self.by_ms <= SLOW_MS_MAX:
            raise ConfigError(f"by {self.by_ms:g}ms: up to {SLOW_MS_MAX:g}ms are allowed")
        targets.check_node(fault.target, fault.event, graph)

    @property
    def lasts_ms(self) -> int:
        """Until the target has its speed back."""
        return self.for_ms

    def lasting(self, lasts_ms: int) -> Self:
        return structs.replace(self, for_ms=lasts_ms)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Order all nodes of the target to be slower, and wait for their answers."""
        processes = strike(injection, run)
        if not processes:
            return
        by_ns, share = round(self.by_ms * 1e6), self.share or WHOLE_CPU
        orders = [run.slow_down(process, injection.number, by_ns, share) for process in processes]
        yield from run.until_answered(orders)
        injection.receipt = Receipt(ReceiptState.APPLIED)

    def undo(self, injection: Injection, run: RunControl) -> None:
        for process in injection.struck:
            with contextlib.suppress(StepFailed):  # the process is gone
                run.slow_down(process, injection.number, 0, WHOLE_CPU)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when a step was delayed."""
        if injection.receipt.state is ReceiptState.APPLIED and run.records_about(injection):
            return Receipt(ReceiptState.ACTIVATED)
        return injection.receipt


def _share(text: str) -> float:
    """A share of a CPU, as `25%`. Raises ConfigError."""
    found = _SHARE.fullmatch(text)
    share = float(found[1]) / 100 if found else 0.0
    if not SHARE_MIN <= share <= SHARE_MAX:
        limits = f"{100 * SHARE_MIN:g}% to {100 * SHARE_MAX:g}% of a CPU are allowed, as 25%"
        raise ConfigError(f"share {text[:40]!r}: {limits}")
    return share
