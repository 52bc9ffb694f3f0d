"""Reads the user's YAML files strictly: scenarios, maps, campaigns, policies, scripts.

A msgspec struct declares what a file may hold: its field names carry the units, its types the ranges. Reading
is converting to that struct. Where msgspec refuses a file, the error names the file, the line and the column,
the key, what was found and what is allowed; for an unknown key it suggests the nearest known one. What the
types do not express is checked elsewhere and raises FileKeyError: `in_file` adds where that stands.

Lines come from PyYAML's node tree, from which the values are made as well: each node knows where it starts.
"""

import contextlib
import re
from collections.abc import Hashable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import yaml
from msgspec import inspect

from aftbed.core.errors import ConfigError, FileKeyError, unknown
from aftbed.core.input_file import read_input

YAML_BYTES_MAX: Final = 100_000
VALUES_MAX: Final = 100_000  # with what aliases repeat: each may stand for all that is before it
_WHERE: Final = re.compile(r" - at `\$(?P<path>.*)`$")
_UNKNOWN: Final = re.compile(r"unknown field `(?P<key>.*)`")
_ANY_KEY: Final = "[...]"
_MISSING: Final = re.compile(r"missing required field `(?P<key>.*)`")

S = TypeVar("S")


class _TwiceError(yaml.MarkedYAMLError):
    """A key stands twice in a mapping."""


# What PyYAML refuses, by its class, the most special first: its own words are about its scanner.
_NOT_YAML: Final[tuple[tuple[type[Exception], str], ...]] = (
    (_TwiceError, ""),
    (
        yaml.scanner.ScannerError,
        "not YAML here; look for a tab, a quote that does not end, or a ': ' in a text (put it in quotes)",
    ),
    (
        yaml.parser.ParserError,
        "not YAML here; look for a bracket that is not closed, or another indentation than above",
    ),
    (
        yaml.composer.ComposerError,
        "not YAML here; look for an alias (*) without its anchor (&), or a second ---",
    ),
    (
        yaml.constructor.ConstructorError,
        "a plain value is allowed: a text, a number, true, false, a list, keys and values; no tag (!), no <<",
    ),
)


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice in a mapping; PyYAML would take the last one. 1e-9 is a number, not a
    text as in YAML 1.1, which wants a point in it.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable):
                if key in seen:
                    mark = key_node.start_mark
                    raise _TwiceError(problem=f"key {key!r} stands twice", problem_mark=mark)
                seen.add(key)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes what `_Loader` would take for a number, and repeats what stands twice."""

    def ignore_aliases(self, data: object) -> bool:
        return True


for _one in (_Loader, _Dumper):
    _one.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
    )


def yaml_text(found: msgspec.Struct) -> str:
    """What `read_yaml` reads as `found`, with every key, defaults too. Raises ConfigError if it is long."""
    text: str = yaml.dump(msgspec.to_builtins(found), Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    if len(text.encode()) > YAML_BYTES_MAX:
        raise ConfigError(f"{len(text.encode())} bytes of YAML, allowed are {YAML_BYTES_MAX}")
    return text


def read_yaml(path: Path, shape: type[S]) -> S:
    """The file as a `shape`. Raises ConfigError naming file, key, what was found and what is allowed."""
    root, found = _parse(path, _read(path))
    if found is None:
        found = {}
    try:
        return msgspec.convert(found, shape)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {_explain(str(error), root, found, shape)}") from error


@contextlib.contextmanager
def in_file(path: Path) -> Iterator[None]:
    """Add the file's name to a ConfigError about what was read from it, to a FileKeyError line and column."""
    try:
        yield
    except FileKeyError as error:
        raise ConfigError(f"{path}: {position(path, error.key)}{error}") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def position(path: Path, key: str) -> str:
    """Line and column of `key`, as `faults[0].name`, or of as much of it as is there. Raises ConfigError."""
    return _position(_node_at(_parse(path, _read(path))[0], key))


