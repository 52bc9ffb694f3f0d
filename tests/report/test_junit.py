"""JUnit XML: what a CI reads must be true, whole, and name the command that repeats the worst."""

from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import msgspec
from campaigns import result
from junitparser import JUnitXml, Properties
from records import CRASH, RecordInTheMaking, whole
from reported import HOSTILE, hostile, named, summary_of, with_results

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.spec import Gate
from aftbed.judge.verdict import Verdict
from aftbed.report.junit import NAMED_MAX, junit_of_run, junit_xml

SCHEMA: Final = {  # what junit-10.xsd and jenkins-junit.xsd both allow: attributes needed, allowed; children
    "testsuites": ((), ("name", "time", "tests", "failures", "errors"), ("testsuite",)),
    "testsuite": (
        ("name", "tests", "failures", "errors"),
        ("time", "skipped", "timestamp", "hostname", "id", "package"),
        ("properties", "testcase", "system-out", "system-err"),
    ),
    "properties": ((), (), ("property",)),
    "property": (("name", "value"), (), ()),
    "testcase": (
        ("name",),
        ("classname", "time"),
        ("properties", "skipped", "error", "failure", "system-out", "system-err"),
    ),
    "error": ((), ("type", "message"), ()),
    "failure": ((), ("type", "message"), ()),
}


def suite_of(ledger: Ledger) -> ElementTree.Element:
    root = ElementTree.fromstring(junit_xml(summary_of(ledger), ledger))
    keeps_to_the_schema(root)
    (suite,) = root
    return suite


def keeps_to_the_schema(element: ElementTree.Element) -> None:
    needed, allowed, children = SCHEMA[element.tag]
    assert set(needed) <= set(element.keys()) <= {*needed, *allowed}, element.attrib
    places = [children.index(child.tag) for child in element]
    assert places == sorted(places), f"{element.tag}: {[child.tag for child in element]}"
    for child in element:
        keeps_to_the_schema(child)


def failures(suite: ElementTree.Element) -> dict[str, ElementTree.Element]:
    cases = {case.get("name", ""): case.find("failure") for case in suite.iter("testcase")}
    return {name: failure for name, failure in cases.items() if failure is not None}


def some(*outcomes: str, reasons: tuple[str, ...] = (), activated: bool = True) -> list[Result]:
    """Of one stratum."""
    found = []
    for index, outcome in enumerate(outcomes):
        unexpected = outcome != "tolerated"
        one = result(outcome, index=index, unexpected=unexpected, reasons=reasons, activated=activated)
        experiment = msgspec.structs.replace(one.experiment, expected=("tolerated",))
        found.append(msgspec.structs.replace(one, experiment=experiment))
    return found


def test_a_case_per_stratum_and_per_gate(ledger: Ledger) -> None:
    suite, summary = suite_of(ledger), summary_of(ledger)
    names = [(case.get("classname"), case.get("name")) for case in suite.iter("testcase")]
    strata = [("aftbed.mixed", stratum.name) for stratum in summary.strata]
    gates = [("aftbed.mixed.gates", f"{g.metric} {g.limit} in {g.strata}") for g in summary.gates]
    assert names == strata + gates
    assert suite.get("tests") == str(len(names)) and suite.get("failures") == str(len(failures(suite)))


def test_properties_say_what_was_run(ledger: Ledger) -> None:
    found = {p.get("name"): p.get("value") for p in suite_of(ledger).iter("property")}
    summary = summary_of(ledger)
    assert found["seed"] == "7" and found["code"] == ledger.head.code and found["gate"] == summary.gate
    assert found["experiments"] == str(len(ledger.results))
    assert {f"outcome.{name}": str(n) for name, n in summary.outcomes.items()}.items() <= found.items()


