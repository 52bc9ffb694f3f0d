"""The documentation as a site: `make docs` writes it into build/docs, to be opened there or put on a server.

Sphinx reads the pages as they lie in the project. Their order, by reader, is that of the table
"Documentation" in the README, which is the first page. Diagrams are drawn while the site is built, so that it
needs no network.
"""

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT: Final = Path(__file__).resolve().parents[1]
README: Final = ROOT / "README.md"

project = "aftbed"
project_copyright = "aftbed authors"
extensions = ["myst_parser"]
root_doc = "README"
include_patterns = ["README.md", "CHANGELOG.md", "docs/*.md"]
exclude_patterns = [".*", "build", "dist"]
myst_heading_anchors = 4  # as code hosts name them, so that one link leads to both
smartquotes = False
suppress_warnings = ["misc.highlighting_failure"]  # a shortened JSON or YAML is still coloured

html_theme = "furo"
html_title = "aftbed"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_sphinx = False

_ROW: Final = re.compile(r"\| ([^|]+) \| (.+) \|")
_NOT_NEEDED: Final = re.compile(r"<style>.*?</style>| data-[\w-]+=\"[^\"]*\"", re.DOTALL)
_ID: Final = re.compile(r'(id="|#)merman')
_LINK: Final = re.compile(r"\[([^\]]+)\]\(([\w/]+)\.md\)")


def reading_order(readme: str) -> dict[str, dict[str, str]]:
    """By reader the pages of the README's table, with their titles. A page stands with its first reader."""
    lines = readme.partition("\n## Documentation\n")[2].partition("\n## ")[0].splitlines()
    rows = [found.groups() for line in lines if (found := _ROW.fullmatch(line))]
    seen: set[str] = set()
    order: dict[str, dict[str, str]] = {}
    for reader, cell in rows[1:]:  # without the head
        pages = {page: _capital(title) for title, page in _LINK.findall(cell) if page not in seen}
        seen |= set(pages)
        order[_capital(reader)] = pages
    return order


def _capital(words: str) -> str:
    return words[0].upper() + words[1:]


def add_reading_order(app: "Sphinx", name: str, source: list[str]) -> None:
    """Give the first page the list of all others, which is shown at the side of each."""
    if name != root_doc:
        return
    for reader, pages in reading_order(source[0]).items():
        listed = "\n".join(f"{title} <{page}>" for page, title in pages.items())
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {reader}\n\n{listed}\n```\n"


def draw_diagrams(app: "Sphinx", doctree: Any) -> None:
    """Put a drawing in the place of each block of Mermaid, in the colours of site.css."""
    import mmdr  # noqa: PLC0415 - a test reads this file where Sphinx is not installed
    from docutils import nodes  # noqa: PLC0415

    for number, block in enumerate(list(doctree.findall(nodes.literal_block))):
        if block.get("language") == "mermaid":
            drawing = _NOT_NEEDED.sub("", mmdr.render(block.astext()).svg())
            drawing = _ID.sub(rf"\1diagram-{number}", drawing)  # else each would have those of the first one
            block.replace_self(nodes.raw("", f'<div class="diagram">{drawing}</div>', format="html"))


def write_index(app: "Sphinx", failure: Exception | None) -> None:
    """A server looks for index.html, and so does a person."""
    if failure is None:
        shutil.copy(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: "Sphinx") -> None:
    app.connect("source-read", add_reading_order)
    app.connect("doctree-read", draw_diagrams)
    app.connect("build-finished", write_index)
