"""JUnit XML: what a CI shows of a campaign, or of a run, without knowing what these are.

A test suite is the campaign; a test case is a stratum, or a gate. A failure has its reason as text, and ends
with the command that repeats the worst experiment, so that it stands in the log of a build.

A stratum fails if
- it has unexpected outcomes, unless a gate on `unexpected` that passes covers it: then the campaign's author
  has set how many are too many, and there were fewer;
- or none of its faults struck.
A gate fails as it does in the summary. So a campaign that fails has a failed test case, and a campaign that
passes without unexpected outcomes has none.

A run is one test case, and not one for each check: a requirement is verified by all of them together, tools
count test cases, and which checks there are depends on what was run. A broken promise is a failure, whose
type is the check; an inconclusive run is an error, and no evidence.

The schema is `junit-10.xsd` of the Jenkins xUnit plugin, which pytest keeps to as well, in the part that the
older `jenkins-junit.xsd` allows too. But where a campaign or a run verifies requirements, a test case has
properties: tools that trace requirements read them there. XML 1.0 has no control characters: they become
U+FFFD.
"""

import io
import re
from collections.abc import Iterable, Mapping
from fnmatch import fnmatch
from typing import Final
from xml.etree import ElementTree

from junitparser import Error, Failure, JUnitXml, Properties, Property, TestCase, TestSuite

from aftbed.campaign.experiment import Result, failed
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.plan import JOINED
from aftbed.campaign.statistics import CONFIDENCE, proportion
from aftbed.campaign.summary import NOT_ALL, GateResult, StratumSummary, Summary, confidence_of
from aftbed.judge.outcome import UNKNOWN
from aftbed.judge.verdict import Verdict
from aftbed.report.worst import worst_of

UNEXPECTED: Final = "unexpected"
GATE: Final = "gate"
NAMED_MAX: Final = 6  # parts of the name of a run: what was driven, the mechanism, faults, adaptations
_NO_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_xml(summary: Summary, ledger: Ledger) -> str:
    """The document, ready to be written."""
    groups: dict[str, list[Result]] = {}
    for result in ledger.results:
        groups.setdefault(result.experiment.stratum, []).append(result)
    suite = TestSuite(_readable(summary.campaign))
    for name, value in _properties(summary, ledger).items():
        suite.add_property(name, _readable(value))
    group = f"aftbed.{summary.campaign}"
    cases = []
    for stratum in summary.strata:
        results = groups[stratum.name]
        seconds = sum(result.seconds for result in results)
        evidence = _evidence(stratum, ledger, results) if ledger.head.spec.verifies else None
        cases.append(_case(group, stratum.name, seconds, _why(stratum, summary.gates, results), evidence))
    for gate in summary.gates:
        why = (GATE, _gate_text(gate, groups)) if gate.word == "fail" else None
        cases.append(_case(f"{group}.gates", _gate_name(gate), 0.0, why))
    suite.add_testcases(cases)  # counts them
    suite.time = round(summary.seconds, 3)
    return _document("aftbed campaign", suite)


def junit_of_run(verdict: Verdict) -> str:
    """The document of a single run."""
    suite = TestSuite("run")
    about = {
        **{name: getattr(verdict, name) for name in ("run", "ftm", "placement", "scenario", "app", "code")},
        "seed": str(verdict.seed),
        "verdict": verdict.verdict,
        **{f"check.{name}": finding for name, finding in verdict.checks.items()},
    }
    for name, value in about.items():
        if value:
            suite.add_property(name, _readable(value))
    faults = [report.fault for report in verdict.faults]
    what = [verdict.scenario, verdict.ftm, *faults, *(one.asked for one in verdict.adaptations)]
    more = [f"{len(what) - NAMED_MAX} more"] if len(what) > NAMED_MAX else []
    evidence = _evidence_of_run(verdict) if verdict.verifies else None
    seconds = verdict.seconds or 0.0
    case = _case("aftbed.run", JOINED.join((*what[:NAMED_MAX], *more)), seconds, None, evidence)
    text = "\n".join((*verdict.reasons, *([verdict.command] if verdict.command else [])))
    if verdict.verdict == "fail":
        check = next(name for name, finding in verdict.checks.items() if finding == "fail")
        message = next((reason for reason in verdict.reasons if reason.startswith(f"{check}:")), check)
        case.result = [_result(Failure, check, message, text)]
    elif verdict.verdict == "inconclusive":
        case.result = [_result(Error, verdict.verdict, next(iter(verdict.reasons), ""), text)]
    suite.add_testcases([case])
    suite.time = round(seconds, 3)
    return _document("aftbed run", suite)


def _document(name: str, suite: TestSuite) -> str:
    document = JUnitXml(name)
    document.add_testsuite(suite)
    document.tests, document.failures, document.errors = suite.tests, suite.failures, suite.errors
    document.time = suite.time  # its other count, `skipped`, is none of the schema's
    file = io.BytesIO()
    document.write(file)
    root = ElementTree.fromstring(file.getvalue())
    ElementTree.indent(root)
    return f"<?xml version='1.0' encoding='utf-8'?>\n{ElementTree.tostring(root, encoding='unicode')}\n"


