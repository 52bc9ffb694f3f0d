"""When the events of a storyboard begin and end: seconds from the start, in closed form.

Until the car ahead changes its speed both cars keep theirs, so each supported condition compares its limit
with a constant or with a linear function of the time t, and holds over a `Span` of time:

    SimulationTimeCondition                    t
    TraveledDistanceCondition                  v t, and of the car ahead what it travels while it brakes
    RelativeDistanceCondition                  d - (ve - vl) t
    TimeHeadwayCondition of the ego           (d - (ve - vl) t) / ve
    TimeToCollisionCondition                  (d - (ve - vl) t) / (ve - vl)
    Speed-, RelativeSpeed-, AccelerationCondition       the speeds, their difference, 0
    StandStillCondition                        a car that stands, or has braked to standstill
    ParameterCondition                         the value of the parameter
    VariableCondition                          the value before, and after, the events that set it
    StoryboardElementStateCondition            the begin, or the end, of an event, maneuver, act or story
    CollisionCondition, EndOfRoadCondition, OffroadCondition    never: a drive ends on contact

`d` is the gap between the bumpers, or the distance of the reference points without `freespace`. A trigger is
met when all conditions of one of its groups hold; one with an edge holds at its instant only. An empty or
missing trigger is met at once.

Limits: if the function brakes the ego before the computed time of a distance, a headway or a speed, the
condition would be met later than computed, or never, or at all: such a moment `assumes_speeds`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import msgspec

from aftbed.interop.openscenario.document import Cause, Element
from aftbed.interop.openscenario.expression import RULES, Values, obeys

TRIGGER_UNKNOWN: Final = "a trigger whose moment does not follow from the start"
NEVER_S: Final = math.inf
_SHAPES: Final = ("linear", "step", "cubic", "sinusoidal")
_DIMENSIONS: Final = ("rate", "time", "distance")
_EDGES: Final = ("rising", "falling", "risingOrFalling", "none")
_UPWARD: Final = ("greaterThan", "greaterOrEqual")
_DOWNWARD: Final = ("lessThan", "lessOrEqual")
_BY_VALUE: Final = (
    "SimulationTimeCondition", "ParameterCondition", "VariableCondition", "StoryboardElementStateCondition",
)  # fmt: skip
_NEVER_IN_A_DRIVE: Final = ("CollisionCondition", "EndOfRoadCondition", "OffroadCondition")
_BY_ENTITY: Final = (
    "RelativeDistanceCondition", "TimeHeadwayCondition", "TimeToCollisionCondition",
    "TraveledDistanceCondition", "SpeedCondition", "RelativeSpeedCondition", "AccelerationCondition",
    "StandStillCondition", *_NEVER_IN_A_DRIVE,
)  # fmt: skip
_ELEMENTS: Final = ("story", "act", "maneuverGroup", "maneuver", "event", "action")
_BEGUN: Final = ("startTransition", "runningState")
_ENDED: Final = ("endTransition", "completeState")
_STATES: Final = (*_BEGUN, *_ENDED, "standbyState", "stopTransition", "skipTransition")


class SpeedChange(msgspec.Struct, frozen=True):
    """The car ahead goes linearly from `from_ms` to `final_ms`, beginning at `after_s`."""

    after_s: float
    from_ms: float
    final_ms: float
    rate_ms2: float

    @property
    def end_s(self) -> float:
        return self.after_s + abs(self.final_ms - self.from_ms) / self.rate_ms2


class Stretch(NamedTuple):
    """The car ahead has `speed_ms` at `from_s`, and changes it by `slope_ms2` until `until_s`."""

    from_s: float
    until_s: float
    speed_ms: float
    slope_ms2: float

    def at(self, at_s: float) -> float:
        """The speed at a time of the stretch."""
        return self.speed_ms + (self.slope_ms2 * (at_s - self.from_s) if self.slope_ms2 else 0.0)


class Motion(msgspec.Struct, frozen=True):
    """Both cars until one of them brakes: names, speeds, and their distance at the start.

    On an empty road `lead` is "". `changes`: what the car ahead does later, as far as it is known already. A
    change lasts until it is done, or the next one begins.
    """

    ego: str
    ego_ms: float
    lead: str = ""
    lead_ms: float = 0.0
    gap_m: float = 0.0
    distance_m: float = 0.0
    changes: tuple[SpeedChange, ...] = ()

    def stretches(self) -> list[Stretch]:
        """The speed of the car ahead over time, from the start on."""
        found: list[Stretch] = []
        from_s, speed_ms = 0.0, self.lead_ms
        for number, change in enumerate(self.changes):
            next_s = self.changes[number + 1].after_s if number + 1 < len(self.changes) else math.inf
            end_s = min(change.end_s, next_s)
            slope_ms2 = math.copysign(change.rate_ms2, change.final_ms - change.from_ms)
            found.append(Stretch(from_s, change.after_s, speed_ms, 0.0))
            found.append(Stretch(change.after_s, end_s, change.from_ms, slope_ms2))
            from_s = end_s
            speed_ms = change.final_ms if end_s == change.end_s else found[-1].at(end_s)
        return [*found, Stretch(from_s, math.inf, speed_ms, 0.0)]

    def lead_speed_ms(self, at_s: float) -> float:
        """The speed of the car ahead at a time."""
        return [one for one in self.stretches() if one.from_s <= at_s][-1].at(at_s)


class StoryEvent(NamedTuple):
    """An event of the story, with the elements that contain it, the names of its actors and its actions."""

    story: Element
    act: Element
    group: Element
    maneuver: Element
    event: Element
    actors: tuple[str, ...]
    actions: tuple[Element, ...]


class SlowedEgo(msgspec.Struct, frozen=True):
    """The ego is slower than `below_ms`, or by `below_lead_ms` slower than the car ahead, for `after_s`."""

    below_ms: float | None = None
    below_lead_ms: float | None = None
    after_s: float = 0.0


class Moment(msgspec.Struct, frozen=True):
    """When something happens, by which condition, and whether both cars have to keep their speed for it.

    `slow`: it happens when the function has braked the ego so far. `moving`: it depends on how the cars move.
    """

    at_s: float
    condition: Element | None = None
    assumes_speeds: bool = False
    slow: SlowedEgo | None = None
    moving: bool = False

    @property
    def never(self) -> bool:
        """Whether it never happens, whatever the function does."""
        return self.at_s == NEVER_S and not self.assumes_speeds


class Span(msgspec.Struct, frozen=True):
    """A condition holds from `from_s` until before `until_s`."""

    from_s: float
    until_s: float
    assumes_speeds: bool = False
    slow: SlowedEgo | None = None


_ALWAYS: Final = Span(-math.inf, math.inf)
_NEVER: Final = Span(NEVER_S, NEVER_S)
_NOT_BEFORE_BRAKING: Final = Span(NEVER_S, NEVER_S, assumes_speeds=True)


def never_met(trigger: Element | None) -> bool:
    """Whether the parameters alone say that a trigger is never met."""
    groups = [one for one in trigger.children if one.tag == "ConditionGroup"] if trigger else []
    return bool(groups) and all(
        any(
            one.parameter is not None
            and not obeys(one.parameter, one.attributes.get("rule", ""), one.attributes.get("value", ""))
            for one in group.walk()
            if one.tag == "ParameterCondition" and one.attributes.get("rule") in RULES
        )
        for group in groups
    )


def speed_change(action: Element, after_s: float, from_ms: float, ego_ms: float) -> SpeedChange:
    """What the SpeedAction `action`, which begins at `after_s`, makes of the speed of the car ahead."""
    dynamics = action.one("SpeedActionDynamics")
    if dynamics.choice("dynamicsShape", _SHAPES) != "linear":
        raise dynamics.wrong("dynamicsShape", "linear", Cause.SPEED)
    dynamics.choice("followingMode", ("position",), "position")
    final_ms = target_speed_ms(action, ego_ms)
    if final_ms < 0.0:
        raise action.error(f"{final_ms:g} m/s, allowed is 0 or more", Cause.SPEED)
    value = abs(dynamics.number("value"))  # some files write a rate as -6
    dimension = dynamics.choice("dynamicsDimension", _DIMENSIONS)
    if value == 0.0:
        raise dynamics.wrong("value", "more than 0", Cause.SPEED)
    match dimension:
        case "rate":
            found = value
        case "time":
            found = abs(from_ms - final_ms) / value
        case _:
            found = abs(from_ms * from_ms - final_ms * final_ms) / (2.0 * value)
    if not 0.01 <= found <= 12.0:
        what = "a deceleration" if final_ms < from_ms else "an acceleration"
        raise dynamics.error(f"{what} of {found:g} m/s2, allowed is 0.01 to 12", Cause.SPEED)
    return SpeedChange(after_s, from_ms, final_ms, found)


def target_speed_ms(action: Element, other_ms: float) -> float:
    """The speed to which a SpeedAction leads; a relative one is to a car that keeps `other_ms`."""
    target = action.one("SpeedActionTarget").one("AbsoluteTargetSpeed", "RelativeTargetSpeed")
    value = target.number("value")
    if target.tag == "AbsoluteTargetSpeed":
        return value
    target.word("entityRef")
    if target.flag("continuous"):
        raise target.wrong("continuous", "false", Cause.SPEED)
    delta = target.choice("speedTargetValueType", ("delta", "factor")) == "delta"
    return other_ms + value if delta else other_ms * value


class Timeline:
    """The moments of the `events` of one storyboard, for cars that move as `motion` says.

    `variables` are the values that the variables of the file have at the start.
    """

    def __init__(
        self,
        acts: Sequence[Element],
        events: Sequence[StoryEvent],
        variables: Values,
        motion: Motion,
        ends_s: Mapping[int, float] | None = None,
    ) -> None:
        self.motion = motion
        self.acts = acts
        self.events = events
        self._variables = variables
        self._ends_s = ends_s or {}  # of the events that change the speed of the car ahead, by their id
        self._asking: list[Element] = []  # the events and acts whose moment is being computed

    def with_motion(self, motion: Motion) -> "Timeline":
        """The same story, for cars that move in another way."""
        return Timeline(self.acts, self.events, self._variables, motion, self._ends_s)

    def with_change(self, event: StoryEvent, change: SpeedChange) -> "Timeline":
        """The same story, in which `event` changes the speed of the car ahead."""
        motion = msgspec.structs.replace(self.motion, changes=(*self.motion.changes, change))
        return self.with_motion(motion).with_end(event, change.end_s)

    def with_end(self, event: StoryEvent, end_s: float) -> "Timeline":
        """The same story, in which it is known when `event` ends."""
        ends_s = {**self._ends_s, id(event.event): end_s}
        return Timeline(self.acts, self.events, self._variables, self.motion, ends_s)

    def changes_speed(self, event: StoryEvent) -> bool:
        """Whether the event is known to change the speed of the car ahead, or to keep it."""
        return id(event.event) in self._ends_s

    def end_s(self, event: StoryEvent) -> float:
        """When an event that changes the speed of the car ahead is done."""
        return self._ends_s[id(event.event)]

    # -- acts and events

    def begin(self, event: StoryEvent) -> Moment:
        """When an event begins."""
        act = self._begin_of_act(event.act)
        if act.at_s == NEVER_S:
            return act
        self._ask(event.event)
        found = self.trigger(event.event.maybe("StartTrigger"), act.at_s)
        self._asking.pop()
        assumes, moving = found.assumes_speeds or act.assumes_speeds, found.moving or act.moving
        return msgspec.structs.replace(found, assumes_speeds=assumes, moving=moving)

    def trigger(self, trigger: Element | None, begin_s: float) -> Moment:
        """When `trigger`, evaluated from `begin_s` on, is met for the first time."""
        groups = trigger.every("ConditionGroup") if trigger else []
        moments = [self.group(group, begin_s) for group in groups if group.children]
        return _first(moments) if moments else Moment(begin_s)

    def group(self, group: Element, begin_s: float) -> Moment:
        """When all conditions of a group, evaluated from `begin_s` on, hold for the first time."""
        found = [(one, *self._span(one)) for one in group.every("Condition")]
        if any(span == _NEVER for _, _, span in found):
            return Moment(NEVER_S)
        assumes = any(span.assumes_speeds for _, _, span in found)
        spans = [_delayed(condition, span, begin_s) for condition, _, span in found]
        at_s = max([begin_s, *(span.from_s for span in spans)])
        last = max(range(len(found)), key=lambda i: spans[i].from_s, default=0)
        if at_s >= min((span.until_s for span in spans), default=NEVER_S):
            at_s = NEVER_S
        by = found[last][1] if found else None
        moving = any(one.maybe("ByEntityCondition") is not None for one, _, _ in found)
        return Moment(at_s, by, assumes, _slow(found, spans), moving)

    def _begin_of_act(self, act: Element) -> Moment:
        self._ask(act)
        found = self.trigger(act.maybe("StartTrigger"), 0.0)
        self._asking.pop()
        return found

    def _end(self, event: StoryEvent) -> Moment:
        """When an event ends: that of the car ahead which brakes, when it has its speed; others at once."""
        begin = self.begin(event)
        speeds = [one for action in event.actions for one in action.walk() if one.tag == "SpeedAction"]
        if not speeds or begin.at_s == NEVER_S:
            return begin
        end_s = self._ends_s.get(id(event.event))
        if end_s is None:  # the function moves the ego, or the change has not been looked at yet
            return Moment(NEVER_S, assumes_speeds=True)
        return msgspec.structs.replace(begin, at_s=end_s)

    def _ask(self, element: Element) -> None:
        if any(one is element for one in self._asking):
            raise element.error("waits for itself", Cause.TRIGGER)
        self._asking.append(element)

    # -- conditions

    def _span(self, condition: Element) -> tuple[Element, Span]:
        """The element that says what is compared, and when the condition holds."""
        kind = condition.one("ByValueCondition", "ByEntityCondition")
        if kind.tag == "ByValueCondition":
            by = _known(kind, kind, _BY_VALUE)
            match by.tag:
                case "SimulationTimeCondition":
                    return by, _crossing(0.0, 1.0, by)
                case "ParameterCondition":
                    by.word("parameterRef")
                    assert by.parameter is not None, "set by substituted()"
                    return by, _constant(by.parameter, by)
                case "VariableCondition":
                    return by, self._variable(by)
                case _:
                    return by, self._state(by)
        entities = kind.one("TriggeringEntities")
        every = entities.choice("triggeringEntitiesRule", ("any", "all")) == "all"
        names = [one.word("entityRef") for one in entities.every("EntityRef")]
        by = _known(kind, kind.one("EntityCondition"), _BY_ENTITY)
        spans = [self._of_entity(by, name) for name in names]
        if not spans:
            raise entities.error("no EntityRef in it")
        if len(spans) == 1:
            return by, spans[0]
        assumes = any(span.assumes_speeds for span in spans)
        pick, other = (max, min) if every else (min, max)
        return by, Span(pick(one.from_s for one in spans), other(one.until_s for one in spans), assumes)

    def _of_entity(self, by: Element, name: str) -> Span:
        motion = self.motion
        if by.tag in _NEVER_IN_A_DRIVE:
            for element in by.walk():
                element.visited = True
                for attribute in element.attributes:
                    element.word(attribute)
            return _NEVER
        if name not in (motion.ego, motion.lead):
            raise by.error(
                f"of {name!r}: a moment that follows from neither the ego nor the car ahead", Cause.TRIGGER
            )
        is_ego = name == motion.ego
        speed_ms = motion.ego_ms if is_ego else motion.lead_ms
        match by.tag:
            case "TraveledDistanceCondition":
                return self._travelled(by, speed_ms, is_ego)
            case "SpeedCondition":
                by.choice("direction", ("longitudinal",), "longitudinal")
                return self._speed(by, speed_ms, is_ego)
            case "AccelerationCondition":
                by.choice("direction", ("longitudinal",), "longitudinal")
                return _crossing(0.0, 0.0, by, assumes=True)
            case "StandStillCondition":
                return self._standstill(by, speed_ms, is_ego)
            case "RelativeSpeedCondition":
                by.choice("direction", ("longitudinal",), "longitudinal")
                other_ms = self._other(by, is_ego)
                span = _crossing(speed_ms - other_ms, 0.0, by, assumes=True)
                slower_ms = by.number("value") * (-1.0 if is_ego else 1.0)
                return _slowed(
                    span, by, SlowedEgo(below_lead_ms=slower_ms), slower_ms >= 0.0, upward=not is_ego
                )
            case _:
                return self._distance(by, is_ego)

    def _other(self, by: Element, is_ego: bool) -> float:
        """Check that `by` compares with the other car; its speed."""
        motion = self.motion
        other = motion.lead if is_ego else motion.ego
        if (found := by.word("entityRef")) != other or not other:
            reason = f"to {found!r}: a moment that follows from neither the ego nor the car ahead"
            raise by.error(reason, Cause.TRIGGER)
        return motion.lead_ms if is_ego else motion.ego_ms

    def _speed(self, by: Element, speed_ms: float, is_ego: bool) -> Span:
        if is_ego:
            slow = SlowedEgo(below_ms=by.number("value"))
            return _slowed(_crossing(speed_ms, 0.0, by, assumes=True), by, slow, by.number("value") > 0.0)
        return self._over_stretches(by)

    def _over_stretches(self, by: Element) -> Span:
        """When the speed of the car ahead is for the first time as `by` says."""
        held: Span | None = None
        for one in (stretch for stretch in self.motion.stretches() if stretch.from_s < stretch.until_s):
            span = _crossing(one.speed_ms - one.slope_ms2 * one.from_s, one.slope_ms2, by)
            from_s, until_s = max(span.from_s, one.from_s), min(span.until_s, one.until_s)
            if from_s < until_s:
                begin_s = held.from_s if held else from_s if from_s > 0.0 else -math.inf
                held = Span(begin_s, until_s)
            if held is not None and (from_s >= until_s or until_s < one.until_s):
                break
        return held or _NEVER

    def _travelled(self, by: Element, speed_ms: float, is_ego: bool) -> Span:
        if is_ego:
            return _crossing(0.0, speed_ms, by, "greaterOrEqual", assumes=True)
        left_m = by.number("value")
        for one in self.motion.stretches():
            lasts_s = _time_for(left_m, one)
            if lasts_s is not None and lasts_s <= one.until_s - one.from_s:
                return Span(one.from_s + lasts_s, math.inf)
            lasts_s = one.until_s - one.from_s
            if lasts_s < math.inf:
                left_m -= (one.speed_ms + one.slope_ms2 * lasts_s / 2.0) * lasts_s
        return _NEVER

    def _standstill(self, by: Element, speed_ms: float, is_ego: bool) -> Span:
        duration_s = by.number("duration")
        if is_ego:
            return Span(duration_s, math.inf, assumes_speeds=True) if speed_ms == 0.0 else _NOT_BEFORE_BRAKING
        for one in self.motion.stretches():
            if one.speed_ms == one.slope_ms2 == 0.0 and one.until_s - one.from_s > duration_s:
                return Span(one.from_s + duration_s, one.until_s)
        return _NEVER

    def _distance(self, by: Element, is_ego: bool) -> Span:
        """Conditions on the distance of the two cars, along the lane."""
        motion = self.motion
        holder = by
        if by.tag == "TimeToCollisionCondition":
            target = by.one("TimeToCollisionConditionTarget")
            if (holder := target.maybe("EntityRef") or target) is target:
                raise target.error(TRIGGER_UNKNOWN, Cause.TRIGGER)
        self._other(holder, is_ego)
        along = ("longitudinal", "euclidianDistance", "cartesianDistance")
        if by.word("relativeDistanceType", "longitudinal") not in along:
            raise by.wrong("relativeDistanceType", " or ".join(along), Cause.TRIGGER)
        by.choice("coordinateSystem", ("entity", "lane", "road", "world", "trajectory"), "entity")
        by.word("routingAlgorithm", "")  # all one on a straight road
        if by.has("alongRoute"):
            by.flag("alongRoute")
        start_m = motion.gap_m if by.flag("freespace") else motion.distance_m
        closing_ms = motion.ego_ms - motion.lead_ms
        match by.tag:
            case "RelativeDistanceCondition":
                return _crossing(start_m, -closing_ms, by, assumes=True)
            case "TimeHeadwayCondition":
                if not is_ego or motion.ego_ms == 0.0:
                    reason = f"allowed is the headway of {motion.ego!r}, which moves, to the car ahead"
                    raise by.error(reason, Cause.TRIGGER)
                return _crossing(start_m / motion.ego_ms, -closing_ms / motion.ego_ms, by, assumes=True)
            case _:
                if closing_ms <= 0.0:  # the gap does not close
                    by.number("value"), by.choice("rule", (*_UPWARD, *_DOWNWARD))
                    return _NOT_BEFORE_BRAKING
                return _crossing(start_m / closing_ms, -1.0, by, assumes=True)

    # -- what the story itself does

    def _variable(self, by: Element) -> Span:
        name, rule, limit = by.word("variableRef"), by.choice("rule", RULES), by.word("value")
        if name not in self._variables:
            raise by.error(f"variableRef: {name!r} is not declared")
        held = obeys(self._variables[name], rule, limit)
        settings = [
            (event, action.one("SetAction", "ModifyAction"))
            for event in self.events
            for kind in event.actions
            for action in kind.walk()
            if action.tag == "VariableAction" and action.attributes.get("variableRef") == name
        ]
        for _, setting in settings:
            if setting.tag == "ModifyAction":
                raise setting.error(TRIGGER_UNKNOWN, Cause.TRIGGER)
        changes = [
            self.begin(event) for event, one in settings if obeys(one.word("value"), rule, limit) != held
        ]
        if not changes:
            return _ALWAYS if held else _NEVER
        first = _first(changes)
        if held:
            return Span(-math.inf, first.at_s, first.assumes_speeds)
        return Span(first.at_s, math.inf, first.assumes_speeds)

    def _state(self, by: Element) -> Span:
        kind, name = by.choice("storyboardElementType", _ELEMENTS), by.word("storyboardElementRef")
        state = by.choice("state", _STATES)
        name = name.rpartition("::")[2]
        events = [event for event in self.events if name in _names(event, kind)]
        acts = [act for act in self.acts if kind == "act" and act.attributes.get("name") == name]
        if not events and not acts:
            raise by.error(f"storyboardElementRef: found {name!r}, no {kind} has this name")
        if state in ("stopTransition", "skipTransition"):
            return _NOT_BEFORE_BRAKING
        if kind in ("event", "action") and state not in _ENDED:
            begins = [
                self._begin_of_act(one.act) if state == "standbyState" else self.begin(one) for one in events
            ]
        elif kind == "story" and state not in _ENDED:
            begins = [Moment(0.0)]
        elif state not in _ENDED:
            begins = [self._begin_of_act(act) for act in (*acts, *(one.act for one in events))]
        else:
            ends = [self._begin_of_act(act) for act in acts] + [self._end(one) for one in events]
            last = max(ends, key=lambda one: one.at_s)
            return Span(last.at_s, math.inf, any(one.assumes_speeds for one in ends))
        first = _first(begins)
        return Span(first.at_s, math.inf, first.assumes_speeds)


def _first(moments: Sequence[Moment]) -> Moment:
    """The first of several moments; it assumes the speeds if another one may come before it that does."""
    first = min(moments, key=lambda one: one.at_s)
    assumes, moving = any(one.assumes_speeds for one in moments), any(one.moving for one in moments)
    return msgspec.structs.replace(first, assumes_speeds=assumes, moving=moving)


def _names(event: StoryEvent, kind: str) -> list[str | None]:
    """The names by which a condition may mean `event`, or an element of this kind around it or in it."""
    match kind:
        case "story":
            elements = [event.story]
        case "act":
            elements = [event.act]
        case "maneuverGroup":
            elements = [event.group]
        case "maneuver":
            elements = [event.maneuver]
        case "event":
            elements = [event.event]
        case _:
            elements = [one for one in event.event.children if one.tag == "Action"]
    return [one.attributes.get("name") for one in elements]


def _known(kind: Element, holder: Element, tags: tuple[str, ...]) -> Element:
    for child in (*holder.children, *kind.children):
        if child.tag not in (*tags, "TriggeringEntities", "EntityCondition"):
            raise child.error(TRIGGER_UNKNOWN, Cause.TRIGGER)
    return holder.one(*tags)


def _time_for(distance_m: float, one: Stretch) -> float | None:
    """How long a car in this stretch needs for a distance; None if it does not get there."""
    if distance_m <= 0.0:
        return 0.0
    if one.slope_ms2 == 0.0:
        return distance_m / one.speed_ms if one.speed_ms > 0.0 else None
    root = one.speed_ms * one.speed_ms + 2.0 * one.slope_ms2 * distance_m
    return (math.sqrt(root) - one.speed_ms) / one.slope_ms2 if root >= 0.0 else None


def _delayed(condition: Element, span: Span, begin_s: float) -> Span:
    """From when to when a condition of a trigger counts, which is evaluated from `begin_s` on."""
    edge = condition.choice("conditionEdge", _EDGES, "none")
    delay_s = condition.number("delay", 0.0)
    if delay_s < 0.0:
        raise condition.wrong("delay", "0 or more")
    from_s, until_s = max(span.from_s, begin_s), span.until_s
    if edge in ("falling", "risingOrFalling"):
        rises = edge == "risingOrFalling" and begin_s <= span.from_s < NEVER_S
        at_s = span.from_s if rises else span.until_s if span.from_s < NEVER_S else NEVER_S
        from_s = at_s if at_s >= begin_s else NEVER_S
    elif edge == "rising" and span.from_s < begin_s:
        late = f"met before it is looked at, at {begin_s:g} s"
        raise condition.error(f"{late}: with conditionEdge 'rising' it never triggers", Cause.TRIGGER)
    from_s += delay_s
    if edge != "none":  # it holds at the instant of the edge only
        return Span(from_s, math.nextafter(from_s, math.inf))
    return Span(from_s, until_s + delay_s)


def _slowed(span: Span, by: Element, slow: SlowedEgo, possible: bool, *, upward: bool = False) -> Span:
    """The span, with `slow` if the condition `by` waits for the ego to become slower."""
    if span.from_s < NEVER_S or not possible or (by.attributes.get("rule") in _UPWARD) != upward:
        return span
    return msgspec.structs.replace(span, slow=slow)


def _slow(found: Sequence[tuple[Element, Element, Span]], delayed: Sequence[Span]) -> SlowedEgo | None:
    """How slow the ego is when all conditions of a group hold, if nothing else is needed for it."""
    slows = [(condition, span.slow) for condition, _, span in found if span.slow is not None]
    if len(slows) != 1:
        return None
    condition, slow = slows[0]
    after_s = condition.number("delay", 0.0)
    others = [late for (_, _, span), late in zip(found, delayed, strict=True) if span.slow is None]
    if any(one.from_s > after_s or one.until_s < NEVER_S for one in others):
        return None
    return msgspec.structs.replace(slow, after_s=after_s)


def _constant(value: str, by: Element) -> Span:
    return _ALWAYS if obeys(value, by.choice("rule", RULES), by.word("value")) else _NEVER


def _crossing(
    start: float, slope: float, by: Element, rule: str | None = None, *, assumes: bool = False
) -> Span:
    """When `start + slope t` is to the value of the condition `by` as its rule says."""
    limit = by.number("value")
    if rule is None:
        rule = by.choice("rule", (*_UPWARD, *_DOWNWARD))
    sign = 1.0 if rule in _UPWARD else -1.0
    missing, rise = sign * (limit - start), sign * slope
    if rise == 0.0:
        holds = missing < 0.0 or (missing == 0.0 and rule.endswith("OrEqual"))
        found = _ALWAYS if holds else _NEVER
        return msgspec.structs.replace(found, assumes_speeds=assumes)
    at_s = missing / rise
    if rise > 0.0:
        return Span(at_s, math.inf, assumes)
    return Span(-math.inf, at_s, assumes)
