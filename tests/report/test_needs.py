"""sphinx-needs, in which requirements are traced, reads the evidence of runs and campaigns as it is written.

`ub-test-reports` makes needs of JUnit XML, for `needimport`; `sphinx-test-reports`, which uses it, has the
directives that show them in a page. The latter brings Sphinx and thirty packages: it is the extra `needs`.
"""

import html
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec
import pytest
from records import CRASH, whole
from reported import summary_of
from ub_test_reports.cli import main as convert

from aftbed.campaign.ledger import Ledger
from aftbed.report.junit import junit_of_run, junit_xml

VERIFIES: Final = ("SG-1", "FSR-3.2")
SHOWN: Final = ("n", "failed", "bound", "confidence", "ftti_ms", "fhti_ms", "seed", "command", "code")
CONF: Final = f"""\
project = "evidence"
extensions = ["sphinx_needs", "sphinx_test_reports"]
tr_extra_options = {list(SHOWN)}
tr_property_link_types = {{"verifies": "links"}}
needs_id_regex = "^[A-Za-z0-9_-]+$"
"""
PAGE: Final = """\
Safety case
===========

.. req:: Stops short of the obstacle
   :id: SG-1

.. req:: Faults are handled
   :id: FSR-3

   :np:`(2) within the FTTI`

.. test-file:: One run
   :file: run.xml
   :id: RUN
   :auto_suites:
   :auto_cases:

.. test-file:: A campaign
   :file: campaign.xml
   :id: CAMPAIGN
   :auto_suites:
   :auto_cases:
"""
SECONDS_MAX: Final = 100.0
STRATUM: Final = "pbr · steady · crash primary"


@pytest.fixture
def reports(tmp_path: Path, ledger: Ledger) -> tuple[Path, Path]:
    """JUnit XML of a run and of a campaign, which verify the same."""
    record = whole(tmp_path / "record", faults=(CRASH,))
    record.failover()
    record.request(epoch=2, replica=2)
    record.options = msgspec.structs.replace(
        record.options, verifies=VERIFIES, ftti_ms=100.0, command="aftbed run", code="0.1.0+0badc0de"
    )
    spec = msgspec.structs.replace(ledger.head.spec, verifies=VERIFIES, ftti="100ms")
    verifying = msgspec.structs.replace(ledger, head=msgspec.structs.replace(ledger.head, spec=spec))
    run, campaign = tmp_path / "run.xml", tmp_path / "campaign.xml"
    run.write_text(junit_of_run(record.verdict()), encoding="utf-8")
    campaign.write_text(junit_xml(summary_of(verifying), verifying), encoding="utf-8")
    return run, campaign


def test_needs_are_made_of_the_evidence(reports: tuple[Path, Path], tmp_path: Path) -> None:
    sink = tmp_path / "needs.json"
    fields = [word for name in SHOWN for word in ("--extra-option", name)]
    words = ["build", "needs", "--no-config", "--link-property", "verifies=links", *fields]
    assert convert([*words, "--output", str(sink), *map(str, reports)]) == 0
    (version,) = json.loads(sink.read_text())["versions"].values()
    found = {need["title"]: need for need in version["needs"].values()}
    run, stratum = found[f"load · pbr · {CRASH}"], found[STRATUM]
    assert tuple(run["links"]) == tuple(stratum["links"]) == VERIFIES
    assert (run["n"], run["bound"], run["ftti_ms"], run["code"]) == ("1", "0.975", "100", "0.1.0+0badc0de")
    assert stratum["seed"] == "7" and stratum["command"].startswith("aftbed sim --ftm pbr")
    gates = [need for need in found.values() if need["classname"].endswith(".gates")]
    assert gates and not any(need["links"] for need in gates), "a gate is no evidence of its own"


@pytest.mark.skipif(
    importlib.util.find_spec("sphinx_test_reports") is None,
    reason="sphinx-test-reports is not installed: pip install -e '.[needs]'",
)
def test_a_page_of_sphinx_needs_shows_the_evidence_beside_the_requirements(
    reports: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "conf.py").write_text(CONF)
    (tmp_path / "index.rst").write_text(PAGE)
    # -W: a link to a requirement that does not exist is a warning of sphinx-needs
    words = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", str(tmp_path), str(tmp_path / "out")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS_MAX, check=False)
    assert done.returncode == 0, done.stderr
    needs = (tmp_path / "out" / "index.html").read_text(encoding="utf-8").split('<table class="need ')
    shown = [" ".join(html.unescape(re.sub("<[^>]+>", " ", need)).split()) for need in needs]
    (run,) = (text for text in shown if "Test-Case" in text and f"load · pbr · {CRASH}" in text)
    assert set(VERIFIES) < set(run.partition("links outgoing: ")[2].split(" , ")), run
    for words_of_it in ("n: 1", "failed: 0", "bound: 0.975", "ftti_ms: 100", "command: aftbed run"):
        assert words_of_it in run
    (stratum,) = (text for text in shown if "Test-Case" in text and f": {STRATUM} " in text)
    assert "seed: 7" in stratum and "SG-1" in stratum and "command: aftbed sim --ftm pbr" in stratum
    goal = next(text for text in shown if "Stops short of the obstacle" in text)
    incoming = goal.partition("links incoming: ")[2]
    assert "RUN_" in incoming and "CAMPAIGN_" in incoming, goal
