"""A parameter value distribution: one scenario file, many sets of values for its parameters.

Deterministic distributions are combined with each other, each value of one with each of the others, the
last one changing fastest (ASAM OpenSCENARIO XML 1.3, 9.3):

    DistributionSet        the values listed
    DistributionRange      from `lowerLimit` to `upperLimit` in steps of `stepWidth`, both ends included
    ValueSetDistribution   values of several parameters that belong together

Stochastic distributions are drawn `numberOfTestRuns` times from a generator with the file's `randomSeed`,
or with the seed that is asked for: uniform, normal, histogram, and a set with weights. The same seed gives
the same draws. Others (log-normal, Poisson, user-defined) are refused.

The name of a variation is made of the names and values of its parameters, so it stays the same when other
values are added to the distribution.
"""

import hashlib
import itertools
import math
import random
import re
from pathlib import PurePosixPath
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.xosc.parameters import Values
from aftbed.vehicle.xosc.tree import Element

VARIATIONS_MAX: Final = 1_000
NAME_CHARACTERS_MAX: Final = 100
_DRAWS_MAX: Final = 1_000  # of a normal distribution, until one falls into its range
_STRANGE: Final = re.compile(r"[^A-Za-z0-9.+-]+")
_STEP_EPSILON: Final = 1e-9  # of a step: an upper limit that is a multiple of the step belongs to the range


def variations_of(root: Element, scenario: str, parameters: list[str], seed: int) -> list[Values]:
    """The sets of values that the distribution `root` gives to the `parameters` of the file `scenario`."""
    definition = root.one("ParameterValueDistribution")
    file = definition.one("ScenarioFile")
    if PurePosixPath(file.word("filepath").replace("\\", "/")).name != scenario:
        raise file.wrong("filepath", f"a path to {scenario}")
    kind = definition.one("Deterministic", "Stochastic")
    found = _deterministic(kind) if kind.tag == "Deterministic" else _stochastic(kind, seed)
    for name in found[0]:
        if name not in parameters:
            raise kind.error(str(unknown(f"parameter of {scenario}", name, parameters)))
    return found


def variation_name(stem: str, values: Values) -> str:
    """The name of a scenario with these values: `brake-EgoSpeed-50-Gap-12`."""
    full = "-".join([stem, *(f"{name}-{_plain(value)}" for name, value in values.items())])
    name = _STRANGE.sub("_", full)
    if len(name) > NAME_CHARACTERS_MAX or name != full:
        name = (
            f"{name[: NAME_CHARACTERS_MAX - 9]}-{hashlib.blake2b(full.encode(), digest_size=4).hexdigest()}"
        )
    return name


def _plain(value: str) -> str:
    return value.removesuffix(".0")


# -- deterministic


def _deterministic(kind: Element) -> list[Values]:
    axes: list[list[dict[str, str]]] = []
    for one in kind.every(
        "DeterministicSingleParameterDistribution", "DeterministicMultiParameterDistribution"
    ):
        if one.tag == "DeterministicSingleParameterDistribution":
            name = one.word("parameterName").removeprefix("$")
            axes.append([{name: value} for value in _values(one)])
        else:
            sets = one.one("ValueSetDistribution").every("ParameterValueSet")
            axes.append([_assigned(group) for group in sets])
    if not axes or not all(axes):
        raise kind.error("no distribution, or one without values")
    count = math.prod(len(axis) for axis in axes)
    if count > VARIATIONS_MAX:
        raise kind.error(f"{count} variations, allowed are {VARIATIONS_MAX}")
    names = [sorted({name for values in axis for name in values}) for axis in axes]
    for first, second in itertools.combinations(names, 2):
        if twice := sorted(set(first) & set(second)):
            raise kind.error(f"parameter {twice[0]!r} stands in two distributions")
    return [
        {name: value for values in choice for name, value in values.items()}
        for choice in itertools.product(*axes)
    ]


