"""A parameter value distribution gives each set of values a scenario of its own, with a name that stays."""

from itertools import pairwise
from pathlib import Path

import pytest
from xoscfiles import FOLDER, LEAD_BRAKES, VALUES, changed

from aftbed.core.errors import ConfigError
from aftbed.interop.openscenario.importer import ImportedFile, ImportOptions, import_scenario, write
from aftbed.vehicle.scenarios.library import load_scenario

GAPS = '<Element value="12"/>'
RANGE = '<Range lowerLimit="2" upperLimit="6"/>'
STEP = '<DistributionRange stepWidth="2">'
SINGLES = VALUES.read_text().partition("<Deterministic>")[2].partition("</Deterministic>")[0]


def varied(path: Path, seed: int = 0) -> ImportedFile:
    return import_scenario(LEAD_BRAKES, path, ImportOptions(seed=seed))


def distribution(folder: Path, inner: str) -> Path:
    text = VALUES.read_text().replace(SINGLES, inner)
    path = folder / "values.xosc"
    path.write_text(text)
    return path


def stochastic(folder: Path, inner: str, attributes: str = 'numberOfTestRuns="50"') -> Path:
    text = VALUES.read_text().replace(SINGLES, inner)
    path = folder / "values.xosc"
    path.write_text(
        text.replace("<Deterministic>", f"<Stochastic {attributes}>").replace("Deterministic>", "Stochastic>")
    )
    return path


def values(found: ImportedFile, name: str) -> list[float]:
    return [float(one.parameters[name]) for one in found.variations]


# -- deterministic


def test_each_value_of_one_parameter_with_each_of_the_other(tmp_path: Path) -> None:
    found = varied(VALUES)
    paths = write(found, tmp_path, force=False)
    assert [path.name for path in paths] == [
        f"lead_brakes-Gap-{gap}-Deceleration-{hard}.yaml" for gap in (12, 40) for hard in (2, 4, 6)
    ]
    leads = [load_scenario(str(path)).plant.lead for path in paths]
    assert [(lead.gap_m, lead.braking.deceleration_ms2) for lead in leads if lead and lead.braking] == [
        (gap, hard) for gap in (12, 40) for hard in (2, 4, 6)
    ]


def test_a_name_stays_when_a_value_is_added(tmp_path: Path) -> None:
    more = changed(tmp_path, (GAPS, '<Element value="8"/>' + GAPS), source=VALUES)
    old = {one.name: one.text for one in varied(VALUES).variations}
    new = {one.name: one.text for one in varied(more).variations}
    assert len(new) == len(old) + 3
    assert old.items() <= new.items()


def test_values_that_belong_together(tmp_path: Path) -> None:
    sets = "".join(
        "<ParameterValueSet>"
        f'<ParameterAssignment parameterRef="SpeedKmh" value="{speed}"/>'
        f'<ParameterAssignment parameterRef="$Gap" value="{gap}"/>'
        "</ParameterValueSet>"
        for speed, gap in ((50, 40), (80, 60))
    )
    inner = (
        "<DeterministicMultiParameterDistribution><ValueSetDistribution>"
        f"{sets}</ValueSetDistribution></DeterministicMultiParameterDistribution>"
    )
    found = varied(distribution(tmp_path, inner))
    assert [one.parameters for one in found.variations] == [
        {"SpeedKmh": "50", "Gap": "40"},
        {"SpeedKmh": "80", "Gap": "60"},
    ]


def test_a_range_has_both_its_ends_and_no_dust(tmp_path: Path) -> None:
    path = changed(
        tmp_path,
        (STEP, '<DistributionRange stepWidth="0.1">'),
        (RANGE, '<Range lowerLimit="1.1" upperLimit="1.5"/>'),
        source=VALUES,
    )
    found = varied(path)
    assert [one.parameters["Deceleration"] for one in found.variations[:5]] == [
        "1.1",
        "1.2",
        "1.3",
        "1.4",
        "1.5",
    ]
    assert len(found.variations) == 10


# -- stochastic


