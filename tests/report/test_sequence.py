"""A simulated run as a listing, in Mermaid's grammar, and as a space-time diagram."""

import re
from xml.etree import ElementTree

import pytest

from aftbed.adapt.commands import scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, parse
from aftbed.judge.verdict import Breach
from aftbed.report.html import TEMPLATES, engine
from aftbed.report.sequence import KEPT_MAX, Shape, SpaceTime, escaped, listing, mermaid, space_time
from aftbed.runtime.sim.trace import Trace, traced
from aftbed.runtime.sim.world import Setup
from aftbed.search.swarm import drawn

CRASH = Fault(Crash(), "primary", Trigger("checkpoint.sent", 2))
LOST = Breach("G2", "request 2: 0 replies")
UNREST = Breach("rest", "requests wait; <no> end")

PARTICIPANT = re.compile(r"    participant (p\d+) as ([^#;<>\"]+)")
NOTE = re.compile(r"    Note over (p\d+)(?:,(p\d+))?: (.+)")
ARROW = re.compile(r"    (p\d+)->>(p\d+): (.+)")
PLAIN = re.compile(r"(?:[A-Za-z0-9 _.,:'/()=+*-]|#\d+;)+")


@pytest.fixture(scope="module")
def trace() -> Trace:
    return traced(Setup("pbr", "process", 7, 4, 0.0, (CRASH,)))


def check_grammar(diagram: str) -> tuple[set[str], int]:
    """The participants, and how many arrows there are; fails on what Mermaid would not read."""
    first, *rest = diagram.splitlines()
    assert first == "sequenceDiagram" and diagram.endswith("\n")
    known: dict[str, str] = {}
    arrows = 0
    for line in rest:
        if found := PARTICIPANT.fullmatch(line):
            assert found[1] not in known
            known[found[1]] = found[2]
            continue
        arrow = ARROW.fullmatch(line)
        found = arrow or NOTE.fullmatch(line)
        assert found, line
        assert {found[1], found[2] or found[1]} <= known.keys()
        assert PLAIN.fullmatch(found[3]) and not re.search(r"\bend\b", found[3], re.IGNORECASE)
        arrows += bool(arrow)
    assert known
    return set(known.values()), arrows


def test_a_listing_ends_with_what_happened_to_the_request_last(trace: Trace) -> None:
    found = listing(trace, (LOST,), 8).splitlines()
    assert len(found) == 9 and found[-1] == "broken: G2: request 2: 0 replies"
    assert "answered" in found[-2] and "#2 " in found[-2]
    columns = r" *\d+\.\d{3} ms  \S+ +(\*|\S+|\w+ -> \S+)  .+"
    assert all(re.fullmatch(columns, line) for line in found[:-1])


def test_without_a_request_it_ends_with_the_run(trace: Trace) -> None:
    whole = [line.split() for line in listing(trace, last=100_000).splitlines()]
    assert len(whole) == len(trace.happened)
    found = [line.split() for line in listing(trace, (UNREST,), 10).splitlines()]
    assert found == [*whole[-10:], f"broken: {UNREST}".split()]


def test_a_listing_tells_faults_and_what_the_executive_said(trace: Trace) -> None:
    found = listing(trace, last=100_000)
    assert "fault.applied: crash primary at checkpoint.sent nth 2" in found
    assert re.search(r"supervisor +struck +a/after\n", found)
    assert re.search(r"supervisor +script +failover \(a\)\n", found)
    assert re.search(r"a/after +aft2aft -> b/after +Checkpoint e1 #2 reply=", found)


def test_a_diagram_has_nodes_arrows_and_notes(trace: Trace) -> None:
    diagram = mermaid(trace, (LOST,))
    names, arrows = check_grammar(diagram)
    assert {"client", "proxy", "a/after", "b/after", "a/watchdog", "recovery"} <= names
    assert arrows > 15
    assert "fault.applied: crash primary at checkpoint.sent nth 2" in diagram
    assert "script: failover (a)" in diagram and "checkpoint.sent #35;" not in diagram
    assert diagram.splitlines()[-1].endswith("broken: G2: request 2: 0 replies")


def test_a_diagram_shows_the_fault_and_counts_what_is_left_out_behind_it() -> None:
    long = traced(Setup("pbr", "process", 7, 60, 0.0, (CRASH,)))
    lines = mermaid(long).splitlines()
    fault = next(at for at, line in enumerate(lines) if "fault.applied: crash primary" in line)
    left_out = [at for at, line in enumerate(lines) if re.search(r": \d+ more, [\d.]+ ms$", line)]
    assert left_out and left_out[0] > fault and len(lines) < 120
    assert "backup.ready" in mermaid(long) and "#35;60 " not in lines[-1], "not the end"
    check_grammar(mermaid(long))


def test_of_a_broken_run_a_diagram_also_shows_the_end() -> None:
    long = traced(Setup("pbr", "process", 7, 200, 0.0, (CRASH,)))
    assert "#35;200 " not in mermaid(long)
    broken = mermaid(long, (UNREST,))
    assert "#35;200 " in broken and "fault.applied: crash primary" in broken
    check_grammar(broken)


def test_both_diagrams_have_the_same_messages() -> None:
    long = traced(Setup("pbr", "process", 7, 60, 0.0, (CRASH,)))
    _, arrows = check_grammar(mermaid(long))
    assert arrows == len(space_time(long).arrows)


