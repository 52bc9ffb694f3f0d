"""Reads a storyboard as one drive: where the cars start, when the car ahead brakes, when the drive ends.

    Init     a place and a speed for each car; the friction of the road
    Story    the car ahead changes its speed, at times that are known beforehand
    Stop     when the drive ends

The friction is OpenSCENARIO's `frictionScaleFactor` times the nominal 0.9 of aftbed's scenarios. `timeline`
says when an event begins. Ignored, and printed with the reason, is

    what brakes the ego after its start, and its controllers: aftbed's function takes their place
    a controller of another car that nothing activates
    a car that is behind the ego, in another lane, or so far beside that it is not in the way
    an act or event that cannot start: by the parameters of the file, or for its condition
    what sets variables: it is looked at where a condition names the variable

Refused is what a scenario of aftbed cannot express: a speed change without duration or along a curve, one
that is no braking, a second one, an act that may stop while the car ahead still brakes, a change of the ego's
speed upwards, two cars ahead.

**The end.** A drive ends by itself: one second after the ego has come to stand, and on contact. A stop
trigger that waits for a time, or for the end of what the car ahead does, is the length of the drive. One that
is met only when the function has braked, or has failed to, is left to the drive's own end. One on a distance
that the ego drives is the earliest end: braking delays it.
"""

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import msgspec

from aftbed.core.errors import unknown
from aftbed.interop.openscenario.catalog import Catalogs
from aftbed.interop.openscenario.document import IGNORED, Cause, Element, RefusedError
from aftbed.interop.openscenario.placing import CarShape, RelativePlace, relative_place
from aftbed.interop.openscenario.timeline import (
    NEVER_S,
    Moment,
    Motion,
    SlowedEgo,
    SpeedChange,
    StoryEvent,
    Timeline,
    never_met,
    speed_change,
    target_speed_ms,
)
from aftbed.vehicle.plant import KMH_PER_MS

FRICTION_NOMINAL: Final = 0.9
DURATION_S_DEFAULT: Final = 30.0
AFTER_BRAKING_S: Final = (
    10.0  # the least that a drive without a stop trigger lasts after the last change of speed
)
NEVER_STARTS: Final = "the parameters say that it never starts"
REPLACED: Final = "aftbed's function takes its place"
_SHAPES: Final = ("linear", "step", "cubic", "sinusoidal")
_DIMENSIONS: Final = ("rate", "time", "distance")
_NAMED_BY: Final = {"Private": "entityRef", "ScenarioObject": "name"}
_PRIORITIES: Final = ("parallel", "override", "overwrite", "skip")


class UsedElement(msgspec.Struct, frozen=True):
    """An element of the file and its meaning for the drive."""

    path: str
    line: int
    element: str
    meaning: str


class LeadDrive(msgspec.Struct, frozen=True):
    """The car ahead: gap from bumper to bumper, offset to the left, speed at the start, and its changes."""

    name: str
    gap_m: float
    lateral_m: float
    speed_ms: float
    changes: tuple[SpeedChange, ...]

    @property
    def braking(self) -> SpeedChange | None:
        """The change of speed, if there is one, and it is downwards."""
        once = len(self.changes) == 1 and self.changes[0].final_ms < self.changes[0].from_ms
        return self.changes[0] if once else None


class ImportedDrive(msgspec.Struct, frozen=True):
    """The content of a scenario file of aftbed, without the expected outcome."""

    ego: str
    speed_ms: float
    lead: LeadDrive | None
    friction: float
    duration_s: float
    slow_ends: tuple[SlowedEgo, ...]
    taken: tuple[UsedElement, ...]


class _Move(NamedTuple):
    """An action that moves the car ahead, and its event."""

    event: StoryEvent
    action: Element


