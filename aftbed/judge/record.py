"""A run's record, read back: what `--record DIR` leaves, also after a `kill -9`."""

import json
from pathlib import Path

import msgspec

from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.history import History
from aftbed.core.journal import dropped, entries, records
from aftbed.runtime.unix.journal import contents
from aftbed.runtime.unix.options import RunOptions
from aftbed.runtime.unix.support import HISTORY_NAME


class RunRecord(msgspec.Struct, frozen=True):
    """`end` is None where the supervisor did not live to write it."""

    path: Path
    options: RunOptions
    started_ns: int
    end: dict[str, object] | None
    history: History
    adaptations: tuple[dict[str, object], ...] = ()  # how each one ended, in order


def read_record(path: Path) -> RunRecord:
    """The record in `path`. Raises ConfigError naming the file that is missing or malformed."""
    about = _json(path / "run.json")
    try:
        options = msgspec.convert(about | {"private": "", "listener": -1}, RunOptions)
        started = msgspec.convert(about.get("started_ns"), int)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path / 'run.json'}: not the options of a run: {error}") from None
    folder = path / "journal"
    files = sorted(folder.glob("*.journal"))
    dialogues = sorted(folder.glob("client.*.dialogue"), key=lambda p: int(p.name.split(".")[1]))
    try:
        journals = {p.name.removesuffix(".journal"): list(records(contents(p))) for p in files}
        dialogue = [e for p in dialogues for e in entries(contents(p))]
        lost = sum(dropped(contents(p)) for p in (*files, *dialogues))
    except PeerError as error:
        raise ConfigError(f"{folder}: {error}") from None
    end = _json(path / "end.json") if (path / "end.json").exists() else None
    return RunRecord(path, options, started, end, History(journals, dialogue, lost), _adaptations(path))


def _adaptations(path: Path) -> tuple[dict[str, object], ...]:
    try:
        lines = (path / HISTORY_NAME).read_bytes().splitlines()
    except FileNotFoundError:
        return ()
    found = []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:  # the last line, cut off with the run
            break
    return tuple(found)


def _json(path: Path) -> dict[str, object]:
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; is this the record of a run?") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return found