def test_bricks_that_share_a_node_are_one_participant() -> None:
    names, _ = check_grammar(mermaid(traced(Setup("pbr", "replica", count=1))))
    assert {"client", "proxy", "a", "b"} == names


def test_a_run_in_which_nothing_was_said_is_a_diagram_too(trace: Trace) -> None:
    empty = Trace(trace.run, ())
    assert check_grammar(mermaid(empty, (UNREST,))) == ({"supervisor"}, 0)
    assert listing(empty) == ""


def test_what_means_something_to_mermaid_is_escaped() -> None:
    assert escaped("request #1; <b> end") == "request #35;1#59; #60;b#62; #101;nd"
    assert escaped("sender, ending: 100 %") == "sender, ending: 100 #37;"
    assert escaped("two\nlines \\ ``") == "two#10;lines #92; #96;#96;"
    assert escaped("END") == "#69;ND"


@pytest.mark.parametrize("seed", range(8))
def test_whatever_a_swarm_does_can_be_drawn(seed: int) -> None:
    trace = traced(drawn(seed))
    check_grammar(mermaid(trace, (LOST, UNREST)))
    assert len(listing(trace, (UNREST,), 200).splitlines()) == 201


# -- space-time


def trace_of(ftm: str = "pbr", placement: str = "process", fault: str = "", adapt: str = "") -> Trace:
    graph = build(ftm, placement)
    faults = (parse(fault),) if fault else ()
    changes = scheduled((adapt,) if adapt else (), graph, RECIPES[0])
    return traced(Setup(ftm, placement, 3, 40, 0.0, faults, changes))


@pytest.fixture(scope="module")
def failover() -> Trace:
    return trace_of(fault="crash primary at server.exit nth 8")


def words(shapes: list[Shape]) -> list[str]:
    return [shape.text for shape in shapes]


def marks(diagram: SpaceTime) -> list[Shape]:
    return [*diagram.arrows, *diagram.dots, *diagram.crosses, *diagram.diamonds]


def test_nodes_are_rows_in_the_order_of_a_request(failover: Trace) -> None:
    rows = words(space_time(failover).rows)
    assert rows[:7] == ["client", "proxy", "a/protocol", "a/before", "a/proceed", "a/server", "a/after"]
    assert rows[-2:] == ["recovery", "supervisor"]
    assert rows.index("a/watchdog") < rows.index("b/protocol")


def test_the_fault_and_the_steps_of_the_failover_are_marked(failover: Trace) -> None:
    diagram = space_time(failover)
    fault = "crash primary at server.exit nth 8"
    assert {fault, "watchdog.suspect", "replica.promoted", "backup.ready"} <= set(words(diagram.labels))
    assert any(text.endswith("a/server was hit") for text in words(diagram.crosses))
    assert any(life.css == "hit" for life in diagram.lives)


def test_the_steps_of_an_adaptation_are_marked() -> None:
    diagram = space_time(trace_of(adapt="compose pbr+tr at request 20"))
    assert {"adapt.plan", "adapt.commit"} <= set(words(diagram.labels))
    assert any("adapt.step.enter 1" in text for text in words(diagram.diamonds))
    assert not diagram.crosses


def test_an_arrow_per_message_that_is_kept_and_the_rest_is_counted(failover: Trace) -> None:
    diagram = space_time(failover)
    left_out = sum(int(text.split()[0]) for text in words(diagram.gaps))
    assert len(diagram.arrows) == diagram.text.count(" -> ") > 20
    lines = len(diagram.text.splitlines())
    assert lines <= KEPT_MAX and lines + left_out <= len(failover.happened) and left_out > 0


@pytest.mark.parametrize("placement", ["process", "replica", "single"])
@pytest.mark.parametrize("ftm", ["none", "pbr", "lfr+tr"])
def test_any_run_can_be_drawn(ftm: str, placement: str) -> None:
    diagram = space_time(trace_of(ftm, placement))
    assert len(diagram.rows) >= 2
    assert diagram.arrows or placement == "single"


def test_nothing_lies_outside_of_the_picture() -> None:
    diagram = space_time(trace_of(fault="hang primary for 90ms at server.exit nth 8"))
    shapes = [*marks(diagram), *diagram.lives, *diagram.bands, *diagram.gaps, *diagram.labels]
    assert all(0 <= x <= diagram.width for shape in shapes for x in (shape.x, shape.x2))
    assert all(0 <= y <= diagram.height for shape in shapes for y in (shape.y, shape.y2))
    assert all(label.y > 0 and diagram.top <= label.y2 for label in diagram.labels)


def test_the_drawing_has_every_mark_with_its_tooltip(failover: Trace) -> None:
    diagram = space_time(failover)
    macros = engine(TEMPLATES).get_template("spacetime.html.j2").module
    names, body = (ElementTree.fromstring(str(macro(diagram))) for macro in (macros.names, macros.body))
    assert [element.text for element in names.iter("text")] == words(diagram.rows)
    gaps = ["left out: no turning point here"] * len(diagram.gaps)
    assert sorted(words(marks(diagram)) + gaps) == sorted(title.text for title in body.iter("title"))
    arrows = [group for group in body.iter("g") if group.get("class", "").startswith("message ")]
    assert len(arrows) == len(diagram.arrows)
    assert body.get("aria-label") == f"space-time diagram: {len(diagram.rows)} nodes"
