"""Reads the log of a bus as strictly as a hub writes it."""

import io
from pathlib import Path

from aftbed.vehicle.can.candump import LogCounts, LogFrame, parse_lines


def read_log(path: Path) -> tuple[list[LogFrame], LogCounts]:
    counts = LogCounts()
    return list(parse_lines(io.BytesIO(path.read_bytes()), counts)), counts
