"""Real runs of the benches have the same homes as in `tests/process`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "process"))

from liveruns import home

__all__ = ["home"]
