"""The schema of OpenSCENARIO XML, as far as the importer reads it: attributes and children of each element.

The tables below are written after ASAM's XSDs of the versions 1.0 to 1.3, which are not part of this package.
They are those of 1.3, which allows what the older ones do. Two rules are looser, for files of esmini: a
story, an act, a maneuver and a list of actions may be empty, and a step has no value. A row of `TYPES` is a
type, its attributes and its content:

    Event [maximumExecutionCount?=count name priority=Priority] Action+ StartTrigger:Trigger?

`?` marks what may be missing, `*` and `+` what may be repeated, `|` a choice, `&` children in any order, and
`:` the type of a child that has another name. The value of an attribute is a number, an int, a count (not
negative), a flag, a row of `ENUMS`, or any text.

What has no row is not looked into: the importer refuses it for its tag, or ignores it (`document`). An
element that is ignored may be missing or in a wrong place, and so may a label: neither can change the drive.
"""

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Final, NamedTuple

from aftbed.interop.openscenario.document import (
    IGNORED,
    LABELS,
    Cause,
    Element,
    RefusedError,
    finite,
    raise_refused,
)

TYPES: Final = """\
AbsoluteTargetSpeed [value=number]
AccelerationCondition [rule=Rule value=number direction?=DirectionalDimension]
Act [name] ManeuverGroup* StartTrigger:Trigger? StopTrigger:Trigger?
Action [name] GlobalAction | UserDefinedAction | PrivateAction
Actors [selectTriggeringEntities=flag] EntityRef*
AngleCondition [angleType=AngleType angle=number angleTolerance=number
    coordinateSystem?=CoordinateSystem]
BoundingBox Center & Dimensions
ByEntityCondition TriggeringEntities & EntityCondition
ByObjectType [type=ObjectType]
ByValueCondition ParameterCondition | TimeOfDayCondition | SimulationTimeCondition |
    StoryboardElementStateCondition | UserDefinedValueCondition | TrafficSignalCondition |
    TrafficSignalControllerCondition | VariableCondition
CatalogReference [catalogName entryName] ParameterAssignments?
Center [x=number y=number z=number]
CollisionCondition EntityRef | ByType:ByObjectType
Condition [conditionEdge=ConditionEdge delay=number name] ByEntityCondition | ByValueCondition
ConditionGroup Condition+
Deterministic (DeterministicMultiParameterDistribution | DeterministicSingleParameterDistribution)*
DeterministicMultiParameterDistribution (ValueSetDistribution)
DeterministicSingleParameterDistribution [parameterName] (DistributionSet | DistributionRange |
    UserDefinedDistribution)
Dimensions [height=number length=number width=number]
DistanceCondition [alongRoute?=flag freespace=flag rule=Rule value=number
    coordinateSystem?=CoordinateSystem relativeDistanceType?=RelativeDistanceType
    routingAlgorithm?=RoutingAlgorithm] Position
DistributionRange [stepWidth=number] Range
DistributionSet Element:DistributionSetElement+
DistributionSetElement [value]
DynamicConstraints [maxAcceleration?=number maxAccelerationRate?=number maxDeceleration?=number
    maxDecelerationRate?=number maxSpeed?=number]
EndOfRoadCondition [duration=number]
Entities ScenarioObject* EntitySelection*
EntityCondition EndOfRoadCondition | CollisionCondition | OffroadCondition | TimeHeadwayCondition |
    TimeToCollisionCondition | AccelerationCondition | StandStillCondition | SpeedCondition |
    RelativeSpeedCondition | TraveledDistanceCondition | ReachPositionCondition | DistanceCondition |
    RelativeDistanceCondition | RelativeClearanceCondition | AngleCondition | RelativeAngleCondition
EntityRef [entityRef]
Environment [name] TimeOfDay? & Weather? & RoadCondition?
EnvironmentAction Environment | CatalogReference
Event [maximumExecutionCount?=count name priority=Priority] Action+ StartTrigger:Trigger?
FileHeader [author date description revMajor=count revMinor=count] License? Properties?
GlobalAction EnvironmentAction | EntityAction | InfrastructureAction | SetMonitorAction |
    ParameterAction | TrafficAction | VariableAction
Histogram Bin:HistogramBin+
HistogramBin [weight=number] Range
Init Actions:InitActions
InitActions GlobalAction* UserDefinedAction* Private*
LanePosition [laneId offset?=number roadId s=number] Orientation?
LogNormalDistribution [expectedValue=number variance=number] Range?
LongitudinalAction SpeedAction | LongitudinalDistanceAction | SpeedProfileAction
LongitudinalDistanceAction [entityRef continuous=flag distance?=number freespace=flag timeGap?=number
    displacement?=LongitudinalDisplacement coordinateSystem?=CoordinateSystem] DynamicConstraints?
Maneuver [name] Event*
ManeuverGroup [maximumExecutionCount=count name] Actors CatalogReference* Maneuver*
MiscObject [mass=number miscObjectCategory=MiscObjectCategory name model3d?] BoundingBox & Properties?
NormalDistribution [expectedValue=number variance=number] Range?
OffroadCondition [duration=number]
OpenScenario FileHeader ((VariableDeclarations? MonitorDeclarations? CatalogLocations RoadNetwork
    Entities Storyboard) | Catalog | ParameterValueDistribution)
Orientation [h?=number p?=number r?=number type?=ReferenceContext]
ParameterAssignment [parameterRef value]
ParameterAssignments ParameterAssignment*
ParameterCondition [parameterRef rule=Rule value]
ParameterValueDistribution ScenarioFile:File (Deterministic | Stochastic)
ParameterValueSet ParameterAssignment+
Pedestrian [mass=number model? name pedestrianCategory=PedestrianCategory model3d? role?=Role]
    BoundingBox & Properties?
PoissonDistribution [expectedValue=number] Range?
Position WorldPosition | RelativeWorldPosition | RelativeObjectPosition | RoadPosition |
    RelativeRoadPosition | LanePosition | RelativeLanePosition | RoutePosition | GeoPosition |
    TrajectoryPosition
Private [entityRef] PrivateAction*
PrivateAction LongitudinalAction | LateralAction | VisibilityAction | SynchronizeAction |
    ActivateControllerAction | ControllerAction | TeleportAction | RoutingAction | AppearanceAction |
    TrailerAction
ProbabilityDistributionSet Element:ProbabilityDistributionSetElement+
ProbabilityDistributionSetElement [value weight=number]
Range [lowerLimit=number upperLimit=number]
ReachPositionCondition [tolerance=number] Position
RelativeAngleCondition [entityRef angleType=AngleType angle=number angleTolerance=number
    coordinateSystem?=CoordinateSystem]
RelativeClearanceCondition [oppositeLanes=flag distanceForward?=number distanceBackward?=number
    freeSpace=flag] RelativeLaneRange* EntityRef*
RelativeDistanceCondition [entityRef freespace=flag relativeDistanceType=RelativeDistanceType rule=Rule
    value=number coordinateSystem?=CoordinateSystem routingAlgorithm?=RoutingAlgorithm]
RelativeLanePosition [entityRef dLane=int ds?=number offset?=number dsLane?=number] Orientation?
RelativeLaneRange [from?=int to?=int]
RelativeObjectPosition [entityRef dx=number dy=number dz?=number] Orientation?
RelativeRoadPosition [entityRef ds=number dt=number] Orientation?
RelativeSpeedCondition [entityRef rule=Rule value=number direction?=DirectionalDimension]
RelativeTargetSpeed [entityRef continuous=flag speedTargetValueType=SpeedTargetValueType value=number]
RelativeWorldPosition [entityRef dx=number dy=number dz?=number] Orientation?
RoadCondition [frictionScaleFactor=number wetness?=Wetness] Properties?
RoadNetwork LogicFile:File? SceneGraphFile:File? TrafficSignals? UsedArea?
RoadPosition [roadId s=number t=number] Orientation?
ScenarioObject [name] (CatalogReference | Vehicle | Pedestrian | MiscObject | ExternalObjectReference)
    ObjectController*
SimulationTimeCondition [rule=Rule value=number]
SpeedAction SpeedActionDynamics:TransitionDynamics & SpeedActionTarget
SpeedActionTarget RelativeTargetSpeed | AbsoluteTargetSpeed
SpeedCondition [rule=Rule value=number direction?=DirectionalDimension]
StandStillCondition [duration=number]
Stochastic [numberOfTestRuns=count randomSeed?=number] StochasticDistribution+
StochasticDistribution [parameterName] (ProbabilityDistributionSet | NormalDistribution |
    LogNormalDistribution | UniformDistribution | PoissonDistribution | Histogram |
    UserDefinedDistribution)
Story [name] Act*
Storyboard Init Story* StopTrigger:Trigger?
StoryboardElementStateCondition [storyboardElementRef state=StoryboardElementState
    storyboardElementType=StoryboardElementType]
TeleportAction Position
TimeHeadwayCondition [entityRef alongRoute?=flag freespace=flag rule=Rule value=number
    coordinateSystem?=CoordinateSystem relativeDistanceType?=RelativeDistanceType
    routingAlgorithm?=RoutingAlgorithm]
TimeOfDayCondition [dateTime rule=Rule]
TimeToCollisionCondition [alongRoute?=flag freespace=flag rule=Rule value=number
    relativeDistanceType?=RelativeDistanceType coordinateSystem?=CoordinateSystem
    routingAlgorithm?=RoutingAlgorithm] TimeToCollisionConditionTarget
TimeToCollisionConditionTarget Position | EntityRef
TransitionDynamics [dynamicsDimension=DynamicsDimension dynamicsShape=DynamicsShape
    followingMode?=FollowingMode value?=number]
TraveledDistanceCondition [value=number]
Trigger ConditionGroup*
TriggeringEntities [triggeringEntitiesRule=TriggeringEntitiesRule] EntityRef+
UniformDistribution Range
UserDefinedValueCondition [name rule=Rule value]
ValueSetDistribution ParameterValueSet+
VariableAction [variableRef] SetAction:VariableSetAction | ModifyAction:VariableModifyAction
VariableAddValueRule [value=number]
VariableCondition [variableRef rule=Rule value]
VariableDeclaration [name variableType=ParameterType value]
VariableDeclarations VariableDeclaration*
VariableModifyAction Rule:VariableModifyRule
VariableModifyRule AddValue:VariableAddValueRule | MultiplyByValue:VariableMultiplyByValueRule
VariableMultiplyByValueRule [value=number]
VariableSetAction [value]
Vehicle [name vehicleCategory=VehicleCategory role?=Role mass?=number model3d?] BoundingBox &
    Performance & Axles & Properties? & TrailerHitch? & TrailerCoupler? & Trailer?
WorldPosition [h?=number p?=number r?=number x=number y=number z?=number]
"""

