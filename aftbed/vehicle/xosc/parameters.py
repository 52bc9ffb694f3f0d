"""Parameters: declared in an element, seen in all that lies below it, replaced by their values.

`substituted` makes a new tree in which no `$name` and no `${expression}` is left, so the rest of the
importer knows nothing of parameters. Scopes are those of the elements that hold `ParameterDeclarations`
(the file, a story, a maneuver, a vehicle, an environment); the innermost declaration wins. A variation
gives other values to the parameters of the file; their type and their constraints are checked as if they
stood there.

A name may be declared with a `$` in front, as files of OpenSCENARIO 1.0 do. A `$` that begins no name
(`costs $5`) is a character like any other.
"""

import re
from collections.abc import Mapping
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.xosc.expression import evaluate
from aftbed.vehicle.xosc.tree import SHOWN_CHARACTERS_MAX, Element, finite

Values = Mapping[str, str]

RULES: Final = ("equalTo", "greaterThan", "lessThan", "greaterOrEqual", "lessOrEqual", "notEqualTo")
_WHOLE: Final = ("integer", "int", "unsignedInt", "unsignedShort")
_TYPES: Final = ("double", *_WHOLE, "boolean", "string", "dateTime")
_REFERENCE: Final = re.compile(r"\$([A-Za-z_][A-Za-z0-9_]*)")
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_EXPRESSION: Final = re.compile(r"\$\{(.*)\}", re.DOTALL)


def declared(root: Element) -> list[str]:
    """The names of the parameters that the file itself declares: those that a variation may set."""
    found = [group for group in root.children if group.tag == "ParameterDeclarations"]
    return [_name(one) for group in found for one in group.children if one.has("name")]


def substituted(root: Element, variation: Values) -> Element:
    """The same tree with every parameter replaced; `variation` overrules the values of the file's own."""
    return _substituted(root, {}, variation)


def replaced_below(entry: Element, assigned: Values) -> Element:
    """An entry of a catalog, its own parameters replaced by what the reference to it assigns."""
    strange = sorted(set(assigned) - set(declared(entry)))
    if strange:
        raise entry.error(str(unknown("parameter", strange[0], declared(entry))))
    return _substituted(entry, {}, assigned)


def _substituted(element: Element, outer: Values, variation: Values) -> Element:
    values = outer
    for group in element.children:
        if group.tag == "ParameterDeclarations":
            values = _declared_values(group, values, variation)
    copy = Element(element.path, element.line, element.tag, {})
    copy.text = element.text
    copy.attributes = {name: _replaced(element, name, outer) for name in element.attributes}
    copy.children = [
        _substituted(child, values, {}) for child in element.children if child.tag != "ParameterDeclarations"
    ]
    return copy


def _declared_values(group: Element, outer: Values, variation: Values) -> Values:
    values = dict(outer)
    for one in group.children:
        if one.tag != "ParameterDeclaration":
            raise one.error("allowed is ParameterDeclaration")
        one.visit()
        name = _name(one)
        values[name] = variation.get(name, _replaced(one, "value", values) if one.has("value") else "")
        if not one.has("value"):
            raise one.error("attribute 'value' is missing")
        _check(one, name, values[name], values)
    return values


def _name(one: Element) -> str:
    name = one.word("name").removeprefix("$")
    if not _NAME.fullmatch(name):
        raise one.wrong("name", "letters, digits and _, with no digit in front")
    return name


def _check(one: Element, name: str, value: str, values: Values) -> None:
    """The value is of the declared type and within one of the groups of constraints."""
    kind = one.choice("parameterType", _TYPES)
    number = finite(value)
    shown = f"{name} = {value[:SHOWN_CHARACTERS_MAX]!r}"
    if kind in ("double", *_WHOLE) and number is None:
        raise one.error(f"{shown}, allowed is a number")
    if kind in _WHOLE and number is not None and number != int(number):
        raise one.error(f"{shown}, allowed is a whole number")
    if kind.startswith("unsigned") and number is not None and number < 0:
        raise one.error(f"{shown}, allowed is 0 or more")
    for other in one.children:
        if other.tag != "ConstraintGroup":
            raise other.error("allowed is ConstraintGroup")
    if one.children and not any(_holds(group, value, values) for group in one.children):
        raise one.error(f"{shown} keeps to no ConstraintGroup")


def _holds(group: Element, value: str, values: Values) -> bool:
    """Whether all constraints of the group hold."""
    for constraint in group.children:
        if constraint.tag != "ValueConstraint":
            raise constraint.error("allowed is ValueConstraint")
    return all(
        _obeys(value, one.choice("rule", RULES), _replaced(one, "value", values)) for one in group.children
    )


def _obeys(value: str, rule: str, limit: str) -> bool:
    left, right = finite(value), finite(limit)
    if left is None or right is None:
        return {"equalTo": value == limit, "notEqualTo": value != limit}.get(rule, False)
    return obeys(left, rule, right)


def obeys(left: float, rule: str, right: float) -> bool:
    """Whether `left` is in the relation `rule`, one of `RULES`, to `right`."""
    match rule:
        case "equalTo":
            return left == right
        case "greaterThan":
            return left > right
        case "lessThan":
            return left < right
        case "greaterOrEqual":
            return left >= right
        case "lessOrEqual":
            return left <= right
        case _:
            assert rule == "notEqualTo", rule
            return left != right


def _replaced(element: Element, name: str, values: Values) -> str:
    """The value of an attribute with its parameter or expression replaced."""
    text = element.word(name)
    if reference := _REFERENCE.fullmatch(text):
        if reference[1] not in values:
            raise element.error(f"{name}: {unknown('parameter', reference[1], values)}")
        return values[reference[1]]
    if expression := _EXPRESSION.fullmatch(text):
        try:
            return repr(evaluate(expression[1], values))
        except ConfigError as error:
            shown = text[:SHOWN_CHARACTERS_MAX]
            raise element.error(f"{name}: {shown!r}: {error}") from error
    return text
