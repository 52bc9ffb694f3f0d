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
resources and events, which may well hold together, the upper one decides: see `observer`. No check of a file
finds a loop through the environment (LFR raises the CPU load that a rule takes for a reason to leave it);
dwell bounds it.
"""

from functools import cache
from itertools import combinations
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown
from aftbed.ftm.compose import DUPLEX, EXPRESSIONS, NONE, SIMPLEX, parse
from aftbed.ftm.registry import MECHANISMS

# What is observed of a run; `observer.symptoms` says by which events.
Symptom = Literal["crash", "hang", "value_fault", "divergence", "detected_stop"]
# The first three as in `suitability.Resources`; `traffic_kbit_s` is what the replicas send to each other now.
Resource = Literal["cpus", "cpu_load", "bandwidth_kbit_s", "traffic_kbit_s"]
Seconds = Annotated[float, Meta(ge=0.001, le=86_400)]
Value = Annotated[float, Meta(ge=0, le=1e9)]

VERBS: Final = ("to", "switch", "compose", "decompose")
COUNT_MAX: Final = 1000
RULES_MAX: Final = 64
NS_PER_S: Final = 1_000_000_000
SETTLE_ROUNDS: Final = 3
SHADOWED: Final = "the first holds already where the second begins; the narrower condition must stand first"
TOO_NEAR: Final = "both can hold at once, or next to each other; there must be a gap between them"
ADAPTABLE: Final = tuple(e for e in EXPRESSIONS if e != NONE)  # nothing leads to `none`, or away from it


class When(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A condition, key by key; which keys go together is checked by `policy_from`."""

    event: Symptom | None = None
    count: Annotated[int, Meta(ge=1, le=COUNT_MAX)] | None = None
    within_s: Seconds | None = None
    quiet_s: Seconds | None = None
    resource: Resource | None = None
    above: Value | None = None
    below: Value | None = None
    until: Value | None = None
    for_s: Annotated[float, Meta(ge=0, le=86_400)] | None = None


class RuleFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One rule of a file."""

    when: When
    then: str


class PolicyFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A policy, key by key."""

    dwell_s: Seconds
    rules: tuple[RuleFile, ...]
    description: str = ""


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
                return "+".join((self.name, *(n for n in names if n not in DUPLEX)))
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


def policy_from(file: PolicyFile, where: str) -> Policy:
    """The policy in `file`; `where` names the file. Raises ConfigError; a contradiction names both rules."""
    if not 1 <= len(file.rules) <= RULES_MAX:
        raise ConfigError(f"{where}: rules: found {len(file.rules)}, allowed are 1 to {RULES_MAX}")
    dwell_ns, rules = _ns(file.dwell_s), list[Rule]()
    for index, one in enumerate(file.rules):
        key = f"rules[{index}]"
        when = _condition(one.when, f"{where}: {key}.when", dwell_ns)
        rules.append(Rule(key, when, action(one.then, f"{where}: {key}.then")))
    for first, second in combinations(rules, 2):
        if reason := contradiction(first, second):
            raise ConfigError(f"{where}: {first} and {second}: {reason}")
    return Policy(tuple(rules), dwell_ns)


def action(text: str, where: str) -> Action:
    """The action that `text` means. Raises ConfigError."""
    verb, _, name = text.strip().partition(" ")
    found = Action(verb, name.strip())
    if verb not in VERBS:
        raise ConfigError(f"{where}: {unknown('action', verb, VERBS)}")
    if verb == "to":
        try:
            if not parse(found.name):
                raise ConfigError("`none` has no engine: nothing leads to it")
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
    elif verb == "decompose":
        if name:
            raise ConfigError(f"{where}: found {text!r}, allowed is `decompose`: all that is inside goes")
    else:
        allowed = DUPLEX if verb == "switch" else SIMPLEX
        if found.name not in allowed:
            raise ConfigError(f"{where}: {unknown(f'FTM to {verb}', found.name, allowed)}")
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
        for running in ADAPTABLE:
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
        raise ConfigError(f"{where}: an event needs count and within_s, or quiet_s")
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
        raise ConfigError(f"{where}.until: found {until:g}, allowed is {side} {threshold:g}")
    return condition


def _only_one(when: When, where: str, one: str, other: str) -> None:
    given = [key for key in (one, other) if getattr(when, key) is not None]
    if len(given) != 1:
        found = "both" if given else "none of them"
        raise ConfigError(f"{where}: found {found}, allowed is one of {one}, {other}")


def _refuse(when: When, where: str, given: str, keys: tuple[str, ...]) -> None:
    for key in keys:
        if getattr(when, key) is not None:
            raise ConfigError(f"{where}: {key} does not go with {given}")


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
