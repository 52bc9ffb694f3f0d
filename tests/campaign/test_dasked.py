"""A campaign over a Dask cluster: the same results, and none lost or counted twice when a worker dies."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from campaigns import CRASHES, planned, ran

from aftbed.campaign import ledger, running
from aftbed.core.errors import ConfigError

pytestmark = [
    pytest.mark.process,
    pytest.mark.filterwarnings("default"),  # of a library that is not ours
]


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and its workers, as processes; their address."""
    address_file = folder / "scheduler.json"
    program = (
        "import asyncio, sys\n"
        "from distributed import Scheduler\n"
        "async def main():\n"
        "    async with Scheduler(port=0, host='127.0.0.1', dashboard=False) as s:\n"
        "        print(s.address, flush=True)\n"
        "        await s.finished()\n"
        "asyncio.run(main())\n"
    )
    worker = (
        "import asyncio, sys\n"
        "from distributed import Worker\n"
        "async def main():\n"
        "    async with Worker(sys.argv[1], nthreads=1, dashboard=False) as w:\n"
        "        print(w.address, flush=True)\n"
        "        await w.finished()\n"
        "asyncio.run(main())\n"
    )
    started: list[subprocess.Popen[bytes]] = []

    def start(code: str, *arguments: str) -> str:
        with open(folder / f"{len(started)}.log", "wb") as log:
            command = [sys.executable, "-c", code, *arguments]
            started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, cwd=folder))
        stdout = started[-1].stdout
        assert stdout is not None
        return stdout.readline().decode().strip()

    try:
        address = start(program)
        assert address.startswith("tcp://"), address_file
        for _ in range(workers):
            assert start(worker, address)
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
            process.communicate()


def test_a_cluster_comes_to_the_same_results(tmp_path: Path) -> None:
    found = planned(tmp_path)
    here = ran(found, tmp_path / "here")
    with cluster(tmp_path, 2) as (address, _):
        there = ran(found, tmp_path / "there", scheduler=address)
    assert [(r.experiment, r.outcome) for r in there.results] == [
        (r.experiment, r.outcome) for r in here.results
    ]


def test_a_worker_that_is_killed_loses_nothing_and_counts_nothing_twice(tmp_path: Path) -> None:
    found = planned(tmp_path, CRASHES.replace("experiments: 4", "experiments: 40"))
    with cluster(tmp_path, 2) as (address, workers):
        asked = running.Asked(tmp_path / "out", scheduler=address)
        told = []
        for result in running.run(found, asked):
            told.append(result.experiment.id)
            if len(told) == 20:
                workers[0].kill()
    assert len(told) == len(set(told)) == found.size == 200
    assert len(ledger.read(tmp_path / "out" / ledger.NAME).results) == 200


def test_real_processes_on_a_cluster(tmp_path: Path) -> None:
    text = CRASHES.replace("runtime: sim", "runtime: unix").replace("experiments: 4", "experiments: 1")
    with cluster(tmp_path, 1) as (address, _):
        found = ran(planned(tmp_path, text), tmp_path / "out", scheduler=address)
    assert {r.outcome for r in found.results} <= {"masked", "tolerated"}, [r.reasons for r in found.results]


def test_a_scheduler_that_is_not_there_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--scheduler tcp://127.0.0.1:9: cannot be reached"):
        running.run(planned(tmp_path), running.Asked(tmp_path / "out", scheduler="tcp://127.0.0.1:9"))
    assert not (tmp_path / "out").exists()
