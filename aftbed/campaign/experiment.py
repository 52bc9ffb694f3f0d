"""An experiment of a campaign, and what came of it: two values, and the order of what can come of it.

The classes are those of the design (section 2), the worst one wins. A run that breaks nothing is `masked`
if nobody could notice the fault, `tolerated` if the mechanism had to act in sight: a failover, a third
execution, a refused adaptation. `inconclusive` and `harness_error` say nothing of the mechanism, and are
never a pass (G8).
"""

import shlex
from typing import Final

import msgspec

from aftbed.core.check import Requests

OUTCOMES: Final = (  # from the best to the worst
    "masked",
    "latent",  # a wrong state behind right replies
    "tolerated",
    "degraded",  # late replies, a recovery over its budget, or no redundancy at the end
    "detected_stop",
    "omission",  # requests without a reply, then replies again
    "duplicate_effect",
    "unavailable",  # no replica was left
    "hang",  # a replica was left, and no reply came any more
    "sdc",  # a wrong reply reached the client
    "inconclusive",
    "harness_error",
)

UNKNOWN: Final = ("inconclusive", "harness_error")  # nothing is known of the mechanism
FAILED: Final = OUTCOMES[OUTCOMES.index("omission") : OUTCOMES.index("sdc") + 1]


class Experiment(msgspec.Struct, frozen=True):
    """One run to be. `id` depends on what is run, by which code; `index` is its place in the plan."""

    id: str
    index: int
    number: int  # within the stratum
    stratum: str
    seed: int
    ftm: str
    placement: str
    runtime: str
    scenario: str
    requests: int
    rate_hz: float
    faults: tuple[str, ...] = ()
    adaptations: tuple[str, ...] = ()
    recipe: str = ""
    expected: tuple[str, ...] = ()
    budget_ms: float | None = None  # for a recovery

    def command(self) -> str:
        """What repeats it by hand, and shows it in full."""
        words = ["aftbed", "sim" if self.runtime == "sim" else "run", "--ftm", self.ftm]
        words += ["--placement", self.placement, "--seed", str(self.seed)]
        simulated = self.runtime == "sim"
        if self.scenario:
            words += ["--scenario", self.scenario, *([] if simulated else ["--pace", "max"])]
        elif simulated:
            words += [
                "--count",
                str(self.requests),
                *(["--rate", f"{self.rate_hz:g}"] if self.rate_hz else []),
            ]
        else:
            words += ["--load", f"{self.requests}" + (f"@{self.rate_hz:g}" if self.rate_hz else "")]
        for text in self.faults:
            words += ["--faults" if simulated else "--inject", shlex.quote(text)]
        for text in self.adaptations:
            words += ["--adapt", shlex.quote(text)]
        return " ".join([*words, *(["--recipe", self.recipe] if self.recipe == "paper" else [])])


class Result(msgspec.Struct, frozen=True, omit_defaults=True):
    """What came of an experiment: one line of the ledger. Times in ms; `gap_m` and `impact_kmh` of a car.

    `broken`: what was promised whatever the faults are, and was not kept: one master (G6), a whole graph
    (G5), a clean exit (G7).
    """

    experiment: Experiment
    outcome: str
    unexpected: bool = False  # its faults happened, and it came to another class than is expected
    activated: bool = True  # every fault of it happened
    broken: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    faults: tuple[dict[str, str], ...] = ()
    requests: Requests | None = None
    failovers: int = 0
    detected_ms: float | None = None
    recovery_ms: float | None = None
    blackout_ms: float | None = None
    adapted: tuple[str, ...] = ()  # how each adaptation ended
    adapt_blackout_ms: float | None = None
    collision: bool | None = None
    impact_kmh: float | None = None
    gap_m: float | None = None
    golden_gap_m: float | None = None  # of the same drive without a fault
    noisy: bool = False  # the machine was too busy for its times to mean anything
    seconds: float = 0.0


def failed(result: Result) -> bool:
    """Whether the client got less than it was promised, as far as it is known."""
    return result.outcome in FAILED


def worst(outcomes: list[str]) -> str:
    """The worst of them; `masked` of none."""
    return max(outcomes, key=OUTCOMES.index, default=OUTCOMES[0])
