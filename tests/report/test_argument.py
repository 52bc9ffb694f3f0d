"""The safety argument: a goal is supported only by evidence that could have failed, and did not."""

from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import msgspec
import pytest
from browser import in_browser, needs_browser
from campaigns import planned, ran
from reported import HOSTILE

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger
from aftbed.core.application import Characteristics
from aftbed.report.argument import (
    Argument,
    GoalStatus,
    LinkKind,
    NodeKind,
    argument_lines,
    argument_of,
)
from aftbed.report.bundle import Bundle, CampaignEnvironment, FiledCampaign
from aftbed.report.gsn import gsn_svg, text_px, wrapped

pytestmark = pytest.mark.simulation

CAMPAIGN: Final = """
campaign: try
seed: 2
verifies: [SG-1]
system: {requests: 40, runtime: sim}
mechanisms: [none, pbr, pbr+tr]
faults:
- name: crash
  fault: crash primary at server.exit nth {nth}
  draw: {nth: [1, 35]}
  mechanisms: [pbr, pbr+tr]
  expect: {"*": [tolerated]}
- name: bitflip
  fault: bitflip result at server.exit nth {nth}
  draw: {nth: [1, 35]}
  expect: {pbr+tr: [tolerated], "*": [sdc]}
- name: slow
  fault: slow primary by 2ms for 20ms at server.enter nth 9
  mechanisms: [pbr]
stop: {experiments: 3}
not_activated_max: 0.9
unknown_max: 0.9
"""
TIMED: Final = """
campaign: timed
ftti: 50ms
system: {requests: 40, runtime: sim}
mechanisms: [pbr]
faults:
- {name: crash, fault: "crash primary at server.exit nth {nth}", draw: {nth: [1, 35]}}
stop: {experiments: 2}
not_activated_max: 0.9
unknown_max: 0.9
"""
ENTRY: Final = "try/records.jsonl"
HASH: Final = "ab" * 32
SUPPORTED, UNDEVELOPED, FAILED = GoalStatus.SUPPORTED, GoalStatus.UNDEVELOPED, GoalStatus.FAILED


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Ledger:
    """A campaign that comes out as it should."""
    folder = tmp_path_factory.mktemp("argued")
    return ran(planned(folder, CAMPAIGN), folder / "out")


def filed(ledger: Ledger, entry: str = ENTRY, **functions: Characteristics | None) -> FiledCampaign:
    machine = ledger.head.environment
    declared = functions or {"": Characteristics()}
    shown = (machine.python, machine.kernel, machine.cpus, machine.command, machine.packages)
    return FiledCampaign(entry, ledger, CampaignEnvironment(ledger.head.code, *shown, declared))


def argued(*ledgers: Ledger) -> Argument:
    found = [filed(one, f"try{number or ''}/records.jsonl") for number, one in enumerate(ledgers)]
    return argument_of(
        "e.zip", Bundle(HASH[::-1], dict.fromkeys((one.entry for one in found), HASH), ()), found
    )


def changed(ledger: Ledger, stratum: str, **values: object) -> Ledger:
    """With other values in the first result of the stratum."""
    at = next(n for n, r in enumerate(ledger.results) if r.experiment.stratum == stratum)
    other = msgspec.structs.replace(ledger.results[at], **values)
    return with_results(ledger, *ledger.results[:at], other, *ledger.results[at + 1 :])


def with_results(ledger: Ledger, *results: Result) -> Ledger:
    return msgspec.structs.replace(ledger, results=results)


def statuses(found: Argument) -> dict[str, GoalStatus | None]:
    return {goal.id: goal.status for goal in found.goals}


def test_what_was_kept_is_supported_and_what_was_not_tried_is_undeveloped(good: Ledger) -> None:
    found = argued(good)
    about = ("G1", "G2", "G3", "G4", "G6", "G8")
    assert statuses(found) == {**dict.fromkeys(about, SUPPORTED), "G5": UNDEVELOPED, "G7": UNDEVELOPED}
    assert found.node("G7").why == "no campaign is about it", "nothing of a simulated run could be left"
    figures = found.node("G1.pbr+tr.try").figures
    assert figures is not None and (figures.experiments, figures.broken, figures.outside) == (6, 0, 0)
    assert 0.3 < figures.at_most < 0.5, "six experiments prove little, and that is said"


def test_a_goal_for_each_promise_a_strategy_for_each_mechanism_and_a_solution_with_its_hash(
    good: Ledger,
) -> None:
    found = argued(good)
    ids = {node.id for node in found.nodes}
    assert {end for link in found.links for end in (link.source, link.target)} <= ids
    for goal in (goal for goal in found.goals if goal.status is SUPPORTED):
        strategies = found.below(goal.id)
        assert strategies and all(one.kind is NodeKind.STRATEGY for one in strategies)
        for strategy in strategies:
            (context,) = found.below(strategy.id, LinkKind.IN_CONTEXT_OF)
            lines = [line.partition(":")[0] for line in context.text.split("\n")]
            assert lines[1:] == ["FT", "A", "R"], "the context of the mechanism"
            for sub in found.below(strategy.id):
                (solution,) = found.below(sub.id)
                assert (solution.entry, solution.sha256) == (ENTRY, HASH)
    assert not any(".none" in name for name in ids), "without a mechanism nothing is promised"
    assert found.verifies == ("SG-1",)