def set_aside(root: Element, ego: str, catalogs: Catalogs, duration_s: float | None) -> None:
    """Put entries of catalogs into the storyboard, and mark as ignored what cannot matter in any drive.

    It comes before anything is refused: what can never start may hold what would be refused.
    """
    storyboard = root.one("Storyboard")
    for act in [one for one in storyboard.walk() if one.tag == "Act"]:
        if never_met(_child(act, "StartTrigger")):
            act.visited, act.ignored = True, NEVER_STARTS
            continue
        for group in [one for one in act.children if one.tag == "ManeuverGroup"]:
            _resolve(root, group, "Maneuver", catalogs, "it may move a car")
            for event in [one for one in group.walk() if one.tag == "Event"]:
                if never_met(_child(event, "StartTrigger")):
                    event.visited, event.ignored = True, NEVER_STARTS
            if _actors(group) == (ego,):
                _replace_controllers(group)
    for element in list(root.walk()):
        if element.tag == "EnvironmentAction":
            _resolve(root, element, "Environment", catalogs, "it may say the friction of the road")
            if not any(one.tag == "RoadCondition" for one in element.walk()):
                element.ignored = IGNORED["Weather"]
        elif element.tag == "VariableAction":
            element.ignored = "looked at where a condition names the variable"
        elif element.tag == "VisibilityAction" and element.attributes.get("sensors") in ("true", "1"):
            element.ignored = "the radar sees the car"
        elif element.attributes.get(_NAMED_BY.get(element.tag, "")) == ego:
            _replace_controllers(element)
        elif element.tag == "ScenarioObject" and not _is_controlled(element, storyboard):
            for controller in [one for one in element.children if one.tag == "ObjectController"]:
                controller.ignored = "nothing activates it"
    stop = _child(storyboard, "StopTrigger")
    if duration_s is not None and stop is not None:
        stop.ignored = "the length of the drive was asked for"


def _resolve(root: Element, holder: Element, kind: str, catalogs: Catalogs, needed: str) -> None:
    """Put the entries of catalogs below `holder` beside the references to them."""
    for reference in holder.every("CatalogReference"):
        holder.children.append(catalogs.entry(root, reference, kind, needed=needed))


