"""SVG as text: elements from names and attributes, with whatever is not ours escaped.

Colours are classes and never values, so that the style sheet of the page decides them: for a screen, for a
dark one, for paper. A `title` inside of an element is its tooltip, in every browser and without a script.
"""

from collections.abc import Mapping
from html import escape
from typing import Final

Attributes = Mapping[str, str | float]

CHARACTER_PX: Final = 6.3  # the width of an average one at 11 px; labels are laid out by it


def element(name: str, attributes: Attributes, *children: str) -> str:
    """One element; `children` are elements."""
    said = "".join(f' {key}="{_value(value)}"' for key, value in attributes.items())
    return f"<{name}{said}>{''.join(children)}</{name}>" if children else f"<{name}{said}/>"


def drawing(width: float, height: float, label: str, *children: str, css: str = "") -> str:
    """A whole drawing of that many pixels; `label` says what it shows, to those who do not see it."""
    attributes: Attributes = {
        "class": css,
        "viewBox": f"0 0 {_value(width)} {_value(height)}",
        "width": width,
        "height": height,
        "role": "img",
        "aria-label": label,
    }
    return element("svg", attributes, *children)


def group(css: str, *children: str, title: str = "") -> str:
    """Elements that belong together, with a tooltip."""
    head = (element("title", {}, text_of(title)),) if title else ()
    return element("g", {"class": css}, *head, *children)


def label(x: float, y: float, text: str, css: str = "", anchor: str = "start") -> str:
    """A line of text."""
    return element("text", {"x": x, "y": y, "class": css, "text-anchor": anchor}, text_of(text))


def line(x1: float, y1: float, x2: float, y2: float, css: str) -> str:
    """A straight one."""
    return element("line", {"x1": x1, "y1": y1, "x2": x2, "y2": y2, "class": css})


def path(points: str, css: str) -> str:
    """Along `points`, in the words of SVG."""
    return element("path", {"d": points, "class": css})


def text_of(text: str) -> str:
    """Safe between two tags."""
    return escape(text, quote=False)


def width_of(text: str) -> float:
    """About as many pixels as `text` takes at 11 px."""
    return CHARACTER_PX * len(text)


def _value(value: str | float) -> str:
    return escape(value) if isinstance(value, str) else f"{value:.2f}".rstrip("0").rstrip(".")
