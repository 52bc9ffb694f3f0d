"""What the commands of the tests are forks of: this is imported once, in a process that only forks them."""

from aftbed.cli import campaign, run, scenario_table
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.unix.supervisor_process import warm_up

assert campaign and run and scenario_table
warm_up(LIGHT)
warm_up(BUS)