def test_no_claim_is_made_for_faults_that_a_mechanism_does_not_tolerate(good: Ledger) -> None:
    found = argued(good)
    assert [strategy.id for strategy in found.below("G4")] == ["S.G4.pbr+tr"]
    (none,) = found.unclaimed
    assert str(none).startswith("G4: pbr makes no claim in try (3 experiments): pbr does not tolerate value")
    figures = found.node("G3.pbr.try").figures
    assert figures is not None and figures.outside == 6, "wrong replies of bit flips, and a slow primary"
    masters = found.node("G6.pbr.try").figures
    assert masters is not None and masters.experiments == 9, "one master, whatever the faults are"


def test_a_function_of_which_nothing_is_known_supports_nothing(good: Ledger) -> None:
    results = [
        msgspec.structs.replace(r, experiment=msgspec.structs.replace(r.experiment, app="files/1/a.py:A"))
        for r in good.results
    ]
    one = filed(with_results(good, *results), **{"files/1/a.py:A": None})
    found = argument_of("e.zip", Bundle(HASH, {ENTRY: HASH}, ()), [one])
    assert statuses(found)["G1"] is UNDEVELOPED
    assert "what files/1/a.py:A declares is not known" in {none.why for none in found.unclaimed}


@pytest.mark.parametrize(
    ("stratum", "values", "broken"),
    [
        ("pbr · crash", {"outcome": "duplicate_effect"}, {"G1"}),
        ("pbr · crash", {"outcome": "omission"}, {"G2"}),
        ("pbr · crash", {"outcome": "sdc"}, {"G3"}),
        ("pbr+tr · bitflip", {"outcome": "sdc"}, {"G3", "G4"}),
        ("pbr · slow", {"broken": ("one_master: two",)}, {"G6"}),
    ],
)
def test_one_experiment_that_broke_a_promise_fails_its_goal(
    good: Ledger, stratum: str, values: dict[str, object], broken: set[str]
) -> None:
    found = argued(changed(good, stratum, **values))
    whys = {goal.id for goal in found.goals if goal.status is FAILED and goal.why.startswith("experiment ")}
    assert whys == broken
    assert not {"G1", "G2", "G3"} & whys or statuses(found)["G8"] is SUPPORTED


def test_a_campaign_with_an_ftti_has_a_goal_for_it(tmp_path: Path) -> None:
    found = ran(planned(tmp_path, TIMED), tmp_path / "out")
    goal = argued(found).node("FTTI")
    assert goal.status is SUPPORTED and goal.text.endswith("fault tolerant time interval, 50ms")
    late = argued(changed(found, "pbr · crash", broken=("ftti: handled after 70 ms",))).node("FTTI")
    assert late.status is FAILED and late.why.endswith(": ftti: handled after 70 ms")


def test_what_the_client_counted_breaks_a_promise_behind_a_worse_outcome(good: Ledger) -> None:
    requests = good.results[0].requests
    assert requests is not None
    doubled = msgspec.structs.replace(requests, duplicated=1, lost=1)
    found = argued(changed(good, "pbr · crash", outcome="sdc", requests=doubled))
    failed = {goal.id for goal in found.goals if goal.why.startswith("experiment ")}
    assert failed == {"G1", "G2", "G3"}


def test_a_worse_outcome_that_may_hide_a_doubled_effect_is_no_evidence_that_there_was_none(
    good: Ledger,
) -> None:
    figures = argued(changed(good, "pbr · crash", outcome="hang")).node("G1.pbr.try").figures
    assert figures is not None and figures.experiments == 2


def test_evidence_whose_gate_does_not_pass_supports_nothing(good: Ledger) -> None:
    gates = planned_gates(good, "{metric: failed, max: 0.1, strata: 'pbr ·*'}")
    found = argued(gates)
    (pbr, tr) = (found.node(f"G1.{ftm}.try") for ftm in ("pbr", "pbr+tr"))
    assert pbr.status is UNDEVELOPED and pbr.why.startswith("gate failed at most 0.1 in pbr ·*: ")
    assert tr.status is SUPPORTED and found.node("G1").status is UNDEVELOPED
    assert argued(good).holds and not found.holds


def planned_gates(ledger: Ledger, gate: str) -> Ledger:
    spec = planned(ledger.path.parents[1], f"{CAMPAIGN}gates: [{gate}]\n").spec
    return msgspec.structs.replace(ledger, head=msgspec.structs.replace(ledger.head, spec=spec))


