"""python-can is imported without what only one of its log formats needs."""

import importlib.util
import subprocess
import sys

import pytest

PROGRAM = """
import importlib, sys
importlib.import_module("{module}")
{act}
assert "can" in sys.modules
print("asammdf" in sys.modules)
"""


@pytest.mark.parametrize(
    ("module", "act"),
    [
        ("aftbed.vehicle.can.python_can", ""),
        ("aftbed.vehicle.can.dbc_file", "from aftbed.vehicle.can.dbc_file import load_dbc; load_dbc()"),
        ("aftbed.vehicle.can.bus", ""),
    ],
)
def test_who_needs_the_bus_does_not_get_asammdf(module: str, act: str) -> None:
    if importlib.util.find_spec("asammdf") is None:
        pytest.skip("the extra mf4 is not installed: nothing to keep out")
    program = PROGRAM.format(module=module, act=act)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.stdout.strip(), done.returncode) == ("False", 0), done.stderr
