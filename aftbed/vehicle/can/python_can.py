"""Importing python-can without asammdf, which only reading and writing MF4 needs.

Where asammdf is installed (the extra `mf4`), `import can` imports it, and with it numpy and pandas: measured,
130 MB instead of 27 MB, and five times as long. The processes of a run are forked from one that has imported
python-can. So every import of python-can goes through `lean` first.
"""

import importlib
import sys
from types import ModuleType

_HEAVY = "asammdf"


def lean() -> None:
    """Import python-can as if asammdf were not installed."""
    if "can" in sys.modules:
        return
    hidden = _HEAVY not in sys.modules
    if hidden:
        sys.modules[_HEAVY] = None  # type: ignore[assignment]  # an import of it then fails as of a missing module
    try:
        importlib.import_module("can")
    finally:
        if hidden:
            del sys.modules[_HEAVY]


def with_asammdf() -> ModuleType:
    """python-can's module for MF4 with asammdf, which must be installed."""
    lean()
    module = importlib.import_module("can.io.mf4")
    return module if module.asammdf is not None else importlib.reload(module)