ENUMS: Final = """\
AngleType = heading pitch roll
ConditionEdge = falling none rising risingOrFalling
CoordinateSystem = entity lane road trajectory world
DirectionalDimension = longitudinal lateral vertical
DynamicsDimension = distance rate time
DynamicsShape = cubic linear sinusoidal step
FollowingMode = follow position
LongitudinalDisplacement = any trailingReferencedEntity leadingReferencedEntity
MiscObjectCategory = barrier building crosswalk gantry none obstacle parkingSpace patch pole railing
    roadMark soundBarrier streetLamp trafficIsland tree vegetation wind
ObjectType = miscellaneous pedestrian vehicle external
ParameterType = boolean dateTime double integer string unsignedInt unsignedShort int
PedestrianCategory = animal pedestrian wheelchair
Priority = overwrite override parallel skip
ReferenceContext = absolute relative
RelativeDistanceType = lateral longitudinal cartesianDistance euclidianDistance
Role = none ambulance civil fire military police publicTransport roadAssistance
RoutingAlgorithm = assignedRoute fastest leastIntersections shortest undefined
Rule = equalTo greaterThan lessThan greaterOrEqual lessOrEqual notEqualTo
SpeedTargetValueType = delta factor
StoryboardElementState = completeState endTransition runningState skipTransition standbyState
    startTransition stopTransition
StoryboardElementType = act action event maneuver maneuverGroup story
TriggeringEntitiesRule = all any
VehicleCategory = bicycle bus car motorbike semitrailer trailer train tram truck van
Wetness = dry moist wetWithPuddles lowFlooded highFlooded
"""


