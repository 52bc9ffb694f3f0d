"""The OpenSCENARIO files of the tests, and how one is changed in a single place."""

from pathlib import Path

import pytest

from aftbed.core.errors import ConfigError
from aftbed.interop.openscenario.importer import ImportedFile, ImportOptions, import_scenario

FOLDER = Path(__file__).resolve().parent / "xosc"
LEAD_BRAKES = FOLDER / "lead_brakes.xosc"
SLOW_LEAD = FOLDER / "slow_lead.xosc"
VALUES = FOLDER / "lead_brakes_values.xosc"


# Pieces of lead_brakes.xosc
RATE = '<SpeedActionDynamics dynamicsShape="linear" dynamicsDimension="rate" value="$Deceleration"/>'
AFTER_1_S = """<ByValueCondition>
                      <SimulationTimeCondition value="1" rule="greaterThan"/>
                    </ByValueCondition>"""
PLACE = '<RelativeLanePosition entityRef="Ego" dLane="0" ds="${$Gap + 3.65 + 1}"/>'
EGO_PLACE = '<LanePosition roadId="1" laneId="-1" offset="0" s="20"/>'
LEAD_SPEED = (
    '<RelativeTargetSpeed entityRef="Ego" value="0" speedTargetValueType="delta" continuous="false"/>'
)
STOP_12_S = '<SimulationTimeCondition value="12" rule="greaterThan"/>'
LATERAL = "<LateralAction><LaneChangeAction/></LateralAction>"
LONGITUDINAL = f"""<LongitudinalAction>
                    <SpeedAction>
                      {RATE}
                      <SpeedActionTarget>
                        <AbsoluteTargetSpeed value="0"/>
                      </SpeedActionTarget>
                    </SpeedAction>
                  </LongitudinalAction>"""


def changed(folder: Path, *changes: tuple[str, str], source: Path = LEAD_BRAKES) -> Path:
    """A copy of `source` in `folder` in which each old text, which stands there once, is a new one."""
    text = source.read_text()
    for old, new in changes:
        assert text.count(old) == 1, (old, text.count(old))
        text = text.replace(old, new)
    path = folder / source.name
    path.write_text(text)
    return path


def imported(
    path: Path, distribution: Path | None = None, *, ego: str | None = None, duration_s: float | None = None
) -> ImportedFile:
    """The file, imported with what else is wanted left as it is."""
    return import_scenario(path, distribution, ImportOptions(ego=ego, duration_s=duration_s))


def refused(path: Path) -> str:
    """Why the file is refused."""
    with pytest.raises(ConfigError) as error:
        imported(path)
    return str(error.value)


def entity_condition(condition: str, who: str = "Ego") -> tuple[str, str]:
    """The change that makes the car ahead brake on a condition of a car."""
    return AFTER_1_S, (
        f'<ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="{who}"/>'
        f"</TriggeringEntities><EntityCondition>{condition}</EntityCondition></ByEntityCondition>"
    )
