"""Writes OpenSCENARIO files in the forms in which others write them: Euro NCAP's, ALKS', esmini's.

Each function makes a piece of XML; `scenario` puts them together. The vehicles lie in a catalog.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

HEADER = '<FileHeader revMajor="1" revMinor="3" date="2026-01-01T00:00:00" description="{}" author="aftbed"/>'
BOX = (
    '<BoundingBox><Center x="{x}" y="0" z="0.7"/><Dimensions width="{width}" length="{length}" height="1.5"/>'
    "</BoundingBox>"
)
EGO_FRONT_M, LEAD_REAR_M = 1.4 + 2.25, 2.0 - 1.3  # of the two cars in `VEHICLES`
VEHICLES = (
    '<Vehicle name="ego_car" vehicleCategory="car">'
    + BOX.format(x=1.4, width=1.8, length=4.5)
    + '<Trailer><TrailerRef entityRef=""/></Trailer></Vehicle>'
    + '<Vehicle name="target" vehicleCategory="car">'
    + BOX.format(x=1.3, width=1.7, length=4.0)
    + "</Vehicle>"
    + '<Vehicle name="moped" vehicleCategory="motorbike">'
    + BOX.format(x=0.5, width=0.8, length=2.0)
    + "</Vehicle>"
)
WALKER = (
    '<Pedestrian name="walker" mass="80" model="m" pedestrianCategory="pedestrian">'
    + BOX.format(x=0.1, width=0.5, length=0.4)
    + "</Pedestrian>"
)


def document(description: str, inner: str) -> str:
    return f'<?xml version="1.0"?>\n<OpenSCENARIO>\n{HEADER.format(description)}\n{inner}\n</OpenSCENARIO>\n'


def catalog(name: str, inner: str) -> str:
    return document("entries", f'<Catalog name="{name}">{inner}</Catalog>')


def write_catalogs(folder: Path, **catalogs: str) -> None:
    """The catalogs `cars` and `people`, and those that are given, each in a folder of its name."""
    for name, inner in {"cars": VEHICLES, "people": WALKER, **catalogs}.items():
        (folder / name).mkdir(exist_ok=True)
        (folder / name / f"{name}.xosc").write_text(catalog(name, inner))


def lane(s: float | str, *, lane_id: str = "-1", offset: float | str = 0) -> str:
    return f'<LanePosition roadId="0" laneId="{lane_id}" offset="{offset}" s="{s}"/>'


def placed(position: str) -> str:
    return f"<TeleportAction><Position>{position}</Position></TeleportAction>"


def speed(
    target: float | str, dynamics: str = 'dynamicsShape="step" value="0" dynamicsDimension="time"'
) -> str:
    return (
        f"<LongitudinalAction><SpeedAction><SpeedActionDynamics {dynamics}/><SpeedActionTarget>"
        f'<AbsoluteTargetSpeed value="{target}"/></SpeedActionTarget></SpeedAction></LongitudinalAction>'
    )


def brakes(rate: float | str, target: float | str = 0) -> str:
    return speed(target, f'dynamicsShape="linear" value="{rate}" dynamicsDimension="rate"')


def keeps(distance: str, entity: str = "Ego") -> str:
    """A LongitudinalDistanceAction; `distance` is its attribute distance or timeGap."""
    return (
        f'<LongitudinalAction><LongitudinalDistanceAction entityRef="{entity}" {distance} freespace="true"'
        ' continuous="false" displacement="leadingReferencedEntity" coordinateSystem="entity"/>'
        "</LongitudinalAction>"
    )


def by_value(inner: str, *, delay: float | str = 0, edge: str = "none") -> str:
    inner = f"<ByValueCondition>{inner}</ByValueCondition>"
    return f'<Condition name="c" delay="{delay}" conditionEdge="{edge}">{inner}</Condition>'


def by_entity(inner: str, entity: str = "Ego", *, delay: float = 0, edge: str = "none") -> str:
    return (
        f'<Condition name="c" delay="{delay}" conditionEdge="{edge}"><ByEntityCondition>'
        f'<TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="{entity}"/>'
        f"</TriggeringEntities><EntityCondition>{inner}</EntityCondition></ByEntityCondition></Condition>"
    )


def after(seconds: float | str) -> str:
    return by_value(f'<SimulationTimeCondition value="{seconds}" rule="greaterThan"/>')


def trigger(tag: str, *groups: Sequence[str]) -> str:
    inner = "".join(f"<ConditionGroup>{''.join(group)}</ConditionGroup>" for group in groups)
    return f"<{tag}>{inner}</{tag}>"


def event(name: str, action: str, *conditions: str, kind: str = "PrivateAction") -> str:
    start = trigger("StartTrigger", conditions) if conditions else ""
    action = f'<Action name="{name}Action"><{kind}>{action}</{kind}></Action>'
    return f'<Event name="{name}" priority="parallel">{action}{start}</Event>'


def group(actor: str | None, *maneuvers: str) -> str:
    actors = f'<EntityRef entityRef="{actor}"/>' if actor else ""
    return (
        '<ManeuverGroup name="group" maximumExecutionCount="1">'
        f'<Actors selectTriggeringEntities="false">{actors}</Actors>{"".join(maneuvers)}</ManeuverGroup>'
    )


def maneuver(name: str, *events: str) -> str:
    return f'<Maneuver name="{name}">{"".join(events)}</Maneuver>'


def act(name: str, *groups: str, start: str = "") -> str:
    return f'<Act name="{name}">{"".join(groups)}{start}</Act>'


def scenario(
    *,
    init: Mapping[str, Sequence[str]],
    story: str = "",
    stop: str = "",
    parameters: Mapping[str, str] | None = None,
    entries: Mapping[str, tuple[str, str]] | None = None,
    variables: str = "",
    world: str = "",
    objects: str = "",
) -> str:
    """A file with the private actions `init` of each entity; Ego and Lead are those of the catalog."""
    entries = {"Ego": ("cars", "ego_car"), "Lead": ("cars", "target"), **(entries or {})}
    declared = "".join(
        f'<ParameterDeclaration name="{name}" parameterType="string" value="{value}"/>'
        for name, value in (parameters or {}).items()
    )
    folders = {"Vehicle": "cars", "Pedestrian": "people", "Maneuver": "maneuvers", "Environment": "worlds"}
    locations = "".join(
        f'<{kind}Catalog><Directory path="{folder}"/></{kind}Catalog>' for kind, folder in folders.items()
    )
    things = "".join(
        f'<ScenarioObject name="{name}"><CatalogReference catalogName="{entries[name][0]}"'
        f' entryName="{entries[name][1]}"/>{objects if name == "Ego" else ""}</ScenarioObject>'
        for name in init
    )
    actions = ""
    for name, ones in init.items():
        private = "".join(f"<PrivateAction>{one}</PrivateAction>" for one in ones)
        actions += f'<Private entityRef="{name}">{private}</Private>'
    told = f'<Story name="story">\n{story}\n</Story>' if story else ""
    road_file = "$Road" if "Road" in (parameters or {}) else "road.xodr"
    return document(
        "a drive",
        f"""<ParameterDeclarations>{declared}</ParameterDeclarations>
<VariableDeclarations>{variables}</VariableDeclarations>
<CatalogLocations>{locations}</CatalogLocations>
<RoadNetwork><LogicFile filepath="{road_file}"/></RoadNetwork>
<Entities>{things}</Entities>
<Storyboard>
<Init><Actions>{world}{actions}</Actions></Init>
{told}
{stop}
</Storyboard>""",
    )


def distribution(file: str, **values: Sequence[str]) -> str:
    inner = "".join(
        f'<DeterministicSingleParameterDistribution parameterName="{name}"><DistributionSet>'
        + "".join(f'<Element value="{one}"/>' for one in ones)
        + "</DistributionSet></DeterministicSingleParameterDistribution>"
        for name, ones in values.items()
    )
    return document(
        "variations",
        f'<ParameterValueDistribution><ScenarioFile filepath="{file}"/><Deterministic>{inner}</Deterministic>'
        "</ParameterValueDistribution>",
    )


def road(geometry: str) -> str:
    plan = f'<planView><geometry s="0" x="0" y="0" hdg="0" length="900">{geometry}</geometry></planView>'
    return f'<OpenDRIVE><road id="0" length="900" junction="-1">{plan}</road></OpenDRIVE>'
