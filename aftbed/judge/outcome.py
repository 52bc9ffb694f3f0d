"""The outcome of an experiment: the worst class that applies.

Two kinds of evidence: the client's dialogue against the bare server (what it saw), and the run's own
records (what had to happen so that it saw no more). A *golden run* is that bare server over the same
requests: its replies, and its last state, with which the state of each replica at the end is compared, so
that a corruption that has not yet come out is seen too (`latent`). A car is compared with the same drive
without a fault.
"""

from typing import Final

from aftbed.adapt.policy import VOTE_MASKED
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.ftm.compose import replication_of
from aftbed.judge import checks
from aftbed.judge.checks import Evidence, corruptions
from aftbed.runtime.deployment import digest

LATENT: Final = "latent"  # a wrong state behind right replies
OUTCOMES: Final = (  # from the best to the worst
    "masked",
    LATENT,
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

ACTED: Final = (Event.RECOVERY_ENTER, Event.ADAPT_ROLLBACK)


def worst(outcomes: list[str]) -> str:
    """The worst of them; `masked` of none."""
    return max(outcomes, key=OUTCOMES.index, default=OUTCOMES[0])


def outcome_of(evidence: Evidence) -> tuple[str, tuple[str, ...]]:
    """The class and its reasons, the worst first.

    Where the function is not deterministic, its replies and its states are not compared.
    """
    record, reference = evidence.record, evidence.reference
    history, living = record.history, record.end.hosted if record.end is not None else None
    counts = checks.requests(history, reference, checks.late_after_ns(record.options.work))
    found: dict[str, str] = {}
    if reference.unknown:
        found["inconclusive"] = reference.unknown
    wrong = corruptions(history, reference)
    if wrong:
        found["sdc"] = wrong[0]
    if record.lost:
        found["unavailable"] = "no replica was left"
    elif counts.lost:
        answered = {e.request_id for e in history.dialogue if e.kind is EntryKind.ANSWERED}
        last = max((e.request_id for e in history.dialogue if e.kind is EntryKind.SENT), default=0)
        found["omission" if last in answered else "hang"] = f"requests without a reply: {counts.lost}"
    doubled = checks.at_most_once(history).reasons
    if doubled or counts.duplicated:
        found["duplicate_effect"] = doubled[0] if doubled else f"doubled replies: {counts.duplicated}"
    if history.events(Event.DETECTED_STOP):
        found["detected_stop"] = "a replica ended itself rather than answer"
    if counts.late:
        found["degraded"] = f"late replies: {counts.late}"
    if living is not None and not record.lost and replication_of(living.ftm) and not living.backup:
        found["degraded"] = "no replica backs up at the end"
    acted = [event.label for event in ACTED if history.events(event)]
    if any(vote.detail == VOTE_MASKED for vote in history.events(Event.VOTE_COMPARED)):
        acted.append("a third execution")
    if acted:
        found["tolerated"] = f"the mechanism acted: {', '.join(acted)}"
    states = set(record.end.states.values()) if record.end is not None and not reference.tolerance else set()
    if history.events(Event.FOLLOWER_DIVERGED) or len(states) > 1:
        found[LATENT] = "the replicas differ"
    elif (
        states
        and reference.deterministic
        and not (wrong or reference.unknown)
        and states != {digest(reference.state)}
    ):
        found[LATENT] = "the state of the replicas is not the bare server's"
    word = worst(list(found))
    return word, tuple(found[name] for name in sorted(found, key=OUTCOMES.index, reverse=True))
