"""A policy: rules that say when another mechanism should run, as data (paper, II: FT, A and R change).

    dwell_s: 5
    rules:
      - {when: {event: value_fault, count: 2, within_s: 10}, then: compose tr}
      - {when: {event: value_fault, quiet_s: 60}, then: decompose}
      - {when: {resource: traffic_kbit_s, above: 600, for_s: 2}, then: switch lfr}
      - {when: {resource: cpu_load, above: 0.8, until: 0.6, for_s: 5}, then: to pbr}

A condition begins and ends at different points (hysteresis), so that noise does not enter and leave it:

| condition | begins                                     | ends                                        |
|-----------|--------------------------------------------|---------------------------------------------|
| Burst     | with the last of `count` within `within_s` | no event for `within_s` and `dwell_s` more  |
| Quiet     | no event for longer than `quiet_s`         | with the next event                         |
| Beyond    | samples beyond the threshold for `for_s`   | a sample at `until`, else at the threshold  |

Two rules that want different things (`conflict`) must not be able to hold at once, nor so nearly that a value
between them leads to and fro; `policy_from` finds such a pair before anything runs. Of rules on different
resources and events, which may well hold together, the upper one decides. No check of a file finds a loop
through the environment (LFR raises the CPU load that a rule takes for a reason to leave it); dwell bounds it.

The `Observer` proposes, from what is observed of a run, which mechanism should run:

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
from functools import cache
from itertools import combinations
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, FileKeyError, unknown
from aftbed.core.events import LATE, Event
from aftbed.ftm.compose import DUPLEX, SIMPLEX, known_expressions, parse, replicates
from aftbed.ftm.registry import MECHANISMS, find

# What is observed of a run; `symptoms` has the events.
Symptom = Literal["crash", "hang", "value_fault", "divergence", "detected_stop"]
# The first three as in `suitability.Resources`; `traffic_kbit_s` is what the replicas send to each other now.
Resource = Literal["cpus", "cpu_load", "bandwidth_kbit_s", "traffic_kbit_s"]
Seconds = Annotated[float, Meta(ge=0.001, le=86_400)]
Value = Annotated[float, Meta(ge=0, le=1e9)]

VERBS: Final = ("to", "switch", "compose", "decompose")
COUNT_MAX: Final = 1000
RULES_MAX: Final = 64
NS_PER_S: Final = 1_000_000_000
VOTE_MASKED: Final = 3  # detail of `vote.compared`: it took a third trial, so one of them was wrong
SETTLE_ROUNDS: Final = 3
SHADOWED: Final = "the first holds already where the second begins; the narrower condition must stand first"
TOO_NEAR: Final = "both can hold at once, or next to each other; there must be a gap between them"


class When(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A condition, key by key; which keys go together is checked by `policy_from`."""

    event: Symptom | None = None  # a symptom; with count and within_s, or with quiet_s
    count: Annotated[int, Meta(ge=1, le=COUNT_MAX)] | None = None  # so many of the event
    within_s: Seconds | None = None  # in so long
    quiet_s: Seconds | None = None  # none of the event for so long
    resource: Resource | None = None  # with above or below
    above: Value | None = None  # it begins at more than this
    below: Value | None = None  # it begins at less than this
    until: Value | None = None  # it ends here; none: where it began
    for_s: Annotated[float, Meta(ge=0, le=86_400)] | None = None  # so long without a break


class RuleFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One rule of a file."""

    when: When  # the condition
    then: str  # to FTM, switch FTM, compose FTM, or decompose


class PolicyFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A policy, key by key."""

    dwell_s: Seconds  # after an adaptation there is no other one for so long
    rules: tuple[RuleFile, ...]  # the first one that holds decides
    description: str = ""  # for people


class Burst(msgspec.Struct, frozen=True):
    """`hold_ns`: how long the event must stay away for this to end."""

    event: str
    count: int
    within_ns: int
    hold_ns: int

    def __str__(self) -> str:
        return f"{self.count} {self.event} within {_s(self.within_ns)}"


class Quiet(msgspec.Struct, frozen=True):
    """No such event for so long, counted from the last one or from the beginning."""

    event: str
    quiet_ns: int

    def __str__(self) -> str:
        return f"no {self.event} for {_s(self.quiet_ns)}"


