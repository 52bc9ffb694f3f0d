"""The results as a table for other programs: a row per experiment, in CSV or in Parquet.

The columns are the same in both, and so are their types where a format has types; the unit is at the end of
a name. An unknown value (no failover, no car) is an empty field in CSV and a null in Parquet. Several
values, such as faults and reasons, are one text, separated by `; `.

Limits: CSV has no types, so a reader guesses them. In CSV, a text that a spreadsheet would take for a formula
(it begins with =, +, -, @, a tab or a carriage return) has an apostrophe before it.
"""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from msgspec.structs import asdict

from aftbed.campaign.ledger import Ledger
from aftbed.core.errors import ConfigError, spreadsheet_text

Value = str | int | float | bool | None
SEPARATOR: Final = "; "

COLUMNS: Final = {  # name: type; most are fields of the experiment, its result and its requests
    "experiment": str,
    "index": int,
    "stratum": str,
    "number": int,
    "seed": int,
    "ftm": str,
    "placement": str,
    "runtime": str,
    "scenario": str,
    "requests": int,
    "rate_hz": float,
    "faults": str,
    "adaptations": str,
    "recipe": str,
    "expected": str,
    "outcome": str,
    "unexpected": bool,
    "activated": bool,
    "receipts": str,
    "reasons": str,
    "sent": int,
    "answered": int,
    "lost": int,
    "duplicated": int,
    "late": int,
    "wrong": int,
    "failovers": int,
    "adapted": str,
    "collision": bool,
    "noisy": bool,
    "starved_ms": float,
    "detected_ms": float,
    "recovery_ms": float,
    "blackout_ms": float,
    "adapt_blackout_ms": float,
    "fdti_ms": float,
    "frti_ms": float,
    "fhti_ms": float,
    "fhti_of_bound": float,
    "reactions": str,
    "impact_kmh": float,
    "gap_m": float,
    "duration_s": float,
    "command": str,
}


def rows(ledger: Ledger) -> Iterator[dict[str, Value]]:
    """For each result, a value for each of `COLUMNS`."""
    for result in ledger.results:
        experiment = result.experiment
        found = asdict(result) | (asdict(result.requests) if result.requests else {}) | asdict(experiment)
        found |= {
            "experiment": experiment.id,
            "receipts": tuple(fault.receipt.value for fault in result.faults),
            "duration_s": result.seconds,
            "fdti_ms": result.fdti_ms,
            "frti_ms": result.frti_ms,
            "fhti_ms": result.fhti_ms,
            "fhti_of_bound": result.of_bound,
            "reactions": tuple(one.reaction.value for one in result.intervals),
            "command": experiment.command(),
        }
        cells = {name: found.get(name) for name in COLUMNS}
        yield {n: SEPARATOR.join(cell) if isinstance(cell, tuple) else cell for n, cell in cells.items()}


def write_csv(ledger: Ledger, path: Path) -> None:
    """With a header line, in UTF-8. Raises ConfigError if `path` cannot be written."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
            writer.writeheader()
            for row in rows(ledger):
                texts = {n: spreadsheet_text(cell) for n, cell in row.items() if isinstance(cell, str)}
                writer.writerow(row | texts)
    except OSError as error:
        raise _unwritable(path, error) from None


def write_parquet(ledger: Ledger, path: Path) -> None:
    """Raises ConfigError if `path` cannot be written, or pyarrow is not installed."""
    try:
        import pyarrow  # noqa: PLC0415 - an extra, and slow to import
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise ConfigError(f"{path}: Parquet needs pyarrow: pip install aftbed[parquet]") from None
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64(), bool: pyarrow.bool_()}
    schema = pyarrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    head = ledger.head
    spec = head.spec
    about = {"campaign": spec.campaign, "seed": str(spec.seed), "spec": head.digest, "code": head.code}
    table = pyarrow.Table.from_pylist(list(rows(ledger)), schema=schema.with_metadata(about))
    try:
        parquet.write_table(table, path)
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be written: {error.strerror or error}")