# -- the content of an element, as an expression over the tags of its children


class Child(NamedTuple):
    """A child with this tag, of this type."""

    tag: str
    type: str


class InOrder(NamedTuple):
    items: "tuple[Content, ...]"


class OneOf(NamedTuple):
    items: "tuple[Content, ...]"


class AnyOrder(NamedTuple):
    """Each of them, in any order."""

    items: "tuple[Content, ...]"


class Repeated(NamedTuple):
    item: "Content"
    optional: bool
    many: bool


Content = Child | InOrder | OneOf | AnyOrder | Repeated
NOTHING: Final = InOrder(())


def may_end(content: Content) -> bool:
    """Whether there may be no further child."""
    match content:
        case Child(tag, _):
            return tag in IGNORED
        case InOrder(items) | AnyOrder(items):
            return all(map(may_end, items))
        case OneOf(items):
            return any(map(may_end, items))
        case Repeated(item, optional, _):
            return optional or may_end(item)


def next_tags(content: Content) -> list[str]:
    """The tags of which one may be the next child."""
    match content:
        case Child(tag, _):
            return [tag]
        case OneOf(items) | AnyOrder(items):
            return [tag for item in items for tag in next_tags(item)]
        case Repeated(item, _, _):
            return next_tags(item)
        case InOrder(items):
            found: list[str] = []
            for item in items:
                found += next_tags(item)
                if not may_end(item):
                    break
            return found