UNIFORM = (
    '<StochasticDistribution parameterName="Gap"><UniformDistribution>'
    '<Range lowerLimit="20" upperLimit="40"/></UniformDistribution></StochasticDistribution>'
)


def test_the_same_seed_draws_the_same_values(tmp_path: Path) -> None:
    path = stochastic(tmp_path, UNIFORM)
    first, again, other = (values(varied(path, seed), "Gap") for seed in (1, 1, 2))
    assert first == again != other
    assert len(set(first)) == 50
    assert all(20 <= gap <= 40 for gap in first)
    own = stochastic(tmp_path, UNIFORM, 'numberOfTestRuns="50" randomSeed="7"')
    assert values(varied(own, 1), "Gap") == values(varied(own, 2), "Gap"), "the file's own seed goes before"


@pytest.mark.parametrize(
    ("kind", "lower", "upper"),
    [
        (
            '<NormalDistribution expectedValue="30" variance="25"><Range lowerLimit="29" upperLimit="33"/>'
            "</NormalDistribution>",
            29,
            33,
        ),
        (
            '<Histogram><Bin weight="0"><Range lowerLimit="5" upperLimit="9"/></Bin>'
            '<Bin weight="2"><Range lowerLimit="30" upperLimit="31"/></Bin></Histogram>',
            30,
            31,
        ),
        (
            '<ProbabilityDistributionSet><Element value="30" weight="3"/><Element value="40" weight="1"/>'
            "</ProbabilityDistributionSet>",
            30,
            40,
        ),
    ],
)
def test_each_kind_of_chance(kind: str, lower: float, upper: float, tmp_path: Path) -> None:
    inner = f'<StochasticDistribution parameterName="Gap">{kind}</StochasticDistribution>'
    found = varied(stochastic(tmp_path, inner))
    assert found.sets == 50
    drawn = values(found, "Gap")
    assert len(drawn) > 1
    assert lower <= min(drawn) < max(drawn) <= upper


def test_a_value_that_is_drawn_twice_is_one_scenario(tmp_path: Path) -> None:
    inner = (
        '<StochasticDistribution parameterName="Gap"><ProbabilityDistributionSet>'
        '<Element value="30" weight="1"/></ProbabilityDistributionSet></StochasticDistribution>'
    )
    found = varied(stochastic(tmp_path, inner))
    assert (found.sets, len(found.variations)) == (50, 1)


# -- what is refused


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('filepath="lead_brakes.xosc"', 'filepath="other.xosc"', "allowed is a path to lead_brakes.xosc"),
        (
            'parameterName="Gap"',
            'parameterName="Gab"',
            "unknown parameter of lead_brakes.xosc 'Gab'; did you mean",
        ),
        ('parameterName="Gap"', 'parameterName="Deceleration"', "'Deceleration' stands in two distributions"),
        (
            GAPS,
            '<Element value="wide"/>',
            "Gap = 'wide', allowed is a number\n  with Gap = wide, Deceleration = 2",
        ),
        (GAPS, '<Element value="-3"/>', "'Lead' is -3 m ahead of the ego, bumper to bumper\n  with Gap = -3"),
        (STEP, '<DistributionRange stepWidth="0">', "stepWidth: found '0', allowed is more than 0"),
        (STEP, '<DistributionRange stepWidth="0.000001">', "4000001 values, allowed are 1000"),
        (
            RANGE,
            '<Range lowerLimit="2" upperLimit="1"/>',
            "upperLimit: found '1', allowed is 2, the lowerLimit",
        ),
        (RANGE, '<Range lowerLimit="-1e308" upperLimit="1e308"/>', "upperLimit: found '1e308'"),
        ("<Deterministic>", "<Deterministic><Magic/>", "line 6: Magic: not allowed here in Deterministic"),
        (RANGE, "", "found nothing, allowed is Range"),
        (STEP, '<DistributionRange stepWidth="0.008">', "1002 variations, allowed are 1000"),
    ],
)
def test_a_distribution_that_does_not_fit_is_refused(old: str, new: str, reason: str, tmp_path: Path) -> None:
    path = changed(tmp_path, (old, new), source=VALUES)
    with pytest.raises(ConfigError) as error:
        varied(path)
    assert reason in str(error.value)


