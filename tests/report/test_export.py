"""Exports: every result, every column, the same in both formats; and what is unknown stays unknown."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import result
from reported import HOSTILE, hostile, with_results

from aftbed.campaign.ledger import Ledger
from aftbed.core.errors import ConfigError
from aftbed.report.export import COLUMNS, rows, write_csv, write_parquet


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_result_has_a_value_for_every_column(ledger: Ledger) -> None:
    found = list(rows(ledger))
    assert len(found) == len(ledger.results)
    for row in found:
        assert row.keys() == COLUMNS.keys()
        assert all(value is None or type(value) is COLUMNS[name] for name, value in row.items())


def test_csv_comes_back_as_it_was(ledger: Ledger, tmp_path: Path) -> None:
    write_csv(ledger, tmp_path / "r.csv")
    found = read_csv(tmp_path / "r.csv")
    assert list(found[0]) == list(COLUMNS)
    for said, one in zip(found, ledger.results, strict=True):
        assert said["experiment"] == one.experiment.id and said["outcome"] == one.outcome
        assert said["recovery_ms"] == ("" if one.recovery_ms is None else str(one.recovery_ms))
        assert said["faults"] == "; ".join(one.experiment.faults)
        assert one.requests is not None and said["late"] == str(one.requests.late)


def test_parquet_has_types_and_nulls(ledger: Ledger, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    write_parquet(ledger, tmp_path / "r.parquet")
    table = parquet.read_table(tmp_path / "r.parquet")
    assert table.to_pylist() == list(rows(ledger))
    types = {field.name: str(field.type) for field in table.schema}
    assert types["recovery_ms"] == "double" and types["unexpected"] == "bool" and types["seed"] == "int64"
    about = {k.decode(): v.decode() for k, v in table.schema.metadata.items()}
    assert about == {"campaign": "mixed", "seed": "7", "spec": ledger.head.digest, "code": ledger.head.code}


def test_no_results_are_a_table_of_no_rows(ledger: Ledger, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    empty = with_results(ledger)
    write_csv(empty, tmp_path / "r.csv")
    write_parquet(empty, tmp_path / "r.parquet")
    assert read_csv(tmp_path / "r.csv") == [] and parquet.read_table(tmp_path / "r.parquet").num_rows == 0


def test_any_text_comes_back(ledger: Ledger, tmp_path: Path) -> None:
    nasty = 'a,b;"c"\n' + HOSTILE
    write_csv(with_results(ledger, hostile(), result(reasons=(nasty,), index=2)), tmp_path / "r.csv")
    first, second = read_csv(tmp_path / "r.csv")
    assert first["stratum"] == HOSTILE and second["reasons"] == nasty


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t"])
def test_no_text_is_a_formula(ledger: Ledger, tmp_path: Path, start: str) -> None:
    told = with_results(ledger, result(reasons=(f"{start}cmd|' /C calc'!A0",), gap_m=-0.5))
    write_csv(told, tmp_path / "r.csv")
    (row,) = read_csv(tmp_path / "r.csv")
    assert row["reasons"] == f"'{start}cmd|' /C calc'!A0"
    assert row["gap_m"] == "-0.5", "a number is none"


def test_a_carriage_return_ends_no_row(ledger: Ledger, tmp_path: Path) -> None:
    write_csv(with_results(ledger, result(reasons=("\ra\r\nb",))), tmp_path / "r.csv")
    (row,) = read_csv(tmp_path / "r.csv")
    assert row["reasons"] == "\na\nb"


@pytest.mark.parametrize("write", [write_csv, write_parquet])
def test_a_place_that_cannot_be_written_is_named(ledger: Ledger, tmp_path: Path, write: object) -> None:
    path = tmp_path / "no" / "r"
    with pytest.raises(ConfigError, match=r"no/r: cannot be written: .*No such file or directory"):
        write(ledger, path)  # type: ignore[operator]


def test_without_pyarrow_the_error_says_what_to_install() -> None:
    code = """
import sys
sys.modules["pyarrow"] = None  # as if it were not installed
from pathlib import Path
from aftbed.core.errors import ConfigError
from aftbed.report.export import write_parquet
try:
    write_parquet(None, Path("r.parquet"))
except ConfigError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "r.parquet: Parquet needs pyarrow: pip install aftbed[parquet]\n"
