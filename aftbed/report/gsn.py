"""A safety argument as a picture: the Goal Structuring Notation, from left to right, as SVG.

Goals are boxes, strategies parallelograms, contexts boxes with round ends, solutions circles. A filled arrow
is "supported by", an open one "in context of". A diamond below a goal says that it is undeveloped, a thick
broken frame that it failed; the word stands in it too. A context and a solution are drawn once with their
text, and by their names wherever they are meant.

The layout is a tree: each row is one campaign under one mechanism, and what is above it stands in the middle
of its rows. Widths of text are estimated by those of DejaVu Sans, which is wider than most fonts, so that
nothing sticks out of its box. It is drawn in light or dark colours, as the reader's screen is.
"""

from collections.abc import Iterable, Sequence
from typing import Final
from xml.etree import ElementTree

import msgspec

from aftbed.core.errors import shown
from aftbed.report.argument import Argument, GoalStatus, GsnNode, LinkKind, NodeKind
from aftbed.report.plots import FONT, SVG

FONT_PX: Final = 12.0
LINE_PX: Final = 16.0
PAD_PX: Final = 10.0
MARGIN: Final = 24.0
GAP_X, GAP_Y = 44.0, 22.0
GOAL_PX, STRATEGY_PX, SUB_PX, CIRCLE_PX = 250.0, 170.0, 330.0, 30.0
NAME_PX: Final = 150.0  # beside a circle
SLANT_PX: Final = 12.0
ROUND_PX: Final = 20.0
CONTEXT_PX: Final = 24.0  # height of one that is only named
DIAMOND_PX: Final = 7.0
WIDTH: Final = 2 * MARGIN + GOAL_PX + STRATEGY_PX + SUB_PX + CIRCLE_PX + NAME_PX + 3 * GAP_X
NARROW, WIDE = frozenset("iljtfrI.,:;'|! ()[]/\\"), frozenset("mwMWQO@%—")
STYLE: Final = f"""
svg {{ --ground: #ffffff; --raised: #f6f7f9; --ink: #1b1f24; --muted: #59626d; --rule: #8a939e;
  --bad: #b3261e; --good: #1a6b3c; font: {FONT_PX:g}px {FONT}; background: var(--ground); }}
@media (prefers-color-scheme: dark) {{
  svg {{ --ground: #15181c; --raised: #1d2126; --ink: #e4e7eb; --muted: #9ba5b1; --rule: #77818d;
    --bad: #ff8a80; --good: #6fcf97; }}
}}
text {{ fill: var(--ink); }}
.muted {{ fill: var(--muted); }} .bold {{ font-weight: 650; }} .title {{ font-size: 16px; font-weight: 650; }}
.shape {{ fill: var(--raised); stroke: var(--rule); stroke-width: 1.2; }}
.link {{ fill: none; stroke: var(--rule); stroke-width: 1.2; }}
.tip {{ fill: var(--rule); stroke: var(--rule); }} .open {{ fill: var(--ground); stroke: var(--rule); }}
.shape.supported {{ stroke: var(--good); }} text.supported {{ fill: var(--good); font-weight: 650; }}
.shape.failed {{ stroke: var(--bad); stroke-width: 2.5; stroke-dasharray: 9 3; }}
text.failed {{ fill: var(--bad); font-weight: 650; }}
text.undeveloped {{ fill: var(--muted); font-weight: 650; }}
.ground {{ fill: var(--ground); }}
"""
MARKS: Final = {GoalStatus.SUPPORTED: "✓", GoalStatus.UNDEVELOPED: "◇", GoalStatus.FAILED: "✗"}


class _Text(msgspec.Struct, frozen=True):
    """A line, and its class."""

    line: str
    css: str = ""


def gsn_svg(found: Argument) -> str:
    """The picture, as a file of its own."""
    return _Picture(found).svg()


def wrapped(text: str, width_px: float) -> list[str]:
    """The text in lines of that width at most, by `text_px`; a word that is longer is broken."""
    lines = []
    for paragraph in shown(text).split("\n"):
        line = ""
        for word in paragraph.split(" "):
            if line and text_px(f"{line} {word}") <= width_px:
                line = f"{line} {word}"
                continue
            lines += [line] if line else []
            line = word
            while text_px(line) > width_px:
                count = next(n for n in range(len(line), 0, -1) if n == 1 or text_px(line[:n]) <= width_px)
                if count == len(line):
                    break  # one character
                lines.append(line[:count])
                line = line[count:]
        lines.append(line)
    return lines


def text_px(text: str) -> float:
    """About the width of a text, rather more than less."""
    return sum(map(_character_px, text))


def _character_px(one: str) -> float:
    if one in NARROW:
        share = 0.42
    elif one in WIDE or not one.isascii():
        share = 1.0
    else:
        share = 0.78 if one.isupper() else 0.65
    return share * FONT_PX


