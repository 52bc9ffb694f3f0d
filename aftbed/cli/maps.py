"""`aftbed map`: maps of other radars, for `aftbed run --replay`.

Without `--out`, all that `map new` prints beside the map is a comment in it, so that its output is a map.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from aftbed.cli.options import Json, check_file, print_json
from aftbed.cli.parsing import PlainGroup
from aftbed.core.errors import ConfigError, shown
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import (
    BoundMap,
    MapFile,
    Reading,
    bind,
    find_dbc,
    find_map,
    read_map,
    shipped_dbcs,
    shipped_maps,
)
from aftbed.vehicle.replay.map_proposal import MapProposal, propose
from aftbed.vehicle.replay.map_trial import Decoded, Span, try_out

maps = typer.Typer(cls=PlainGroup)

Log = Annotated[Path | None, typer.Option(metavar="LOG", help="A log of the same bus, to try it on.")]


class UsedMessage(msgspec.Struct, frozen=True):
    """A message that a map uses, as the ego's speed, as a track, or only judged."""

    name: str | None
    can_id: int
    use: str


# -- list -----------------------------------------------------------------------------------------


@maps.command("list")
def list_(json: Json = False) -> None:
    """The maps that are shipped, and whether their DBC is, too."""
    found = {name: read_map(find_map(name)) for name in shipped_maps()}
    if json:
        documents = [_listed(name, file) for name, file in found.items()]
        print_json({"maps": documents})
        return
    width = max(map(len, found))
    for name, file in found.items():
        dbc = "" if name in shipped_dbcs() else " (needs its DBC)"
        print(f"{name:<{width}}  {file.description}{dbc}")


def _listed(name: str, file: MapFile) -> dict[str, object]:
    shipped = name in shipped_dbcs()
    return {"name": name, "description": file.description, "cycle_ms": file.cycle_ms, "dbc_shipped": shipped}


# -- check ----------------------------------------------------------------------------------------


@maps.command()
def check(
    name: Annotated[str, typer.Argument(metavar="MAP", help="A shipped map by name, or a file.")],
    dbc: Annotated[
        str | None, typer.Option(help="The DBC, by name or a file; default: the shipped one of MAP's name.")
    ] = None,
    log: Log = None,
    json: Json = False,
) -> None:
    """Check a map against its DBC; with a log, show what it decodes.

    Exit code: 0 it fits, 1 it makes nothing of the log, 2 it does not fit the DBC.
    """
    map_path = find_map(name)
    if dbc is None and name not in shipped_dbcs():
        raise ConfigError(f"map check {name}: its DBC is not shipped; --dbc FILE is needed")
    path = find_dbc(dbc or name)
    bound = bind(map_path, path)
    decoded = None if log is None else try_out(bound, _frames(log))
    found = [] if decoded is None else decoded.problems()
    problems = [*bound.problems, *found]
    if json:
        print_json({"map": name, "dbc": str(path)} | _document(bound, decoded, problems))
    else:
        print(shown(f"map {name}: {bound.map.description}"))
        _print_report(bound, decoded, problems)
    raise typer.Exit(1 if found else 0)


# -- new ------------------------------------------------------------------------------------------


@maps.command()
def new(
    dbc: Annotated[
        list[str] | None,
        typer.Option(help="The radar's DBC, by name or a file; once more for one with the ego's speed."),
    ] = None,
    log: Log = None,
    out: Annotated[
        Path | None, typer.Option(metavar="MAP.yaml", help="The map to write; default: printed.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite MAP.yaml.")] = False,
    json: Json = False,
) -> None:
    """Propose a map by names, units and what moves in the log.

    Exit code: 0 it is whole, and makes requests of the log; 1 something is missing, which is named.
    """
    if not dbc:
        raise ConfigError("map new: --dbc FILE is needed, the DBC of the radar")
    check_file("--out", out)
    if out is not None and out.exists() and not force:
        raise ConfigError(f"--out {out}: exists; --force overwrites it")
    frames = [] if log is None else _frames(log)
    proposal = propose([load_dbc(find_dbc(one), strict=False) for one in dbc], frames)
    decoded = None if proposal.bound is None or log is None else try_out(proposal.bound, frames)
    found = [] if decoded is None else decoded.problems()
    if out is not None and proposal.map is not None:
        _write(out, proposal)
    written = out if proposal.map is not None else None
    if json:
        text = proposal.text() if proposal.map is not None else None
        used = str(proposal.bound.codec.path) if proposal.bound is not None else None
        head = {"map": text, "written": str(written) if written is not None else None, "dbc": used}
        print_json(head | _document(proposal.bound, decoded, [*proposal.problems, *found]))
    elif written is not None or proposal.map is None:
        print(f"{written}: written" if written is not None else "no map")
        _print_report(proposal.bound, decoded, [*proposal.problems, *found])
    else:
        print(proposal.text(), end="")
        for line in _report(proposal.bound, decoded, found):
            print(f"# {line}")
    raise typer.Exit(1 if proposal.bound is None or found else 0)


