"""Bundles: all that is evidence is in them, nothing of the machine is, and what was changed is named."""

import getpass
import io
import json
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Final

import command_line
import msgspec
import pytest
from campaigns import planned, ran, result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aftbed.campaign import ledger as ledgers
from aftbed.campaign.ledger import Environment, Ledger
from aftbed.campaign.plan import plan
from aftbed.campaign.spec import read_spec
from aftbed.core.errors import ConfigError
from aftbed.report.bundle import SUMS, BundledFile, archive_of, entries, sha256, verified
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.trust import NOBODY, trusting

pytestmark = pytest.mark.simulation

HOME: Final = str(Path.home())
LEDGER_TRY: Final = "try/records.jsonl"
MINE: Final = """
from aftbed.vehicle.aeb.function import AebFunction


class Mine(AebFunction):
    pass
"""
CAMPAIGN: Final = """
campaign: mine
seed: 1
system: {app: mine.py:Mine, requests: 20, runtime: sim}
mechanisms: [pbr]
adaptations:
- {name: steady}
- {name: to itself, adapt: "update app to {app} at request 9"}
faults:
- {name: crash, fault: "crash primary at server.exit nth {nth}", draw: {nth: [1, 15]}}
stop: {experiments: 2}
not_activated_max: 0.9
unknown_max: 0.9
"""


@pytest.fixture(scope="module")
def crashes(tmp_path_factory: pytest.TempPathFactory) -> Ledger:
    """A small campaign, run with paths and reasons that name the home of its user."""
    folder = tmp_path_factory.mktemp("crashes")
    found = ran(planned(folder), folder / "out")
    command = f"aftbed campaign run {HOME}/a/try.yaml --out=/data/b/out --shard 1/1"
    told = f"HarnessError: {HOME}/runs/x/end.json: No space left, not in /var/tmp/y/z"
    first, *rest = found.results
    results = (msgspec.structs.replace(first, reasons=(told,)), *rest)
    machine = Environment("CPython 3.11.0", "Linux 6.1", "2 of 2, Some CPU", command, {"numpy": "2.0"})
    return Ledger(found.path, msgspec.structs.replace(found.head, environment=machine), results)


@pytest.fixture(scope="module")
def made(crashes: Ledger) -> dict[str, BundledFile]:
    return entries([crashes], NOBODY)


def written(folder: Path, made: dict[str, BundledFile]) -> Path:
    path = folder / "e.zip"
    path.write_bytes(archive_of(made))
    return path


def with_file(made: dict[str, BundledFile], name: str, data: bytes) -> dict[str, BundledFile]:
    return made | {name: BundledFile(data)}


def test_all_that_is_evidence_is_in_it(made: dict[str, BundledFile], crashes: Ledger) -> None:
    top = {name for name in made if "/worst/" not in name}
    files = ("plan.jsonl", "records.jsonl", "summary.json", "junit.xml", "report.html", "environment.json")
    assert top == {"README.md", SUMS, "rerun.sh", "try.yaml", *(f"try/{name}" for name in files)}
    assert len(made["try/plan.jsonl"].data.splitlines()) == len(crashes.results)
    environment = json.loads(made["try/environment.json"].data)
    assert environment["kernel"] == "Linux 6.1" and environment["packages"] == {"numpy": "2.0"}
    assert environment["code"] == crashes.head.code and environment["functions"][""]["deterministic"]
    (worst, *_) = [name for name in made if name.endswith("/trace.txt")]
    assert b" sent " in made[worst].data, "what happened in the run is there"
    sums = dict(reversed(line.split("  ")) for line in made[SUMS].data.decode().splitlines())
    assert sums == {name: sha256(entry.data) for name, entry in made.items() if name != SUMS}
    assert b"not a qualified tool" in made["README.md"].data


def test_the_campaign_file_is_that_of_the_records(
    made: dict[str, BundledFile], crashes: Ledger, tmp_path: Path
) -> None:
    path = tmp_path / "try.yaml"
    path.write_bytes(made["try.yaml"].data)
    found = plan(read_spec(str(path)))
    assert (found.spec, found.digest) == (crashes.head.spec, crashes.head.digest)


def test_no_path_and_no_name_of_the_user_is_in_it(made: dict[str, BundledFile], tmp_path: Path) -> None:
    for name, entry in made.items():
        for path in (HOME + "/", "/data/", "/var/tmp", str(tmp_path.parent), f"/{getpass.getuser()}/"):
            assert path.encode() not in entry.data, name
    head, first, *_ = made[LEDGER_TRY].data.decode().splitlines()
    assert json.loads(head)["environment"]["command"] == "aftbed campaign run try.yaml --out=out --shard 1/1"
    assert json.loads(first)["reasons"] == ["HarnessError: end.json: No space left, not in z"]


