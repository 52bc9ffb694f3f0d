"""`aftbed check`: judge the record of a run."""

from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.options import Json
from aftbed.cli.views import show_verdict
from aftbed.judge.record import read_record
from aftbed.judge.verdict import EXIT_CODES, Verdict, judge


def check(
    record: Annotated[Path, typer.Argument(help="The directory of --record.")],
    json: Json = False,
) -> None:
    """Judge a recorded run again."""
    raise typer.Exit(EXIT_CODES[judge_and_show(record, as_json=json).verdict])


def judge_and_show(record: Path, *, as_json: bool) -> Verdict:
    """Judge the record in this directory, and print the verdict."""
    verdict = judge(read_record(record))
    show_verdict(verdict, as_json=as_json)
    return verdict