def behind(content: Content, tag: str) -> Content | None:
    """What may follow a child with this tag; None if it is not allowed. At most one item of a row has it."""
    match content:
        case Child(own, _):
            return NOTHING if own == tag else None
        case OneOf(items):
            return next((rest for item in items if (rest := behind(item, tag)) is not None), None)
        case Repeated(item, _, many):
            rest = behind(item, tag)
            return None if rest is None else InOrder((rest, Repeated(item, True, many))) if many else rest
        case AnyOrder(items):
            for place, item in enumerate(items):
                if behind(item, tag) is not None:
                    return AnyOrder(items[:place] + items[place + 1 :])
            return None
        case InOrder(items):
            for place, item in enumerate(items):
                if (rest := behind(item, tag)) is not None:
                    return InOrder((rest, *items[place + 1 :]))
                if not may_end(item):
                    return None
            return None


def children(content: Content) -> Iterator[Child]:
    """All that can stand in it."""
    match content:
        case Child():
            yield content
        case Repeated(item, _, _):
            yield from children(item)
        case InOrder(items) | OneOf(items) | AnyOrder(items):
            for item in items:
                yield from children(item)


# -- the tables, read


class Attribute(NamedTuple):
    name: str
    optional: bool
    kind: str


class Type(NamedTuple):
    attributes: tuple[Attribute, ...]
    content: Content
    types: Mapping[str, str]  # of the children, by tag


_TOKENS: Final = re.compile(r"[A-Za-z]+(?::[A-Za-z]+)?|[()|&?*+]")


def _rows(table: str) -> list[str]:
    return table.replace("\n    ", " ").splitlines()


@cache
def types() -> Mapping[str, Type]:
    """The rows of `TYPES`, by name."""
    return dict(map(_type, _rows(TYPES)))


@cache
def enums() -> Mapping[str, tuple[str, ...]]:
    """The rows of `ENUMS`, by name."""
    return {name: tuple(words.split()) for name, words in (row.split(" = ") for row in _rows(ENUMS))}


def _type(row: str) -> tuple[str, Type]:
    found = re.fullmatch(r"(\w+)(?: \[(.+)\])?(?: (.+))?", row)
    assert found is not None, row
    attributes = tuple(map(_attribute, (found[2] or "").split()))
    tokens = _TOKENS.findall(found[3] or "")
    content = _content(tokens)
    assert not tokens, row
    return found[1], Type(attributes, content, {child.tag: child.type for child in children(content)})


def _attribute(text: str) -> Attribute:
    name, _, kind = text.partition("=")
    return Attribute(name.removesuffix("?"), name.endswith("?"), kind)


def _content(tokens: list[str]) -> Content:
    """Reads `tokens` up to the end or a closing bracket, and takes them away."""
    items: list[Content] = []
    kind: type[InOrder | OneOf | AnyOrder] = InOrder
    while tokens and tokens[0] != ")":
        token = tokens.pop(0)
        if token in "|&":
            kind = OneOf if token == "|" else AnyOrder
            continue
        item: Content
        if token == "(":
            item = _content(tokens)
            tokens.pop(0)
        else:
            tag, _, name = token.partition(":")
            item = Child(tag, name or tag)
        if tokens and tokens[0] in "?*+":
            mark = tokens.pop(0)
            item = Repeated(item, mark in "?*", mark in "*+")
        items.append(item)
    return items[0] if len(items) == 1 else kind(tuple(items))


