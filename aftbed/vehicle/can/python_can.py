"""python-can without asammdf, which only MF4 needs: `from aftbed.vehicle.can.python_can import can`.

Where asammdf is installed (the extra `mf4`), `import can` imports it, and with it numpy and pandas:
measured, 130 MB instead of 27 MB, and five times as long, in every process on the bus. So whatever imports
python-can, or cantools, which does, imports this module first.
"""

import importlib
import sys
from types import ModuleType

__all__ = ["can", "with_asammdf"]

_hidden = "asammdf" not in sys.modules
if _hidden:
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # its import then fails as if it were missing
try:
    import can
    import can.interfaces.socketcand  # `can.Bus` would import it while a drive begins
finally:
    if _hidden:
        del sys.modules["asammdf"]


def with_asammdf() -> ModuleType:
    """python-can's module for MF4 with asammdf, which must be installed."""
    module = importlib.import_module("can.io.mf4")
    return module if module.asammdf is not None else importlib.reload(module)
