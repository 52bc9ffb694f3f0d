"""Exports a run to the files that its user asked for: MCAP for Foxglove, a trace for Perfetto."""

from functools import partial
from pathlib import Path

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.interop import mcap as mcap_file
from aftbed.interop import perfetto
from aftbed.interop.files import write_whole
from aftbed.judge.record import RunRecord


class ExportFiles(msgspec.Struct, frozen=True):
    """The files of `--mcap` and `--trace`, or None."""

    mcap: Path | None = None
    trace: Path | None = None


def check(files: ExportFiles) -> None:
    """Check before the run that the files can be written. Raises ConfigError."""
    if files.mcap is not None:
        mcap_file.require_mcap()
    for option, path in (("--mcap", files.mcap), ("--trace", files.trace)):
        if path is None:
            continue
        if path.is_dir():
            raise ConfigError(f"{option} {path}: is a directory, a file is allowed")
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{option} {path}: {path.absolute().parent} is no directory")
    if files.mcap is not None and files.mcap == files.trace:
        raise ConfigError(f"--mcap and --trace: {files.mcap} is asked for as both")


class WrittenFile(msgspec.Struct, frozen=True):
    """`count` of `what` are in it: messages, or trace events."""

    file: str
    count: int
    what: str

    def __str__(self) -> str:
        return f"{self.file}: {self.count} {self.what}"


def export(run: RunRecord, files: ExportFiles) -> list[WrittenFile]:
    """Write the files. Raises ConfigError if one cannot be written."""
    found = []
    if files.mcap is not None:
        messages = write_whole(files.mcap, partial(mcap_file.write, run))
        found.append(WrittenFile(str(files.mcap), messages, "messages"))
    if files.trace is not None:
        events = write_whole(files.trace, partial(perfetto.write, run))
        found.append(WrittenFile(str(files.trace), events, "trace events"))
    return found
