"""`aftbed check`: judge the record of a run."""

import contextlib
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from aftbed.cli.options import Html, Json, Junit, Quiet, TrustedFolders, check_file
from aftbed.cli.views import show_verdict
from aftbed.judge.record import read_record
from aftbed.judge.verdict import EXIT_CODES, Verdict, evidence_of, judge
from aftbed.report.progress import ProgressLine
from aftbed.runtime.unix.trust import Trust, trusting


def check(
    record: Annotated[Path, typer.Argument(help="The directory of --record.")],
    trust: TrustedFolders = None,
    junit: Junit = None,
    html: Html = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Judge a recorded run again."""
    check_file("--junit", junit)
    check_file("--html", html)
    trusted = trusting(trust)
    with ProgressLine("check", plain=False) as progress:
        progress.step(f"reading {record}")
        found = read_record(record)
        progress.step(f"judging {record}")
        verdict = judge(found, evidence_of(found, trust=trusted))
    show_verdict(verdict, as_json=json, quiet=quiet)
    lines = write_junit(junit, verdict) if junit is not None else []
    lines += write_html(html, record, verdict) if html is not None else []
    if lines and not (json or quiet):
        print("\n".join(lines))
    raise typer.Exit(EXIT_CODES[verdict.verdict])


def judge_and_show(record: Path, trust: Trust, *, as_json: bool, quiet: bool = False) -> Verdict:
    """Judge the record in this directory, and print the verdict."""
    found = read_record(record)
    verdict = judge(found, evidence_of(found, trust=trust))
    show_verdict(verdict, as_json=as_json, quiet=quiet)
    return verdict


def keep_verdict(record: Path, verdict: Verdict) -> None:
    """Leave the verdict in the record, for `aftbed list`; a full disk changes nothing else."""
    from aftbed.judge.listed import VERDICT_NAME  # noqa: PLC0415 - of runs with --record

    with contextlib.suppress(OSError):
        (record / VERDICT_NAME).write_bytes(msgspec.json.encode(verdict))


def write_junit(sink: Path, verdict: Verdict) -> list[str]:
    """Write the verdict as JUnit XML; what to tell the user. Raises ConfigError."""
    from aftbed.interop.files import write_text_whole  # noqa: PLC0415 - only with --junit
    from aftbed.report.junit import junit_of_run  # noqa: PLC0415 - the same: scipy

    write_text_whole(sink, junit_of_run(verdict))
    return [f"{sink}: 1 test case"]


def write_html(sink: Path, record: Path, verdict: Verdict) -> list[str]:
    """Write the report of the run as a page; what to tell the user. Raises ConfigError."""
    from aftbed.interop.files import write_text_whole  # noqa: PLC0415 - only with --html
    from aftbed.report.run_page import run_page  # noqa: PLC0415 - the same: jinja2, matplotlib

    page = run_page(read_record(record), verdict)
    write_text_whole(sink, page)
    return [f"{sink}: {len(page.encode()) / 1e3:.0f} kB"]
