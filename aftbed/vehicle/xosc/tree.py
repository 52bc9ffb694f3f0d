"""XML as a tree whose elements know their line, and which of them were read.

The file comes from anywhere, so expat does the reading with the dangerous half of XML switched off: a
DOCTYPE is refused at its first character, and with it every entity that could be expanded without end or
fetched from elsewhere. Size, depth and number of elements have limits.

An `Element` is asked for its attributes and children by name; it remembers what it was asked for. What
nobody asked for (`unread`) is what the importer would have dropped silently: `words` says what becomes of
it. Every complaint names file, line and element.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.parsers import expat

from aftbed.core.errors import ConfigError, unknown

FILE_BYTES_MAX: Final = 4_000_000
DEPTH_MAX: Final = 60
ELEMENTS_MAX: Final = 100_000
SHOWN_CHARACTERS_MAX: Final = 60
_FLAGS: Final = {"true": True, "1": True, "false": False, "0": False}


class Element:
    """An element of the file `path`, which began in `line`. `text` is its character data, stripped."""

    def __init__(self, path: str, line: int, tag: str, attributes: dict[str, str]) -> None:
        self.path = path
        self.line = line
        self.tag = tag
        self.attributes = attributes
        self.children: list[Element] = []
        self.text = ""
        self.ignored: str | None = None
        self._read: set[str] = set()
        self._visited = False

    def error(self, reason: str) -> ConfigError:
        """What is wrong with this element, with its place."""
        return ConfigError(f"{self.path}: line {self.line}: {self.tag}: {reason}")

    def wrong(self, name: str, allowed: str) -> ConfigError:
        """The attribute `name` has another value than the `allowed` ones."""
        return self.error(f"{name}: found {_shown(self.attributes.get(name))}, allowed is {allowed}")

    # -- attributes

    def has(self, name: str) -> bool:
        """Whether the attribute is there. It is not read by this."""
        return name in self.attributes

    def word(self, name: str, default: str | None = None) -> str:
        """The value of an attribute, as text. Without `default` it has to be there."""
        self._read.add(name)
        found = self.attributes.get(name, default)
        if found is None:
            raise self.error(f"attribute {name!r} is missing")
        return found

    def choice(self, name: str, allowed: tuple[str, ...], default: str | None = None) -> str:
        """The value of an attribute that is one of `allowed`."""
        found = self.word(name, default)
        if found not in allowed:
            raise self.error(f"{name}: {unknown('value', found[:SHOWN_CHARACTERS_MAX], allowed)}")
        return found

    def number(self, name: str, default: float | None = None) -> float:
        """The value of an attribute that is a finite number."""
        found = self.word(name, None if default is None else repr(default))
        number = finite(found)
        if number is None:
            raise self.wrong(name, "a number")
        return number

    def flag(self, name: str, default: bool | None = None) -> bool:
        """The value of an attribute that is true or false."""
        found = _FLAGS.get(self.word(name, None if default is None else str(default).lower()))
        if found is None:
            raise self.wrong(name, "true or false")
        return found

    # -- children

    def every(self, *tags: str) -> list["Element"]:
        """The children with these tags, in the order of the file."""
        found = [child for child in self.children if child.tag in tags]
        for child in found:
            child.visit()
        return found

    def maybe(self, *tags: str) -> "Element | None":
        """The only child with one of these tags, if there is one."""
        found = self.every(*tags)
        if len(found) > 1:
            raise found[1].error(f"stands twice in {self.tag}, of line {self.line}")
        return found[0] if found else None

    def one(self, *tags: str) -> "Element":
        """The only child with one of these tags, which has to be there."""
        found = self.maybe(*tags)
        if found is None:
            there = ", ".join(child.tag for child in self.children[:5]) or "nothing"
            raise self.error(f"found {there}, allowed is {' or '.join(tags)}")
        return found

    # -- what was read

    def visit(self) -> None:
        """Mark the element as read; its attributes and children are another matter."""
        self._visited = True

    def visited(self) -> bool:
        """Whether anybody asked for this element."""
        return self._visited

    def ignore(self, reason: str) -> None:
        """Say why this element, with all below it, cannot change the drive."""
        self.ignored = reason

    def unread_attributes(self) -> list[str]:
        """The attributes that nobody asked for; what XML itself needs does not count."""
        return [name for name in self.attributes if name not in self._read and not _of_xml(name)]

    def walk(self) -> Iterator["Element"]:
        """This element and all below it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()


def finite(text: str) -> float | None:
    """`text` as a finite number, as XML writes them; None if it is none."""
    try:
        number = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def read_tree(path: Path, name: str | None = None) -> Element:
    """The root of the XML file `path`, which is called `name` in what is said of it."""
    name = name or str(path)
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read: {error.strerror}") from error
    return parse_tree(data, name)


def parse_tree(data: bytes, name: str) -> Element:
    """The root of XML in `data`. Raises ConfigError."""
    if len(data) > FILE_BYTES_MAX:
        raise ConfigError(f"{name}: more than the {FILE_BYTES_MAX} bytes that are allowed")
    builder = _Builder(name)
    try:
        builder.parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigError(f"{name}: line {error.lineno}: not XML: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # the encoding that the file claims to have
        raise ConfigError(f"{name}: line 1: not XML: {error}") from error
    assert builder.root is not None, "expat refuses a document without an element"
    return builder.root


class _Builder:
    """What expat calls."""

    def __init__(self, name: str) -> None:
        self.root: Element | None = None
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._data
        self.parser.StartDoctypeDeclHandler = self._doctype
        self._name = name
        self._open: list[Element] = []
        self._elements = 0

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self.parser.CurrentLineNumber
        element = Element(self._name, line, tag[:SHOWN_CHARACTERS_MAX], attributes)
        self._elements += 1
        if self._elements > ELEMENTS_MAX:
            raise element.error(f"more than the {ELEMENTS_MAX} elements that are allowed")
        if len(self._open) >= DEPTH_MAX:
            raise element.error(f"deeper than the {DEPTH_MAX} levels that are allowed")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _end(self, _tag: str) -> None:
        self._open.pop()

    def _data(self, data: str) -> None:
        self._open[-1].text = (self._open[-1].text + data).strip()[: SHOWN_CHARACTERS_MAX + 1]

    def _doctype(self, *_arguments: object) -> None:
        line = self.parser.CurrentLineNumber
        raise ConfigError(f"{self._name}: line {line}: DOCTYPE: not allowed, it may define entities")


def _of_xml(name: str) -> bool:
    return name == "xmlns" or name.startswith(("xmlns:", "xsi:", "xml:"))


def _shown(found: str | None) -> str:
    if found is None:
        return "nothing"
    cut = found[:SHOWN_CHARACTERS_MAX]
    return repr(cut) + ("..." if cut != found else "")
