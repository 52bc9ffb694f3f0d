"""JUnit XML: what a CI shows of a campaign without knowing what a campaign is.

A test suite is the campaign; a test case is a stratum, or a gate. The text of a failure says why, and ends
with the command that repeats the worst experiment, for whoever reads it in the log of a build.

A stratum fails where
- experiments came out otherwise than expected, unless a gate on `unexpected` that holds covers it: then the
  campaign's author has said how many are too many, and they were not;
- or its faults never struck.
A gate fails where it does. So a campaign that fails has a test case that does, and one that passes without
unexpected outcomes has none.

The schema is `junit-10.xsd` of the Jenkins xUnit plugin, which pytest keeps to as well, in the part of it
that the older `jenkins-junit.xsd` allows too. XML 1.0 has no control characters: they come as U+FFFD.
"""

import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatch
from typing import Final
from xml.etree import ElementTree

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.summary import GateResult, StratumSummary, Summary
from aftbed.report.worst import worst_of

UNEXPECTED: Final = "unexpected"
NOT_ACTIVATED: Final = "not_activated"
GATE: Final = "gate"
_NO_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_xml(summary: Summary, ledger: Ledger) -> str:
    """The document, ready to be written."""
    groups: dict[str, list[Result]] = {}
    for result in ledger.results:
        groups.setdefault(result.experiment.stratum, []).append(result)
    suite = ElementTree.Element("testsuite")
    suite.append(_properties(summary, ledger))
    for stratum in summary.strata:
        why = _why(stratum, summary.gates, groups[stratum.name])
        seconds = sum(result.seconds for result in groups[stratum.name])
        suite.append(_case(f"aftbed.{summary.campaign}", stratum.name, seconds, why))
    for gate in summary.gates:
        why = (GATE, _gate_text(gate, groups)) if gate.word == "fail" else None
        suite.append(_case(f"aftbed.{summary.campaign}.gates", _gate_name(gate), 0.0, why))
    counts = {"tests": len(suite.findall("testcase")), "failures": len(suite.findall("testcase/failure"))}
    told = {name: str(count) for name, count in counts.items()} | {"errors": "0"}
    _attributes(suite, {"name": summary.campaign, **told, "skipped": "0", "time": f"{summary.seconds:.3f}"})
    root = ElementTree.Element("testsuites")
    _attributes(root, {"name": "aftbed campaign", **told, "time": f"{summary.seconds:.3f}"})
    root.append(suite)
    ElementTree.indent(root)
    return f"<?xml version='1.0' encoding='utf-8'?>\n{ElementTree.tostring(root, encoding='unicode')}\n"


def _properties(summary: Summary, ledger: Ledger) -> ElementTree.Element:
    found = {
        "campaign": summary.campaign,
        "seed": str(summary.seed),
        "code": summary.code,
        "spec": ledger.head.digest,
        "runtime": ledger.head.spec.system.runtime,
        "experiments": str(summary.experiments),
        "planned": str(summary.planned),
        "gate": summary.gate,
        **{f"outcome.{name}": str(count) for name, count in summary.outcomes.items()},
    }
    element = ElementTree.Element("properties")
    for name, value in found.items():
        _attributes(ElementTree.SubElement(element, "property"), {"name": name, "value": value})
    return element


def _case(group: str, name: str, seconds: float, why: tuple[str, str] | None) -> ElementTree.Element:
    case = ElementTree.Element("testcase")
    _attributes(case, {"classname": group, "name": name, "time": f"{seconds:.3f}"})
    if why is not None:
        kind, text = why
        failure = ElementTree.SubElement(case, "failure")
        _attributes(failure, {"type": kind, "message": text.partition("\n")[0]})
        failure.text = _readable(text)
    return case


def _why(
    stratum: StratumSummary, gates: Iterable[GateResult], results: list[Result]
) -> tuple[str, str] | None:
    """Kind and text of its failure, if it fails."""
    if stratum.unexpected and not _allowed(stratum.name, gates):
        came = ", ".join(f"{name} {count}" for name, count in stratum.outcomes.items())
        text = f"{stratum.unexpected} of {stratum.experiments} unexpected: {came};"
        return UNEXPECTED, f"{text} expected: {', '.join(stratum.expected)}\n{_worst_text(results)}"
    if results[0].experiment.faults and not stratum.activated:
        text = f"none of {stratum.experiments} faults struck: this stratum could not have failed"
        return NOT_ACTIVATED, f"{text}\n{_worst_text(results)}"
    return None


def _allowed(name: str, gates: Iterable[GateResult]) -> bool:
    """Whether a gate says how many unexpected outcomes are too many here, and it holds."""
    words = [gate.word for gate in gates if gate.metric == UNEXPECTED and fnmatch(name, gate.strata)]
    return bool(words) and "fail" not in words


def _worst_text(results: list[Result]) -> str:
    worst = worst_of(results)
    experiment = worst.experiment
    head = f"the worst: experiment {experiment.id}: {worst.outcome}"
    lines = [head, *worst.broken, *worst.reasons, experiment.command()]
    return "\n".join(lines)


def _gate_name(gate: GateResult) -> str:
    return f"{gate.metric} {gate.limit} in {gate.strata}"


def _gate_text(gate: GateResult, groups: Mapping[str, list[Result]]) -> str:
    """The worst is that of the strata which the gate is about."""
    meant = [
        r
        for name, results in groups.items()
        if name == gate.strata or fnmatch(name, gate.strata)
        for r in results
    ]
    text = f"{_gate_name(gate)}: {gate.reason}"
    return f"{text}\n{_worst_text(meant)}" if meant else text


def _attributes(element: ElementTree.Element, values: Mapping[str, str]) -> None:
    for name, value in values.items():
        element.set(name, _readable(value))


def _readable(text: str) -> str:
    return _NO_XML.sub("�", text)
