"""The HTML report: whole, self-contained, its links lead somewhere, and no name becomes markup."""

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Final

import msgspec
import pytest
from campaigns import result
from certified import certified, suite
from reported import HOSTILE, MACHINE, hostile, named, summary_of, with_results

from aftbed.campaign.ledger import Ledger
from aftbed.campaign.spec import Gate
from aftbed.judge.outcome import OUTCOMES
from aftbed.report.html import COLUMNS_MAX, DRAWN_MAX, html_report, percent
from aftbed.report.plots import LINES
from aftbed.report.worst import by_badness

VOID: Final = frozenset(("meta", "link", "br"))
FETCHING: Final = frozenset(("src", "srcset", "data", "action", "poster", "background"))


class Page(HTMLParser):
    """A page read: its elements, ids, links and text; tags that do not close in order fail the test."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags = Counter[str]()
        self.classes = Counter[str]()
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        values = {name: value or "" for name, value in attrs}
        self.classes.update(values.get("class", "").split())
        self.ids += [values["id"]] if "id" in values else []
        self.attributes += values.items()

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text.append(data)

    def values(self, name: str) -> list[str]:
        return [value for attribute, value in self.attributes if attribute == name]


@pytest.fixture(scope="module")
def text(ledger: Ledger) -> str:
    return html_report(summary_of(ledger), ledger)


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_every_link_leads_to_a_place_in_the_page(page: Page) -> None:
    links = [link for link in page.values("href") if link != "data:,"]
    assert len(links) > 30
    assert all(link.startswith("#") for link in links)
    assert {link.removeprefix("#") for link in links} <= set(page.ids)
    assert max(Counter(page.ids).values()) == 1


def test_it_needs_nothing_beside_it(page: Page, text: str) -> None:
    assert page.tags["script"] == page.tags["link"] - 1 == page.tags["img"] == page.tags["iframe"] == 0
    assert not FETCHING & {name for name, _ in page.attributes}
    assert not any(name.startswith("on") for name, _ in page.attributes)
    assert "http:" not in text and "https:" not in text and "@import" not in text and "url(" not in text


def test_every_stratum_has_its_cell_and_its_row(page: Page, ledger: Ledger) -> None:
    summary, said = summary_of(ledger), "".join(page.text)
    assert page.classes["counts"] == len(summary.strata)
    assert {f"stratum-{n}" for n in range(len(summary.strata))} <= set(page.ids)
    assert all(stratum.name in said for stratum in summary.strata)
    shown = [value for value in page.values("title") if " of " in value]
    assert len(shown) == sum(len(stratum.outcomes) for stratum in summary.strata)
    assert page.classes["empty"] == 1  # no hang under pbr+tr
    assert page.classes["unexpected"] == sum(stratum.unexpected > 0 for stratum in summary.strata)


def test_every_kind_of_time_and_fault_has_its_plot(page: Page) -> None:
    drawn = [label for label in page.values("aria-label") if "share of runs" in label]
    assert drawn == [
        "Recovery, crash primary: share of runs over time in ms",
        "Recovery, hang primary: share of runs over time in ms",
        "Blackout of a failover, crash primary: share of runs over time in ms",
        "Blackout of a failover, hang primary: share of runs over time in ms",
        *(
            f"Blackout of an adaptation, {fault}: share of runs over time in ms"
            for fault in ("crash primary", "hang primary", "bitflip result", "nothing")
        ),
        *(
            f"FHTI, {fault}: share of runs over time in ms"
            for fault in ("hang primary", "crash primary", "bitflip result")  # `none` handles no crash
        ),
    ]
    said = "".join(page.text)
    assert said.count("budget 4 ms") == 2 and said.count("gate: p50 at most 3 ms") == 1


def test_the_handling_of_faults_has_its_table(page: Page) -> None:
    said = "".join(page.text)
    assert "Handling of faults" in said and "not known of 3" in said and "3 detected, 0 tolerated" in said


def test_the_worst_runs_are_drawn_with_the_command_that_repeats_them(page: Page, ledger: Ledger) -> None:
    worst = by_badness(ledger.results)
    said = "".join(page.text)
    assert len(worst) > DRAWN_MAX and page.classes["spacetime"] == DRAWN_MAX
    for told in worst:
        assert told.experiment.command() in said and f"run-{told.experiment.id}" in page.ids


def test_gates_and_environment(page: Page, ledger: Ledger) -> None:
    said = "".join(page.text)
    for gate in summary_of(ledger).gates:
        assert gate.metric in said and gate.limit in said and gate.reason in said
    for fact in (MACHINE.python, MACHINE.kernel, MACHINE.cpus, MACHINE.command, ledger.head.code):
        assert fact in said
    assert re.search(r"Seed\s*7", said)


def test_rows_with_other_faults_are_another_table(text: str, ledger: Ledger, tmp_path: Path) -> None:
    assert Page(text).classes["matrix"] == 1, "of these, each has a fault in common with another"
    spec = suite(tmp_path, "Counter", ("pbr", "lfr"), "nothing", "crash primary", "adapting")
    found, summary = certified(spec)
    page = Page(html_report(summary, found, drawn=0))
    assert (page.classes["matrix"], page.classes["empty"]) == (2, 0)
    assert page.classes["counts"] == len(summary.strata) == 6


@pytest.mark.parametrize(
    ("faults", "corner", "columns"),
    [(COLUMNS_MAX, "mechanism", COLUMNS_MAX), (COLUMNS_MAX + 1, "fault", 2)],
)
def test_a_matrix_with_many_faults_is_turned(ledger: Ledger, faults: int, corner: str, columns: int) -> None:
    names = [f"{ftm} · process · fault {number}" for ftm in ("pbr", "lfr") for number in range(faults)]
    few = with_results(ledger, *(named(result("masked", index=n), name) for n, name in enumerate(names)))
    page = html_report(summary_of(few), few, drawn=0)
    table = page[page.index('<table class="matrix">') :].partition("</table>")[0]
    head = re.findall("<th>(.*?)</th>", table.partition("</thead>")[0])
    assert head[0] == corner and len(head) == 1 + columns
    assert table.count('class="counts"') == len(names) and "empty" not in table


def test_more_rows_than_styles_are_one_line_for_each_mechanism(ledger: Ledger) -> None:
    """Two lines of one style could not be told apart."""
    names = [f"pbr · to {number} · crash primary" for number in range(len(LINES) + 1)]
    many = [
        named(result("tolerated", index=number, recovery_ms=1.0 + number), name)
        for number, name in enumerate(names)
    ]
    for count, lines, told in [(len(LINES), len(LINES), 0), (len(LINES) + 1, 1, 1)]:
        few = with_results(ledger, *many[:count])
        page = Page(html_report(summary_of(few), few, drawn=0))
        assert page.classes["swatch"] == page.classes["line"] == lines
        assert "".join(page.text).count("A line is a mechanism") == told


def test_times_of_which_all_are_zero_are_told_and_not_drawn(ledger: Ledger) -> None:
    none = with_results(ledger, *(result("tolerated", index=n, adapt_blackout_ms=0.0) for n in range(3)))
    page = Page(html_report(summary_of(none), none, drawn=0))
    assert "(3 runs)\n0 ms in all of them." in "".join(page.text) and page.classes["plot"] == 0


def test_a_cell_of_which_nothing_is_known_does_not_say_as_expected(ledger: Ledger) -> None:
    first = result("tolerated", index=1)
    first = msgspec.structs.replace(
        first, experiment=msgspec.structs.replace(first.experiment, expected=("tolerated",))
    )
    busy = msgspec.structs.replace(first, outcome="inconclusive")
    for results, said in [((first,), "✓ as expected"), ((first, busy), "nothing is known of 1; the others")]:
        few = with_results(ledger, *results)
        assert said in "".join(Page(html_report(summary_of(few), few, drawn=0)).text)


def test_hostile_names_are_text(ledger: Ledger) -> None:
    bad = with_results(ledger, hostile(), gates=(Gate("sdc", max=0.5, strata=HOSTILE),))
    spec = msgspec.structs.replace(bad.head.spec, about=HOSTILE)
    bad = msgspec.structs.replace(bad, head=msgspec.structs.replace(bad.head, spec=spec))
    machine = msgspec.structs.replace(MACHINE, command=HOSTILE)
    bad = msgspec.structs.replace(bad, head=msgspec.structs.replace(bad.head, environment=machine))
    text = html_report(summary_of(bad), bad)
    page = Page(text)
    assert page.tags["script"] == 0 and "\x01" not in text
    assert "".join(page.text).count(HOSTILE.replace("\x01", "�")) >= 6
    assert "alert" not in "".join(
        value for name, value in page.attributes if name not in ("title", "aria-label")
    )


def test_a_run_that_cannot_be_simulated_says_why(ledger: Ledger) -> None:
    ours = result("sdc", unexpected=True)
    lost = msgspec.structs.replace(
        ours, experiment=msgspec.structs.replace(ours.experiment, faults=("crash nobody",))
    )
    page = Page(html_report(summary_of(with_results(ledger, lost)), with_results(ledger, lost)))
    said = "".join(page.text)
    assert page.classes["spacetime"] == 0
    assert "Not drawn: it cannot be simulated: unknown target 'nobody'" in said


def test_a_run_that_comes_out_otherwise_in_the_simulator_says_so(ledger: Ledger) -> None:
    real = next(r for r in ledger.results if r.outcome == "tolerated" and r.recovery_ms)
    changed = msgspec.structs.replace(real, outcome="hang", unexpected=True)
    said = "".join(Page(html_report(summary_of(ledger), with_results(ledger, changed))).text)
    assert "As simulated, where it came out otherwise: tolerated." in said


def test_a_campaign_without_results_or_trouble_has_a_page_too(ledger: Ledger) -> None:
    none = with_results(ledger)
    assert "None: every run came out as expected" in html_report(summary_of(none), none)
    calm = with_results(ledger, result("masked"))
    page = Page(html_report(summary_of(calm), calm))
    assert "There was none." in "".join(page.text) and page.classes["plot"] == 0


def test_every_outcome_has_a_colour_of_its_own(ledger: Ledger) -> None:
    text = html_report(summary_of(ledger), ledger, drawn=0)
    colours = re.findall(r"\.o-(\w+) \{ background: ([^}]+)\}", text)
    assert {name for name, _ in colours} == set(OUTCOMES)
    assert len({colour for _, colour in colours}) == len(OUTCOMES)


@pytest.mark.parametrize(
    ("share", "said"),
    [(0, "0 %"), (1, "100 %"), (0.0001, "< 0.1 %"), (0.9999, "> 99.9 %"), (0.088, "8.8 %"), (0.5, "50.0 %")],
)
def test_what_is_not_quite_all_is_not_rounded_to_all(share: float, said: str) -> None:
    assert percent(share) == said


def test_the_templates_are_part_of_the_package() -> None:
    import aftbed.report as package  # noqa: PLC0415

    folder = Path(package.__file__).parent / "templates"
    assert {path.name for path in folder.iterdir()} == {
        "live.html",
        "report.css",
        "report.html.j2",
        "run.html.j2",
        "spacetime.html.j2",
        "spacetime.svg.j2",
        "swatch.html.j2",
    }
