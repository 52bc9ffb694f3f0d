"""A file in the form of Euro NCAP's rear tests: one base for standing, moving and braking targets.

Variables are set by a maneuver of a catalog; an act that only starts where the target brakes puts the target
at its headway; the drive ends when the car is slower than a part of the target's speed.
"""

from pathlib import Path

import xoscbuilder as osc

WORLDS = (
    '<Environment name="Sunny"><Weather><Sun azimuth="${172*pi/180}" elevation="1"/></Weather>'
    '</Environment><Environment name="Wet"><RoadCondition frictionScaleFactor="0.5"/></Environment>'
)
LOG_AND_SET = (
    '<Maneuver name="LogAndSet"><ParameterDeclarations>'
    '<ParameterDeclaration name="hit" parameterType="string" value="VRU"/>'
    '<ParameterDeclaration name="egoSpeed" parameterType="double" value="0"/></ParameterDeclarations>'
    + osc.event(
        "AtCollision",
        '<VariableAction variableRef="collided"><SetAction value="true"/></VariableAction>',
        osc.by_entity('<CollisionCondition><EntityRef entityRef="$hit"/></CollisionCondition>'),
        kind="GlobalAction",
    )
    + osc.event(
        "AtSpeed",
        '<VariableAction variableRef="reached"><SetAction value="$egoSpeed"/></VariableAction>',
        osc.by_entity('<SpeedCondition value="${$egoSpeed*0.98}" rule="greaterThan"/>'),
        kind="GlobalAction",
    )
    + "</Maneuver>"
)
VARIABLES = (
    '<VariableDeclaration name="collided" variableType="boolean" value="false"/>'
    '<VariableDeclaration name="reached" variableType="double" value="0.0"/>'
)
SETS_VARIABLES = osc.group(
    None,
    '<CatalogReference catalogName="maneuvers" entryName="LogAndSet"><ParameterAssignments>'
    '<ParameterAssignment parameterRef="hit" value="Lead"/>'
    '<ParameterAssignment parameterRef="egoSpeed" value="${$Ego_kph/3.6}"/>'
    "</ParameterAssignments></CatalogReference>",
)
REACHED = osc.by_value('<VariableCondition variableRef="reached" rule="greaterThan" value="0"/>', delay=1)
COLLIDED = osc.by_value('<VariableCondition variableRef="collided" rule="equalTo" value="true"/>', delay=1)
STANDS = osc.by_entity('<StandStillCondition duration="0.1"/>', delay=1)
IS_BRAKING = osc.by_value('<ParameterCondition parameterRef="Brakes" rule="equalTo" value="true"/>')
TELEPORTED = osc.by_value(
    '<StoryboardElementStateCondition storyboardElementType="maneuver" storyboardElementRef="Teleport"'
    ' state="completeState"/>',
    delay="$Delay",
)
PARAMETERS = {
    "Ego_kph": "20",
    "Lead_kph": "0",
    "Final_kph": "0",
    "Rate": "2",
    "Headway": "12",
    "Delay": "3",
    "Overlap": "100",
    "Brakes": "false",
}


def rear_test(
    folder: Path, slow: str = '<SpeedCondition value="${$Lead_kph/3.6*0.8}" rule="lessThan"/>'
) -> Path:
    """Write the file and its catalogs. `slow` is the condition on which a drive ends."""
    osc.write_catalogs(folder, maneuvers=LOG_AND_SET, worlds=WORLDS)
    path = folder / "rear.xosc"
    place = 'entityRef="Ego" dLane="0" offset="${($Overlap-100)*0.0171}" ds="${5*$Ego_kph/3.6}"'
    behind = f"<RelativeLanePosition {place}/>"
    jumps = osc.maneuver("Teleport", osc.event("Jump", osc.keeps('distance="$Headway"')))
    slows = osc.maneuver("Brake", osc.event("Slow", osc.brakes("$Rate", "${$Final_kph/3.6}"), TELEPORTED))
    story = osc.act("Variables", SETS_VARIABLES)
    story += osc.act(
        "Braking", osc.group("Lead", jumps, slows), start=osc.trigger("StartTrigger", [IS_BRAKING])
    )
    stop = osc.trigger("StopTrigger", [COLLIDED], [REACHED, STANDS], [REACHED, osc.by_entity(slow, delay=1)])
    path.write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(50)), osc.speed("${$Ego_kph/3.6}")],
                "Lead": [osc.placed(behind), osc.speed("${$Lead_kph/3.6}")],
            },
            story=story,
            stop=stop,
            parameters=PARAMETERS,
            variables=VARIABLES,
            world=(
                '<GlobalAction><EnvironmentAction><CatalogReference catalogName="worlds" entryName="Sunny"/>'
                "</EnvironmentAction></GlobalAction>"
            ),
        )
    )
    return path
