"""The last messages before a breach: as people read them, and in Mermaid's grammar."""

import re

import pytest

from aftbed.inject.crash import Crash
from aftbed.inject.model import Fault
from aftbed.inject.timing import Trigger
from aftbed.judge.verdict import Breach
from aftbed.report.sequence import escaped, mermaid, text
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
    found = text(trace, (LOST,), 8).splitlines()
    assert len(found) == 9 and found[-1] == "broken: G2: request 2: 0 replies"
    assert "answered" in found[-2] and "#2 " in found[-2]
    columns = r" *\d+\.\d{3} ms  \S+ +(\*|\S+|\w+ -> \S+)  .+"
    assert all(re.fullmatch(columns, line) for line in found[:-1])


def test_without_a_request_it_ends_with_the_run(trace: Trace) -> None:
    whole = [line.split() for line in text(trace, last=100_000).splitlines()]
    assert len(whole) == len(trace.happened)
    found = [line.split() for line in text(trace, (UNREST,), 10).splitlines()]
    assert found == [*whole[-10:], f"broken: {UNREST}".split()]


def test_a_listing_tells_faults_and_what_the_executive_said(trace: Trace) -> None:
    found = text(trace, last=100_000)
    assert "fault.applied: crash primary at checkpoint.sent nth 2" in found
    assert re.search(r"supervisor +struck +a/after\n", found)
    assert re.search(r"supervisor +script +failover \(a\)\n", found)
    assert re.search(r"a/after +aft2aft -> b/after +Checkpoint e1 #2 reply=", found)


def test_a_diagram_has_nodes_arrows_and_notes(trace: Trace) -> None:
    diagram = mermaid(trace, (LOST,), 100_000)
    names, arrows = check_grammar(diagram)
    assert {"client", "proxy", "a/after", "b/after", "a/watchdog", "recovery"} <= names
    assert arrows > 30
    assert "fault.applied: crash primary at checkpoint.sent nth 2" in diagram
    assert "script: failover (a)" in diagram and "checkpoint.sent #35;" not in diagram
    assert diagram.splitlines()[-1].endswith("broken: G2: request 2: 0 replies")


def test_a_diagram_is_as_long_as_it_is_told(trace: Trace) -> None:
    body = [line for line in mermaid(trace, last=5).splitlines() if not line.startswith("    participant")]
    assert len(body) == 1 + 5


def test_bricks_that_share_a_node_are_one_participant() -> None:
    names, _ = check_grammar(mermaid(traced(Setup("pbr", "replica", count=1)), last=100))
    assert {"client", "proxy", "a", "b"} == names


def test_a_run_in_which_nothing_was_said_is_a_diagram_too(trace: Trace) -> None:
    empty = Trace(trace.run, ())
    assert check_grammar(mermaid(empty, (UNREST,))) == ({"supervisor"}, 0)
    assert text(empty) == ""


def test_what_means_something_to_mermaid_is_escaped() -> None:
    assert escaped("request #1; <b> end") == "request #35;1#59; #60;b#62; #101;nd"
    assert escaped("sender, ending: 100 %") == "sender, ending: 100 #37;"
    assert escaped("two\nlines \\ ``") == "two#10;lines #92; #96;#96;"
    assert escaped("END") == "#69;ND"


@pytest.mark.parametrize("seed", range(8))
def test_whatever_a_swarm_does_can_be_drawn(seed: int) -> None:
    trace = traced(drawn(seed))
    check_grammar(mermaid(trace, (LOST, UNREST), 200))
    assert len(text(trace, (UNREST,), 200).splitlines()) == 201