def _write(path: Path, proposal: MapProposal) -> None:
    try:
        path.write_text(proposal.text(), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--out {path}: cannot be written: {error.strerror}") from error


# -- both -----------------------------------------------------------------------------------------


def _frames(log: Path) -> Sequence[Frame]:
    """As a replay has them; what cannot be read does not matter here. Raises ConfigError."""
    from aftbed.interop.logs import read_for_replay  # noqa: PLC0415 - only with --log

    return read_for_replay(log, skip_bad=True).frames


def _used(bound: BoundMap) -> list[UsedMessage]:
    return [
        UsedMessage(
            rule.name,
            rule.can_id,
            "ego" if rule.can_id == bound.ego_id else "other" if rule.track is None else "track",
        )
        for rule in bound.rules.values()
    ]


def _document(bound: BoundMap | None, decoded: Decoded | None, problems: Sequence[str]) -> dict[str, object]:
    used = [] if bound is None else _used(bound)
    return {
        "tracks": sum(one.use == "track" for one in used),
        "messages": used,
        "decoded": decoded,
        "problems": list(problems),
    }


def _print_report(bound: BoundMap | None, decoded: Decoded | None, problems: Sequence[str]) -> None:
    for line in _report(bound, decoded, problems):
        print(line)


def _report(bound: BoundMap | None, decoded: Decoded | None, problems: Sequence[str]) -> Iterator[str]:
    lines = [] if bound is None else _map_lines(bound)
    lines += [] if decoded is None else _log_lines(decoded)
    width = max((len(head) for head, _ in lines), default=0)
    for head, text in lines:
        yield shown(f"  {head:<{width}}  {text}")
    if problems:
        yield "to be looked at"
        yield from (shown(f"  {' '.join(problem.split())}") for problem in problems)


def _map_lines(bound: BoundMap) -> list[tuple[str, str]]:
    used = _used(bound)
    tracks = [rule for rule in bound.rules.values() if rule.track is not None]
    first, last = tracks[0], tracks[-1]
    assert first.track is not None
    names = str(first.name) if first is last else f"{first.name} to {last.name}"
    place = "polar" if first.track.angle is not None else "Cartesian"
    others = sum(one.use == "other" for one in used)
    ends = {rule.can_id: rule.name for rule in bound.rules.values()}
    end = f"ends with {ends[bound.cycle_end_id]}" if bound.cycle_end_id is not None else "announced"
    ego = bound.rules[bound.ego_id]
    return [
        ("dbc", bound.codec.path.name),
        ("tracks", f"{len(tracks)} message{'s' if len(tracks) > 1 else ''}, {names}, {place}"),
        ("values", ", ".join(_value(key, reading) for key, reading in _readings(bound))),
        ("ego", f"{ego.name or f'{ego.can_id:#05x}'}: {_value('speed', bound.ego_speed)}"),
        ("cycle", f"{bound.map.cycle_ms} ms, {end}"),
        *([("others", f"{others} judged and not used")] if others else []),
    ]


def _readings(bound: BoundMap) -> Iterator[tuple[str, Reading]]:
    track = next(rule.track for rule in bound.rules.values() if rule.track is not None)
    for key in ("range", "relative_speed", "lateral_offset", "angle"):
        reading = getattr(track, key)
        if reading is not None:
            yield key, reading


def _value(key: str, reading: Reading) -> str:
    return f"{key} {reading.signal or 'raw'}"


def _log_lines(decoded: Decoded) -> list[tuple[str, str]]:
    refused = ", ".join(f"{count} by {reason}" for reason, count in decoded.refused.items()) or "none"
    taken = f"{decoded.accepted} accepted, {decoded.ignored} of others, {refused} refused"
    cycles = f"{decoded.with_ego} with the ego's speed, {decoded.with_targets} with targets in our path"
    lines = [
        ("log", f"{decoded.frames} frames: {taken}"),
        ("cycles", f"{decoded.cycles}: {cycles}, {decoded.targets} at most"),
        ("ego", _span(decoded.ego_kmh, "km/h")),
        ("range", _span(decoded.range_m, "m")),
        ("speed", _span(decoded.relative_speed_ms, "m/s, relative")),
    ]
    for cycle in decoded.shown:
        ego = "unknown" if cycle.ego_kmh is None else f"{cycle.ego_kmh:.1f} km/h"
        targets = ", ".join(f"{range_m:.1f} m {speed_ms:+.1f} m/s" for range_m, speed_ms in cycle.targets)
        lines.append((f"{cycle.t_s:.2f} s", f"ego {ego}; {targets or 'nothing'}"))
    return lines


def _span(span: Span | None, unit: str) -> str:
    if span is None:
        return "none"
    low, high = span
    return f"{low:.1f} {unit}" if low == high else f"{low:.1f} to {high:.1f} {unit}"