class StoryboardReader:
    """Reads the storyboard of the file `root` for one ego."""

    def __init__(
        self, root: Element, cars: Mapping[str, CarShape], ego: str, duration_s: float | None
    ) -> None:
        self._root = root
        self._cars = cars
        self._ego = cars[ego]
        self._duration_s = duration_s
        self._friction = FRICTION_NOMINAL
        self._places: dict[str, Element] = {}
        self._speeds: dict[str, Element] = {}
        self._gaps: dict[str, Element] = {}
        self._slow_ends: list[SlowedEgo] = []
        self._taken: list[UsedElement] = []

    def read(self) -> ImportedDrive:
        """The drive. Raises ConfigError with the first element that a scenario of aftbed cannot express."""
        storyboard = self._root.one("Storyboard")
        init = storyboard.one("Init")
        actions = init.one("Actions")
        self._read_init(actions)
        lead = self._find_lead(storyboard)
        for name in (self._ego.name, *([lead[0].name] if lead else [])):
            if name not in self._speeds:
                self._take(init, f"{name} stands: no SpeedAction")
        motion = Motion(self._ego.name, self._speed_ms(self._ego.name, ()))
        if lead is None:
            for place in self._places.values():
                place.ignored = place.ignored or "the road is empty: one place is like another"
        else:
            motion = self._start(*lead, motion.ego_ms)
        acts, events = _read_story(storyboard)
        timeline = Timeline(acts, events, self._variables(actions), motion)
        timeline = self._read_moves(timeline)
        duration_s = self._read_stop(storyboard, timeline)
        motion, drive = timeline.motion, None
        changes = tuple(one for one in motion.changes if one.after_s < duration_s)
        for late in motion.changes[len(changes) :]:
            words = f"would change its speed at {late.after_s:g} s: the drive has ended by then"
            self._take(storyboard, f"{motion.lead} {words}")
        if lead is not None:
            drive = LeadDrive(motion.lead, motion.gap_m, lead[1].lateral_m, motion.lead_ms, changes)
        return ImportedDrive(
            ego=self._ego.name,
            speed_ms=motion.ego_ms,
            lead=drive,
            friction=self._friction,
            duration_s=duration_s,
            slow_ends=tuple(self._slow_ends),
            taken=tuple(self._taken),
        )

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
                    found = kind.one("SpeedAction", "LongitudinalDistanceAction")
                    begin = self._speeds if found.tag == "SpeedAction" else self._gaps
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
            allowed = f"more than 0 and at most {1.2 / FRICTION_NOMINAL:.3f}"
            raise road.wrong("frictionScaleFactor", allowed, Cause.RANGE)
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
            allowed = "0, or the shape 'step': a drive begins at its speed"
            raise dynamics.wrong("value", allowed, Cause.SPEED)
        dynamics.choice("followingMode", ("position", "follow"), "position")
        target = action.one("SpeedActionTarget").one("AbsoluteTargetSpeed", "RelativeTargetSpeed")
        other_ms = 0.0
        if target.tag == "RelativeTargetSpeed":
            others = set(self._cars) - {name, *asking}
            other = target.word("entityRef")
            if other not in others:
                raise target.error(f"entityRef: {unknown('car', other, others)}")
            other_ms = self._speed_ms(other, (*asking, name))
        speed_ms = target_speed_ms(action, other_ms)
        if speed_ms < 0.0:
            raise target.error(f"{speed_ms:g} m/s, allowed is 0 or more", Cause.SPEED)
        if not asking:
            self._take(target, f"{name} drives at {speed_ms * KMH_PER_MS:g} km/h")
        return speed_ms

    def _variables(self, actions: Element) -> dict[str, str]:
        """The variables of the file, and their values after the `actions` of Init."""
        group = self._root.maybe("VariableDeclarations")
        found = {}
        for one in group.every("VariableDeclaration") if group else []:
            one.word("variableType")
            found[one.word("name")] = one.word("value")
        for action in (one for one in actions.walk() if one.tag == "VariableAction"):
            found[action.word("variableRef")] = action.one("SetAction").word("value")
        return found

    # -- the car ahead

    def _find_lead(self, storyboard: Element) -> tuple[CarShape, RelativePlace] | None:
        """The car ahead of the ego, and where it is. Cars that are not in the way are ignored."""
        found: list[tuple[CarShape, RelativePlace]] = []
        for name, car in self._cars.items():
            if car is self._ego:
                continue
            for placed in (self._ego.name, name):
                if placed not in self._places:
                    raise storyboard.error(f"Init places {placed!r} nowhere: TeleportAction is missing")
            seen, where = relative_place(self._ego, car, self._places), self._places[name]
            if seen.aside is None:
                found.append((car, seen))
                continue
            for element in (where, self._speeds.get(name), self._gaps.get(name)):
                if element is not None:
                    element.ignored = f"{name} does not matter: {seen.aside}"
        if not found:
            return None
        if len(found) > 1:
            names = " and ".join(repr(car.name) for car, _ in found)
            where = self._places[found[1][0].name]
            raise where.error(
                f"{names} are both in the ego's lane; one car ahead is all there is", Cause.ROAD_USERS
            )
        return found[0]

    def _start(self, car: CarShape, seen: RelativePlace, ego_ms: float) -> Motion:
        """How the two cars start, after the actions of Init."""
        lead_ms, where = self._speed_ms(car.name, ()), self._places[car.name]
        motion = Motion(self._ego.name, ego_ms, car.name, lead_ms, seen.gap_m, seen.distance_m)
        for name, action in self._gaps.items():
            if name in (motion.ego, motion.lead):
                motion, where = _with_gap(motion, name, action), action
        if seen.lateral_m:
            side = "left" if seen.lateral_m > 0.0 else "right"
            self._take(self._places[car.name], f"{car.name} is {abs(seen.lateral_m):g} m to the {side}")
        if motion.gap_m > 0.0:
            self._take(where, f"{car.name} is {motion.gap_m:g} m ahead, bumper to bumper")
        return motion

    # -- Story

    def _read_moves(self, timeline: Timeline) -> Timeline:
        """The timeline with what the storyboard makes the car ahead do."""
        motion = timeline.motion
        moves = [_Move(event, action) for event in timeline.events for action in self._moving(event, motion)]
        for event, action in [one for one in moves if one.action.tag == "LongitudinalDistanceAction"]:
            self._check(event, motion, [one.event for one in moves])
            begin = timeline.begin(event)
            if begin.at_s == NEVER_S:
                self._drop([(begin, _Move(event, action))])
                continue
            if begin.at_s > 0.0:
                raise action.error(f"a car that jumps, at {begin.at_s:g} s; only at the start", Cause.SPEED)
            motion = _with_gap(motion, motion.lead, action)
            self._take(action, f"{motion.lead} is {motion.gap_m:g} m ahead, bumper to bumper")
        if motion.lead and motion.gap_m <= 0.0:
            where = self._places[motion.lead]
            raise where.error(f"{motion.lead!r} is {motion.gap_m:g} m ahead of the ego, bumper to bumper")
        timeline = self._read_changes(
            timeline.with_motion(motion), [one for one in moves if one.action.tag == "SpeedAction"]
        )
        _ignore_quiet(timeline, [one.event for one in moves])
        return timeline

    def _read_changes(self, timeline: Timeline, waiting: list[_Move]) -> Timeline:
        """The timeline with the changes of speed of the car ahead, one after the other."""
        done: list[_Move] = []
        while waiting:
            begins = [(self._check_move(one, timeline, waiting + done), one) for one in waiting]
            begin, move = min(begins, key=lambda one: one[0].at_s)
            if begin.at_s == NEVER_S:
                self._drop(begins)
                break
            if begin.moving and timeline.motion.changes:
                where = begin.condition or move.event.event
                reason = "depends on how the cars move, after another change of speed"
                raise where.error(reason, Cause.TRIGGER)
            timeline = self._change_speed(move, begin, timeline)
            waiting = [one for one in waiting if one is not move]
            done.append(move)
        for event, _ in done:
            _check_act_stop(event, timeline)
        return timeline

    def _drop(self, begins: list[tuple[Moment, _Move]]) -> None:
        """Mark events that never begin as ignored; refuse those of which it is not known."""
        for begin, (event, _) in begins:
            if not begin.never:
                where = begin.condition or event.event
                raise where.error("never met while both cars keep their speed", Cause.TRIGGER)
            event.event.ignored = "its trigger is never met"

    def _change_speed(self, move: _Move, begin: Moment, timeline: Timeline) -> Timeline:
        """The timeline with one more change of the speed of the car ahead."""
        (event, action), motion, begin_s = move, timeline.motion, 0.0
        from_ms = motion.lead_speed_ms(begin.at_s)
        relative = action.one("SpeedActionTarget").maybe("RelativeTargetSpeed") is not None
        if not relative and target_speed_ms(action, motion.ego_ms) == from_ms:
            action.ignored = "it is the speed that the car has"
            return timeline.with_end(event, begin.at_s)
        for element in (event.act, event.event):
            if (trigger := element.maybe("StartTrigger")) is not None:
                met = timeline.trigger(trigger, begin_s)
                begin_s = met.at_s
                kept = ", if no car has braked by then" if met.assumes_speeds else ""
                words = f"met at {met.at_s:g} s{kept}"
                where = met.condition or trigger
                self._take(where, words if met.condition else f"has no condition: {words}")
        change = speed_change(action, begin.at_s, from_ms, motion.ego_ms)
        how = "brakes" if change.final_ms < from_ms else "speeds up"
        final = f" to {change.final_ms * KMH_PER_MS:g} km/h" if change.final_ms else ""
        kept = ", if the ego has its speed then" if relative else ""
        self._take(
            action, f"{motion.lead} {how} at {change.rate_ms2:g} m/s2{final} from {begin.at_s:g} s on{kept}"
        )
        return timeline.with_change(event, change)

    def _check_move(self, move: _Move, timeline: Timeline, moves: list[_Move]) -> Moment:
        """When an event that changes the speed begins; it moves nothing else, and happens once."""
        self._check(move.event, timeline.motion, [one.event for one in moves])
        return timeline.begin(move.event)

    def _moving(self, event: StoryEvent, motion: Motion) -> Iterator[Element]:
        """The actions of an event that move the car ahead. Those that move another car are ignored."""
        for action in event.actions:
            if idle(action):
                continue
            if action.tag == "GlobalAction":
                raise action.error("changes the world while the cars drive; only Init may", Cause.SPEED)
            kind = action.one("LongitudinalAction")
            actors = event.group.one("Actors")
            for name in event.actors:
                if name not in self._cars:
                    raise actors.error(f"entityRef: {unknown('car', name, self._cars)}")
            if motion.lead in event.actors:
                yield kind.one("SpeedAction", "LongitudinalDistanceAction")
            elif motion.ego in event.actors:
                self._check_slowing(kind, motion)
                kind.ignored = REPLACED
            elif event.actors:
                kind.ignored = "the car does not matter"
            else:
                raise actors.error("no car in it that the action could move")

    def _check_slowing(self, kind: Element, motion: Motion) -> None:
        """Check that the function can take the place of an action of the ego."""
        action = kind.one("SpeedAction", "LongitudinalDistanceAction")
        if action.tag == "SpeedAction":
            speed_ms = target_speed_ms(action, motion.lead_ms)
            if speed_ms > motion.ego_ms:
                reason = (
                    f"the ego speeds up to {speed_ms * KMH_PER_MS:g} km/h; it keeps its speed of the start"
                )
                raise action.error(f"{reason} until the function brakes", Cause.SPEED)

    def _check(self, event: StoryEvent, motion: Motion, moving: list[StoryEvent]) -> None:
        """Check that an event that moves the car ahead moves nothing else, and happens once."""
        actors = event.group.one("Actors")
        if actors.flag("selectTriggeringEntities", False):
            raise actors.wrong("selectTriggeringEntities", "false", Cause.TRIGGER)
        for actor in actors.every("EntityRef"):
            actor.word("entityRef")
        if event.actors != (motion.lead,):
            names = ", ".join(map(repr, event.actors))
            raise actors.error(f"found {names}; allowed is the car ahead, {motion.lead!r}", Cause.SPEED)
        for element in (event.group, event.event):
            if element.word("maximumExecutionCount", "1") != "1":
                raise element.wrong("maximumExecutionCount", "1", Cause.SPEED)
        if event.event.word("priority", "") == "skip":
            allowed = "another one: it may not begin while another event runs"
            raise event.event.wrong("priority", allowed, Cause.TRIGGER)
        for other in event.maneuver.every("Event"):
            stops = other.attributes.get("priority") in ("override", "overwrite")
            if stops and other.ignored is None and not any(one.event is other for one in moving):
                allowed = "parallel: it may stop the event that moves the car"
                raise other.wrong("priority", allowed, Cause.TRIGGER)

    # -- Stop

    def _read_stop(self, storyboard: Element, timeline: Timeline) -> float:
        stop = storyboard.maybe("StopTrigger")
        if self._duration_s is not None:
            return self._duration_s
        motion = timeline.motion
        ends_s: list[float] = []
        earliest_s = motion.changes[-1].end_s + AFTER_BRAKING_S if motion.changes else 0.0
        for group in stop.every("ConditionGroup") if stop else []:
            found = self._stop_of(group, timeline)
            if found.slow is not None and motion.lead:
                self._slow_ends.append(found.slow)
                self._take(
                    group, f"the drive ends {found.slow.after_s:g} s after {_words(found.slow, motion)}"
                )
            elif found.at_s == NEVER_S:
                group.ignored = "not met before the function has braked: the drive ends by itself"
            elif found.assumes_speeds and motion.lead:
                earliest_s = max(earliest_s, found.at_s)
                self._take(group, f"met at {found.at_s:g} s at the earliest: later if a car brakes")
            else:
                ends_s.append(found.at_s)
                self._take(found.condition or group, f"the drive ends at {found.at_s:g} s")
        if ends_s and min(ends_s) <= 0.0:
            raise storyboard.one("StopTrigger").error("ends the drive at its start", Cause.RANGE)
        if ends_s:
            return min(ends_s)
        duration_s = max(DURATION_S_DEFAULT, earliest_s)
        self._take(storyboard, f"the drive ends at {duration_s:g} s: no StopTrigger says when")
        return duration_s

    def _stop_of(self, group: Element, timeline: Timeline) -> Moment:
        """When a group of the stop trigger is met."""
        try:
            return timeline.group(group, 0.0)
        except RefusedError as error:
            if error.cause is not Cause.TRIGGER:
                raise
            reason = "ends the drive at a moment that is not known; --duration says it"
            raise group.children[0].error(f"{reason} ({error.reason})", Cause.TRIGGER) from error


