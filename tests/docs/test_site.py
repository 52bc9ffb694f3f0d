"""The pages as a site (docs/conf.py, `make docs`): order by reader, no lost link, no network."""

import importlib.util
import runpy
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import pytest
from pages import PAGES, ROOT, blocks

README: Final = ROOT / "README.md"
CHANGELOG: Final = ROOT / "CHANGELOG.md"
TOOLS: Final = ("sphinx", "myst_parser", "furo", "mmdr")
FETCHED: Final = {"script": "src", "img": "src", "iframe": "src", "source": "src"}
MISSING: Final = [tool for tool in TOOLS if importlib.util.find_spec(tool) is None]


@pytest.fixture(scope="module")
def configuration() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs" / "conf.py"))


def test_the_order_of_reading_has_every_page_once(configuration: dict[str, Any]) -> None:
    order = configuration["reading_order"](README.read_text())
    readers = ["Begin", "Run experiments", "Want the figures", "Change aftbed", "Look something up"]
    assert list(order) == readers
    listed = [page for pages in order.values() for page in pages]
    files = [*PAGES, CHANGELOG]
    assert sorted([README.stem, *listed]) == sorted(
        path.relative_to(ROOT).with_suffix("").as_posix() for path in files
    )
    assert order["Begin"] == {"docs/architecture": "Architecture", "docs/glossary": "Glossary"}


def test_a_page_that_two_readers_want_stands_with_the_first(configuration: dict[str, Any]) -> None:
    rows = "| you | read |\n|---|---|\n| are a | [x](x.md) |\n| b | [y](y.md), [x](x.md) |\n"
    readme = f"# A\n\n## Documentation\n\n{rows}\n## C\n\n| d | [z](z.md) |\n"
    assert configuration["reading_order"](readme) == {"Are a": {"x": "X"}, "B": {"y": "Y"}}


class BuiltPage(HTMLParser):
    """What a page of the site links to, what it fetches, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given["id"]} if "id" in given else set()
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and {"stylesheet", "icon"} & set(given["rel"].split()):
            self.fetched.append(given["href"])
        if FETCHED.get(tag) in given:
            self.fetched.append(given[FETCHED[tag]])


def lost(site: dict[Path, BuiltPage]) -> Iterator[str]:
    """Links of the site's pages into it that lead nowhere, and whatever a page would fetch from elsewhere."""
    for path, page in site.items():
        for link in page.fetched:
            if "://" in link or not (path.parent / unquote(link.partition("?")[0])).exists():
                yield f"{path.name} fetches {link}"
        for link in page.links:
            name, _, anchor = link.partition("#")
            target = (path.parent / unquote(name)).resolve() if name else path
            if "://" in link:
                continue
            if not target.exists() or (anchor and anchor not in site[target].anchors):
                yield f"{path.name} links {link}"


@pytest.mark.simulation  # five seconds
@pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}: pip install -e '.[docs]'")
def test_the_site_is_whole_and_needs_no_network(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-E", "-q", "-b", "html"]
    words += ["-d", str(tmp_path / "doctrees"), "-c", str(ROOT / "docs"), str(ROOT), str(tmp_path / "site")]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    site = {path: BuiltPage(path) for path in (tmp_path / "site").rglob("*.html")}
    assert {page.relative_to(ROOT).with_suffix(".html") for page in (*PAGES, CHANGELOG)} <= {
        path.relative_to(tmp_path / "site") for path in site
    }
    assert list(lost(site)) == []
    for name in ("machines", "architecture"):
        diagrams = [block for block in blocks(ROOT / "docs" / f"{name}.md") if block.language == "mermaid"]
        text = (tmp_path / "site" / "docs" / f"{name}.html").read_text(encoding="utf-8")
        assert text.count('<div class="diagram"><svg ') == len(diagrams) > 0
    assert (tmp_path / "site" / "index.html").read_text() == (tmp_path / "site" / "README.html").read_text()
    index = (tmp_path / "site" / "searchindex.js").read_text()
    assert all(f'"docs/{page.stem}"' in index for page in PAGES if page != README)


def test_a_lost_link_and_a_fetched_script_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(
        '<h1 id="a"></h1><a href="#a"></a><a href="#b"></a><a href="gone.html"></a><a href="https://x.org"></a>'
        '<script src="https://x.org/y.js"></script><img src="page.html"><img src="gone.png">'
        '<link rel="stylesheet" href="gone.css"><link rel="next" href="https://x.org">'
    )
    assert list(lost({page: BuiltPage(page)})) == [
        "page.html fetches https://x.org/y.js",
        "page.html fetches gone.png",
        "page.html fetches gone.css",
        "page.html links #b",
        "page.html links gone.html",
    ]
