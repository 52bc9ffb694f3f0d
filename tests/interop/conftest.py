"""Helpers of other test packages: `puredrive` (vehicle), `records` and `tracechecks` (campaign)."""

import sys
from pathlib import Path

for package in ("vehicle", "campaign"):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / package))