def test_a_stratum_has_its_evidence_for_the_requirements_that_the_campaign_verifies(ledger: Ledger) -> None:
    assert next(suite_of(ledger).iter("testcase")).find("properties") is None, "no requirement is named"
    verifying = msgspec.structs.replace(ledger.head.spec, verifies=("SG-1", "FSR-3.2"), ftti="100ms")
    head = msgspec.structs.replace(ledger.head, spec=verifying)
    cases = list(suite_of(msgspec.structs.replace(ledger, head=head)).iter("testcase"))
    by_name = {
        case.get("name"): {p.get("name"): p.get("value") for p in case.iter("property")} for case in cases
    }
    found = by_name["pbr · steady · crash primary"]
    (stratum,) = (one for one in summary_of(ledger).strata if one.name == "pbr · steady · crash primary")
    assert stratum.handling is not None and stratum.handling.fhti_ms is not None
    assert (found["verifies"], found["n"], found["failed"]) == ("SG-1,FSR-3.2", str(stratum.experiments), "0")
    assert 0.0 < float(found["bound"] or 0) < 1.0, "few experiments prove little"
    assert (found["ftti_ms"], found["fhti_ms"]) == ("100", f"{stratum.handling.fhti_ms.max:g}")
    assert found["seed"] == "7" and found["code"] == ledger.head.code
    assert (found["command"] or "").startswith("aftbed sim --ftm pbr")
    assert by_name[cases[-1].get("name")] == {}, "a gate is no evidence of its own"


def test_what_nothing_is_known_of_is_no_evidence(ledger: Ledger) -> None:
    """Neither an experiment of an unknown outcome nor one whose fault did not strike."""
    head = msgspec.structs.replace(
        ledger.head, spec=msgspec.structs.replace(ledger.head.spec, verifies=("SG-1",))
    )
    group = [
        *some("tolerated", "inconclusive", "harness_error", "unavailable"),
        *some("tolerated", activated=False),
    ]
    suite = suite_of(with_results(msgspec.structs.replace(ledger, head=head), *group))
    (case,) = (case for case in suite.iter("testcase") if case.get("name") == "pbr · crash")
    found = {p.get("name"): p.get("value") for p in case.iter("property")}
    assert (found["n"], found["failed"]) == ("2", "1")


def test_junitparser_reads_the_properties_of_a_test_case(ledger: Ledger, tmp_path: Path) -> None:
    head = msgspec.structs.replace(
        ledger.head, spec=msgspec.structs.replace(ledger.head.spec, verifies=("SG-1",))
    )
    path = tmp_path / "junit.xml"
    path.write_text(junit_xml(summary_of(ledger), msgspec.structs.replace(ledger, head=head)))
    (suite,) = JUnitXml.fromfile(str(path))
    properties = next(iter(suite)).child(Properties)
    assert {p.name: p.value for p in properties}["verifies"] == "SG-1"


def test_a_failure_says_why_and_how_to_repeat_the_worst(ledger: Ledger) -> None:
    group = some("tolerated", "degraded", "sdc", "degraded", reasons=("because",))
    failure = failures(suite_of(with_results(ledger, *group)))["pbr · crash"]
    assert failure.get("type") == "unexpected"
    assert failure.get("message", "").startswith(
        "3 of 4 unexpected: tolerated 1, degraded 2, sdc 1; expected: tol"
    )
    lines = (failure.text or "").splitlines()
    assert lines[1:] == [f"the worst: experiment {2:016x}: sdc", "because", group[2].experiment.command()]


def test_a_gate_on_unexpected_that_holds_excuses_the_stratum(ledger: Ledger) -> None:
    group = some("tolerated", "degraded")
    assert failures(suite_of(with_results(ledger, *group, gates=(Gate("unexpected", max=1.0),)))) == {}
    elsewhere = (Gate("unexpected", max=1.0, strata="lfr*"), Gate("sdc", max=1.0))
    assert "pbr · crash" in failures(suite_of(with_results(ledger, *group, gates=elsewhere)))


def test_a_gate_that_fails_names_the_worst_of_its_strata(ledger: Ledger) -> None:
    group = [*some("sdc", "tolerated"), named(some("harness_error")[0], "lfr · crash")]
    other = msgspec.structs.replace(group[2].experiment, id="f" * 16)
    group[2] = msgspec.structs.replace(group[2], experiment=other)
    found = failures(suite_of(with_results(ledger, *group, gates=(Gate("sdc", max=0.1, strata="pbr*"),))))
    failure = found["sdc at most 0.1 in pbr*"]
    assert failure.get("type") == "gate" and "and it may be" in failure.get("message", "")
    assert f"experiment {0:016x}: sdc" in (failure.text or "")


def test_a_stratum_that_could_not_have_failed_fails(ledger: Ledger) -> None:
    found = failures(suite_of(with_results(ledger, *some("tolerated", "tolerated", activated=False))))
    assert found["pbr · crash"].get("type") == "not_activated"
    assert len(found) == 2  # and so does the gate that the campaign has for it


