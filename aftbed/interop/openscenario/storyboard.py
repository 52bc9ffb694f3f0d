"""Reads a storyboard as one drive: where the cars start, when the car ahead brakes, when the drive ends.

    Init     a place and a speed for each car; the friction of the road
    Story    at most one event: the car ahead brakes to a standstill, at a time that is known beforehand
    Stop     when the drive ends

The friction is OpenSCENARIO's `frictionScaleFactor` times the nominal 0.9 of aftbed's scenarios. Refused is
what a scenario of aftbed cannot express: a speed change without duration or along a curve, a target speed
other than 0, a second speed change, an act that may stop while the car ahead still brakes, anything that
moves the ego after its start.

**Triggers** become seconds from the start, in closed form. Until the car ahead brakes, both cars keep their
speed, so each supported condition compares its limit with a linear function of the time t:

    SimulationTimeCondition                    t
    TraveledDistanceCondition                  v t
    RelativeDistanceCondition                  d - (ve - vl) t
    TimeHeadwayCondition of the ego           (d - (ve - vl) t) / ve
    TimeToCollisionCondition                  (d - (ve - vl) t) / (ve - vl)

`d` is the gap between the bumpers, or the distance of the reference points without `freespace`. Limits: if
the function brakes the ego before the computed time of a distance, headway or time to collision, the
condition would be met later than computed; the printed meaning says so. A trigger may have one condition; an
edge may be `rising` or `none`. An empty or missing trigger is met at once.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import msgspec

from aftbed.core.errors import unknown
from aftbed.interop.openscenario.document import IGNORED, TRIGGER_UNKNOWN, Element
from aftbed.interop.openscenario.placing import CarShape, distance_m, gap_m
from aftbed.vehicle.plant import KMH_PER_MS

FRICTION_NOMINAL: Final = 0.9
DURATION_S_DEFAULT: Final = 30.0
_SHAPES: Final = ("linear", "step", "cubic", "sinusoidal")
_DIMENSIONS: Final = ("rate", "time", "distance")
_EDGES: Final = ("rising", "none")
_UPWARD: Final = ("greaterThan", "greaterOrEqual")
_DOWNWARD: Final = ("lessThan", "lessOrEqual")
_CONDITIONS: Final = (
    "RelativeDistanceCondition", "TimeHeadwayCondition", "TimeToCollisionCondition",
    "TraveledDistanceCondition",
)  # fmt: skip


# -- triggers


class Motion(msgspec.Struct, frozen=True):
    """Both cars until one of them brakes: names, speeds, and their distance at the start."""

    ego: str
    lead: str
    ego_ms: float
    lead_ms: float
    gap_m: float
    distance_m: float


class TriggerTime(msgspec.Struct, frozen=True):
    """When a trigger is met, by which condition, and whether that assumes that both cars keep their speed."""

    at_s: float
    condition: Element | None
    assumes_speeds: bool = False


class _Linear(msgspec.Struct, frozen=True):
    """A quantity over the time t: `start + slope t`."""

    start: float
    slope: float


def trigger_time(trigger: Element | None, begin_s: float, motion: Motion) -> TriggerTime:
    """When `trigger`, evaluated from `begin_s` on, is met for the first time."""
    condition = only_condition(trigger)
    if condition is None:
        return TriggerTime(begin_s, None)
    edge = condition.choice("conditionEdge", _EDGES, "none")
    delay_s = condition.number("delay", 0.0)
    if delay_s < 0.0:
        raise condition.wrong("delay", "0 or more")
    by, line = _quantity(condition, motion)
    travelled = by.tag == "TraveledDistanceCondition"
    rule = "greaterOrEqual" if travelled else by.choice("rule", (*_UPWARD, *_DOWNWARD))
    at_s = _crossing_s(line, rule, by.number("value"), begin_s)
    if at_s is None:
        raise by.error("never met while both cars keep their speed")
    if at_s < begin_s and edge == "rising":
        late = f"met before it is looked at, at {begin_s:g} s"
        raise by.error(f"{late}: with conditionEdge 'rising' it never triggers")
    return TriggerTime(max(at_s, begin_s) + delay_s, by, by.tag != "SimulationTimeCondition")


def only_condition(trigger: Element | None) -> Element | None:
    """The condition of a trigger, or None if it has none. Raises ConfigError if it has several."""
    groups = trigger.every("ConditionGroup") if trigger else []
    conditions = [condition for group in groups for condition in group.every("Condition")]
    if len(conditions) > 1:
        raise conditions[1].error("a second condition; a trigger may have one")
    return conditions[0] if conditions else None


def time_limit_s(condition: Element) -> float | None:
    """When a condition on the simulation time is met; None for any other condition."""
    value = condition.maybe("ByValueCondition")
    time = value.maybe("SimulationTimeCondition") if value else None
    if time is None:
        return None
    condition.choice("conditionEdge", _EDGES, "none")
    time.choice("rule", _UPWARD)
    return time.number("value") + condition.number("delay", 0.0)


def _quantity(condition: Element, motion: Motion) -> tuple[Element, _Linear]:
    """The element of the condition, and the quantity that it compares with its limit."""
    kind = condition.one("ByValueCondition", "ByEntityCondition")
    for child in kind.children:
        if child.tag not in ("SimulationTimeCondition", "TriggeringEntities", "EntityCondition"):
            raise child.error(TRIGGER_UNKNOWN)
    if kind.tag == "ByValueCondition":
        return kind.one("SimulationTimeCondition"), _Linear(0.0, 1.0)
    entities = kind.one("TriggeringEntities")
    entities.choice("triggeringEntitiesRule", ("any", "all"))
    name = entities.one("EntityRef").choice("entityRef", (motion.ego, motion.lead))
    holder = kind.one("EntityCondition")
    first = holder.children[0] if holder.children else kind
    if first.tag not in _CONDITIONS:
        raise first.error(TRIGGER_UNKNOWN)
    by = holder.one(*_CONDITIONS)
    if by.tag == "TraveledDistanceCondition":
        return by, _Linear(0.0, motion.ego_ms if name == motion.ego else motion.lead_ms)
    distance, closing_ms = _distance_m(by, name, motion), motion.ego_ms - motion.lead_ms
    match by.tag:
        case "RelativeDistanceCondition":
            return by, _Linear(distance, -closing_ms)
        case "TimeHeadwayCondition":
            if name != motion.ego or motion.ego_ms == 0.0:
                raise by.error(f"allowed is the headway of {motion.ego!r}, which moves, to the car ahead")
            return by, _Linear(distance / motion.ego_ms, -closing_ms / motion.ego_ms)
        case _:
            assert by.tag == "TimeToCollisionCondition", by.tag
            if closing_ms <= 0.0:
                raise by.error("never met: the gap does not close while both cars keep their speed")
            return by, _Linear(distance / closing_ms, -1.0)


def _distance_m(by: Element, name: str, motion: Motion) -> float:
    """The distance of the condition at the start: that between the two cars, along the lane."""
    holder = by
    if by.tag == "TimeToCollisionCondition":
        holder = by.one("TimeToCollisionConditionTarget").one("EntityRef")
    holder.choice("entityRef", (motion.lead if name == motion.ego else motion.ego,))
    along = ("longitudinal", "euclidianDistance", "cartesianDistance")
    by.choice("relativeDistanceType", along, "longitudinal")
    by.choice("coordinateSystem", ("entity", "lane", "road", "world"), "entity")  # all one on a straight road
    by.word("routingAlgorithm", "")
    if by.has("alongRoute"):
        by.flag("alongRoute")
    return motion.gap_m if by.flag("freespace") else motion.distance_m


def _crossing_s(line: _Linear, rule: str, limit: float, begin_s: float) -> float | None:
    """The first time at which the rule holds (before `begin_s` if it holds then already); None: never."""
    sign = 1.0 if rule in _UPWARD else -1.0
    missing = sign * (limit - line.start)
    slope = sign * line.slope
    at_begin = missing - slope * begin_s
    if at_begin < 0.0 or (at_begin == 0.0 and slope == 0.0 and rule.endswith("OrEqual")):
        return begin_s - 1.0
    if slope <= 0.0:
        return None
    return max(begin_s, missing / slope)


# -- the storyboard


class UsedElement(msgspec.Struct, frozen=True):
    """An element of the file and its meaning for the drive."""

    path: str
    line: int
    element: str
    meaning: str


class Braking(msgspec.Struct, frozen=True):
    """The car ahead brakes to a standstill."""

    after_s: float
    deceleration_ms2: float


class LeadDrive(msgspec.Struct, frozen=True):
    """The car ahead: gap from bumper to bumper and speed at the start, and when it brakes."""

    name: str
    gap_m: float
    speed_ms: float
    braking: Braking | None


class ImportedDrive(msgspec.Struct, frozen=True):
    """The content of a scenario file of aftbed, without the expected outcome."""

    ego: str
    speed_ms: float
    lead: LeadDrive | None
    friction: float
    duration_s: float
    taken: tuple[UsedElement, ...]


class MovingAction(NamedTuple):
    """An action of the story that may move a car, with the elements that contain it."""

    act: Element
    group: Element
    event: Element
    action: Element


class StoryboardReader:
    """Reads the storyboard of one file for one ego."""

    def __init__(self, cars: Mapping[str, CarShape], ego: str, duration_s: float | None) -> None:
        self._cars = cars
        self._ego = cars[ego]
        self._lead = next((car for name, car in cars.items() if name != ego), None)
        self._duration_s = duration_s
        self._friction = FRICTION_NOMINAL
        self._places: dict[str, Element] = {}
        self._speeds: dict[str, Element] = {}
        self._taken: list[UsedElement] = []

    def read(self, storyboard: Element) -> ImportedDrive:
        """The drive. Raises ConfigError with the first element that a scenario of aftbed cannot express."""
        init = storyboard.one("Init")
        self._read_init(init.one("Actions"))
        for name in self._cars:
            if name not in self._speeds:
                self._take(init, f"{name} stands: no SpeedAction")
        speed_ms = self._speed_ms(self._ego.name, ())
        lead = None
        if self._lead is not None:
            lead = self._read_lead(storyboard, self._lead, speed_ms)
        else:
            for change in _moving_actions(storyboard):
                raise change.event.error("there is no car ahead that it could move")
            for place in self._places.values():
                place.ignored = "the road is empty: one place is like another"
        duration_s = self._read_stop(storyboard)
        if lead and lead.braking and lead.braking.after_s >= duration_s:
            begin = f"braking begins at {lead.braking.after_s:g} s"
            raise storyboard.error(f"{begin}, the drive ends at {duration_s:g} s")
        return ImportedDrive(self._ego.name, speed_ms, lead, self._friction, duration_s, tuple(self._taken))

    def _take(self, element: Element, meaning: str) -> None:
        self._taken.append(UsedElement(element.path, element.line, element.tag, meaning))

    # -- Init

    def _read_init(self, actions: Element) -> None:
        for action in actions.every("GlobalAction"):
            if not idle(action):
                self._read_environment(action.one("EnvironmentAction").one("Environment"))
        for private in actions.every("Private"):
            name = private.word("entityRef")
            if name not in self._cars:
                raise private.error(f"entityRef: {unknown('car', name, self._cars)}")
            for action in private.every("PrivateAction"):
                if idle(action):
                    continue
                kind = action.one("TeleportAction", "LongitudinalAction")
                if kind.tag == "TeleportAction":
                    begin, found = self._places, kind.one("Position")
                else:
                    begin, found = self._speeds, kind.one("SpeedAction")
                if name in begin:
                    raise found.error(f"the second one of {name!r}")
                begin[name] = found

    def _read_environment(self, environment: Element) -> None:
        road = environment.maybe("RoadCondition")
        if road is None:
            return
        if any(taken.element == road.tag for taken in self._taken):
            raise road.error("a second one")
        road.word("wetness", "")  # the friction factor includes its effect
        factor = road.number("frictionScaleFactor")
        self._friction = round(factor * FRICTION_NOMINAL, 6)
        if not 0.0 < self._friction <= 1.2:
            raise road.wrong("frictionScaleFactor", f"more than 0 and at most {1.2 / FRICTION_NOMINAL:.3f}")
        self._take(road, f"friction {self._friction:g}, {factor:g} times {FRICTION_NOMINAL:g}")

    def _speed_ms(self, name: str, asking: tuple[str, ...]) -> float:
        """Speed of a car at the start, 0 without a SpeedAction. `asking`: cars whose speed depends on it."""
        action = self._speeds.get(name)
        if action is None:
            return 0.0
        dynamics = action.one("SpeedActionDynamics")
        step = dynamics.choice("dynamicsShape", _SHAPES) == "step"
        dynamics.choice("dynamicsDimension", _DIMENSIONS if step else ("time", "distance"))
        if dynamics.number("value", 0.0) != 0.0 and not step:
            raise dynamics.wrong("value", "0, or the shape 'step': a drive begins at its speed")
        dynamics.choice("followingMode", ("position",), "position")
        target = action.one("SpeedActionTarget").one("AbsoluteTargetSpeed", "RelativeTargetSpeed")
        speed_ms = target.number("value")
        if target.tag == "RelativeTargetSpeed":
            others = set(self._cars) - {name, *asking}
            other = target.word("entityRef")
            if other not in others:
                raise target.error(f"entityRef: {unknown('car', other, others)}")
            if target.flag("continuous"):
                raise target.wrong("continuous", "false")
            other_ms = self._speed_ms(other, (*asking, name))
            delta = target.choice("speedTargetValueType", ("delta", "factor")) == "delta"
            speed_ms = other_ms + speed_ms if delta else other_ms * speed_ms
        if speed_ms < 0.0:
            raise target.error(f"{speed_ms:g} m/s, allowed is 0 or more")
        if not asking:
            self._take(target, f"{name} drives at {speed_ms * KMH_PER_MS:g} km/h")
        return speed_ms

    # -- Story

    def _read_lead(self, storyboard: Element, lead: CarShape, ego_ms: float) -> LeadDrive:
        for name in self._cars:
            if name not in self._places:
                raise storyboard.error(f"Init places {name!r} nowhere: TeleportAction is missing")
        gap = gap_m(self._ego, lead, self._places)
        where = self._places[lead.name]
        if gap <= 0.0:
            raise where.error(f"{lead.name!r} is {gap:g} m ahead of the ego, bumper to bumper")
        self._take(where, f"{lead.name} is {gap:g} m ahead, bumper to bumper")
        lead_ms = self._speed_ms(lead.name, ())
        away_m = distance_m(self._ego, lead, self._places)
        motion = Motion(self._ego.name, lead.name, ego_ms, lead_ms, gap, away_m)
        return LeadDrive(lead.name, gap, lead_ms, self._read_braking(storyboard, motion))

    def _read_braking(self, storyboard: Element, motion: Motion) -> Braking | None:
        changes = _moving_actions(storyboard)
        if not changes:
            return None
        if len(changes) > 1:
            raise changes[1].action.error("a second action that moves a car; the car ahead brakes once")
        act, group, event, change = changes[0]
        if change.tag == "GlobalAction":
            raise change.error("changes the world while the cars drive; only Init may")
        _check_actors(group, motion.lead)
        for element in (group, event):
            if element.word("maximumExecutionCount", "1") != "1":
                raise element.wrong("maximumExecutionCount", "1")
        action = change.one("LongitudinalAction").one("SpeedAction")
        if event.word("priority", "") == "skip":
            raise event.wrong("priority", "another one: it may not begin while another event runs")
        begin_s = self._begin_s(event, self._begin_s(act, 0.0, motion), motion)
        deceleration_ms2 = _deceleration_ms2(action, motion.lead_ms)
        _check_act_stop(act, begin_s + motion.lead_ms / deceleration_ms2)
        self._take(action, f"{motion.lead} brakes at {deceleration_ms2:g} m/s2 from {begin_s:g} s on")
        return Braking(begin_s, deceleration_ms2)

    def _begin_s(self, element: Element, from_s: float, motion: Motion) -> float:
        """When an act or event begins whose trigger is evaluated from `from_s` on."""
        trigger = element.maybe("StartTrigger")
        found = trigger_time(trigger, from_s, motion)
        if found.condition is not None:
            kept = ", if no car has braked by then" if found.assumes_speeds else ""
            self._take(found.condition, f"met at {found.at_s:g} s{kept}")
        elif trigger is not None:
            self._take(trigger, f"has no condition: met at {found.at_s:g} s")
        return found.at_s

    # -- Stop

    def _read_stop(self, storyboard: Element) -> float:
        stop = storyboard.maybe("StopTrigger")
        if self._duration_s is not None:
            return self._duration_s
        found_s: list[float] = []
        for group in stop.every("ConditionGroup") if stop else []:
            for condition in group.every("Condition"):
                at_s = time_limit_s(condition)
                tags = {element.tag for element in condition.walk()}
                if at_s is not None and len(group.children) == 1:
                    found_s.append(at_s)
                    self._take(condition, f"the drive ends at {at_s:g} s")
                elif tags & {"StandStillCondition", "CollisionCondition"} and len(group.children) == 1:
                    condition.ignored = "the drive ends by itself then, at a standstill or on contact"
                else:
                    raise condition.error("ends the drive at a moment that is not known; --duration says it")
        if not found_s:
            self._take(storyboard, f"the drive ends at {DURATION_S_DEFAULT:g} s: no StopTrigger says when")
        return min(found_s, default=DURATION_S_DEFAULT)


def idle(holder: Element) -> bool:
    """Whether all children of `holder` are ignored."""
    return bool(holder.children) and all(
        child.ignored is not None or child.tag in IGNORED for child in holder.children
    )


def _moving_actions(storyboard: Element) -> list[MovingAction]:
    """The moving actions of all acts. Triggers and actors of elements without any are marked as ignored."""
    found = []
    for act in (act for story in storyboard.every("Story") for act in story.every("Act")):
        in_act = []
        for group in act.every("ManeuverGroup"):
            group.word("maximumExecutionCount", "")
            for reference in group.every("CatalogReference"):
                raise reference.error("maneuvers of catalogs are not read; put it into the file")
            in_group = [
                one for maneuver in group.every("Maneuver") for one in _in_maneuver(act, group, maneuver)
            ]
            if not in_group:
                _ignore_below(group, "Actors")
            in_act += in_group
        if not in_act:
            _ignore_below(act, "StartTrigger", "StopTrigger")
        found += in_act
    return found


def _in_maneuver(act: Element, group: Element, maneuver: Element) -> list[MovingAction]:
    found, quiet = [], []
    for event in maneuver.every("Event"):
        event.word("maximumExecutionCount", "")
        event.choice("priority", ("parallel", "override", "overwrite", "skip"), "parallel")
        moving = [
            MovingAction(act, group, event, kind)
            for action in event.every("Action")
            for kind in action.every("PrivateAction", "GlobalAction")
            if not idle(kind)
        ]
        found += moving
        if not moving:
            quiet.append(event)
            _ignore_below(event, "StartTrigger")
    for event in quiet:
        if found and event.attributes.get("priority") in ("override", "overwrite"):
            raise event.wrong("priority", "parallel: it may stop the event that moves the car")
    return found


def _ignore_below(element: Element, *tags: str) -> None:
    for child in element.every(*tags):
        child.ignored = f"nothing in the {element.tag} moves a car"


def _check_actors(group: Element, lead: str) -> None:
    actors = group.one("Actors")
    if actors.flag("selectTriggeringEntities", False):
        raise actors.wrong("selectTriggeringEntities", "false")
    actor = actors.one("EntityRef")
    if (name := actor.word("entityRef")) != lead:
        raise actor.error(f"found {name!r}; only the car ahead, {lead!r}, is moved by the storyboard")


def _deceleration_ms2(action: Element, speed_ms: float) -> float:
    dynamics = action.one("SpeedActionDynamics")
    if dynamics.choice("dynamicsShape", _SHAPES) != "linear":
        raise dynamics.wrong("dynamicsShape", "linear")
    dynamics.choice("followingMode", ("position",), "position")
    target = action.one("SpeedActionTarget").one("AbsoluteTargetSpeed")
    if target.number("value") != 0.0:
        raise target.wrong("value", "0: the car ahead brakes to a standstill")
    if speed_ms == 0.0:
        raise action.error("the car ahead stands already")
    value = abs(dynamics.number("value"))  # some files write a rate as -6
    dimension = dynamics.choice("dynamicsDimension", _DIMENSIONS)
    if value == 0.0:
        raise dynamics.wrong("value", "more than 0")
    match dimension:
        case "rate":
            found = value
        case "time":
            found = speed_ms / value
        case _:
            found = speed_ms * speed_ms / (2.0 * value)
    if not 0.01 <= found <= 12.0:
        raise dynamics.error(f"a deceleration of {found:g} m/s2, allowed is 0.01 to 12")
    return found


def _check_act_stop(act: Element, end_s: float) -> None:
    """Check that nothing stops the act while the car ahead brakes, until `end_s`."""
    stop = act.maybe("StopTrigger")
    condition = only_condition(stop)
    if stop is None or condition is None:
        return
    at_s = time_limit_s(condition)
    states = [one for one in condition.walk() if one.tag == "StoryboardElementStateCondition"]
    ended = len(states) == 1 and states[0].attributes.get("state") in ("completeState", "endTransition")
    if at_s is None and ended:
        stop.ignored = "what it waits for has ended by then"
    elif at_s is None or at_s < end_s:
        raise stop.error(f"may stop the act before the car ahead stands, at {end_s:g} s")
