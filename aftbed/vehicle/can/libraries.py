"""The libraries of the bus, all of them: imported by importing this, by whoever forks those who drive."""

import importlib
from typing import Final

from aftbed.vehicle.can.python_can import lean

LIBRARIES: Final = ("can.interfaces.socketcand", "cantools", "e2e.p11")

lean()
for _name in LIBRARIES:
    importlib.import_module(_name)