def test_equal_records_give_equal_bytes(made: dict[str, BundledFile], crashes: Ledger) -> None:
    again = archive_of(entries([crashes], NOBODY))
    assert again == archive_of(made)
    with zipfile.ZipFile(io.BytesIO(again)) as archive:
        assert archive.namelist() == sorted(made)
        assert {one.date_time for one in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        modes = {one.filename: one.external_attr >> 16 for one in archive.infolist()}
    assert modes["rerun.sh"] & 0o111 and not modes["README.md"] & 0o111


def test_two_campaigns_of_one_name_are_both_in_it(crashes: Ledger) -> None:
    made = entries([crashes, crashes], NOBODY)
    assert made[LEDGER_TRY] == made["try-2/records.jsonl"]
    assert made["rerun.sh"].data.endswith(b'exit "$result"\n') and b"again try-2 " in made["rerun.sh"].data


def test_records_that_are_not_of_their_plan_are_refused(crashes: Ledger) -> None:
    first, *rest = crashes.results
    other = msgspec.structs.replace(first.experiment, seed=first.experiment.seed + 1)
    forged = msgspec.structs.replace(
        crashes, results=(msgspec.structs.replace(first, experiment=other), *rest)
    )
    with pytest.raises(
        ConfigError, match=rf"experiment {first.experiment.id} \(number 0\) is not that of the"
    ):
        entries([forged], NOBODY)
    beyond = msgspec.structs.replace(crashes, results=(result(index=1_000_000),))
    with pytest.raises(ConfigError, match="is not that of the plan"):
        entries([beyond], NOBODY)


def test_a_shard_alone_is_refused(crashes: Ledger) -> None:
    shard = msgspec.structs.replace(crashes, head=msgspec.structs.replace(crashes.head, shard=2, shards=3))
    with pytest.raises(ConfigError, match="shard 2 of 3: `aftbed campaign merge` makes one"):
        entries([shard], NOBODY)


@pytest.mark.parametrize(
    "damage", ["none", "changed", "unsealed", "names the home", "a link", "a link in it"]
)
def test_the_record_of_a_run_that_went_wrong_is_in_it_as_it_was_sealed(
    crashes: Ledger, tmp_path: Path, damage: str
) -> None:
    """A stranger's directory gives no file but what lies in it."""
    found = msgspec.structs.replace(crashes, path=tmp_path / ledgers.NAME)
    name = crashes.results[-1].experiment.id
    record = tmp_path / ledgers.RECORDS / name
    record.mkdir(parents=True)
    (record / "run.json").write_text(f'"{HOME}/a"' if damage == "names the home" else '"/run/user/1"')
    (tmp_path / "secret").write_text("secret")
    if damage == "a link in it":
        (record / "linked").symlink_to(tmp_path / "secret")
    if damage != "unsealed":
        seal.write(record)
    if damage == "changed":
        (record / "run.json").write_text("{}")
    if damage == "a link":
        record.rename(tmp_path / "elsewhere")
        record.symlink_to(tmp_path / "elsewhere")
    made = entries([found], NOBODY)
    files = {path.rpartition("/")[2] for path in made if path.startswith(f"try/worst/{name}/record/")}
    assert files == ({"run.json", "seal.json"} if damage == "none" else set())
    assert not [path for path, file in made.items() if file.data == b"secret"]


# -- functions of the user ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_a_function(tmp_path_factory: pytest.TempPathFactory) -> Ledger:
    folder = tmp_path_factory.mktemp("function")
    (folder / "mine.py").write_text(MINE)
    return ran(planned(folder, CAMPAIGN), folder / "out")


def test_a_function_is_in_it_only_if_it_is_trusted(of_a_function: Ledger) -> None:
    folder = of_a_function.path.parents[1]
    with pytest.raises(ConfigError, match=r"mine.py:Mine is not trusted.*; --trust"):
        entries([of_a_function], NOBODY)
    made = entries([of_a_function], trusting([folder]))
    assert made["files/1/mine.py"].data.decode() == MINE
    assert b"app: files/1/mine.py:Mine" in made["mine.yaml"].data
    assert b"update app to files/1/./mine.py:Mine" in made["mine/plan.jsonl"].data
    assert not [name for name, entry in made.items() if str(folder).encode() in entry.data]


def test_a_function_that_is_another_one_by_now_is_refused(of_a_function: Ledger, tmp_path: Path) -> None:
    shutil.copytree(of_a_function.path.parents[1], tmp_path, dirs_exist_ok=True)
    moved = (tmp_path / "out" / ledgers.NAME).read_text()
    moved = moved.replace(str(of_a_function.path.parents[1]), str(tmp_path))
    (tmp_path / "out" / ledgers.NAME).write_text(moved)
    (tmp_path / "mine.py").write_text(f"{MINE}    changed = 1\n")
    with pytest.raises(ConfigError, match="the function, the requests or the scenario are not those"):
        entries([ledgers.read(tmp_path / "out" / ledgers.NAME)], trusting([tmp_path]))


# -- verified -------------------------------------------------------------------------------------


def test_each_file_that_does_not_fit_is_named(made: dict[str, BundledFile], tmp_path: Path) -> None:
    assert verified(written(tmp_path, made)).misfits == ()
    changed = with_file(made, LEDGER_TRY, made[LEDGER_TRY].data.replace(b"tolerated", b"masked", 1))
    changed = with_file(changed, "note.txt", b"all is well")
    del changed["try/junit.xml"]
    found = {one.path: one.why for one in verified(written(tmp_path, changed)).misfits}
    assert found.keys() == {LEDGER_TRY, "try/junit.xml", "note.txt"}
    assert found[LEDGER_TRY].startswith("its hash is ") and found["try/junit.xml"] == "it is missing"
    assert found["note.txt"] == f"it is not in {SUMS}"


@pytest.mark.parametrize(
    ("sums", "why"),
    [
        (None, f"no bundle: {SUMS} is missing"),
        (b"", f"{SUMS}: line 1: '' is no hash, two blanks and a name"),
        (b"0" * 64 + b" a\n", "line 1: .* is no hash"),
        ((b"0" * 64 + b"  a\n") * 2, "line 2: .* stands twice"),
    ],
)
def test_what_is_no_bundle_is_refused(
    made: dict[str, BundledFile], tmp_path: Path, sums: bytes | None, why: str
) -> None:
    other = {name: entry for name, entry in made.items() if name != SUMS}
    with pytest.raises(ConfigError, match=f"e.zip: .*{why}"):
        verified(written(tmp_path, other if sums is None else with_file(other, SUMS, sums)))


SMALL: Final = {
    "a": BundledFile(b"some text"),
    "b/c": BundledFile(b"more of it", executable=True),
    SUMS: BundledFile(f"{sha256(b'some text')}  a\n{sha256(b'more of it')}  b/c\n".encode()),
}
ARCHIVE: Final = archive_of(SMALL)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, len(ARCHIVE) - 1), length=st.integers(0, 6), put=st.binary(max_size=6))
def test_no_change_of_an_archive_passes_with_other_contents(
    tmp_path: Path, at: int, length: int, put: bytes
) -> None:
    path = tmp_path / "e.zip"
    path.write_bytes(ARCHIVE[:at] + put + ARCHIVE[at + length :])
    try:
        found = verified(path)
    except ConfigError:
        return
    if not found.misfits:
        with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as archive:
            read = {name: archive.read(name) for name in archive.namelist()}
        assert read == {name: entry.data for name, entry in SMALL.items()}


