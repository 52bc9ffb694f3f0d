"""When a trigger is met: seconds from the start, in closed form.

Up to the moment at which the car ahead begins to brake both cars keep their speed, so every quantity that
a supported condition looks at is a straight line over time, and the moment at which it crosses its limit
is known beforehand. That is all that a scenario of ours can express: `braking.after_s`.

    SimulationTimeCondition                    t
    TraveledDistanceCondition                  v t
    RelativeDistanceCondition                  d - (ve - vl) t
    TimeHeadwayCondition of the ego           (d - (ve - vl) t) / ve
    TimeToCollisionCondition                  (d - (ve - vl) t) / (ve - vl)

where `d` is the gap between the bumpers, or the distance of the reference points without `freespace`.

Limits. If the function brakes the ego before the moment that a distance, headway or time to collision
gives, the condition would be met later than computed: what is taken says so. A trigger may have one
condition; an edge may be `rising` or `none`. A trigger that is empty or missing is met at once.
"""

from typing import Final

import msgspec

from aftbed.vehicle.xosc.tree import Element
from aftbed.vehicle.xosc.words import TRIGGER_UNKNOWN

_EDGES: Final = ("rising", "none")
_UPWARD: Final = ("greaterThan", "greaterOrEqual")
_DOWNWARD: Final = ("lessThan", "lessOrEqual")
_ALONG: Final = ("longitudinal", "euclidianDistance", "cartesianDistance")
_FRAMES: Final = ("entity", "lane", "road", "world")
_CONDITIONS: Final = ("RelativeDistanceCondition", "TimeHeadwayCondition", "TimeToCollisionCondition") + (
    "TraveledDistanceCondition",
)

_BY_VALUE: Final = ("SimulationTimeCondition",)
_BY_ENTITY: Final = ("TriggeringEntities", "EntityCondition")


class Motion(msgspec.Struct, frozen=True):
    """Both cars until one of them brakes: names, speeds, and the distance at the start."""

    ego: str
    lead: str
    ego_ms: float
    lead_ms: float
    gap_m: float
    distance_m: float

    @property
    def closing_ms(self) -> float:
        """How fast the gap closes."""
        return self.ego_ms - self.lead_ms


class Moment(msgspec.Struct, frozen=True):
    """When a trigger is met, by which condition, and whether that rests on both cars' keeping their speed."""

    at_s: float
    condition: Element | None
    foreseen: bool = False


class _Line(msgspec.Struct, frozen=True):
    """A quantity over time: `start + slope t`."""

    start: float
    slope: float
    foreseen: bool = True


def moment(trigger: Element | None, begin_s: float, motion: Motion) -> Moment:
    """When `trigger`, which is looked at from `begin_s` on, is met for the first time."""
    condition = only_condition(trigger)
    if condition is None:
        return Moment(begin_s, None)
    edge = condition.choice("conditionEdge", _EDGES, "none")
    delay_s = condition.number("delay", 0.0)
    if delay_s < 0.0:
        raise condition.wrong("delay", "0 or more")
    by, line = _line(condition, motion)
    allowed = (*_UPWARD, *_DOWNWARD)
    travelled = by.tag == "TraveledDistanceCondition"
    rule = "greaterOrEqual" if travelled else by.choice("rule", allowed)
    at_s = _crossing_s(by, line, rule, by.number("value"), begin_s)
    if at_s is None:
        raise by.error("never met while both cars keep their speed")
    if at_s < begin_s and edge == "rising":
        late = f"met before it is looked at, at {begin_s:g} s"
        raise by.error(f"{late}: with conditionEdge 'rising' it never triggers")
    return Moment(max(at_s, begin_s) + delay_s, by, line.foreseen)


def only_condition(trigger: Element | None) -> Element | None:
    """The condition of a trigger; None of an empty one. Raises ConfigError if there are several."""
    groups = trigger.every("ConditionGroup") if trigger else []
    conditions = [condition for group in groups for condition in group.every("Condition")]
    if len(conditions) > 1:
        raise conditions[1].error("a second condition; a trigger may have one")
    return conditions[0] if conditions else None


def time_limit_s(condition: Element) -> float | None:
    """When a condition on simulation time, and on nothing else, is met; None of any other condition."""
    value = condition.maybe("ByValueCondition")
    time = value.maybe("SimulationTimeCondition") if value else None
    if time is None:
        return None
    condition.choice("conditionEdge", _EDGES, "none")
    time.choice("rule", _UPWARD)
    return time.number("value") + condition.number("delay", 0.0)


def _line(condition: Element, motion: Motion) -> tuple[Element, _Line]:
    """What the condition looks at, over time."""
    kind = condition.one("ByValueCondition", "ByEntityCondition")
    for child in kind.children:
        if child.tag not in _BY_VALUE and child.tag not in _BY_ENTITY:
            raise child.error(TRIGGER_UNKNOWN)
    if kind.tag == "ByValueCondition":
        return kind.one("SimulationTimeCondition"), _Line(0.0, 1.0, foreseen=False)
    entities = kind.one("TriggeringEntities")
    entities.choice("triggeringEntitiesRule", ("any", "all"))
    who = entities.one("EntityRef")
    name = who.choice("entityRef", (motion.ego, motion.lead))
    (by,) = kind.one("EntityCondition").children[:1] or [kind]
    if by.tag not in _CONDITIONS:
        raise by.error(TRIGGER_UNKNOWN)
    by = kind.one("EntityCondition").one(*_CONDITIONS)
    if by.tag == "TraveledDistanceCondition":
        return by, _Line(0.0, motion.ego_ms if name == motion.ego else motion.lead_ms)
    _check_other(by, name, motion)
    distance_m = motion.gap_m if by.flag("freespace") else motion.distance_m
    match by.tag:
        case "RelativeDistanceCondition":
            return by, _Line(distance_m, -motion.closing_ms)
        case "TimeHeadwayCondition":
            if name != motion.ego or motion.ego_ms == 0.0:
                raise by.error(f"allowed is the headway of {motion.ego!r}, which moves, to the car ahead")
            return by, _Line(distance_m / motion.ego_ms, -motion.closing_ms / motion.ego_ms)
        case _:
            assert by.tag == "TimeToCollisionCondition", by.tag
            if motion.closing_ms <= 0.0:
                raise by.error("never met: the gap does not close while both cars keep their speed")
            return by, _Line(distance_m / motion.closing_ms, -1.0)


def _check_other(by: Element, name: str, motion: Motion) -> None:
    """The distance is the one between the two cars, along the lane."""
    holder = by
    if by.tag == "TimeToCollisionCondition":
        holder = by.one("TimeToCollisionConditionTarget").one("EntityRef")
    holder.choice("entityRef", (motion.lead if name == motion.ego else motion.ego,))
    by.choice("relativeDistanceType", _ALONG, "longitudinal")
    by.choice("coordinateSystem", _FRAMES, "entity")  # on a straight road they are all one
    by.word("routingAlgorithm", "")
    if by.has("alongRoute"):
        by.flag("alongRoute")


def _crossing_s(by: Element, line: _Line, rule: str, limit: float, begin_s: float) -> float | None:
    """The first moment at which the rule holds; before `begin_s` if it holds then already. None: never."""
    sign = 1.0 if rule in _UPWARD else -1.0
    missing = sign * (limit - line.start)  # what has to be gained
    slope = sign * line.slope
    at_begin = missing - slope * begin_s
    if at_begin < 0.0 or (at_begin == 0.0 and slope == 0.0 and rule.endswith("OrEqual")):
        return begin_s - 1.0
    if slope <= 0.0:
        return None
    return max(begin_s, missing / slope)
