"""The documents that are made of the records of a campaign, by the names of their files."""

from typing import Final

import msgspec

from aftbed.campaign.ledger import Ledger
from aftbed.campaign.summary import Summary
from aftbed.report.html import html_report
from aftbed.report.junit import junit_xml
from aftbed.report.markdown import markdown_summary

SUMMARY: Final = "summary.json"
JUNIT: Final = "junit.xml"
HTML: Final = "report.html"
MARKDOWN: Final = "summary.md"  # of a campaign with a function of the user


def documents(summary: Summary, ledger: Ledger) -> dict[str, str]:
    """The text of each."""
    found = {
        SUMMARY: msgspec.json.format(msgspec.json.encode(summary)).decode(),
        JUNIT: junit_xml(summary, ledger),
        HTML: html_report(summary, ledger),
    }
    if ledger.head.spec.system.app:
        found[MARKDOWN] = markdown_summary(summary, ledger.head.spec.system.app)
    return found
