"""The arithmetic of OpenSCENARIO: what stands in `${...}`, over numbers and `$parameters`.

    ${$EgoSpeed / 3.6}      ${max($Gap - 2, 0) * 1.5}

The standard (ASAM OpenSCENARIO XML 1.3, 9.2) has + - * / %, parentheses, and the functions below. Python
knows how to parse that, so `ast` does, and this module walks the tree over a closed list of nodes: whatever
else Python can say (a name, an attribute, a call of something else, `**`, a string, a lambda) is refused
by its name, and nothing is ever evaluated by Python itself. Before that, the text may only have numbers as
XML writes them, names, operators and parentheses, and only so many characters.

Limits: numbers only; the standard's booleans (`and`, `or`, `not`) are refused. Angles are radians.
"""

import ast
import math
import re
from collections.abc import Callable, Mapping
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.xosc.tree import finite

EXPRESSION_CHARACTERS_MAX: Final = 200

_NUMBER: Final = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?![A-Za-z0-9_.])"
_NAME: Final = r"\$?[A-Za-z_][A-Za-z0-9_]*(?![A-Za-z0-9_])"
_TOKENS: Final = re.compile(rf"(?: *(?:{_NUMBER}|{_NAME}|[-+*/%(),]))* *")
_PARAMETER: Final = re.compile(r"\$([A-Za-z_][A-Za-z0-9_]*)")
_PLACE: Final = "é"  # begins what Python's parser sees of a parameter; nobody can write it, see _TOKENS


def _round(value: float) -> float:
    """Half away from zero, as a person does it."""
    return math.copysign(math.floor(abs(value) + 0.5), value)


def _sign(value: float) -> float:
    return 0.0 if value == 0.0 else math.copysign(1.0, value)


_UNARY: Final[Mapping[str, Callable[[float], float]]] = {
    "round": _round,
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


def parameters_in(text: str) -> list[str]:
    """The names behind each `$`."""
    return _PARAMETER.findall(text)


def evaluate(text: str, values: Mapping[str, str]) -> float:
    """The value of what stands between `${` and `}`. Raises ConfigError with the reason, without a place."""
    if len(text) > EXPRESSION_CHARACTERS_MAX:
        raise ConfigError(f"{len(text)} characters, allowed are {EXPRESSION_CHARACTERS_MAX}")
    if not _TOKENS.fullmatch(text):
        raise ConfigError("allowed are numbers, $parameters, + - * / % ( ) and functions")
    names: list[str] = []

    def place(found: re.Match[str]) -> str:
        names.append(found[1])
        return f" {_PLACE}{len(names) - 1} "

    try:
        tree = ast.parse(_PARAMETER.sub(place, text).strip(), mode="eval")
        found = _value(tree.body, {f"{_PLACE}{i}": _number(name, values) for i, name in enumerate(names)})
    except (SyntaxError, ValueError, OverflowError, ZeroDivisionError, RecursionError, MemoryError) as error:
        raise ConfigError(_reason(error)) from error
    if not math.isfinite(found):
        raise ConfigError("the result is not a finite number")
    return found


def _reason(error: Exception) -> str:
    match error:
        case ZeroDivisionError():
            return "division by zero"
        case OverflowError():
            return "the result is too large"
        case ValueError():
            return "outside of the function's domain"
        case _:
            return "not understood as arithmetic"


def _number(name: str, values: Mapping[str, str]) -> float:
    if name not in values:
        raise unknown("parameter", name, values)
    found = finite(values[name])
    if found is None:
        raise ConfigError(f"${name} is {values[name]!r}, allowed is a number")
    return found


def _value(node: ast.expr, places: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id=name) if name in places:
            return places[name]
        case ast.Name(id=name):
            raise ConfigError(f"the name {name!r}: a parameter is written ${name}")
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, places)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _value(operand, places)
        case ast.BinOp(left=left, op=operator, right=right):
            return _binary(operator, _value(left, places), _value(right, places))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            return _call(name, [_value(argument, places) for argument in arguments])
        case _:
            raise ConfigError(f"{type(node).__name__} is no arithmetic")


def _binary(operator: ast.operator, left: float, right: float) -> float:
    match operator:
        case ast.Add():
            return left + right
        case ast.Sub():
            return left - right
        case ast.Mult():
            return left * right
        case ast.Div():
            return left / right
        case ast.Mod():
            if right == 0.0:
                raise ZeroDivisionError
            return math.fmod(left, right)
        case _:
            raise ConfigError(f"the operator {type(operator).__name__} is none of + - * / %")


def _call(name: str, arguments: list[float]) -> float:
    match arguments:
        case [value] if name in _UNARY:
            return _UNARY[name](value)
        case [left, right] if name in _BINARY:
            return _BINARY[name](left, right)
    if name not in FUNCTIONS:
        raise unknown("function", name, FUNCTIONS)
    raise ConfigError(f"{name} takes {1 if name in _UNARY else 2} arguments, found {len(arguments)}")
