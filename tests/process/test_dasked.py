"""A campaign over a Dask cluster: the same results, and none lost or counted twice when a worker dies."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from campaigns import CRASHES, planned, ran
from liveruns import GONE_SECONDS_MAX, Home, ended, until

from aftbed.campaign import dask, ledger, runner
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


def test_a_cluster_comes_to_the_same_results_though_a_worker_is_killed(tmp_path: Path) -> None:
    """None is lost, and none counted twice."""
    found = planned(tmp_path, CRASHES.replace("experiments: 4", "experiments: 20"))
    here = ran(found, tmp_path / "here")
    with cluster(tmp_path, 2) as (address, workers):
        asked = runner.CampaignRunOptions(tmp_path / "there", scheduler=address)
        told = []
        for result in runner.run(found, asked):
            told.append(result.experiment.id)
            if len(told) == 20:
                workers[0].kill()
    assert len(told) == len(set(told)) == found.size == 100
    there = ledger.read(tmp_path / "there" / ledger.NAME)
    assert [(r.experiment, r.outcome) for r in there.results] == [
        (r.experiment, r.outcome) for r in here.results
    ]


@pytest.mark.deep  # a real experiment is the same on any worker
def test_real_processes_on_a_cluster(tmp_path: Path) -> None:
    text = CRASHES.replace("runtime: sim", "runtime: unix").replace("experiments: 4", "experiments: 1")
    asked = planned(tmp_path, text)
    with cluster(tmp_path, 1) as (address, _):
        found = ran(asked, tmp_path / "out", scheduler=address)
    assert len(found.results) == asked.size
    for result in found.results:  # a noisy one says nothing of its times, so `inconclusive` is its outcome
        allowed = ("masked", "tolerated", *(["inconclusive"] if result.noisy else []))
        assert result.outcome in allowed and result.activated and not result.broken, result.reasons


@pytest.mark.deep  # the rest of a killed run is looked for in `test_kill` too
def test_a_worker_that_dies_in_the_midst_of_a_real_run_leaves_nothing(tmp_path: Path, home: Home) -> None:
    """Its interpreter, its run and all processes of that die with it, and another worker does the work."""
    text = CRASHES.replace("requests: 30, runtime: sim", "requests: 200, rate_hz: 200, runtime: unix")
    found = planned(tmp_path, text.replace("experiments: 4", "experiments: 1"))
    with cluster(tmp_path, 2) as (address, workers):
        told = []
        for result in runner.run(found, runner.CampaignRunOptions(tmp_path / "out", scheduler=address)):
            told.append(result.experiment.id)
            if len(told) == 1:
                under_way = new_run_below(workers[0].pid)
                workers[0].kill()
                limit = time.monotonic() + GONE_SECONDS_MAX
                assert all(ended(pid, limit - time.monotonic()) for pid in under_way)
    assert len(set(told)) == len(told) == found.size == 5
    assert not home.runs()


def new_run_below(worker: int) -> list[int]:
    """The pids of its next run, which has just begun: the present one may be at its end."""
    old = set(run_below(worker))
    until(lambda: set(run_below(worker)) - old, "a new run on the first worker")
    return run_below(worker)


def run_below(worker: int) -> list[int]:
    """The pids of a run that the worker has under way: its interpreter has started something."""
    try:
        children = psutil.Process(worker).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
    return [child.pid for child in children] if len(children) > 1 else []


LOCAL = """
import sys

from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local:
        print(local.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.mark.deep  # the scheduler and the workers are those of the first test
def test_a_local_cluster_comes_to_the_same_results(tmp_path: Path) -> None:
    """Dask's own way to have a few workers, what a user tries first: here in a process of its own."""
    found = planned(tmp_path)
    here = ran(found, tmp_path / "here")
    program = tmp_path / "local.py"
    program.write_text(LOCAL)
    with subprocess.Popen(
        [sys.executable, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as local:
        try:
            assert local.stdout is not None
            address = local.stdout.readline().decode().strip()
            assert address.startswith("tcp://127.0.0.1:"), "no cluster has started"
            there = ran(found, tmp_path / "there", scheduler=address)
        finally:
            local.communicate(timeout=60)
    assert [(r.experiment, r.outcome) for r in there.results] == [
        (r.experiment, r.outcome) for r in here.results
    ]


def test_a_scheduler_that_is_not_there_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask, "CONNECT_SECONDS_MAX", 0.1)
    with pytest.raises(ConfigError, match=r"--scheduler tcp://127.0.0.1:9: cannot be reached"):
        runner.run(
            planned(tmp_path), runner.CampaignRunOptions(tmp_path / "out", scheduler="tcp://127.0.0.1:9")
        )
    assert not (tmp_path / "out").exists()