class Beyond(msgspec.Struct, frozen=True):
    """A resource above (else below) `threshold` for `for_ns`, until it is back at `until`."""

    resource: Resource
    above: bool
    threshold: float
    until: float
    for_ns: int

    def __str__(self) -> str:
        held = f" for {_s(self.for_ns)}" if self.for_ns else ""
        until = f" until {self.until:g}" if self.until != self.threshold else ""
        return f"{self.resource} {'above' if self.above else 'below'} {self.threshold:g}{held}{until}"

    def begins(self, value: float) -> bool:
        """Whether a sample of `value` lies beyond the threshold."""
        return value > self.threshold if self.above else value < self.threshold

    def ends(self, value: float) -> bool:
        """Whether a sample of `value` is back."""
        return value <= self.until if self.above else value >= self.until


Condition = Burst | Quiet | Beyond


class Action(msgspec.Struct, frozen=True):
    """`to EXPR`, `switch pbr`, `compose tr`, `decompose`; `name` is the rest of the words."""

    verb: str
    name: str = ""

    def __str__(self) -> str:
        return f"{self.verb} {self.name}".strip()

    def applied(self, running: str) -> str:
        """What should run instead of `running`; `running` itself where that is so already.

        switch: what replicates is exchanged, what is inside of it stays. compose: one more inside, before
        what can only be innermost.
        decompose: the outermost alone.
        """
        names = parse(running)
        match self.verb:
            case _ if not names:
                return running
            case "to":
                return self.name
            case "switch":
                return "+".join((self.name, *(n for n in names if not replicates(n))))
            case "compose":
                inside = names if self.name in names else (*names, self.name)
                return "+".join(sorted(inside, key=lambda n: MECHANISMS[n].innermost))
            case _:
                return names[0]


class Rule(msgspec.Struct, frozen=True):
    """`key` is its place in the file."""

    key: str
    when: Condition
    then: Action

    def __str__(self) -> str:
        return f"{self.key} ({self.when}: {self.then})"


class Policy(msgspec.Struct, frozen=True):
    """Rules that were checked against each other, the first one first."""

    rules: tuple[Rule, ...]
    dwell_ns: int


def policy_from(file: PolicyFile) -> Policy:
    """The policy in `file`. Raises FileKeyError; a contradiction names both rules."""
    if not 1 <= len(file.rules) <= RULES_MAX:
        raise FileKeyError("rules", f"found {len(file.rules)}, allowed are 1 to {RULES_MAX}")
    dwell_ns, rules = _ns(file.dwell_s), list[Rule]()
    for index, one in enumerate(file.rules):
        key = f"rules[{index}]"
        when = _condition(one.when, f"{key}.when", dwell_ns)
        rules.append(Rule(key, when, action(one.then, f"{key}.then")))
    for first, second in combinations(rules, 2):
        if reason := contradiction(first, second):
            raise FileKeyError(second.key, f"{first} and {second}: {reason}")
    return Policy(tuple(rules), dwell_ns)


def action(text: str, where: str) -> Action:
    """The action that `text` means. Raises FileKeyError."""
    verb, _, name = text.strip().partition(" ")
    found = Action(verb, name.strip())
    if verb not in VERBS:
        raise FileKeyError(where, unknown("action", verb, VERBS))
    if verb == "to":
        try:
            if not parse(found.name):
                raise ConfigError("`none` has no engine: nothing leads to it")
        except ConfigError as error:
            raise FileKeyError(where, error) from error
    elif verb == "decompose":
        if name:
            raise FileKeyError(where, f"found {text!r}, allowed is `decompose`: all that is inside goes")
    else:
        allowed = DUPLEX if verb == "switch" else SIMPLEX
        if find(found.name) is None or replicates(found.name) != (verb == "switch"):
            raise FileKeyError(where, unknown(f"FTM to {verb}", found.name, allowed))
    return found


def contradiction(first: Rule, second: Rule) -> str:
    """Why these two, in this order, cannot stand in one policy; "" if they can."""
    if first.when == second.when and first.then != second.then:
        return "the same condition, and two actions"
    if not conflict(first.then, second.then):
        return ""
    match first.when, second.when:
        case Beyond(), Beyond() if first.when.resource == second.when.resource:
            return _beyond_contradiction(first.when, second.when)
        case Burst(), Burst() if first.when.event == second.when.event:
            wider = first.when.count <= second.when.count and first.when.within_ns >= second.when.within_ns
            return SHADOWED if wider else ""
        case Quiet(), Quiet() if first.when.event == second.when.event:
            return SHADOWED if first.when.quiet_ns < second.when.quiet_ns else ""
        case (Burst() as burst, Quiet() as quiet) | (Quiet() as quiet, Burst() as burst):
            if burst.event == quiet.event and quiet.quiet_ns < burst.hold_ns:
                return f"both can hold at once; quiet_s must be {_s(burst.hold_ns)} at least"
    return ""


