"""The closed loop: proposes, from what is observed of a run, which mechanism should run. Pure.

**Deciding.** Rules are read from the top. A rule is passed over while a rule above it holds that wants
something else; of the others, the first that would change what runs is proposed. What counts is what holds
now, not what was proposed before: an adaptation that was rolled back is proposed again, one that the user
declined (`Declined`) not before its condition has ended.

**Dwell.** After a proposal, and after any change of what runs, nothing is proposed for `dwell_s`. A burst of
events in that time still counts afterwards, because it holds for longer.

The caller observes, asks the user, adapts, and reports what runs then (`Running`). From `Proposal.since_ns`
to that report is the time from the change to consistency.
"""

from collections import deque
from collections.abc import Iterator
from typing import Final

import msgspec

from aftbed.adapt.policy import Beyond, Burst, Condition, Policy, Quiet, Resource, Rule, Symptom, conflict
from aftbed.core.events import Event

VOTE_MASKED: Final = 3  # detail of `vote.compared`: it took a third trial, so one of them was wrong


def symptoms(event: Event, detail: int) -> tuple[Symptom, ...]:
    """What a recorded event is a symptom of. Crashes and hangs are reported by a Watchdog, with their cause.

    A value fault shows as a divergence, as a detected stop (no majority, an assertion that failed), or as a
    vote that masked it. Under PBR alone it does not show at all.
    """
    match event:
        case Event.FOLLOWER_DIVERGED:
            return ("divergence", "value_fault")
        case Event.DETECTED_STOP:
            return ("detected_stop", "value_fault")
        case Event.VOTE_COMPARED if detail == VOTE_MASKED:
            return ("value_fault",)
        case _:
            return ()


class Seen(msgspec.Struct, frozen=True):
    """A symptom was seen now."""

    event: Symptom


class Measured(msgspec.Struct, frozen=True):
    """The resources as they are now, measured regularly; what is left out is not known."""

    values: dict[Resource, float]


class Running(msgspec.Struct, frozen=True):
    """From now on this expression runs."""

    expression: str


class Declined(msgspec.Struct, frozen=True):
    """The user did not want the last proposal."""


Observation = Seen | Measured | Running | Declined


class Proposal(msgspec.Struct, frozen=True):
    """`since_ns` is when the change began that led to it: the first event, the first sample."""

    rule: str
    reason: str
    action: str
    running: str
    target: str
    since_ns: int
    now_ns: int


class Observer:
    """`deadline_ns` and `wake` are as in the brick contract: what is due without an observation."""

    def __init__(self, policy: Policy, running: str, now_ns: int) -> None:
        self.running = running
        self._policy = policy
        self._watches = tuple(_watch(rule.when, now_ns) for rule in policy.rules)
        self._rest_until_ns = now_ns
        self._now_ns = now_ns
        self._last: Proposal | None = None
        self._declined: dict[str, int] = {}  # by rule: since when the condition holds that was declined

    def step(self, observation: Observation, now_ns: int) -> Proposal | None:
        """The proposal that `observation` leads to, if any. A late observation counts as of now."""
        now_ns = max(now_ns, self._now_ns)
        match observation:
            case Running():
                if observation.expression != self.running:
                    self._rest_until_ns = now_ns + self._policy.dwell_ns
                self.running = observation.expression
            case Declined():
                if self._last is not None:
                    self._declined[self._last.rule] = self._last.since_ns
            case Seen() | Measured():
                for watch in self._watches:
                    watch.see(observation, now_ns)
        return self.wake(now_ns)

    def wake(self, now_ns: int) -> Proposal | None:
        now_ns = max(now_ns, self._now_ns)
        self._now_ns = now_ns
        if now_ns < self._rest_until_ns:
            return None
        for rule, since_ns in self._deciding(now_ns):
            target = rule.then.applied(self.running)
            if target != self.running and self._declined.get(rule.key) != since_ns:
                self._rest_until_ns = now_ns + self._policy.dwell_ns
                self._last = Proposal(
                    rule.key, str(rule.when), str(rule.then), self.running, target, since_ns, now_ns
                )
                return self._last
        return None

    def deadline_ns(self) -> int | None:
        """When to call `wake` at the latest; None: not before the next observation."""
        if self._now_ns < self._rest_until_ns:
            return self._rest_until_ns
        due = [watch.deadline_ns(self._now_ns) for watch in self._watches]
        return min([t_ns for t_ns in due if t_ns is not None], default=None)

    def _deciding(self, now_ns: int) -> Iterator[tuple[Rule, int]]:
        """The rules that hold, and since when, without those that a rule above them conflicts with."""
        held: list[Rule] = []
        for rule, watch in zip(self._policy.rules, self._watches, strict=True):
            if watch.holds(now_ns):
                if not any(conflict(above.then, rule.then) for above in held):
                    yield rule, watch.since_ns
                held.append(rule)