# -- the check


class Violation(NamedTuple):
    """What the schema does not allow; `lineage` ends with `element`."""

    element: Element
    reason: str
    lineage: tuple[Element, ...]

    @property
    def matters(self) -> bool:
        return not any(one.ignored is not None or one.tag in IGNORED for one in self.lineage)


@contextlib.contextmanager
def fitting(root: Element) -> Iterator[Callable[[Element], None]]:
    """What is done with a whole file, or a distribution; it gives what takes in entries of catalogs.

    Raises ConfigError with all that does not fit and is not ignored by then. That takes the place of the
    first mistake that the block has come upon, but of no other refusal.
    """
    unfit = violations(root, "OpenScenario")
    try:
        yield lambda entry: unfit.extend(violations(entry, entry.tag))
    except RefusedError as error:
        if error.cause is Cause.MISTAKE:
            _refuse(root, unfit)
        raise
    _refuse(root, unfit)


def violations(root: Element, type_name: str) -> list[Violation]:
    """What of a tree of this type the schema does not allow. A value with a parameter in it fits."""
    return list(_violations(root, type_name, ()))


def _refuse(root: Element, unfit: list[Violation]) -> None:
    raise_refused(root, [(one.element, (Cause.MISTAKE, one.reason)) for one in unfit if one.matters])


def _violations(element: Element, type_name: str, above: tuple[Element, ...]) -> Iterator[Violation]:
    schema, lineage = types().get(type_name), (*above, element)
    if schema is None:
        return
    yield from (Violation(element, reason, lineage) for reason in _of_attributes(element, schema.attributes))
    rest = schema.content
    for child in element.children:
        after = behind(rest, child.tag)
        if after is None:
            allowed = [*next_tags(rest), *(["its end"] if may_end(rest) else [])]
            reason = f"not allowed here in {element.tag}, allowed is {' or '.join(allowed)}"
            yield Violation(child, reason, (*lineage, child))
        else:
            rest = after
        if child.tag in schema.types:
            yield from _violations(child, schema.types[child.tag], lineage)
    if not may_end(rest):
        there = ", ".join(child.tag for child in element.children[:5]) or "nothing"
        yield Violation(element, f"found {there}, allowed is {' or '.join(next_tags(rest))}", lineage)


def _of_attributes(element: Element, allowed: tuple[Attribute, ...]) -> Iterator[str]:
    for one in allowed:
        value = element.attributes.get(one.name)
        if value is None:
            if not one.optional and one.name not in LABELS:
                yield f"attribute {one.name!r} is missing"
        elif "$" not in value and not _fits(value, one.kind):
            yield element.wrong(one.name, _words(one.kind)).reason.removeprefix(f"{element.tag}: ")
    names = {one.name for one in allowed} | LABELS
    for name in element.attributes:
        if name not in names and name != "xmlns" and not name.startswith(("xmlns:", "xsi:", "xml:")):
            shown = ", ".join(one.name for one in allowed) or "none"
            yield f"attribute {name!r} is not expected here, allowed is {shown}"


_FITS: Final[Mapping[str, Callable[[str], bool]]] = {
    "": lambda text: True,
    "number": lambda text: finite(text) is not None or text in ("INF", "-INF", "NaN"),
    "int": lambda text: re.fullmatch(r"\s*[+-]?[0-9]+\s*", text, re.ASCII) is not None,
    "count": lambda text: re.fullmatch(r"\s*\+?[0-9]+\s*", text, re.ASCII) is not None,
    "flag": lambda text: text.strip() in ("true", "false", "1", "0"),
}
_WORDS: Final = {
    "number": "a number",
    "int": "a whole number",
    "count": "a whole number",
    "flag": "true or false",
}


def _fits(text: str, kind: str) -> bool:
    return _FITS[kind](text) if kind in _FITS else text in enums()[kind]


def _words(kind: str) -> str:
    return _WORDS.get(kind) or f"one of {', '.join(enums()[kind])}"