def test_hostile_names_are_text_and_what_xml_cannot_say_is_replaced(ledger: Ledger) -> None:
    found = failures(suite_of(with_results(ledger, hostile())))
    assert HOSTILE.replace("\x01", "�") in found


def test_no_results_no_cases_but_gates(ledger: Ledger) -> None:
    cases = list(suite_of(with_results(ledger)).iter("testcase"))
    assert {case.get("classname") for case in cases} == {"aftbed.mixed.gates"}


def test_it_says_its_encoding(ledger: Ledger, tmp_path: Path) -> None:
    path = tmp_path / "junit.xml"
    path.write_text(junit_xml(summary_of(ledger), ledger), encoding="utf-8")
    assert "pbr · steady · crash primary" in [c.get("name") for c in ElementTree.parse(path).iter("testcase")]


# -- of a single run


def case_of(verdict: Verdict) -> tuple[ElementTree.Element, dict[str, str]]:
    """Its only test case, and the properties of it."""
    root = ElementTree.fromstring(junit_of_run(verdict))
    keeps_to_the_schema(root)
    (case,) = root.iter("testcase")
    return case, {p.get("name", ""): p.get("value", "") for p in case.iter("property")}


def verifying(record: RecordInTheMaking, *, command: str = "aftbed run") -> RecordInTheMaking:
    record.options = msgspec.structs.replace(
        record.options, verifies=("SG-1", "FSR-3.2"), ftti_ms=100.0, command=command, code="0.1.0+0badc0de"
    )
    return record


def test_a_run_is_one_test_case_with_its_evidence(tmp_path: Path) -> None:
    record = verifying(whole(tmp_path / "record", faults=(CRASH,)), command="aftbed run --seed 7")
    record.failover()
    record.request(epoch=2, replica=2)
    verdict = record.verdict()
    case, found = case_of(verdict)
    assert (case.get("name"), list(case)) == (f"load · pbr · {CRASH}", [case.find("properties")])
    (handled,) = (one.fhti_ms for one in verdict.intervals if one.of_fault)
    assert handled is not None
    assert found == {
        "verifies": "SG-1,FSR-3.2",
        "n": "1",
        "failed": "0",
        "bound": "0.975",
        "confidence": "0.95",
        "ftti_ms": "100",
        "fhti_ms": f"{handled:g}",
        "seed": "7",
        "command": "aftbed run --seed 7",
        "code": "0.1.0+0badc0de",
    }


def test_a_run_that_broke_a_promise_is_a_failure_of_that_check(tmp_path: Path) -> None:
    record = verifying(whole(tmp_path / "record"), command="aftbed run --seed 7 --verifies SG-1")
    record.request(answers=0)
    case, found = case_of(record.verdict())
    failure = case.find("failure")
    assert failure is not None and failure.get("type") == "exactly_one_answer"
    assert failure.get("message") == "exactly_one_answer: request 4: 0 replies"
    assert (failure.text or "").splitlines()[-1] == "aftbed run --seed 7 --verifies SG-1"
    assert (found["n"], found["failed"], found["bound"]) == ("1", "1", "1")


def test_an_inconclusive_run_is_an_error_and_no_evidence(tmp_path: Path) -> None:
    record = verifying(whole(tmp_path / "record"))
    record.end = None
    case, found = case_of(record.verdict())
    error = case.find("error")
    assert error is not None and error.get("type") == "inconclusive" and case.find("failure") is None
    assert (found["n"], found["failed"], found["bound"]) == ("0", "0", "1")


def test_a_run_that_verifies_nothing_has_no_properties_of_its_case(tmp_path: Path) -> None:
    case, found = case_of(whole(tmp_path / "record").verdict())
    assert (list(case), found) == ([], {})


def test_the_texts_of_a_run_are_text(tmp_path: Path) -> None:
    record = verifying(whole(tmp_path / "record"), command=HOSTILE)
    verdict = msgspec.structs.replace(record.verdict(), scenario=HOSTILE)
    case, found = case_of(verdict)
    assert found["command"] == HOSTILE.replace("\x01", "\ufffd")
    assert (case.get("name") or "").startswith(HOSTILE.replace("\x01", "\ufffd"))


def test_the_name_of_a_run_with_many_faults_is_cut(tmp_path: Path) -> None:
    verdict = whole(tmp_path / "record", faults=(CRASH,) * 100).verdict()
    case, _ = case_of(verdict)
    assert (case.get("name") or "").endswith(f" · {102 - NAMED_MAX} more")
