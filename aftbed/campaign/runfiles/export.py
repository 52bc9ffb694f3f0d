"""Which files of a run were asked for, and their writing; each is there whole or not at all."""

from functools import partial
from pathlib import Path

import msgspec

from aftbed.campaign.runfiles import mcapfile, tracefile
from aftbed.core.errors import ConfigError
from aftbed.judge.record import RunRecord
from aftbed.vehicle.logs.convert import written


class Wanted(msgspec.Struct, frozen=True):
    """The files of `--mcap` and `--trace`, or None."""

    mcap: Path | None = None
    trace: Path | None = None


def check(wanted: Wanted) -> None:
    """What would make the writing fail, found before the run. Raises ConfigError."""
    if wanted.mcap is not None:
        mcapfile.needed()
    for option, path in (("--mcap", wanted.mcap), ("--trace", wanted.trace)):
        if path is None:
            continue
        if path.is_dir():
            raise ConfigError(f"{option} {path}: is a directory, a file is allowed")
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{option} {path}: {path.absolute().parent} is no directory")
    if wanted.mcap is not None and wanted.mcap == wanted.trace:
        raise ConfigError(f"--mcap and --trace: {wanted.mcap} is asked for as both")


def export(record: RunRecord, wanted: Wanted) -> list[str]:
    """Write what is wanted; a line about each. Raises ConfigError where a file cannot be written."""
    found = []
    if wanted.mcap is not None:
        messages = written(wanted.mcap, partial(mcapfile.write, record))
        found.append(f"{wanted.mcap}: {messages} messages")
    if wanted.trace is not None:
        events = written(wanted.trace, partial(tracefile.write, record))
        found.append(f"{wanted.trace}: {events} trace events")
    return found
