"""Short drives for tests of the road: they are over in two seconds of bus time."""

from pathlib import Path

from aftbed.runtime.sim.world import Setup
from aftbed.search.worst_instant import Course, course_of

SUDDEN = """
description: a car that stands so near that full braking cannot wait for anything
duration_s: 6
ego: {{speed_kmh: {speed_kmh}}}
lead: {{gap_m: {gap_m}, speed_kmh: 0}}
expect: {{outcome: impact, impact_speed_kmh_max: 200}}
"""

NEAR = """
description: 20 km/h at a standing car, two seconds before contact, for every stage of braking
duration_s: 6
ego: {speed_kmh: 20}
lead: {gap_m: 11, speed_kmh: 0}
expect: {outcome: stop}
"""


def near(folder: Path) -> str:
    """The path of a scenario with a warning, partial and full braking."""
    path = folder / "near.yaml"
    path.write_text(NEAR)
    return str(path)


def near_course(folder: Path, ftm: str) -> Course:
    """It, driven without a fault."""
    return course_of(Setup(ftm, scenario=near(folder)))


def sudden(folder: Path, speed_kmh: float, gap_m: float) -> str:
    """The path of such a scenario."""
    path = folder / f"sudden-{speed_kmh:g}.yaml"
    path.write_text(SUDDEN.format(speed_kmh=speed_kmh, gap_m=gap_m))
    return str(path)


def sudden_course(folder: Path, ftm: str, speed_kmh: float, gap_m: float) -> Course:
    """It, driven without a fault."""
    return course_of(Setup(ftm, scenario=sudden(folder, speed_kmh, gap_m)))