@cache
def conflict(one: Action, other: Action) -> bool:
    """Whether the two, each carried out whenever it would change something, never come to rest."""
    for first, second in ((one, other), (other, one)):
        for running in known_expressions()[1:]:  # nothing leads to `none`, or away from it
            for _ in range(SETTLE_ROUNDS):
                running = second.applied(first.applied(running))  # noqa: PLW2901 - towards a fixed point
            if not first.applied(running) == second.applied(running) == running:
                return True
    return False


# -- reading


def _condition(when: When, where: str, dwell_ns: int) -> Condition:
    _only_one(when, where, "event", "resource")
    if when.resource is not None:
        return _beyond(when, when.resource, where)
    assert when.event is not None
    _refuse(when, where, "event", ("above", "below", "until", "for_s"))
    if when.quiet_s is not None:
        _refuse(when, where, "quiet_s", ("count", "within_s"))
        return Quiet(when.event, _ns(when.quiet_s))
    if when.count is None or when.within_s is None:
        raise FileKeyError(where, "an event needs count and within_s, or quiet_s")
    within_ns = _ns(when.within_s)
    return Burst(when.event, when.count, within_ns, within_ns + dwell_ns)


def _beyond(when: When, resource: Resource, where: str) -> Beyond:
    _refuse(when, where, "resource", ("count", "within_s", "quiet_s"))
    _only_one(when, where, "above", "below")
    above = when.above is not None
    threshold = when.above if when.above is not None else when.below
    assert threshold is not None
    until = threshold if when.until is None else when.until
    condition = Beyond(resource, above, threshold, until, _ns(when.for_s or 0.0))
    if condition.begins(until):
        side = "at most" if above else "at least"
        raise FileKeyError(f"{where}.until", f"found {until:g}, allowed is {side} {threshold:g}")
    return condition


def _only_one(when: When, where: str, one: str, other: str) -> None:
    given = [key for key in (one, other) if getattr(when, key) is not None]
    if len(given) != 1:
        found = "both" if given else "none of them"
        raise FileKeyError(where, f"found {found}, allowed is one of {one}, {other}")


def _refuse(when: When, where: str, given: str, keys: tuple[str, ...]) -> None:
    for key in keys:
        if getattr(when, key) is not None:
            raise FileKeyError(where, f"{key} does not go with {given}")


def _beyond_contradiction(first: Beyond, second: Beyond) -> str:
    """Of two that want different things of one resource; `first` decides where both hold."""
    if first.above != second.above:
        high, low = (first, second) if first.above else (second, first)
        apart = low.threshold < high.threshold
        return "" if apart and low.threshold <= high.until and low.until <= high.threshold else TOO_NEAR
    wider = first.threshold == second.threshold or first.begins(second.threshold)
    if wider:
        return SHADOWED if first.for_ns <= second.for_ns else ""
    if first.until == first.threshold:
        return f"a value around {first.threshold:g} would lead to and fro; give the first an `until`"
    return ""


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def _s(ns: int) -> str:
    return f"{ns / NS_PER_S:g} s"


# -- observing ------------------------------------------------------------------------------------


def symptoms(event: Event, detail: int) -> tuple[Symptom, ...]:
    """What a recorded event is a symptom of. Crashes and hangs are reported by a Watchdog, with their cause.

    A value fault shows as a divergence, as a detected stop (no majority, an assertion that failed), or as a
    vote that masked it. Under PBR alone it does not show at all. A stop at a deadline tells of no value.
    """
    match event:
        case Event.FOLLOWER_DIVERGED:
            return ("divergence", "value_fault")
        case Event.DETECTED_STOP if detail == LATE:
            return ("detected_stop",)
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
        self.held: set[str] = set()  # the rules whose conditions have held so far
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
        pairs = zip(self._policy.rules, self._watches, strict=True)
        self.held.update(rule.key for rule, watch in pairs if watch.holds(now_ns))
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
