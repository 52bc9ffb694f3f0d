"""The ledger: appended to, gone on with, merged; what does not belong together is refused by name."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import CRASHES, planned, ran, result

from aftbed.campaign import ledger
from aftbed.campaign.ledger import head_of
from aftbed.core.errors import ConfigError, HarnessError


def begun(folder: Path, count: int = 3) -> Path:
    path = folder / ledger.NAME
    ledger.begin(path, head_of(planned(folder)))
    descriptor = ledger.opened(path)
    for index in range(count):
        ledger.append(descriptor, result(index=index))
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    found = ledger.read(begun(tmp_path))
    assert found.head == head_of(planned(tmp_path))
    assert found.results == tuple(result(index=i) for i in range(3))


@pytest.mark.parametrize("cut", [1, 20, 150])
def test_a_torn_last_line_is_refused_and_cut_off_by_resume(tmp_path: Path, cut: int) -> None:
    path = begun(tmp_path)
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(ConfigError, match=r"records.jsonl: line 4: it is torn: .*--resume"):
        ledger.read(path)
    ledger.resume(path, head_of(planned(tmp_path)))
    assert ledger.read(path).results == tuple(result(index=i) for i in range(2))


def test_a_full_disk_is_told() -> None:
    descriptor = ledger.opened(Path("/dev/full"))
    try:
        with pytest.raises(
            HarnessError, match="/dev/full: a result cannot be written: No space left on device"
        ):
            ledger.append(descriptor, result())
    finally:
        os.close(descriptor)


def test_a_result_that_fits_in_part_only_is_told(tmp_path: Path) -> None:
    """In a process of its own, whose files may not grow beyond what is there and ten bytes."""
    path = begun(tmp_path)
    program = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "from campaigns import result\n"
        "from aftbed.campaign import ledger\n"
        "path = Path(sys.argv[1])\n"
        "limit = path.stat().st_size + 10\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))\n"
        "ledger.append(ledger.opened(path), result(index=9))\n"
    )
    here = os.fspath(Path(__file__).parent)
    done = subprocess.run(
        [sys.executable, "-c", program, path],
        env={**os.environ, "PYTHONPATH": here},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "10 of" in done.stderr and "make room, then go on with --resume" in done.stderr, done.stderr
    ledger.resume(path, head_of(planned(tmp_path)))
    assert ledger.read(path).results == tuple(result(index=i) for i in range(3))


def test_a_line_that_is_no_record_is_named(tmp_path: Path) -> None:
    path = begun(tmp_path)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:2], b'{"outcome": 7}', *lines[3:]]))
    with pytest.raises(ConfigError, match=r"records.jsonl: line 3: Expected"):
        ledger.read(path)


def test_resume_refuses_another_spec(tmp_path: Path) -> None:
    path = begun(tmp_path)
    other = head_of(planned(tmp_path, CRASHES.replace("seed: 3", "seed: 4")))
    with pytest.raises(ConfigError, match=r"another spec .*: --out begins a new campaign"):
        ledger.resume(path, other)


def test_a_campaign_does_not_overwrite_another(tmp_path: Path) -> None:
    path = begun(tmp_path)
    with pytest.raises(ConfigError, match="exists already: --resume goes on"):
        ledger.begin(path, head_of(planned(tmp_path)))


def test_what_is_no_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is this the directory of a campaign"):
        ledger.read(tmp_path / ledger.NAME)


def test_shards_merge_to_the_whole(tmp_path: Path) -> None:
    found = planned(tmp_path)
    whole = ran(found, tmp_path / "whole")
    shards = [ran(found, tmp_path / f"{i}", shard=i, shards=3) for i in (1, 2, 3)]
    assert [len(shard.results) for shard in shards] == [7, 7, 6]
    names = {stratum.name for stratum in found.strata}
    assert all({r.experiment.stratum for r in shard.results} == names for shard in shards)
    merged = ledger.merged(shards)
    assert [(r.experiment, r.outcome, r.faults) for r in merged.results] == [
        (r.experiment, r.outcome, r.faults) for r in whole.results
    ]


def test_what_does_not_belong_together_is_not_merged(tmp_path: Path) -> None:
    first = ran(planned(tmp_path), tmp_path / "a", shard=1, shards=20)
    other = ran(planned(tmp_path, CRASHES.replace("seed: 3", "seed: 4")), tmp_path / "b", shard=2, shards=20)
    half = ran(planned(tmp_path), tmp_path / "c", shard=2, shards=2)
    with pytest.raises(ConfigError, match=r"shard 2 of 2; .* is one of 20: shards of one run belong"):
        ledger.merged([first, half])
    with pytest.raises(ConfigError, match="shard 1 of 2 is missing: name the records of all"):
        ledger.merged([half])
    with pytest.raises(ConfigError, match="of another spec or code"):
        ledger.merged([first, other])
    with pytest.raises(ConfigError, match="shard 1 of 20 stands twice"):
        ledger.merged([first, first])


def test_an_experiment_is_found_by_its_name(tmp_path: Path) -> None:
    found = ran(planned(tmp_path), tmp_path / "out")
    wanted = found.results[7]
    assert ledger.find(found, wanted.experiment.id[:9]) == ledger.find(found, "7") == wanted
    with pytest.raises(ConfigError, match="experiment 'xyz': 0 of"):
        ledger.find(found, "xyz")