def _words(slow: SlowedEgo, motion: Motion) -> str:
    if slow.below_ms is not None:
        return f"{motion.ego} is slower than {slow.below_ms * KMH_PER_MS:g} km/h"
    by = f" by {slow.below_lead_ms * KMH_PER_MS:g} km/h" if slow.below_lead_ms else ""
    return f"{motion.ego} is slower than {motion.lead}{by}"


def idle(holder: Element) -> bool:
    """Whether all children of `holder` are ignored."""
    return bool(holder.children) and all(
        child.ignored is not None or child.tag in IGNORED for child in holder.children
    )


def _read_story(storyboard: Element) -> tuple[list[Element], list[StoryEvent]]:
    """All acts, and all events, that can start."""
    acts: list[Element] = []
    events: list[StoryEvent] = []
    for story in storyboard.every("Story"):
        for act in (one for one in story.every("Act") if one.ignored is None):
            acts.append(act)
            for group in act.every("ManeuverGroup"):
                group.word("maximumExecutionCount", "")
                for maneuver in group.every("Maneuver"):
                    events += _events(story, act, group, maneuver)
    return acts, events


def _events(story: Element, act: Element, group: Element, maneuver: Element) -> Iterator[StoryEvent]:
    for event in (one for one in maneuver.every("Event") if one.ignored is None):
        event.word("maximumExecutionCount", "")
        event.choice("priority", _PRIORITIES, "parallel")
        kinds = [
            kind for action in event.every("Action") for kind in action.every("PrivateAction", "GlobalAction")
        ]
        yield StoryEvent(story, act, group, maneuver, event, _actors(group), tuple(kinds))


