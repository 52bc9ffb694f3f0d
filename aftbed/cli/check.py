"""`aftbed check`: judge the record of a run."""

from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.options import Json, TrustedFolders
from aftbed.cli.views import show_verdict
from aftbed.judge.record import read_record
from aftbed.judge.verdict import EXIT_CODES, Verdict, evidence_of, judge
from aftbed.runtime.unix.trust import Trust, trusting


def check(
    record: Annotated[Path, typer.Argument(help="The directory of --record.")],
    trust: TrustedFolders = None,
    json: Json = False,
) -> None:
    """Judge a recorded run again."""
    verdict = judge_and_show(record, trusting(trust), as_json=json)
    raise typer.Exit(EXIT_CODES[verdict.verdict])


def judge_and_show(record: Path, trust: Trust, *, as_json: bool) -> Verdict:
    """Judge the record in this directory, and print the verdict."""
    found = read_record(record)
    verdict = judge(found, evidence_of(found, trust=trust))
    show_verdict(verdict, as_json=as_json)
    return verdict
