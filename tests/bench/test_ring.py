"""The limits that run in processes of their own: the bare ring with its way to the backup, a death, forks."""

import os
from collections import Counter
from functools import partial

import pytest
from homes import Home

from aftbed.bench.ballast import SIZE_BYTES_MAX
from aftbed.bench.campaign import answer, fork_and_wait, limit_ms
from aftbed.bench.cycle import RingShape, RingWork, ring_of, ring_us
from aftbed.bench.recovery import death_ms
from aftbed.bench.sweep import captured_bytes, state_work
from aftbed.core.errors import HarnessError
from aftbed.ftm.compose import EXPRESSIONS, build, hops
from aftbed.ftm.pages import PAGE_BYTES
from aftbed.vehicle.aeb.function import sample_requests

# -- its shape


def test_the_ring_of_pbr_has_its_checkpoint() -> None:
    """client, proxy, protocol, before, proceed, server, proceed, after, server, after: the tenth visit."""
    found = ring_of(build("pbr", "process"))
    assert found == RingShape(12, ((9, "b/after"),))
    assert found.name == "bare ring of 12 hops and 1 to the backup"


def test_the_ring_of_lfr_has_what_the_leader_forwards_and_what_it_notifies() -> None:
    assert ring_of(build("lfr", "process")) == RingShape(10, ((3, "b/before"), (7, "b/after")))


def test_in_a_process_per_replica_one_process_sends_all_of_it() -> None:
    assert ring_of(build("pbr", "replica")) == RingShape(4, ((2, "b"),))
    assert ring_of(build("lfr", "replica")) == RingShape(4, ((2, "b"), (2, "b")))


@pytest.mark.parametrize("ftm", EXPRESSIONS)
def test_nothing_leaves_a_process_with_both_replicas(ftm: str) -> None:
    assert ring_of(build(ftm, "single")).beside == ()
    for placement in ("process", "replica", "single"):
        graph = build(ftm, placement)
        assert ring_of(graph).hops == hops(graph)


def test_one_replica_sends_nothing_beside() -> None:
    assert ring_of(build("none", "process")).name == "bare ring of 4 hops"
    assert ring_of(build("tr", "process")).beside == ()


# -- what a checkpoint copies


def test_what_is_captured_for_a_checkpoint() -> None:
    assert captured_bytes("pbr", 1_000_000, tracked=False) == 1_000_000
    assert captured_bytes("pbr", 1_000_000, tracked=True) == PAGE_BYTES
    assert captured_bytes("pbr+tr", 100, tracked=True) == 100
    assert captured_bytes("lfr", 1_000_000, tracked=False) == 0
    assert captured_bytes("none", 1_000_000, tracked=False) == 0


@pytest.mark.parametrize("size_bytes", [1, 100, PAGE_BYTES, 3 * PAGE_BYTES + 1])
def test_a_checkpoint_is_the_last_page_and_it_changes_each_time(size_bytes: int) -> None:
    work = state_work(size_bytes)
    checkpoint, restore = work.of_leader(), work.of_backup()
    first, second = bytes(checkpoint()), bytes(checkpoint())
    assert len(first) == len(second) == min(size_bytes, PAGE_BYTES) and first != second
    restore(first)
    restore(second)


def test_the_largest_state_fits() -> None:
    assert len(state_work(SIZE_BYTES_MAX).of_leader()()) == PAGE_BYTES


# -- in processes


@pytest.mark.process
@pytest.mark.parametrize("pin", [True, False])
def test_each_turn_of_the_ring_takes_its_time(home: Home, pin: bool) -> None:
    before = os.sched_getaffinity(0), os.sched_getscheduler(0)
    for ftm in ("pbr", "lfr", "none"):
        times = ring_us(ring_of(build(ftm, "process")), 64, 30, pin=pin, warm_up=5)
        assert len(times) == 30 and min(times) > 0
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before


@pytest.mark.process
def test_what_is_sent_to_the_backup_arrives_there(home: Home) -> None:
    """Once for each turn, as the leader made it, in processes that run as nodes."""
    reader, writer = os.pipe()

    def report(packet: bytes) -> None:
        assert os.sched_getscheduler(0) == os.SCHED_BATCH
        os.write(writer, packet)

    def make() -> bytes:
        assert os.sched_getscheduler(0) == os.SCHED_BATCH
        return b"page"

    work = RingWork(lambda: make, lambda: report)
    ring_us(ring_of(build("pbr", "process")), 64, 7, warm_up=2, work=work)
    os.close(writer)
    with os.fdopen(reader, "rb") as got:
        assert got.read() == 9 * b"page"


@pytest.mark.process
def test_a_ring_whose_process_dies_ends(home: Home) -> None:
    def fail() -> bytes:
        os._exit(1)

    with pytest.raises(HarnessError, match=r"the bare ring: (one of its processes died|Broken pipe)"):
        ring_us(
            ring_of(build("pbr", "process")), 64, 7, work=RingWork(lambda: fail, lambda: lambda packet: None)
        )


@pytest.mark.process
def test_the_limits_of_recovery_and_of_a_campaign(home: Home) -> None:
    assert death_ms(pin=True) > 0
    assert limit_ms(partial(fork_and_wait, 3), 4, 2) > 0
    assert limit_ms(partial(answer, sample_requests(0, 20)), 2, 2) > 0


@pytest.mark.process
def test_a_limit_of_a_campaign_is_shared_by_its_jobs(home: Home) -> None:
    reader, writer = os.pipe()

    def tell() -> None:
        os.write(writer, os.getpid().to_bytes(4, "little"))

    limit_ms(tell, 7, 2)
    os.close(writer)
    with os.fdopen(reader, "rb") as got:
        pids = memoryview(got.read()).cast("I").tolist()
    assert sorted(Counter(pids).values()) == [3, 4]
    assert os.getpid() not in pids


@pytest.mark.process
def test_a_limit_of_a_campaign_whose_job_fails(home: Home) -> None:
    with pytest.raises(HarnessError, match="the limit: not done within 60 s, or no process was left"):
        limit_ms(partial(os._exit, 1), 2, 2)