@pytest.mark.parametrize(
    ("inner", "attributes", "reason"),
    [
        (
            UNIFORM,
            'numberOfTestRuns="0"',
            "numberOfTestRuns: found '0', allowed is a whole number, 1 to 1000",
        ),
        (UNIFORM, 'numberOfTestRuns="1e9"', "numberOfTestRuns: found '1e9'"),
        (UNIFORM * 2, 'numberOfTestRuns="2"', "a parameter stands in two distributions"),
        ("", 'numberOfTestRuns="2"', "Stochastic: found nothing, allowed is StochasticDistribution"),
        (
            UNIFORM.replace("Uniform", "Poisson").replace("bution>", 'bution expectedValue="1">', 1),
            'numberOfTestRuns="2"',
            "found PoissonDistribution, allowed is UniformDistribution or NormalDistribution or",
        ),
        (
            UNIFORM.replace("<Uniform", '<Normal expectedValue="0" variance="1" ')
            .replace("<Normal ", "<NormalDistribution ")
            .replace(" Distribution>", ">")
            .replace("</Uniform", "</Normal"),
            'numberOfTestRuns="2"',
            "none of 1000 draws falls into the range",
        ),
        (
            '<StochasticDistribution parameterName="Gap"><ProbabilityDistributionSet>'
            '<Element value="1" weight="0"/></ProbabilityDistributionSet></StochasticDistribution>',
            'numberOfTestRuns="2"',
            "weights have to be 0 or more, and not all 0",
        ),
    ],
)
def test_chance_that_cannot_be_drawn_is_refused(
    inner: str, attributes: str, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as error:
        varied(stochastic(tmp_path, inner, attributes))
    assert reason in str(error.value)


def test_a_scenario_is_no_distribution() -> None:
    with pytest.raises(ConfigError, match="no ParameterValueDistribution in it"):
        varied(LEAD_BRAKES)
    with pytest.raises(ConfigError, match="no ParameterValueDistribution in it"):
        varied(FOLDER / "catalogs" / "cars.xosc")


# -- what is written


def test_a_different_file_is_not_overwritten(tmp_path: Path) -> None:
    found = varied(VALUES)
    paths = write(found, tmp_path / "new" / "folder", force=False)
    assert write(found, tmp_path / "new" / "folder", force=False) == paths, "the same text again is no matter"
    paths[-1].write_text("mine")
    paths[0].unlink()
    with pytest.raises(ConfigError, match="exists, and says something else; --force writes over it"):
        write(found, tmp_path / "new" / "folder", force=False)
    assert not paths[0].exists(), "all or nothing"
    write(found, tmp_path / "new" / "folder", force=True)
    assert paths[0].exists()
    assert paths[-1].read_text() != "mine"


def test_names_are_fit_for_files(tmp_path: Path) -> None:
    first = '<ParameterDeclaration name="SpeedKmh"'
    note = '<ParameterDeclaration name="Note" parameterType="string" value=""/>'
    text = LEAD_BRAKES.read_text().replace(first, note + first)
    scenario = tmp_path / "lead_brakes.xosc"
    scenario.write_text(text)
    notes = ("../../etc/x", ".._.._etc_x", "a b", "é", "x" * 500, "x" * 501, "")
    elements = "".join(f'<Element value="{note}"/>' for note in notes)
    inner = (
        '<DeterministicSingleParameterDistribution parameterName="Note"><DistributionSet>'
        f"{elements}</DistributionSet></DeterministicSingleParameterDistribution>"
    )
    found = import_scenario(scenario, distribution(tmp_path, inner), ImportOptions())
    names = sorted(one.name for one in found.variations)
    assert len(names) == len(notes)
    assert all(first != second for first, second in pairwise(names))
    assert all(len(name) <= 100 and "/" not in name and name.isascii() for name in names)
    write(found, tmp_path / "out", force=False)
    assert len(list((tmp_path / "out").iterdir())) == len(notes)