def _ignore_quiet(timeline: Timeline, moving: list[StoryEvent]) -> None:
    """Mark the triggers and actors of what moves no car, and the ends of acts in which no speed changes."""
    for act in timeline.acts:
        if not any(event.act is act and timeline.changes_speed(event) for event in moving):
            _ignore_below(act, "StopTrigger")
        if not any(event.act is act for event in moving):
            _ignore_below(act, "StartTrigger")
        for group in act.every("ManeuverGroup"):
            if not any(event.group is group for event in moving):
                _ignore_below(group, "Actors")
    for event in timeline.events:
        if not any(one.event is event.event for one in moving):
            _ignore_below(event.event, "StartTrigger")


def _ignore_below(element: Element, *tags: str) -> None:
    for child in element.every(*tags):
        child.ignored = f"nothing in the {element.tag} moves a car that matters"


def _with_gap(motion: Motion, name: str, action: Element) -> Motion:
    """The motion after a LongitudinalDistanceAction of the car `name`, at the start."""
    other = action.word("entityRef")
    if {name, other} != {motion.ego, motion.lead}:
        raise action.error(f"entityRef: found {other!r}, allowed is the other one of ego and car ahead")
    if action.flag("continuous"):
        raise action.wrong("continuous", "false: the car ahead drives at a speed", Cause.SPEED)
    limits = action.maybe("DynamicConstraints")
    if limits is not None:
        raise limits.error("a distance that is reached bit by bit", Cause.SPEED)
    ahead = "leadingReferencedEntity" if name == motion.lead else "trailingReferencedEntity"
    side = action.word("displacement", "any")
    if side not in ("any", ahead):
        raise action.wrong("displacement", f"any or {ahead}", Cause.ROAD_USERS)
    action.choice("coordinateSystem", ("entity", "lane", "road", "world", "trajectory"), "entity")
    if action.has("distance") == action.has("timeGap"):
        raise action.error("allowed is one of distance, timeGap")
    wanted_m = (
        action.number("distance") if action.has("distance") else action.number("timeGap") * motion.ego_ms
    )
    change_m = wanted_m - (motion.gap_m if action.flag("freespace") else motion.distance_m)
    if motion.gap_m + change_m <= 0.0:
        raise action.error(
            f"{motion.lead!r} is {motion.gap_m + change_m:g} m ahead of the ego, bumper to bumper"
        )
    return msgspec.structs.replace(
        motion, gap_m=motion.gap_m + change_m, distance_m=motion.distance_m + change_m
    )


