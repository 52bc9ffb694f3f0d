"""Helpers of other test packages: `puredrive` (vehicle), `recordedruns` (judge)."""

import sys
from pathlib import Path

for package in ("vehicle", "judge"):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / package))
