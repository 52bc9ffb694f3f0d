"""The weaknesses of a function of the user, in the terminal, the page and the Markdown."""

import re
from pathlib import Path

import pytest
from certified import certified, suite
from msgspec.structs import replace
from reported import HOSTILE, summary_of

from aftbed.campaign.ledger import Ledger
from aftbed.campaign.summary import Summary
from aftbed.report.html import html_report
from aftbed.report.markdown import markdown_summary
from aftbed.report.terminal import PLACES_MAX, places, summary_lines

pytestmark = pytest.mark.simulation


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ledger, Summary]:
    folder = tmp_path_factory.mktemp("weak")
    return certified(suite(folder, "Forgetful", ("none", "pbr"), "crash primary", "wrong reply"), 2)


def test_the_terminal_tells_of_each_with_what_would_have_held(weak: tuple[Ledger, Summary]) -> None:
    text = "\n".join(summary_lines(weak[1]))
    assert (
        "weakness: crash primary: wrong replies reach the client\n  seen under pbr 2 of 2 (15.8 to 100.0 %)"
        in text
    )
    assert "limit: wrong reply: " in text
    assert text.index("weakness: ") < text.index("limit: ") < text.index("gate: fail")


def test_a_page_and_a_markdown_have_the_same_table(weak: tuple[Ledger, Summary]) -> None:
    ledger, summary = weak
    page = html_report(summary, ledger, drawn=0)
    text = markdown_summary(summary, ledger.head.spec.system.app)
    for words in (
        "crash primary",
        "capture() or restore() forgets something",
        "pbr 2 of 2 (15.8 to 100.0 %)",
    ):
        assert words in page and words in text
    assert "<code>aftbed app check " in page and "`aftbed app check " in text
    assert 'href="#weaknesses"' in page and page.count("<b>limit</b>") == 1
    assert text.startswith("# certify: fail\n") and "| **weakness** | crash primary | " in text


def test_without_a_function_of_the_user_there_is_no_such_section(ledger: Ledger) -> None:
    page = html_report(summary_of(ledger), ledger, drawn=0)
    assert "weaknesses" not in re.sub(r"<style>.*</style>", "", page, flags=re.S)


def test_texts_of_a_stranger_stay_in_their_cells(weak: tuple[Ledger, Summary], tmp_path: Path) -> None:
    ledger, summary = weak
    hostile = replace(summary.weaknesses[0], fault=HOSTILE, advice=f"a | b\n# c {HOSTILE}")
    summary = replace(summary, weaknesses=(hostile,))
    page = html_report(summary, ledger, drawn=0)
    assert "<script" not in page
    lines = markdown_summary(summary, HOSTILE).splitlines()
    assert not any("<script" in line or "\x01" in line for line in lines)
    assert sum(line.startswith("| **weakness** |") for line in lines) == 1
    (row,) = (line for line in lines if line.startswith("| **weakness** |"))
    assert len(re.findall(r"(?<!\\)\|", row)) == 6


def test_a_long_list_of_places_is_cut(weak: tuple[Ledger, Summary]) -> None:
    seen = weak[1].weaknesses[0].seen * (PLACES_MAX + 2)
    assert places(seen).endswith(", and 2 more") and places(seen).count("pbr 2 of 2") == PLACES_MAX
