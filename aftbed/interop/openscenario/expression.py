"""Parameters of OpenSCENARIO files: their values, arithmetic over them, and the variations of a distribution.

**Expressions**, `${$EgoSpeed / 3.6}` or `${max($Gap - 2, 0) * 1.5}` or `${not $Braking}`. The standard (ASAM
OpenSCENARIO XML 1.3, 9.2) has + - * / % and parentheses, `and`, `or`, `not`, `true`, `false`, `pi`, and the
functions below. `ast` parses the text and `evaluate` walks the tree over a closed list of nodes: everything
else of Python (another name, an attribute, another call, `**`, a string, a lambda) is refused by its name.
Nothing is evaluated by Python itself. Before parsing, the text may contain only numbers in XML notation,
names, operators and parentheses, and its length is limited. Angles are in radians.

**Parameters.** `substituted` makes a new tree without any `$name` or `${expression}`, so the rest of the
importer does not deal with parameters; a ParameterCondition gets the value that it compares. The scope of a
parameter is the element that holds its `ParameterDeclarations` (the file, a story, a maneuver, a vehicle, an
environment); the innermost declaration wins. A variation gives other values to the parameters of the file;
their types and constraints are checked in the same way. A name may be declared with a leading `$`, as files
of OpenSCENARIO 1.0 do. A `$` that starts no name (`costs $5`) is an ordinary character.

**Variations.** A parameter value distribution gives one scenario file many sets of values. Deterministic
distributions are combined: each value of one with each of the others, the last one changing fastest (9.3):

    DistributionSet        the values listed
    DistributionRange      from `lowerLimit` to `upperLimit` in steps of `stepWidth`, both ends included
    ValueSetDistribution   values of several parameters that belong together

Stochastic distributions (uniform, normal, histogram, weighted set) are drawn `numberOfTestRuns` times from a
generator seeded with the file's `randomSeed` or, without one, with the seed of the command. The same seed
gives the same draws. Others (log-normal, Poisson, user-defined) are refused. The name of a variation is made
of the names and values of its parameters, so it stays the same when the distribution gets more values.
"""

import ast
import hashlib
import itertools
import math
import operator
import random
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.interop.openscenario.document import SHOWN_CHARACTERS_MAX, Element, finite

EXPRESSION_CHARACTERS_MAX: Final = 1_000
VARIATIONS_MAX: Final = 1_000
NAME_CHARACTERS_MAX: Final = 100
_DRAWS_MAX: Final = 1_000  # tries to draw a normal value within its range
_STEP_EPSILON: Final = 1e-9  # steps: an upper limit that is a multiple of the step belongs to the range

_NUMBER: Final = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?![A-Za-z0-9_.])"
_NAME: Final = r"\$?[A-Za-z_][A-Za-z0-9_]*(?![A-Za-z0-9_])"
_TOKENS: Final = re.compile(rf"(?: *(?:{_NUMBER}|{_NAME}|[-+*/%(),]))* *")
_PLACEHOLDER: Final = "é"  # before a parameter while Python parses; `_TOKENS` keeps it out of the input
_DECLARED_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_PARAMETER: Final = re.compile(rf"\$({_DECLARED_NAME.pattern})")
_EXPRESSION: Final = re.compile(r"\$\{(.*)\}", re.DOTALL)
_NOT_IN_FILE_NAMES: Final = re.compile(r"[^A-Za-z0-9.+-]+")

Values = Mapping[str, str]


# -- expressions


def _modulo(left: float, right: float) -> float:
    if right == 0.0:
        raise ZeroDivisionError
    return math.fmod(left, right)


def _sign(value: float) -> float:
    return 0.0 if value == 0.0 else math.copysign(1.0, value)