class _Picture:
    """Drawn from the top to the bottom: title, contexts and solutions with their text, then the promises."""

    def __init__(self, found: Argument) -> None:
        self._found = found
        self._root = ElementTree.Element("svg", {"xmlns": SVG, "role": "img"})
        ElementTree.SubElement(self._root, "title").text = f"Safety argument of {shown(found.bundle)}"
        ElementTree.SubElement(self._root, "style").text = STYLE
        self._ground = self._shape("rect", "ground", x=0, y=0, width=WIDTH)
        self._links = ElementTree.SubElement(self._root, "g")  # below all shapes
        self._y = MARGIN
        self._title()
        self._legend()
        for goal in found.goals:
            self._promise(goal)
        self._paragraph(map(str, found.unclaimed))
        self._paragraph([found.note])

    def svg(self) -> str:
        height = self._y + MARGIN - GAP_Y
        self._ground.set("height", f"{height:g}")
        self._root.attrib |= {
            "width": f"{WIDTH:g}",
            "height": f"{height:g}",
            "viewBox": f"0 0 {WIDTH:g} {height:g}",
        }
        return ElementTree.tostring(self._root, encoding="unicode") + "\n"

    # -- parts ------------------------------------------------------------------------------------

    def _title(self) -> None:
        found = self._found
        self._line(MARGIN, self._y + 14, _Text(f"Safety argument of {found.bundle}", "title"))
        self._y += 24
        verifies = [f"verifies {', '.join(found.verifies)}"] if found.verifies else []
        self._paragraph([f"sha256 {found.sha256}", *verifies])

    def _legend(self) -> None:
        """Contexts and solutions, each in a box as wide as the picture, with the text that they stand for."""
        inside = WIDTH - 2 * MARGIN - NAME_PX - PAD_PX
        for node in self._found.nodes:
            if node.kind not in (NodeKind.CONTEXT, NodeKind.SOLUTION):
                continue
            text = f"{node.text}\n{node.entry}, sha256 {node.sha256}" if node.entry else node.text
            lines, names = wrapped(text, inside), wrapped(node.id, NAME_PX - 3 * PAD_PX)
            height = max(len(lines), len(names)) * LINE_PX + 2 * PAD_PX
            round_px = ROUND_PX if node.kind is NodeKind.CONTEXT else 0.0
            width = WIDTH - 2 * MARGIN
            self._shape("rect", "shape", x=MARGIN, y=self._y, width=width, height=height, rx=round_px)
            self._lines(MARGIN + 2 * PAD_PX, self._y + PAD_PX, [_Text(name, "bold") for name in names])
            self._lines(MARGIN + NAME_PX, self._y + PAD_PX, [_Text(line) for line in lines])
            self._y += height + PAD_PX
        self._y += GAP_Y

    def _promise(self, goal: GsnNode) -> None:
        """A goal, its strategies, and a row for each campaign below them."""
        strategies = self._found.below(goal.id)
        texts = self._texts(goal, GOAL_PX, short=bool(strategies))
        height = len(texts) * LINE_PX + 2 * PAD_PX
        top, middles = self._y, []
        for strategy in strategies:
            middles.append(self._strategy(strategy))
        self._y = max(self._y, top + height + GAP_Y + DIAMOND_PX)
        middle = (middles[0] + middles[-1]) / 2 if middles else top + height / 2
        middle = max(middle, top + height / 2)
        self._goal(goal, texts, MARGIN, middle, GOAL_PX)
        right = MARGIN + GOAL_PX
        for end in middles:
            self._arrow(right, middle, right + GAP_X + SLANT_PX / 2, end)

    def _strategy(self, strategy: GsnNode) -> float:
        """Its middle."""
        left = MARGIN + GOAL_PX + GAP_X
        lines = wrapped(strategy.text, STRATEGY_PX - 2 * (PAD_PX + SLANT_PX))
        names = [node.id for node in self._found.below(strategy.id, LinkKind.IN_CONTEXT_OF)]
        height = len(lines) * LINE_PX + 2 * PAD_PX
        whole = height + len(names) * (CONTEXT_PX + PAD_PX)
        top, middles = self._y, []
        for sub in self._found.below(strategy.id):
            middles.append(self._row(sub))
        middle = max((middles[0] + middles[-1]) / 2, top + height / 2)
        y = middle - height / 2
        corners = ((SLANT_PX, 0), (STRATEGY_PX, 0), (STRATEGY_PX - SLANT_PX, height), (0, height))
        points = " ".join(f"{left + dx:g},{y + dy:g}" for dx, dy in corners)
        self._shape("polygon", "shape", points=points)
        self._lines(left + PAD_PX + SLANT_PX, y + PAD_PX, [_Text(line) for line in lines])
        for number, name in enumerate(names):
            below = y + height + PAD_PX + number * (CONTEXT_PX + PAD_PX)
            self._named_context(name, left + SLANT_PX, below)
        self._y = max(self._y, y + whole + GAP_Y)
        right = left + STRATEGY_PX
        for end in middles:
            self._arrow(right - SLANT_PX / 2, middle, right + GAP_X, end)
        return middle

    def _named_context(self, name: str, left: float, top: float) -> None:
        width = STRATEGY_PX - 2 * SLANT_PX
        middle = left + width / 2
        self._shape("rect", "shape", x=left, y=top, width=width, height=CONTEXT_PX, rx=CONTEXT_PX / 2)
        self._link(f"M{middle:g} {top - PAD_PX:g}V{top:g}")
        self._shape("path", "open", d=f"M{middle - 4:g} {top - 7:g}h8l-4 7z")
        lines = wrapped(name, width - 2 * PAD_PX)
        text = lines[0] if len(lines) == 1 else f"{lines[0][:-1]}…"
        self._line(middle, top + CONTEXT_PX / 2 + 4, _Text(text), anchor="middle")

    def _row(self, sub: GsnNode) -> float:
        left = MARGIN + GOAL_PX + GAP_X + STRATEGY_PX + GAP_X
        texts = self._texts(sub, SUB_PX, short=False)
        names = [wrapped(node.id, NAME_PX - PAD_PX) for node in self._found.below(sub.id)]
        height = max(len(texts) * LINE_PX + 2 * PAD_PX, CIRCLE_PX, *(len(name) * LINE_PX for name in names))
        middle = self._y + height / 2
        self._goal(sub, texts, left, middle, SUB_PX)
        centre = left + SUB_PX + GAP_X + CIRCLE_PX / 2
        for name in names:
            self._shape("circle", "shape", cx=centre, cy=middle, r=CIRCLE_PX / 2)
            self._line(centre, middle + 4, _Text("Sn"), anchor="middle")
            top = middle - len(name) * LINE_PX / 2
            self._lines(centre + CIRCLE_PX / 2 + PAD_PX, top, [_Text(line) for line in name])
            self._arrow(left + SUB_PX, middle, left + SUB_PX + GAP_X, middle)
        self._y += height + GAP_Y
        return middle

    def _texts(self, goal: GsnNode, width: float, *, short: bool) -> list[_Text]:
        """What stands in the box of a goal. `short`: not why it is not supported, which stands below it."""
        assert goal.status is not None
        inside = width - 2 * PAD_PX
        head = f"{MARKS[goal.status]} {goal.status.value}"
        names = wrapped(goal.id, inside - text_px(head) - PAD_PX)
        texts = [_Text(name, "bold") for name in names]
        texts += [_Text(line) for line in wrapped(goal.text, inside)]
        why = "" if short else goal.why
        return texts + [_Text(line, "muted") for line in (wrapped(why, inside) if why else ())]

    def _goal(self, goal: GsnNode, texts: Sequence[_Text], left: float, middle: float, width: float) -> None:
        assert goal.status is not None
        height = len(texts) * LINE_PX + 2 * PAD_PX
        top = middle - height / 2
        css = goal.status.value
        self._shape("rect", f"shape {css}", x=left, y=top, width=width, height=height)
        self._lines(left + PAD_PX, top + PAD_PX, texts)
        head = _Text(f"{MARKS[goal.status]} {css}", css)
        self._line(left + width - PAD_PX, top + PAD_PX + 12, head, anchor="end")
        if goal.status is GoalStatus.UNDEVELOPED:
            x, y, d = left + width / 2, top + height, DIAMOND_PX
            self._shape("path", "open", d=f"M{x:g} {y:g}l{d:g} {d:g}l{-d:g} {d:g}l{-d:g} {-d:g}z")

    def _paragraph(self, texts: Iterable[str]) -> None:
        lines = [line for text in texts for line in wrapped(text, WIDTH - 2 * MARGIN)]
        if lines:
            self._lines(MARGIN, self._y, [_Text(line, "muted") for line in lines])
            self._y += len(lines) * LINE_PX + GAP_Y

    # -- elements ---------------------------------------------------------------------------------

    def _lines(self, x: float, y: float, texts: Iterable[_Text]) -> None:
        for number, text in enumerate(texts):
            self._line(x, y + number * LINE_PX + 12, text)

    def _line(self, x: float, y: float, text: _Text, anchor: str = "start") -> None:
        element = self._shape("text", text.css, x=x, y=y)
        element.attrib |= {"text-anchor": anchor} if anchor != "start" else {}
        element.text = shown(text.line)

    def _arrow(self, x1: float, y1: float, x2: float, y2: float) -> None:
        """To the right, with the bend in the gap between two columns; the tip is filled: supported by."""
        self._link(f"M{x1:g} {y1:g}H{x2 - GAP_X / 2:g}V{y2:g}H{x2:g}")
        self._shape("path", "tip", parent=self._links, d=f"M{x2:g} {y2:g}l-8 -4v8z")

    def _link(self, path: str) -> None:
        self._shape("path", "link", parent=self._links, d=path)

    def _shape(
        self, tag: str, css: str, parent: ElementTree.Element | None = None, **numbers: float | str
    ) -> ElementTree.Element:
        about = {key: value if isinstance(value, str) else f"{value:g}" for key, value in numbers.items()}
        about |= {"class": css} if css else {}
        return ElementTree.SubElement(self._root if parent is None else parent, tag, about)