def _evidence(stratum: StratumSummary, ledger: Ledger, results: list[Result]) -> Properties:
    """What a stratum says about the requirements: tools read the properties of a test case, not of its suite.

    An experiment of which nothing is known, or whose faults did not strike, is no evidence. `bound`: of the
    share of experiments that failed, with the confidence of the campaign. Of fault handling times, in ms: the
    longest, and the p99 at most, where that is known.
    """
    spec = ledger.head.spec
    told = [r for r in results if failed(r) or (r.activated and r.outcome not in UNKNOWN)]
    bad = sum(map(failed, told))
    confidence = confidence_of(spec)
    fhti = stratum.handling.fhti_ms if stratum.handling is not None else None
    found = {
        "verifies": ",".join(spec.verifies),
        "n": str(len(told)),
        "failed": str(bad),
        "bound": f"{proportion(bad, len(told), confidence).high:.4g}",
        "confidence": f"{confidence:g}",
        "ftti_ms": f"{spec.ftti_ms:g}" if spec.ftti else "",
        "fhti_ms": f"{fhti.max:g}" if fhti is not None else "",
        "fhti_p99_bound_ms": f"{fhti.p99_bound:g}" if fhti is not None and fhti.p99_bound is not None else "",
        "seed": str(spec.seed),
        "command": worst_of(results).experiment.command(),
        "code": ledger.head.code,
    }
    return _properties_of(found)


def _evidence_of_run(verdict: Verdict) -> Properties:
    """What one run says about its requirements: little, as its bound tells, and nothing if inconclusive."""
    known, bad = int(verdict.verdict != "inconclusive"), int(verdict.verdict == "fail")
    times = [one.fhti_ms for one in verdict.intervals if one.of_fault and one.fhti_ms is not None]
    found = {
        "verifies": ",".join(verdict.verifies),
        "n": str(known),
        "failed": str(bad),
        "bound": f"{proportion(bad, known).high:.4g}",
        "confidence": f"{CONFIDENCE:g}",
        "ftti_ms": f"{verdict.ftti_ms:g}" if verdict.ftti_ms else "",
        "fhti_ms": f"{max(times):g}" if times else "",
        "seed": str(verdict.seed),
        "command": verdict.command,
        "code": verdict.code,
    }
    return _properties_of(found)


def _properties_of(found: Mapping[str, str]) -> Properties:
    """Without those that are empty."""
    properties = Properties()  # type: ignore[no-untyped-call]
    for name, value in found.items():
        if value:
            properties.add_property(Property(name, _readable(value)))
    return properties


def _case(
    group: str,
    name: str,
    seconds: float,
    why: tuple[str, str] | None,
    evidence: Properties | None = None,
) -> TestCase:
    case = TestCase(_readable(name), _readable(group), round(seconds, 3))
    if evidence is not None:
        case.append(evidence)  # type: ignore[no-untyped-call]
    if why is not None:
        kind, text = why
        case.result = [_result(Failure, kind, text.partition("\n")[0], text)]
    return case


def _result(made: type[Failure] | type[Error], kind: str, message: str, text: str) -> Failure | Error:
    result = made(_readable(message), kind)
    result.text = _readable(text)
    return result


def _properties(summary: Summary, ledger: Ledger) -> dict[str, str]:
    return {
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


def _why(
    stratum: StratumSummary, gates: Iterable[GateResult], results: list[Result]
) -> tuple[str, str] | None:
    """Kind and text of the stratum's failure, if it fails."""
    if stratum.unexpected and not _allowed(stratum.name, gates):
        came = ", ".join(f"{name} {count}" for name, count in stratum.outcomes.items())
        text = f"{stratum.unexpected} of {stratum.experiments} unexpected: {came};"
        return UNEXPECTED, f"{text} expected: {', '.join(stratum.expected)}\n{_worst_text(results)}"
    vacuous = (gate for gate in gates if gate.limit == NOT_ALL and gate.strata == stratum.name)
    return next(((gate.metric, f"{gate.reason}\n{_worst_text(results)}") for gate in vacuous), None)


def _allowed(name: str, gates: Iterable[GateResult]) -> bool:
    """Whether a gate limits the unexpected outcomes of this stratum, and passes."""
    words = [gate.word for gate in gates if gate.metric == UNEXPECTED and fnmatch(name, gate.strata)]
    return bool(words) and "fail" not in words


def _worst_text(results: list[Result]) -> str:
    worst = worst_of(results)
    experiment = worst.experiment
    head = f"the worst: experiment {experiment.id}: {worst.outcome}"
    return "\n".join((head, *worst.broken, *worst.reasons, experiment.command()))


def _gate_name(gate: GateResult) -> str:
    return f"{gate.metric} {gate.limit} in {gate.strata}"


def _gate_text(gate: GateResult, groups: Mapping[str, list[Result]]) -> str:
    """With the worst experiment of the strata that the gate is about."""
    covered = [
        result
        for name, results in groups.items()
        if name == gate.strata or fnmatch(name, gate.strata)
        for result in results
    ]
    text = f"{_gate_name(gate)}: {gate.reason}"
    return f"{text}\n{_worst_text(covered)}" if covered else text


def _readable(text: str) -> str:
    return _NO_XML.sub("�", text)