_SIGNS: Final[Mapping[type[ast.unaryop], Callable[[float], float]]] = {
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_OPERATORS: Final[Mapping[type[ast.operator], Callable[[float, float], float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: _modulo,
}
_UNARY: Final[Mapping[str, Callable[[float], float]]] = {
    "round": lambda value: math.copysign(math.floor(abs(value) + 0.5), value),  # halves away from zero
    "floor": lambda value: float(math.floor(value)),
    "ceil": lambda value: float(math.ceil(value)),
    "sqrt": math.sqrt,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "sign": _sign,
    "abs": abs,
}
_BINARY: Final[Mapping[str, Callable[[float, float], float]]] = {"max": max, "min": min, "pow": math.pow}
FUNCTIONS: Final = (*_UNARY, *_BINARY)
_CONSTANTS: Final[Mapping[str, float | bool]] = {"pi": math.pi, "true": True, "false": False}


def evaluate(text: str, values: Values) -> float | bool:
    """The value of the text between `${` and `}`. Raises ConfigError with the reason, but without a place."""
    if len(text) > EXPRESSION_CHARACTERS_MAX:
        raise ConfigError(f"{len(text)} characters, allowed are {EXPRESSION_CHARACTERS_MAX}")
    if not _TOKENS.fullmatch(text):
        raise ConfigError("allowed are numbers, $parameters, + - * / % ( ) and functions")
    try:
        tree = ast.parse(_PARAMETER.sub(rf" {_PLACEHOLDER}\1 ", text).strip(), mode="eval")
        found = _value(tree.body, values)
    except ZeroDivisionError as error:
        raise ConfigError("division by zero") from error
    except OverflowError as error:
        raise ConfigError("the result is too large") from error
    except ValueError as error:
        raise ConfigError("outside of the function's domain") from error
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise ConfigError("not understood as arithmetic") from error
    if not math.isfinite(found):
        raise ConfigError("the result is not a finite number")
    return found


def _value(node: ast.expr, values: Values) -> float | bool:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id=name) if name.startswith(_PLACEHOLDER):
            return _parameter_value(name.removeprefix(_PLACEHOLDER), values)
        case ast.Name(id=name) if name in _CONSTANTS:
            return _CONSTANTS[name]
        case ast.Name(id=name):
            raise ConfigError(f"the name {name!r}: a parameter is written ${name}")
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return not _truth("not", operand, values)
        case ast.BoolOp(op=operation, values=operands):
            word, combine = ("and", all) if isinstance(operation, ast.And) else ("or", any)
            return combine([_truth(word, operand, values) for operand in operands])
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _SIGNS:
            return _SIGNS[type(sign)](_number(operand, values))
        case ast.BinOp(left=left, op=operation, right=right):
            if type(operation) not in _OPERATORS:
                raise ConfigError(f"the operator {type(operation).__name__} is none of + - * / %")
            return _OPERATORS[type(operation)](_number(left, values), _number(right, values))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            return _call(name, [_number(argument, values) for argument in arguments])
        case _:
            raise ConfigError(f"{type(node).__name__} is no arithmetic")


def _number(node: ast.expr, values: Values) -> float:
    found = _value(node, values)
    if isinstance(found, bool):
        raise ConfigError(f"found {str(found).lower()}, allowed is a number")
    return found


def _truth(word: str, node: ast.expr, values: Values) -> bool:
    found = _value(node, values)
    if not isinstance(found, bool):
        raise ConfigError(f"{word} takes true or false, found {found:g}")
    return found


def _call(name: str, arguments: list[float]) -> float:
    match arguments:
        case [value] if name in _UNARY:
            return _UNARY[name](value)
        case [left, right] if name in _BINARY:
            return _BINARY[name](left, right)
    if name not in FUNCTIONS:
        raise unknown("function", name, FUNCTIONS)
    raise ConfigError(f"{name} takes {1 if name in _UNARY else 2} arguments, found {len(arguments)}")


def _parameter_value(name: str, values: Values) -> float | bool:
    if name not in values:
        raise unknown("parameter", name, values)
    if values[name] in ("true", "false"):
        return values[name] == "true"
    found = finite(values[name])
    if found is None:
        raise ConfigError(f"${name} is {values[name]!r}, allowed is a number")
    return found


# -- parameters

_INTEGERS: Final = ("integer", "int", "unsignedInt", "unsignedShort")
_TYPES: Final = ("double", *_INTEGERS, "boolean", "string", "dateTime")
_COMPARISONS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    "equalTo": operator.eq,
    "greaterThan": operator.gt,
    "lessThan": operator.lt,
    "greaterOrEqual": operator.ge,
    "lessOrEqual": operator.le,
    "notEqualTo": operator.ne,
}
RULES: Final = tuple(_COMPARISONS)


def declared(root: Element) -> list[str]:
    """The names of the parameters declared at the root of the file. A variation may set these."""
    groups = [group for group in root.children if group.tag == "ParameterDeclarations"]
    return [_name(one) for group in groups for one in group.children if one.has("name")]


def substituted(element: Element, variation: Values, outer: Values | None = None) -> Element:
    """A copy of the tree with every parameter replaced by its value.

    `variation` overrules the values declared in `element` itself; `outer` are the values of its surroundings.
    """
    outer = outer or {}
    values = outer
    for group in element.children:
        if group.tag == "ParameterDeclarations":
            values = _declared_values(group, values, variation)
    copy = Element(element.path, element.line, element.tag, {})
    copy.text = element.text
    if element.tag == "ParameterCondition":
        copy.parameter = _value_of(element, "parameterRef", outer)
    copy.attributes = {name: _replaced(element, name, outer) for name in element.attributes}
    copy.children = [
        substituted(child, {}, values) for child in element.children if child.tag != "ParameterDeclarations"
    ]
    return copy


def replaced_below(entry: Element, assigned: Values) -> Element:
    """A catalog entry with its own parameters replaced by the values that the reference to it assigns."""
    strange = sorted(set(assigned) - set(declared(entry)))
    if strange:
        raise entry.error(str(unknown("parameter", strange[0], declared(entry))))
    return substituted(entry, assigned)


def _declared_values(group: Element, outer: Values, variation: Values) -> Values:
    values = dict(outer)
    for one in group.children:
        if one.tag != "ParameterDeclaration":
            raise one.error("allowed is ParameterDeclaration")
        one.visited = True
        name, default = _name(one), _replaced(one, "value", values)
        values[name] = variation.get(name, default)
        _check(one, name, values[name], values)
    return values


def _name(one: Element) -> str:
    name = one.word("name").removeprefix("$")
    if not _DECLARED_NAME.fullmatch(name):
        raise one.wrong("name", "letters, digits and _, with no digit in front")
    return name


def _check(one: Element, name: str, value: str, values: Values) -> None:
    """Check that the value is of the declared type and satisfies at least one ConstraintGroup."""
    kind = one.choice("parameterType", _TYPES)
    number = finite(value)
    shown = f"{name} = {value[:SHOWN_CHARACTERS_MAX]!r}"
    if kind in ("double", *_INTEGERS) and number is None:
        raise one.error(f"{shown}, allowed is a number")
    if kind in _INTEGERS and number is not None and number != int(number):
        raise one.error(f"{shown}, allowed is a whole number")
    if kind.startswith("unsigned") and number is not None and number < 0:
        raise one.error(f"{shown}, allowed is 0 or more")
    for group in one.children:
        if group.tag != "ConstraintGroup":
            raise group.error("allowed is ConstraintGroup")
    if one.children and not any(_holds(group, value, values) for group in one.children):
        raise one.error(f"{shown} keeps to no ConstraintGroup")


def _holds(group: Element, value: str, values: Values) -> bool:
    for constraint in group.children:
        if constraint.tag != "ValueConstraint":
            raise constraint.error("allowed is ValueConstraint")
    return all(
        obeys(value, one.choice("rule", RULES), _replaced(one, "value", values)) for one in group.children
    )


def obeys(value: str, rule: str, limit: str) -> bool:
    """Whether `value` is to `limit` as `rule` says: as numbers, or as texts, which are equal or not."""
    left, right = finite(value), finite(limit)
    if left is None or right is None:
        return value == limit if rule == "equalTo" else rule == "notEqualTo" and value != limit
    return _COMPARISONS[rule](left, right)


def _replaced(element: Element, name: str, values: Values) -> str:
    text = element.word(name)
    if _PARAMETER.fullmatch(text):
        return _value_of(element, name, values)
    if expression := _EXPRESSION.fullmatch(text):
        try:
            found = evaluate(expression[1], values)
        except ConfigError as error:
            raise element.error(f"{name}: {text[:SHOWN_CHARACTERS_MAX]!r}: {error}") from error
        return str(found).lower() if isinstance(found, bool) else repr(found)
    return text


def _value_of(element: Element, attribute: str, values: Values) -> str:
    """The value of the parameter that an attribute names, with or without a $."""
    name = _parameter(element, attribute)
    if name not in values:
        raise element.error(f"{attribute}: {unknown('parameter', name, values)}")
    return values[name]


# -- variations


def variations_of(
    root: Element, scenario: str, parameters: list[str], seed: int, pick: Sequence[tuple[str, str]] = ()
) -> list[Values]:
    """The sets of values that the distribution `root` gives to the `parameters` of the file `scenario`.

    `pick` has names with values: of each parameter named, only the values that are in it.
    """
    definition = root.one("ParameterValueDistribution")
    file = definition.one("ScenarioFile")
    if PurePosixPath(file.word("filepath").replace("\\", "/")).name != scenario:
        raise file.wrong("filepath", f"a path to {scenario}")
    kind = definition.one("Deterministic", "Stochastic")
    found = _deterministic(kind, pick) if kind.tag == "Deterministic" else _stochastic(kind, seed, pick)
    for name in found[0]:
        if name not in parameters:
            raise kind.error(str(unknown(f"parameter of {scenario}", name, parameters)))
    return found


def variation_name(stem: str, values: Values) -> str:
    """The name of a scenario with these values: `brake-EgoSpeed-50-Gap-12`."""
    full = "-".join([stem, *(f"{name}-{value.removesuffix('.0')}" for name, value in values.items())])
    name = _NOT_IN_FILE_NAMES.sub("_", full)
    if len(name) <= NAME_CHARACTERS_MAX and name == full:
        return name
    return f"{name[: NAME_CHARACTERS_MAX - 9]}-{hashlib.blake2b(full.encode(), digest_size=4).hexdigest()}"


def _picked(kind: Element, axes: list[list[dict[str, str]]], pick: Sequence[tuple[str, str]]) -> None:
    """Keep of each axis the sets that `pick` takes. Raises ConfigError if it takes none."""
    names = sorted({name for axis in axes for values in axis for name in values})
    for name in dict.fromkeys(name for name, _ in pick):
        if name not in names:
            raise ConfigError(f"--pick: {unknown('varied parameter', name, names)}")
        wanted = [value for one, value in pick if one == name]
        for axis in axes:
            if not any(name in values for values in axis):
                continue
            there = [values.get(name, "") for values in axis]
            axis[:] = [one for one in axis if any(_is_value(one.get(name, ""), value) for value in wanted)]
            if not axis:
                values = ", ".join(dict.fromkeys(there))
                raise ConfigError(f"--pick: {name} is never {' or '.join(wanted)} (one of: {values})")
    if math.prod(len(axis) for axis in axes) > VARIATIONS_MAX:
        count = math.prod(len(axis) for axis in axes)
        raise kind.error(f"{count} variations, allowed are {VARIATIONS_MAX}; --pick NAME=VALUE takes some")


def _is_value(value: str, wanted: str) -> bool:
    left, right = finite(value), finite(wanted)
    return value == wanted if left is None or right is None else left == right


def _deterministic(kind: Element, pick: Sequence[tuple[str, str]]) -> list[Values]:
    axes: list[list[dict[str, str]]] = []
    for one in kind.every(
        "DeterministicSingleParameterDistribution", "DeterministicMultiParameterDistribution"
    ):
        if one.tag == "DeterministicSingleParameterDistribution":
            name = _parameter(one, "parameterName")
            axes.append([{name: value} for value in _values(one)])
        else:
            sets = one.one("ValueSetDistribution").every("ParameterValueSet")
            axes.append([_assigned(group) for group in sets])
    if not axes or not all(axes):
        raise kind.error("no distribution, or one without values")
    _picked(kind, axes, pick)
    names = [{name for values in axis for name in values} for axis in axes]
    for first, second in itertools.combinations(names, 2):
        if twice := sorted(first & second):
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
    return [_decimal(lower + i * step) for i in range(math.floor(steps + _STEP_EPSILON) + 1)]


def _limits(limits: Element) -> tuple[float, float]:
    lower, upper = limits.number("lowerLimit"), limits.number("upperLimit")
    if upper < lower or not math.isfinite(upper - lower):
        raise limits.wrong("upperLimit", f"{lower:g}, the lowerLimit, or more")
    return lower, upper


def _parameter(one: Element, attribute: str) -> str:
    return one.word(attribute).removeprefix("$")


def _assigned(group: Element) -> dict[str, str]:
    assigned: dict[str, str] = {}
    for one in group.every("ParameterAssignment"):
        name = _parameter(one, "parameterRef")
        if name in assigned:
            raise one.error(f"parameter {name!r} stands twice")
        assigned[name] = one.word("value")
    return assigned


def _decimal(value: float) -> str:
    """Rounded to 9 decimals; a whole number without a point."""
    rounded = round(value, 9)
    return str(int(rounded)) if rounded == int(rounded) else repr(rounded)


def _stochastic(kind: Element, seed: int, pick: Sequence[tuple[str, str]]) -> list[Values]:
    runs = kind.number("numberOfTestRuns")
    if not 1 <= runs <= VARIATIONS_MAX or runs != int(runs):
        raise kind.wrong("numberOfTestRuns", f"a whole number, 1 to {VARIATIONS_MAX}")
    chance = random.Random(repr(kind.number("randomSeed", float(seed))))
    distributions = kind.every("StochasticDistribution")
    if not distributions:
        raise kind.error("no StochasticDistribution")
    names = [_parameter(one, "parameterName") for one in distributions]
    if len(set(names)) < len(names):
        raise kind.error("a parameter stands in two distributions")
    drawn = [
        {name: _draw(one, chance) for name, one in zip(names, distributions, strict=True)}
        for _ in range(int(runs))
    ]
    _picked(kind, [drawn], pick)
    return list(drawn)


def _draw(one: Element, chance: random.Random) -> str:
    kind = one.one("UniformDistribution", "NormalDistribution", "ProbabilityDistributionSet", "Histogram")
    match kind.tag:
        case "UniformDistribution":
            return _decimal(chance.uniform(*_limits(kind.one("Range"))))
        case "NormalDistribution":
            return _decimal(_draw_normal(kind, chance))
        case "ProbabilityDistributionSet":
            elements = kind.every("Element")
            words = [element.word("value") for element in elements]
            return words[_weighted(kind, elements, chance)]
        case _:
            bins = kind.every("Bin")
            limits = [_limits(one.one("Range")) for one in bins]
            return _decimal(chance.uniform(*limits[_weighted(kind, bins, chance)]))


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
    """The index of the choice that is drawn."""
    weights = [one.number("weight") for one in choices]
    if not weights or min(weights) < 0.0 or not 0.0 < sum(weights) < math.inf:
        raise kind.error("weights have to be 0 or more, and not all 0")
    return chance.choices(range(len(weights)), weights)[0]