# -- watches: each follows one condition ----------------------------------------------------------
#
# `see` takes an observation; `holds` is whether the condition holds now, which it does since `since_ns`;
# `deadline_ns` is when that will change without an observation, if it will.


class BurstWatch:
    """Keeps the last `count` events: no others can complete a burst."""

    def __init__(self, when: Burst, now_ns: int) -> None:
        self.since_ns = now_ns
        self._when = when
        self._seen_ns: deque[int] = deque(maxlen=when.count)
        self._held = False

    def see(self, observation: Seen | Measured, now_ns: int) -> None:
        if not isinstance(observation, Seen) or observation.event != self._when.event:
            return
        held = self.holds(now_ns)
        self._seen_ns.append(now_ns)
        complete = len(self._seen_ns) == self._when.count
        if not held and complete and now_ns - self._seen_ns[0] < self._when.within_ns:
            self._held, self.since_ns = True, self._seen_ns[0]

    def holds(self, now_ns: int) -> bool:
        if self._held and now_ns - self._seen_ns[-1] > self._when.hold_ns:
            self._held = False
        return self._held

    def deadline_ns(self, now_ns: int) -> int | None:
        return self._seen_ns[-1] + self._when.hold_ns + 1 if self.holds(now_ns) else None


class QuietWatch:
    """`since_ns` is the last event, or the beginning."""

    def __init__(self, when: Quiet, now_ns: int) -> None:
        self.since_ns = now_ns
        self._when = when

    def see(self, observation: Seen | Measured, now_ns: int) -> None:
        if isinstance(observation, Seen) and observation.event == self._when.event:
            self.since_ns = now_ns

    def holds(self, now_ns: int) -> bool:
        return now_ns - self.since_ns > self._when.quiet_ns

    def deadline_ns(self, now_ns: int) -> int | None:
        return None if self.holds(now_ns) else self.since_ns + self._when.quiet_ns + 1


class BeyondWatch:
    """Between two samples the resource is taken to be as in both. Only samples change what holds."""

    def __init__(self, when: Beyond, now_ns: int) -> None:
        self.since_ns = now_ns
        self._when = when
        self._beyond = False  # since `since_ns`
        self._held = False

    def see(self, observation: Seen | Measured, now_ns: int) -> None:
        """A resource that is not known is beyond nothing."""
        if not isinstance(observation, Measured):
            return
        value = observation.values.get(self._when.resource)
        if self._held:
            self._held = value is not None and not self._when.ends(value)
            self._beyond = self._held
        elif value is None or not self._when.begins(value):
            self._beyond = False
        else:
            self.since_ns = self.since_ns if self._beyond else now_ns
            self._beyond = True
            self._held = now_ns - self.since_ns >= self._when.for_ns

    def holds(self, now_ns: int) -> bool:
        return self._held

    def deadline_ns(self, now_ns: int) -> int | None:
        return None


def _watch(when: Condition, now_ns: int) -> BurstWatch | QuietWatch | BeyondWatch:
    match when:
        case Burst():
            return BurstWatch(when, now_ns)
        case Quiet():
            return QuietWatch(when, now_ns)
        case Beyond():
            return BeyondWatch(when, now_ns)