def _read(path: Path) -> bytes:
    try:
        return read_input(path, YAML_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:  # a name with a NUL
        raise ConfigError(f"{path}: cannot be read: {error}") from error


def _parse(path: Path, data: bytes) -> tuple[yaml.Node | None, object]:
    """The root node and the value made from it; both are None in a file without content."""
    try:
        loader = _Loader(data)
        root = loader.get_single_node()
        if root is not None and _size(root, {}) > VALUES_MAX:
            raise yaml.YAMLError(f"more than {VALUES_MAX} values, by its aliases")
        found: object = None if root is None else loader.construct_document(root)
    except yaml.MarkedYAMLError as error:
        reason = next((words for kind, words in _NOT_YAML if isinstance(error, kind)), "") or error.problem
        raise ConfigError(f"{path}: {_mark(error.problem_mark)}{reason}") from error
    except yaml.reader.ReaderError as error:
        raise ConfigError(f"{path}: not YAML: it is no text in UTF-8, at byte {error.position}") from error
    except yaml.YAMLError as error:  # of our own
        raise ConfigError(f"{path}: not YAML: {error}") from error
    except ValueError as error:
        raise ConfigError(
            f"{path}: not YAML: a number or a date that does not exist; put it in quotes"
        ) from error
    except RecursionError as error:
        raise ConfigError(f"{path}: not YAML: its lists and keys lie too deep in one another") from error
    return root, found


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values the node comes to with each alias written out. Raises YAMLError on one in itself."""
    found = known.get(id(node))
    if found is None:
        known[id(node)] = -1  # under way
        inner: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            inner = node.value
        elif isinstance(node, yaml.MappingNode):
            inner = [part for pair in node.value for part in pair]
        found = known[id(node)] = 1 + sum(_size(one, known) for one in inner)
    if found < 0:
        raise yaml.YAMLError("an alias stands in what it names")
    return found


def _explain(error: str, root: yaml.Node | None, found: object, shape: type[object]) -> str:
    """msgspec's error in the user's terms, with the line if the file has any content."""
    at = _WHERE.search(error)
    path = _with_keys(at["path"], error, found, shape).removeprefix(".") if at else ""
    reason = error[: at.start()] if at else error
    node, value, allowed = _node_at(root, path), found, inspect.type_info(shape)
    for key in _steps(path):
        value, allowed = _descend(value, allowed, key)
    strange = _UNKNOWN.search(reason)
    if strange and isinstance(node, yaml.MappingNode):
        node = next((name for name, _ in node.value if str(name.value) == strange["key"]), node)
    where = _position(node) + (f"{path}: " if path else "")
    if strange:
        return f"{where}{unknown('key', strange['key'], _keys(allowed))}"
    if missing := _MISSING.search(reason):
        empty = "" if root is not None else "; the file is empty"
        return f"{where}key {missing['key']!r} is missing{empty}"
    return f"{where}found {value!r}, allowed is {_describe(allowed)}"


def _with_keys(path: str, error: str, found: object, shape: type[object]) -> str:
    """The path in msgspec's `error`, with the key for each `[...]`, by which it means any key of a mapping.

    It is the first key with which alone the error is the same.
    """
    while _ANY_KEY in path:
        before, _, behind = path.partition(_ANY_KEY)
        mapping = found
        for step in _steps(before):
            mapping, _ = _descend(mapping, inspect.AnyType(), step)
        if not isinstance(mapping, dict):
            return before
        for key, value in mapping.items():
            try:
                msgspec.convert(_replaced(found, _steps(before), {key: value}), shape)
            except msgspec.ValidationError as alone:
                if str(alone) == error:
                    path = f"{before}.{key}{behind}"
                    break
        else:
            return before
    return path


def _replaced(node: object, steps: Sequence[str], value: object) -> object:
    """`node` with `value` in the place to which the steps lead."""
    if not steps:
        return value
    step, *rest = steps
    if isinstance(node, list):
        return [_replaced(one, rest, value) if str(at) == step else one for at, one in enumerate(node)]
    assert isinstance(node, dict)
    return {key: _replaced(one, rest, value) if key == step else one for key, one in node.items()}


def _steps(path: str) -> list[str]:
    """The keys and indices of a path as `faults[0].name`."""
    return [key for key in re.split(r"[.\[\]]+", path) if key]


def _node_at(root: yaml.Node | None, path: str) -> yaml.Node | None:
    """The node at the path, or the last on the way to it."""
    node = root
    for key in _steps(path):
        inner = next((one for name, one in _items(node) if name == key), None)
        if inner is None:
            break
        node = inner
    return node


def _position(node: yaml.Node | None) -> str:
    return _mark(node.start_mark if node is not None else None)


def _mark(mark: yaml.Mark | None) -> str:
    """Where something stands; the beginning where there is nothing."""
    return f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else "line 1, column 1: "


def _items(node: yaml.Node | None) -> Iterator[tuple[str, yaml.Node]]:
    """Key or index, and node, of each value in a mapping or sequence. The last of equal keys comes first."""
    if isinstance(node, yaml.MappingNode):
        yield from ((str(name.value), value) for name, value in reversed(node.value))
    elif isinstance(node, yaml.SequenceNode):
        yield from ((str(index), value) for index, value in enumerate(node.value))


def _descend(node: object, allowed: inspect.Type, key: str) -> tuple[object, inspect.Type]:
    """One step along the path: the value there, and what is allowed there."""
    if key.isdigit() and isinstance(node, list):
        sequence = _only(allowed, inspect.ListType, inspect.VarTupleType)
        return node[int(key)], sequence.item_type if sequence else inspect.AnyType()
    value: object = node.get(key) if isinstance(node, dict) else None
    if (mapping := _only(allowed, inspect.DictType)) is not None:
        return value, mapping.value_type
    struct = _only(allowed, inspect.StructType)
    fields = {field.encode_name: field.type for field in struct.fields} if struct else {}
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
    return [field.encode_name for field in struct.fields] if struct else []


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
        case inspect.DictType():
            return "keys and values"
        case inspect.ListType() | inspect.VarTupleType():
            return "a list"
        case inspect.StrType(pattern=pattern):
            return f"a text that matches {pattern}" if pattern else "a text"
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
