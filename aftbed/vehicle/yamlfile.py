"""The user's YAML files, read strictly: scenarios and maps.

What a file may hold is said once, as a msgspec struct whose field names carry their units and whose types
carry their ranges. Reading is converting to it. What msgspec refuses is told to the user in full: the
file, the key, what was found, what is allowed, and for a key that does not exist the nearest that does.
"""

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import yaml
from msgspec import inspect

from aftbed.core.errors import ConfigError, unknown

YAML_BYTES_MAX: Final = 100_000
_WHERE: Final = re.compile(r" - at `\$(?P<path>.*)`$")
_UNKNOWN: Final = re.compile(r"unknown field `(?P<key>.*)`")
_MISSING: Final = re.compile(r"missing required field `(?P<key>.*)`")

S = TypeVar("S", bound=msgspec.Struct)


class _Loader(yaml.SafeLoader):
    """YAML lets a key stand twice, and the last one wins: not here."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable):
                if key in seen:
                    mark = key_node.start_mark
                    raise yaml.MarkedYAMLError(problem=f"key {key!r} stands twice", problem_mark=mark)
                seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path, shape: type[S]) -> S:
    """The file as a `shape`. Raises ConfigError naming file, key, what was found and what is allowed."""
    data = _read(path)
    found = _parse(path, data)
    if found is None:
        found = {}
    try:
        return msgspec.convert(found, shape)
    except msgspec.ValidationError as error:
        line = _line(data, str(error))
        raise ConfigError(f"{path}: {line}{_explain(str(error), found, shape)}") from error


def _read(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > YAML_BYTES_MAX:
        raise ConfigError(f"{path}: {len(data)} bytes, allowed are {YAML_BYTES_MAX}")
    return data


def _parse(path: Path, data: bytes) -> object:
    try:
        found: object = yaml.load(data, Loader=_Loader)  # a SafeLoader
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{path}: {line}{error.problem}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not YAML: {error}") from error
    return found


def _line(data: bytes, reason: str) -> str:
    """`line N: `, where in the file what msgspec refuses stands; `""` for a file without any content."""
    node: yaml.Node | None = yaml.compose(data, Loader=_Loader)
    strange = _UNKNOWN.search(reason)
    at = _WHERE.search(reason)
    keys = [key for key in re.split(r"[.\[\]]+", at["path"] if at else "") if key]
    for key in (*keys, *([strange["key"]] if strange else [])):
        if isinstance(node, yaml.MappingNode):
            pairs = {str(name.value): (name, value) for name, value in node.value}
            if key in pairs and strange is not None and key == strange["key"]:
                node = pairs[key][0]
            elif key in pairs:
                node = pairs[key][1]
        elif isinstance(node, yaml.SequenceNode) and key.isdigit():
            node = node.value[int(key)]
    return f"line {node.start_mark.line + 1}: " if node is not None else ""


def _explain(reason: str, found: object, shape: type[msgspec.Struct]) -> str:
    """msgspec's reason, in the user's terms."""
    at = _WHERE.search(reason)
    path = at["path"].removeprefix(".") if at else ""
    reason = reason[: at.start()] if at else reason
    keys = [key for key in re.split(r"[.\[\]]+", path) if key]
    node, allowed = found, inspect.type_info(shape)
    for key in keys:
        node, allowed = _descend(node, allowed, key)
    where = f"{path}: " if path else ""
    if strange := _UNKNOWN.search(reason):
        return f"{where}{unknown('key', strange['key'], _keys(allowed))}"
    if missing := _MISSING.search(reason):
        return f"{where}key {missing['key']!r} is missing"
    return f"{where}found {node!r}, allowed is {_describe(allowed)}"


def _descend(node: object, allowed: inspect.Type, key: str) -> tuple[object, inspect.Type]:
    """One step along the path: the value there, and what is allowed there."""
    if key.isdigit() and isinstance(node, list):
        sequence = _only(allowed, inspect.ListType, inspect.VarTupleType)
        return node[int(key)], sequence.item_type if sequence else inspect.AnyType()
    struct = _only(allowed, inspect.StructType)
    fields = {field.name: field.type for field in struct.fields} if struct else {}
    value: object = node.get(key) if isinstance(node, dict) else None
    return value, fields.get(key, inspect.AnyType())


T = TypeVar("T", bound=inspect.Type)
U = TypeVar("U", bound=inspect.Type)


def _only(allowed: inspect.Type, first: type[T], second: type[U] | None = None) -> "T | U | None":
    """The member of an optional type that is of one of the kinds."""
    members = allowed.types if isinstance(allowed, inspect.UnionType) else (allowed,)
    for member in members:
        if isinstance(member, first):
            return member
        if second is not None and isinstance(member, second):
            return member
    return None


def _keys(allowed: inspect.Type) -> list[str]:
    struct = _only(allowed, inspect.StructType)
    return [field.name for field in struct.fields] if struct else []


def _describe(allowed: inspect.Type) -> str:
    """A type in words."""
    match allowed:
        case inspect.UnionType(types=types):
            return " or ".join(_describe(kind) for kind in types)
        case inspect.LiteralType(values=values):
            return "one of " + ", ".join(map(str, values))
        case inspect.FloatType():
            return "a number" + _limits(allowed)
        case inspect.IntType():
            return "a whole number" + _limits(allowed)
        case inspect.StructType():
            return "keys and values: " + ", ".join(_keys(allowed))
        case inspect.ListType() | inspect.VarTupleType():
            return "a list"
        case inspect.StrType():
            return "a text"
        case inspect.BoolType():
            return "true or false"
        case inspect.NoneType():
            return "nothing"
        case _:
            return "another value"


def _limits(allowed: inspect.FloatType | inspect.IntType) -> str:
    signs = (("more than", allowed.gt), ("at least", allowed.ge), ("less than", allowed.lt))
    words = [f"{sign} {limit:g}" for sign, limit in (*signs, ("at most", allowed.le)) if limit is not None]
    return " " + " and ".join(words) if words else ""
