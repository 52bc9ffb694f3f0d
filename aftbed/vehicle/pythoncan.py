"""python-can without what it imports for one of its log formats.

Where asammdf is installed (the extra `mf4`), `import can` imports it, and with it numpy and pandas:
measured, 130 MB instead of 27, and five times as long. Nobody needs that but who reads or writes MF4, and
the processes of a run are forked from one that has python-can. So whoever imports python-can imports it by
way of `lean` first.
"""

import importlib
import sys
from types import ModuleType

_HEAVY = "asammdf"


def lean() -> None:
    """Have python-can imported; of asammdf it believes that it is not there."""
    if "can" in sys.modules:
        return
    hidden = _HEAVY not in sys.modules
    if hidden:
        sys.modules[_HEAVY] = None  # type: ignore[assignment]  # to an import, this is a module that does not exist
    try:
        importlib.import_module("can")
    finally:
        if hidden:
            del sys.modules[_HEAVY]


def with_asammdf() -> ModuleType:
    """python-can's module for MF4, asammdf included, however python-can was imported. It has to be there."""
    lean()
    module = importlib.import_module("can.io.mf4")
    return module if module.asammdf is not None else importlib.reload(module)
