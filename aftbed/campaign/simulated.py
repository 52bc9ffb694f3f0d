"""The judgement over a simulated run: which promise it breaks, if any.

The checkers are those of real runs. Beside them: an assert that failed in a brick is a fault of ours
whatever came of it; the graph must be whole at the end (G5); and when the faults are over, the run must come
to rest.
No mechanism outvotes a bit that is flipped in a checkpoint, so nothing is promised of the values then, but
that a switch brings the Servers in line. A service that is gone because a fault struck each replica is no
breach: nobody promised anything else.
"""

import itertools
from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.campaign.value import corruptions
from aftbed.campaign.wholeness import half_a_graph
from aftbed.core import check
from aftbed.core.application import Application
from aftbed.core.check import History
from aftbed.core.events import Event
from aftbed.core.script import ScriptKind
from aftbed.core.valuefault import Flip
from aftbed.ftm.compose import replication_of
from aftbed.runtime.rewiring import replica_of
from aftbed.runtime.sim.world import Run
from aftbed.vehicle.aeb.function import default_application

SINGLE: Final = "single"  # the node of that placement: one host, one fate
UNPROMISED: Final = frozenset(  # a bit of a checkpoint, or of a reply that is kept
    event.label
    for event in (Event.STATE_CAPTURED, Event.STATE_RESTORED, Event.CHECKPOINT_SENT)
    + (Event.CHECKPOINT_APPLIED, Event.REPLY_STORED, Event.DEDUPE_HIT)
)
REST: Final = "rest"
ASSERT: Final = "assert"


class Breach(msgspec.Struct, frozen=True):
    """`promise`: G1 to G6 (design 3), `rest` or `assert`."""

    promise: str
    reason: str

    def __str__(self) -> str:
        return f"{self.promise}: {self.reason}"


def breaches(run: Run, function: Callable[[], Application] = default_application) -> tuple[Breach, ...]:
    """All that `run` breaks; `function` makes the bare server."""
    history, down = run.history, struck_down(run)
    flips = [f for f in run.setup.faults if isinstance(f.action, Flip)]
    checks = {
        "G1": check.at_most_once(history),
        "G2": check.exactly_one_answer(history, cut_off=down),
        "G6": check.one_master(history),
    }
    if run.setup.adaptations or not any(f.event in UNPROMISED for f in flips):
        checks["G4" if flips else "G3"] = check.one_history(history, function())
    found = [Breach(name, c.reasons[0]) for name, c in checks.items() if c.finding == "fail"]
    found += [Breach(ASSERT, failure) for failure in run.failures[:1]]
    if run.rest.lost and not down:
        names = ", ".join(name for _, name in run.struck) or "nobody"
        found.append(Breach("G2", f"the service is lost, though only {names} was struck"))
    if not run.rest.lost and not down:
        found += [Breach("G5", reason) for reason in half_a_graph(run.rest.hosted, expected_of(run))[:1]]
        found += [Breach(REST, "; ".join(run.rest.why_not))] if run.rest.why_not else []
    return tuple(found)


def struck_down(run: Run) -> bool:
    """Whether faults struck each replica, the second before redundancy was back from the first.

    Or any, where for a time there may have been one only.
    """
    replicas = {b.replica for b in run.rest.graph.bricks if b.replica and b.part == "server"}
    renewed = [
        (s.began_ns, s.ended_ns)
        for s in run.scripts
        if s.kind is ScriptKind.NEW_BACKUP and s.ended_ns and not s.failure
    ]
    strikes = sorted((t_ns, replica_of(name)) for t_ns, name in run.struck if replica_of(name))
    if any(name == SINGLE for _, name in run.struck):
        return True
    simplex = any(a.goal.expression and not replication_of(a.goal.expression) for a in run.setup.adaptations)
    if len(replicas) < 2 or simplex:
        return bool(strikes)
    return any(
        other != replica and not any(first_ns < began and done < second_ns for began, done in renewed)
        for (first_ns, replica), (second_ns, other) in itertools.combinations(strikes, 2)
    )


def expected_of(run: Run) -> str:
    """The FTM that the adaptations, as they ended, have come to."""
    done = [a.ftm for a in run.adaptations if a.outcome == "done"]
    return done[-1] if done else run.setup.ftm


def outcome(run: Run, function: Callable[[], Application] = default_application) -> str:
    """The class of what the faults did."""
    return class_of(run.history, function, lost=run.rest.lost)


def class_of(history: History, function: Callable[[], Application], *, lost: bool) -> str:
    """`masked`, `tolerated`, `unavailable` or `sdc` (design 2), by what the client saw; the worst wins."""
    if corruptions(history, function()):
        return "sdc"
    if lost:
        return "unavailable"
    late = check.requests(history, function()).late
    return "tolerated" if late or check.failovers(history) else "masked"