# -- run again ------------------------------------------------------------------------------------

AFTBED: Final = f"{sys.executable} -P -m aftbed"


@pytest.mark.process
def test_it_is_unpacked_elsewhere_verified_and_run_again_to_the_same_outcomes(
    made: dict[str, BundledFile],
    of_a_function: Ledger,
    crashes: Ledger,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also a campaign of a function whose files are gone where it was run."""
    monkeypatch.setenv("AFTBED", AFTBED)
    both = entries([crashes, of_a_function], trusting([of_a_function.path.parents[1]]))
    with zipfile.ZipFile(written(tmp_path, both)) as archive:
        archive.extractall(tmp_path / "there")
    shutil.rmtree(of_a_function.path.parents[1])
    checked = command_line.called("sha256sum", "-c", SUMS, folder=tmp_path / "there")
    assert checked.returncode == 0, checked.stderr
    again = command_line.called("sh", "there/rerun.sh", "new", folder=tmp_path)
    told = [line for line in again.stdout.splitlines() if line.startswith("rerun.sh: ")]
    assert told == ["rerun.sh: try: same outcomes", "rerun.sh: mine: same outcomes"], again.stderr
    assert again.returncode == 0
    assert (tmp_path / "new" / "mine" / "report.html").is_file(), "the new records are where they are wanted"

    (tmp_path / "there" / LEDGER_TRY).write_bytes(b"")
    refused = command_line.called("sh", "there/rerun.sh", "other", folder=tmp_path)
    assert refused.returncode == 1 and not (tmp_path / "other").exists(), "a file does not fit its hash"


@pytest.mark.process
def test_a_bundle_that_claims_other_outcomes_is_found_out(
    crashes: Ledger, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AFTBED", AFTBED)
    first, *rest = crashes.results
    claimed = (msgspec.structs.replace(first, outcome="masked"), *rest)
    made = entries([msgspec.structs.replace(crashes, results=claimed)], NOBODY)
    with zipfile.ZipFile(written(tmp_path, made)) as archive:
        archive.extractall(tmp_path / "there")
    differs = command_line.called("sh", "there/rerun.sh", folder=tmp_path)
    assert differs.returncode == 1 and differs.stdout.endswith("\nrerun.sh: try: other outcomes\n"), (
        differs.stderr
    )
    assert "1 with another outcome" in differs.stdout
