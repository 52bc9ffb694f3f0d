"""The rehearsal shows where a node will write to: what else it writes to is little."""

import subprocess
import sys

import pytest

from aftbed.runtime.unix.prefault import PAGE, written_by

SCRIPT = """
import resource
from aftbed.runtime.unix import linux, prefault

areas = prefault.warm_up()

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def prepared():
    linux.populate(areas)
    before = faults()
    prefault.rehearse_host()
    print(sum(size for _, size in areas) // prefault.PAGE, faults() - before, flush=True)

prefault.written_by(prepared)
"""


@pytest.mark.skipif(not written_by(lambda: None), reason="this kernel does not tell which pages are whose")
def test_a_child_that_owns_the_pages_of_the_rehearsal_takes_hardly_a_fault_in_it() -> None:
    """In an interpreter of its own, as in a zygote: the rehearsal freezes the garbage collector."""
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout
    owned, faults = map(int, told.split())
    assert owned > 100
    assert faults < owned / 5, f"{faults} page faults, {owned} pages of {PAGE} bytes were owned before"
