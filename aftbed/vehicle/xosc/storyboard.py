"""The storyboard, read as one drive: where the cars begin, and when the one ahead brakes.

    Init     for each car a place and a speed; for the world, the friction of the road
    Story    one event at most: the car ahead brakes to a standstill, from a moment that is known beforehand
    Stop     when the drive ends

The friction is OpenSCENARIO's `frictionScaleFactor` times the nominal 0.9 of a scenario of ours.

What cannot be expressed is refused: a speed that is reached in no time or along a curve, a target speed
other than 0, a second change of speed, an act that is stopped while the car ahead still brakes, anything
that moves the ego after its start.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import msgspec

from aftbed.core.errors import unknown
from aftbed.vehicle.plant import KMH_PER_MS
from aftbed.vehicle.xosc.placing import Car, distance_m, gap_m
from aftbed.vehicle.xosc.tree import Element
from aftbed.vehicle.xosc.trigger import Motion, moment, only_condition, time_limit_s
from aftbed.vehicle.xosc.words import IGNORED

FRICTION_NOMINAL: Final = 0.9
DURATION_S_DEFAULT: Final = 30.0
_SHAPES: Final = ("linear", "step", "cubic", "sinusoidal")
_DIMENSIONS: Final = ("rate", "time", "distance")
_PRIORITIES: Final = ("parallel", "override", "overwrite", "skip")
_OVERRIDING: Final = ("override", "overwrite")
_OWN_END: Final = "the drive ends by itself then, at a standstill or on contact"


class Taken(msgspec.Struct, frozen=True):
    """What an element of the file became."""

    path: str
    line: int
    element: str
    meaning: str


class Braking(msgspec.Struct, frozen=True):
    """The car ahead brakes to a standstill."""

    after_s: float
    deceleration_ms2: float


class LeadDrive(msgspec.Struct, frozen=True):
    """The car ahead: how far from bumper to bumper at the start, how fast, and when it brakes."""

    name: str
    gap_m: float
    speed_ms: float
    braking: Braking | None


class Drive(msgspec.Struct, frozen=True):
    """All that a scenario of ours says about a drive."""

    ego: str
    speed_ms: float
    lead: LeadDrive | None
    friction: float
    duration_s: float
    taken: tuple[Taken, ...]


class Change(NamedTuple):
    """An action of the story that may move a car, with what it is in."""

    act: Element
    group: Element
    event: Element
    action: Element


class Reader:
    """Reads one file, for one ego; `taken` grows as it goes."""

    def __init__(self, cars: Mapping[str, Car], ego: str, duration_s: float | None) -> None:
        self._cars = cars
        self._ego = cars[ego]
        self._lead = next((car for name, car in cars.items() if name != ego), None)
        self._duration_s = duration_s
        self._friction = FRICTION_NOMINAL
        self._places: dict[str, Element] = {}
        self._speeds: dict[str, Element] = {}
        self._taken: list[Taken] = []

    def read(self, storyboard: Element) -> Drive:
        """The drive. Raises ConfigError with the first thing that cannot be expressed."""
        init = storyboard.one("Init")
        self._read_init(init.one("Actions"))
        for name in self._cars:
            if name not in self._speeds:
                self._take(init, f"{name} stands: no SpeedAction")
        speed_ms = self._speed_ms(self._ego.name, ())
        if self._lead is None:
            self._refuse_changes(storyboard)
            for place in self._places.values():
                place.ignore("the road is empty: one place is like another")
        lead = self._read_lead(storyboard, speed_ms) if self._lead else None
        duration_s = self._read_stop(storyboard)
        if lead and lead.braking and lead.braking.after_s >= duration_s:
            begin = f"braking begins at {lead.braking.after_s:g} s"
            raise storyboard.error(f"{begin}, the drive ends at {duration_s:g} s")
        return Drive(self._ego.name, speed_ms, lead, self._friction, duration_s, tuple(self._taken))

    def _take(self, element: Element, meaning: str) -> None:
        self._taken.append(Taken(element.path, element.line, element.tag, meaning))

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
                if not idle(action):
                    self._read_begin(name, action.one("TeleportAction", "LongitudinalAction"))

    def _read_begin(self, name: str, action: Element) -> None:
        if action.tag == "TeleportAction":
            begin, found = self._places, action.one("Position")
        else:
            begin, found = self._speeds, action.one("SpeedAction")
        if name in begin:
            raise found.error(f"the second one of {name!r}")
        begin[name] = found

    def _read_environment(self, environment: Element) -> None:
        road = environment.maybe("RoadCondition")
        if road is None:
            return
        if any(taken.element == road.tag for taken in self._taken):
            raise road.error("a second one")
        road.word("wetness", "")  # what it does to the tyres is the factor
        factor = road.number("frictionScaleFactor")
        self._friction = round(factor * FRICTION_NOMINAL, 6)
        if not 0.0 < self._friction <= 1.2:
            raise road.wrong("frictionScaleFactor", f"more than 0 and at most {1.2 / FRICTION_NOMINAL:.3f}")
        self._take(road, f"friction {self._friction:g}, {factor:g} times {FRICTION_NOMINAL:g}")

    def _speed_ms(self, name: str, asking: tuple[str, ...]) -> float:
        """How fast a car is at the start; without a word about it, it stands."""
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
            speed_ms = self._relative_ms(name, target, asking)
        if speed_ms < 0.0:
            raise target.error(f"{speed_ms:g} m/s, allowed is 0 or more")
        if not asking:
            self._take(target, f"{name} drives at {speed_ms * KMH_PER_MS:g} km/h")
        return speed_ms

    def _relative_ms(self, name: str, target: Element, asking: tuple[str, ...]) -> float:
        other = target.word("entityRef")
        if other not in self._cars or other in (*asking, name):
            raise target.error(f"entityRef: {unknown('car', other, set(self._cars) - {name, *asking})}")
        if target.flag("continuous"):
            raise target.wrong("continuous", "false")
        other_ms = self._speed_ms(other, (*asking, name))
        kind = target.choice("speedTargetValueType", ("delta", "factor"))
        value = target.number("value")
        return other_ms + value if kind == "delta" else other_ms * value

    # -- Story

    def _read_lead(self, storyboard: Element, ego_ms: float) -> LeadDrive:
        assert self._lead is not None
        for name in self._cars:
            if name not in self._places:
                raise storyboard.error(f"Init places {name!r} nowhere: TeleportAction is missing")
        gap = gap_m(self._ego, self._lead, self._places)
        where = self._places[self._lead.name]
        if gap <= 0.0:
            raise where.error(f"{self._lead.name!r} is {gap:g} m ahead of the ego, bumper to bumper")
        self._take(where, f"{self._lead.name} is {gap:g} m ahead, bumper to bumper")
        lead_ms = self._speed_ms(self._lead.name, ())
        away_m = distance_m(self._ego, self._lead, self._places)
        motion = Motion(self._ego.name, self._lead.name, ego_ms, lead_ms, gap, away_m)
        braking = self._read_braking(storyboard, motion)
        return LeadDrive(self._lead.name, gap, lead_ms, braking)

    def _refuse_changes(self, storyboard: Element) -> None:
        for change in self._changes(storyboard):
            raise change.event.error("there is no car ahead that it could move")

    def _changes(self, storyboard: Element) -> list[Change]:
        found = []
        for story in storyboard.every("Story"):
            for act in story.every("Act"):
                found += _changes(act)
        return found

    def _read_braking(self, storyboard: Element, motion: Motion) -> Braking | None:
        changes = self._changes(storyboard)
        if not changes:
            return None
        if len(changes) > 1:
            raise changes[1].action.error("a second action that moves a car; the car ahead brakes once")
        act, group, event, change = changes[0]
        if change.tag == "GlobalAction":
            raise change.error("changes the world while the cars drive; only Init may")
        self._check_actors(group)
        for element in (group, event):
            if element.word("maximumExecutionCount", "1") != "1":
                raise element.wrong("maximumExecutionCount", "1")
        action = change.one("LongitudinalAction").one("SpeedAction")
        if event.word("priority", "") == "skip":
            raise event.wrong("priority", "another one: it may not begin while another event runs")
        begin = self._begin(act, 0.0, motion)
        start = self._begin(event, begin, motion)
        deceleration_ms2 = self._deceleration_ms2(action, motion.lead_ms)
        end_s = start + motion.lead_ms / deceleration_ms2
        self._check_act_stop(act, end_s)
        self._take(action, f"{motion.lead} brakes at {deceleration_ms2:g} m/s2 from {start:g} s on")
        return Braking(start, deceleration_ms2)

    def _begin(self, element: Element, begin_s: float, motion: Motion) -> float:
        """When an act or event begins that is looked at from `begin_s` on."""
        trigger = element.maybe("StartTrigger")
        found = moment(trigger, begin_s, motion)
        if found.condition is not None:
            kept = ", if no car has braked by then" if found.foreseen else ""
            self._take(found.condition, f"met at {found.at_s:g} s{kept}")
        elif trigger is not None:
            self._take(trigger, f"has no condition: met at {found.at_s:g} s")
        return found.at_s

    def _check_actors(self, group: Element) -> None:
        actors = group.one("Actors")
        if actors.flag("selectTriggeringEntities", False):
            raise actors.wrong("selectTriggeringEntities", "false")
        who = actors.one("EntityRef")
        assert self._lead is not None
        if who.word("entityRef") != self._lead.name:
            moved = f"only the car ahead, {self._lead.name!r}, is moved by the storyboard"
            raise who.error(f"found {who.word('entityRef')!r}; {moved}")

    def _deceleration_ms2(self, action: Element, speed_ms: float) -> float:
        dynamics = action.one("SpeedActionDynamics")
        if dynamics.choice("dynamicsShape", _SHAPES) != "linear":
            raise dynamics.wrong("dynamicsShape", "linear")
        dynamics.choice("followingMode", ("position",), "position")
        target = action.one("SpeedActionTarget").one("AbsoluteTargetSpeed")
        if target.number("value") != 0.0:
            raise target.wrong("value", "0: the car ahead brakes to a standstill")
        if speed_ms == 0.0:
            raise action.error("the car ahead stands already")
        value = abs(dynamics.number("value"))  # a rate is written as -6 by some
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

    def _check_act_stop(self, act: Element, end_s: float) -> None:
        """Nothing may stop the act while the car ahead brakes. That its events have ended is no matter."""
        stop = act.maybe("StopTrigger")
        condition = only_condition(stop)
        if stop is None or condition is None:
            return
        at_s = time_limit_s(condition)
        if at_s is None and _has_ended(condition):
            stop.ignore("what it waits for has ended by then")
        elif at_s is None or at_s < end_s:
            raise stop.error(f"may stop the act before the car ahead stands, at {end_s:g} s")

    # -- Stop

    def _read_stop(self, storyboard: Element) -> float:
        stop = storyboard.maybe("StopTrigger")
        if self._duration_s is not None:
            return self._duration_s
        found_s: list[float] = []
        for group in stop.every("ConditionGroup") if stop else []:
            for condition in group.every("Condition"):
                at_s = time_limit_s(condition)
                if at_s is not None and len(group.children) == 1:
                    found_s.append(at_s)
                    self._take(condition, f"the drive ends at {at_s:g} s")
                elif _ends_by_itself(condition) and len(group.children) == 1:
                    condition.ignore(_OWN_END)
                else:
                    raise condition.error("ends the drive at a moment that is not known; --duration says it")
        if not found_s:
            self._take(storyboard, f"the drive ends at {DURATION_S_DEFAULT:g} s: no StopTrigger says when")
        return min(found_s, default=DURATION_S_DEFAULT)


def idle(holder: Element) -> bool:
    """Whether nothing in `holder` can change the drive."""
    return bool(holder.children) and all(
        child.ignored is not None or child.tag in IGNORED for child in holder.children
    )


def _changes(act: Element) -> list[Change]:
    """What the events of an act do to the cars. Triggers and actors of what does nothing are ignored."""
    found = []
    for group in act.every("ManeuverGroup"):
        group.word("maximumExecutionCount", "")
        for reference in group.every("CatalogReference"):
            raise reference.error("maneuvers of catalogs are not read; put it into the file")
        changes = [
            change for maneuver in group.every("Maneuver") for change in _in_maneuver(act, group, maneuver)
        ]
        if not changes:
            _ignore_below(group, "Actors")
        found += changes
    if not found:
        _ignore_below(act, "StartTrigger", "StopTrigger")
    return found


def _in_maneuver(act: Element, group: Element, maneuver: Element) -> list[Change]:
    found, quiet = [], []
    for event in maneuver.every("Event"):
        event.word("maximumExecutionCount", "")
        event.choice("priority", _PRIORITIES, "parallel")
        inner = [
            kind for action in event.every("Action") for kind in action.every("PrivateAction", "GlobalAction")
        ]
        moving = [kind for kind in inner if not idle(kind)]
        found += [Change(act, group, event, kind) for kind in moving]
        if not moving:
            quiet.append(event)
            _ignore_below(event, "StartTrigger")
    for event in quiet:
        if found and event.attributes.get("priority") in _OVERRIDING:
            raise event.wrong("priority", "parallel: it may stop the event that moves the car")
    return found


def _ignore_below(element: Element, *tags: str) -> None:
    for child in element.every(*tags):
        child.ignore(f"nothing in the {element.tag} moves a car")


def _ends_by_itself(condition: Element) -> bool:
    tags = {element.tag for element in condition.walk()}
    return bool(tags & {"StandStillCondition", "CollisionCondition"})


def _has_ended(condition: Element) -> bool:
    states = [one for one in condition.walk() if one.tag == "StoryboardElementStateCondition"]
    return len(states) == 1 and states[0].attributes.get("state") in ("completeState", "endTransition")
