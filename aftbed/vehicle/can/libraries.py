"""Importing this imports all libraries of the bus: for the zygote that forks the processes on the bus."""

import importlib
from typing import Final

from aftbed.vehicle.can.python_can import lean

LIBRARIES: Final = ("can.interfaces.socketcand", "cantools", "e2e.p11")

lean()
for _name in LIBRARIES:
    importlib.import_module(_name)