def _values(one: Element) -> list[str]:
    kind = one.one("DistributionSet", "DistributionRange")
    if kind.tag == "DistributionSet":
        return [element.word("value") for element in kind.every("Element")]
    lower, upper = _limits(kind.one("Range"))
    step = kind.number("stepWidth")
    if step <= 0.0:
        raise kind.wrong("stepWidth", "more than 0")
    steps = (upper - lower) / step
    if steps >= VARIATIONS_MAX:
        raise kind.error(f"{steps + 1:.0f} values, allowed are {VARIATIONS_MAX}")
    return [_number(lower + i * step) for i in range(math.floor(steps + _STEP_EPSILON) + 1)]


def _limits(limits: Element) -> tuple[float, float]:
    lower, upper = limits.number("lowerLimit"), limits.number("upperLimit")
    if upper < lower or not math.isfinite(upper - lower):
        raise limits.wrong("upperLimit", f"{lower:g}, the lowerLimit, or more")
    return lower, upper


def _assigned(group: Element) -> dict[str, str]:
    assigned: dict[str, str] = {}
    for one in group.every("ParameterAssignment"):
        name = one.word("parameterRef").removeprefix("$")
        if name in assigned:
            raise one.error(f"parameter {name!r} stands twice")
        assigned[name] = one.word("value")
    return assigned


def _number(value: float) -> str:
    """Without the dust of binary fractions, and whole numbers as such."""
    rounded = round(value, 9)
    return str(int(rounded)) if rounded == int(rounded) else repr(rounded)


# -- stochastic


def _stochastic(kind: Element, seed: int) -> list[Values]:
    runs = kind.number("numberOfTestRuns")
    if not 1 <= runs <= VARIATIONS_MAX or runs != int(runs):
        raise kind.wrong("numberOfTestRuns", f"a whole number, 1 to {VARIATIONS_MAX}")
    chance = random.Random(repr(kind.number("randomSeed", float(seed))))
    distributions = kind.every("StochasticDistribution")
    if not distributions:
        raise kind.error("no StochasticDistribution")
    names = [one.word("parameterName").removeprefix("$") for one in distributions]
    if len(set(names)) < len(names):
        raise kind.error("a parameter stands in two distributions")
    return [
        {name: _draw(one, chance) for name, one in zip(names, distributions, strict=True)}
        for _ in range(int(runs))
    ]


def _draw(one: Element, chance: random.Random) -> str:
    kind = one.one("UniformDistribution", "NormalDistribution", "ProbabilityDistributionSet", "Histogram")
    match kind.tag:
        case "UniformDistribution":
            return _number(chance.uniform(*_limits(kind.one("Range"))))
        case "NormalDistribution":
            return _number(_draw_normal(kind, chance))
        case "ProbabilityDistributionSet":
            elements = kind.every("Element")
            words = [element.word("value") for element in elements]
            return words[_weighted(kind, elements, chance)]
        case _:
            bins = kind.every("Bin")
            limits = [_limits(one.one("Range")) for one in bins]
            return _number(chance.uniform(*limits[_weighted(kind, bins, chance)]))


def _draw_normal(kind: Element, chance: random.Random) -> float:
    mean, variance = kind.number("expectedValue"), kind.number("variance")
    if variance < 0.0:
        raise kind.wrong("variance", "0 or more")
    limits = kind.maybe("Range")
    lower, upper = _limits(limits) if limits else (-math.inf, math.inf)
    for _ in range(_DRAWS_MAX):
        value = chance.gauss(mean, math.sqrt(variance))
        if lower <= value <= upper and math.isfinite(value):
            return value
    raise kind.error(f"none of {_DRAWS_MAX} draws falls into the range")


def _weighted(kind: Element, choices: list[Element], chance: random.Random) -> int:
    """The place of the one that is drawn."""
    weights = [one.number("weight") for one in choices]
    if not weights or min(weights) < 0.0 or not 0.0 < sum(weights) < math.inf:
        raise kind.error("weights have to be 0 or more, and not all 0")
    return chance.choices(range(len(weights)), weights)[0]


def check_distribution(root: Element) -> None:
    """Raise ConfigError if `root` is not the root of a distribution file."""
    if not any(child.tag == "ParameterValueDistribution" for child in root.children):
        raise ConfigError(f"{root.path}: no ParameterValueDistribution in it")
