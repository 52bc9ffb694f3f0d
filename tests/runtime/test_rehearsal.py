"""A node that has rehearsed has its pages for itself, and nothing else is left of that."""

import subprocess
import sys

import pytest

from aftbed.core.graph import BrickSpec
from aftbed.runtime import control
from aftbed.runtime.unix.zygote import waits

SCRIPT = """
import os, resource, sys
from aftbed.runtime.unix import rehearsal

rehearsal.warm_up()
if os.fork():
    os.wait()
    sys.exit()

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    rehearsal.rehearse_node([sys.argv[1]])
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


@pytest.mark.parametrize(
    ("name", "kind", "staged", "expected"),
    [
        ("a/protocol", "protocol", False, False),
        ("b/protocol", "protocol", False, True),
        ("a/tr.before", "tr.before", True, True),
        ("proxy", "proxy", False, True),
        ("client", "client", False, False),
        ("recovery", "recovery", False, False),
    ],
)
def test_a_node_rehearses_that_serves_from_a_failover_or_a_commit_on(
    name: str, kind: str, staged: bool, expected: bool
) -> None:
    bricks = (BrickSpec(name, kind),)
    order = control.Assign(1, name, "", bricks, 1, "a", (), (), (), cpu=None, staged=staged)
    assert waits(order) == expected


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
