"""`aftbed log`: convert a log of the bus, or the record of a run, to files that other tools open."""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import asdict

from aftbed.cli.options import Json, print_json
from aftbed.cli.parsing import PlainGroup
from aftbed.core.errors import ConfigError, shown
from aftbed.report.progress import ProgressLine

log = typer.Typer(cls=PlainGroup)


@log.command()
def convert(
    source: Annotated[Path, typer.Argument(help="A log of a CAN bus.")],
    sink: Annotated[Path, typer.Argument(help="The file to write.")],
    from_format: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="<candump|asc|blf|trc|mf4|csv>",
            help="If SOURCE's ending does not say; csv by frame.",
        ),
    ] = None,
    to_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="<candump|asc|blf|trc|mf4|csv>",
            help="If SINK's ending does not say; csv by signal.",
        ),
    ] = None,
    dbc: Annotated[
        Path | None, typer.Option(help="The DBC of the frames, to write csv; aftbed's own if left out.")
    ] = None,
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave out what cannot be read of SOURCE, and count it.")
    ] = False,
    json: Json = False,
) -> None:
    """Write a log of a CAN bus in another format."""
    from aftbed.interop.logs import convert as convert_log  # noqa: PLC0415 - imports python-can

    with ProgressLine("log convert", plain=False) as progress:
        done = convert_log(source, sink, from_format, to_format, dbc, skip_bad=skip_bad, show=progress.step)
    if json:
        print_json({"file": str(sink)} | asdict(done))
        return
    print(f"{sink}: {done.frames} frames, {done.source} to {done.sink}")
    for reason, count in done.left_out.items():
        print(f"  left out: {count} times {reason}")
    if done.skipped:
        print(shown(f"  skipped: {done.skipped} bad parts, the first at {done.first_skipped}"))


@log.command()
def export(
    record: Annotated[Path, typer.Argument(help="The directory of --record.")],
    mcap: Annotated[Path | None, typer.Option(help="Write the run to this file, for Foxglove.")] = None,
    trace: Annotated[Path | None, typer.Option(help="Write its nodes to this file, for Perfetto.")] = None,
    json: Json = False,
) -> None:
    """Write the record of a run as files that other tools open."""
    from aftbed.interop.export import ExportFiles, check  # noqa: PLC0415 - imports the simulator, 200 ms
    from aftbed.interop.export import export as write_files  # noqa: PLC0415 - the same
    from aftbed.judge.record import read_record  # noqa: PLC0415 - the same

    files = ExportFiles(mcap, trace)
    if files == ExportFiles():
        raise ConfigError("nothing to write: give --mcap FILE, --trace FILE, or both")
    check(files)
    with ProgressLine("log export", plain=False) as progress:
        progress.step(f"reading {record}")
        found = read_record(record)
        progress.step(f"writing the run of {record}")
        written = write_files(found, files)
    if json:
        print_json({"files": written})
    else:
        print("\n".join(map(str, written)))
