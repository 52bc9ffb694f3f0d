"""A node that has rehearsed has its pages for itself, and nothing else is left of that."""

import subprocess
import sys

import pytest

from aftbed.core.events import Event
from aftbed.ftm.compose import build, chain
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.runtime import control
from aftbed.runtime.interface import Process
from aftbed.runtime.sim.processes import SimProcessPool
from aftbed.runtime.sim.world import Setup, World, simulate

SCRIPT = """
import os, resource, sys
from aftbed.runtime.unix import rehearsal

rehearsal.warm_up()
if os.fork():
    os.wait()
    sys.exit()

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    rehearsal.rehearse_node([sys.argv[1]], commits=True)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def left():
    with open("/proc/self/maps") as maps:
        return len(os.listdir("/proc/self/fd")), maps.read().count("/dev/zero")  # a journal in memory

before = left()
print(faults(), faults(), before == left(), flush=True)
"""


@pytest.mark.parametrize("kind", ["client", "proxy", "protocol", "lfr.after", "server"])
def test_a_node_that_has_rehearsed_takes_hardly_a_page_fault_in_what_it_did(kind: str) -> None:
    """In an interpreter of its own, as in a zygote: it freezes the garbage collector."""
    told = subprocess.run([sys.executable, "-c", SCRIPT, kind], capture_output=True, text=True, check=True)
    first, again, nothing_left = told.stdout.split()
    assert int(first) > 100
    assert int(again) < int(first) / 5
    assert nothing_left == "True"


def test_what_waits_for_a_failover_rehearses_and_a_new_backup_when_it_is_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until it is, the next crash ends the service; so it is not made to wait."""
    at_birth: list[str] = []
    later: list[tuple[str, tuple[str, ...], int]] = []
    send = SimProcessPool.order

    def order(
        pool: SimProcessPool, process: Process, order: control.ToNode, fds: tuple[int, ...] = ()
    ) -> None:
        if isinstance(order, control.Assign) and order.rehearse:
            at_birth.append(order.node)
        elif isinstance(order, control.Rehearse):
            later.append((process.name, order.kinds, pool.clock.ns))
        send(pool, process, order, fds)

    monkeypatch.setattr(SimProcessPool, "order", order)
    crash = Fault(Crash(), "primary", Trigger("server.exit", 3))
    run = simulate(Setup("pbr", "process", 1, 40, faults=(crash,)))
    graph = build("pbr", "process")
    assert sorted(at_birth) == [*sorted(chain(graph, "b")), "proxy"]
    assert sorted((name, kinds) for name, kinds, _ in later) == [
        (name, (graph.brick(name).kind,)) for name in sorted(chain(graph, "a"))
    ]
    (ready,) = run.history.events(Event.BACKUP_READY)
    assert all(t_ns > ready.t_ns for *_, t_ns in later)


def test_a_backup_that_is_gone_meanwhile_rehearses_nothing() -> None:
    """The run was adapted to a single replica while the order was waiting, or the backup is dead again."""
    world = World(Setup("tr", "process", 1, 3))
    world.run()
    deployment = world.controller.deployment
    assert "b" not in deployment.slots
    deployment.rehearse("b")
    for node in deployment.slots["a"].nodes:
        deployment.process(node).kill()
    deployment.rehearse("a")


REUSES = """
import resource
from aftbed.runtime.unix import linux

linux.reuse_blocks()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def copies(count):
    before, kept = faults(), b""
    for number in range(count):
        kept = bytes({size})  # beside the one before
        kept.count(1)
    return faults() - before
copies(10)
print(copies(50))
"""


@pytest.mark.parametrize("size", [1_000_000, 10_000_000])
def test_the_memory_of_a_large_block_is_used_again(size: int) -> None:
    """Given back, each block would cost a fault for each of its pages."""
    done = subprocess.run([sys.executable, "-c", REUSES.format(size=size)], capture_output=True, check=True)
    assert int(done.stdout) < 50
