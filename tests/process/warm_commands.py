"""What the commands of the tests are forks of: this is imported once, in a process that only forks them."""

from aftbed.cli import campaign, run
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.unix.supervisor_process import warm_up

assert campaign and run
warm_up(LIGHT)
warm_up(BUS)