def _check_act_stop(event: StoryEvent, timeline: Timeline) -> None:
    """Check that nothing stops the act of an event while the car ahead changes its speed."""
    stop, end_s = event.act.maybe("StopTrigger"), timeline.end_s(event)
    if stop is None or not stop.children:
        return
    found = timeline.trigger(stop, 0.0)
    if found.at_s < end_s or (found.at_s == NEVER_S and not found.never):
        reason = f"may stop the act before the car ahead has its speed, at {end_s:g} s"
        raise stop.error(reason, Cause.TRIGGER)
    stop.ignored = "what it waits for comes after the change of speed, or does not come"


# -- what does not matter


def _child(element: Element, tag: str) -> Element | None:
    return next((one for one in element.children if one.tag == tag), None)


def _actors(group: Element) -> tuple[str, ...]:
    """The names of those that the events of a ManeuverGroup move."""
    actors = _child(group, "Actors")
    return tuple(one.attributes.get("entityRef", "") for one in actors.children) if actors else ()


def _is_controlled(thing: Element, storyboard: Element) -> bool:
    """Whether the story, or Init, does something with a controller of an entity."""
    name = thing.attributes.get("name", "")
    return any(
        action.tag in ("ControllerAction", "ActivateControllerAction")
        for holder in storyboard.walk()
        if (holder.tag == "Private" and holder.attributes.get("entityRef") == name)
        or (holder.tag == "ManeuverGroup" and name in _actors(holder))
        for action in holder.walk()
    )


def _replace_controllers(element: Element) -> None:
    for one in element.walk():
        if one.tag in ("ObjectController", "ControllerAction", "ActivateControllerAction"):
            one.ignored = REPLACED