def test_evidence_that_could_not_have_failed_supports_nothing(good: Ledger) -> None:
    missed = [
        msgspec.structs.replace(r, activated=False) if r.experiment.stratum == "pbr · crash" else r
        for r in good.results
    ]
    found = argued(with_results(good, *missed))
    sub = found.node("G2.pbr.try")
    assert (sub.status, found.node("G2").status) == (UNDEVELOPED, UNDEVELOPED)
    assert "could not have failed" in sub.why
    assert found.node("G8").status is FAILED, "a campaign whose faults did not happen fails"
    unknown = [msgspec.structs.replace(r, outcome="inconclusive") for r in good.results]
    assert SUPPORTED not in statuses(argued(with_results(good, *unknown))).values()
    assert set(statuses(argued(with_results(good))).values()) == {UNDEVELOPED}


def test_a_promise_is_only_as_good_as_the_worst_campaign(good: Ledger) -> None:
    found = argued(good, changed(good, "pbr · crash", outcome="omission"))
    assert found.node("G2.pbr.try").status is SUPPORTED and found.node("G2.pbr.try1").status is FAILED
    assert found.node("G2").status is FAILED


def test_no_asil_is_claimed(good: Ledger) -> None:
    found = argued(good)
    text = "\n".join(argument_lines(found))
    assert text.endswith(
        "not a qualified tool, and nothing here is a claim of an ASIL: it is what was measured."
    )
    assert f"{text}{gsn_svg(found)}".count("ASIL") == 2, "nowhere else"


# -- the picture ----------------------------------------------------------------------------------


def test_the_picture_is_one_file_of_its_own_with_every_node_in_it(good: Ledger) -> None:
    found = argued(good)
    root = ElementTree.fromstring(gsn_svg(found))
    texts = [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]
    for node in found.nodes:
        if node.kind is not NodeKind.STRATEGY:
            assert node.id in texts, node.id
    words = [text.split(" ")[-1] for text in texts if text[:1] in "✓◇✗"]
    assert sorted(words) == sorted(n.status.value for n in found.nodes if n.status is not None)
    assert gsn_svg(found) == gsn_svg(found) and "http" not in gsn_svg(found).replace(root.tag[1:27], "")


def test_lines_are_as_narrow_as_they_have_to_be() -> None:
    for text in ("a few words of text", "x" * 300, "", "W", HOSTILE, "one\ntwo", f"word {'m' * 99} word"):
        lines = wrapped(text, 90)
        assert all(text_px(line) <= 90 for line in lines)
        assert "".join(lines).replace(" ", "") == "".join(text.split()).replace("\x01", "�")


MEASURE: Final = """<script>
const box = (e) => e.getBoundingClientRect();
const shapes = [...document.querySelectorAll(".shape")].map(box);
const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
let over = 0, out = 0;
shapes.forEach((a, i) => shapes.slice(i + 1).forEach((b) => { if (!apart(a, b)) over++; }));
const page = box(document.querySelector("svg"));
const texts = [...document.querySelectorAll("text")].map(box);
for (const t of texts) {
  const near = shapes.filter((s) => !apart(s, t));
  if (t.right > page.right || near.some((s) =>
    t.left < s.left - .5 || t.right > s.right + .5 || t.top < s.top - .5 || t.bottom > s.bottom + .5)) out++;
}
texts.forEach((a, i) => texts.slice(i + 1).forEach((b) => {
  if (!apart(a, b) && Math.abs(a.top - b.top) < 4) over++; }));
document.title = ["measured", over, out, shapes.length > 20].join(" ");
</script>"""


def overlaps(folder: Path, *found: FiledCampaign) -> str:
    """How many shapes or texts overlap, and how many texts stick out, as a browser lays them out."""
    bundle = Bundle(HASH, dict.fromkeys((one.entry for one in found), HASH), ())
    picture = gsn_svg(argument_of("e.zip", bundle, found))
    page = f"<!DOCTYPE html><meta charset='utf-8'><body style='margin:0'>{picture}{MEASURE}</body>"
    dom, console = in_browser(folder, page)
    assert console == []
    return dom.partition("<title>measured")[2].partition("</title>")[0]


@needs_browser
@pytest.mark.process
def test_nothing_overlaps_and_no_text_is_cut_off(good: Ledger, tmp_path: Path) -> None:
    """With names that are short, long, and markup."""
    spec = msgspec.structs.replace(good.head.spec, verifies=tuple(f"SG-{n}" for n in range(60)))
    other = msgspec.structs.replace(good, head=msgspec.structs.replace(good.head, spec=spec))
    why = f"{HOSTILE} {'long' * 90}"
    long = filed(changed(other, "pbr · crash", outcome="sdc", reasons=(why,)), f"{'try-' * 14}/records.jsonl")
    assert overlaps(tmp_path, filed(good), long) == " 0 0 true"
    few = [result for result in good.results if result.experiment.stratum == "pbr · crash"]
    assert overlaps(tmp_path, filed(with_results(good, *few))) == " 0 0 true", "rows as low as can be"
