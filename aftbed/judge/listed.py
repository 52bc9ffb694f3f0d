"""Which runs there are: those that live, and those whose records lie below some directories.

A record is a directory with `journal/` and one of the files that a run writes beside it. Nothing of it is
judged: its verdict is the one that its command left in `verdict.json`. Two small files are read of each.
"""

import time
from collections.abc import Iterable, Iterator
from enum import Enum
from pathlib import Path
from typing import Annotated, Final, TypeVar, assert_never

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.input_file import read_input
from aftbed.judge.verdict import Word
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, Work

Found = TypeVar("Found")

VERDICT_NAME: Final = "verdict.json"  # in the record: the verdict of its command, as of --json
FILE_BYTES_MAX: Final = 4_000_000
SEED_MAX: Final = 2**63 - 1
DEPTH_MAX: Final = 3  # below a directory: records of campaigns lie in OUT/records/ID
FOLDERS_MAX: Final = 20_000  # that are looked into


class ListedState(Enum):
    """`UNFINISHED`: its supervisor did not live to write how it ended. `DAMAGED`: it cannot be read."""

    LIVE = "live"
    ENDED = "ended"
    UNFINISHED = "unfinished"
    DAMAGED = "damaged"


class ListedRun(msgspec.Struct, frozen=True, kw_only=True):
    """`began_s`: since the epoch, by the time of `run.json`. `verdict` is None where none is known.

    `record` is None for a live run that keeps none. `damage`: why it cannot be read.
    """

    state: ListedState
    run: str = ""
    ftm: str = ""
    placement: str = ""
    scenario: str = ""
    seed: int | None = None
    began_s: float | None = None
    verdict: Word | None = None
    record: str | None = None
    damage: str = ""


class RunList(msgspec.Struct, frozen=True):
    """`whole`: False if there were more than FOLDERS_MAX directories, and not all were looked into."""

    runs: tuple[ListedRun, ...]
    whole: bool


class _About(msgspec.Struct, frozen=True):
    """What is needed of `run.json`."""

    run: str
    ftm: str
    placement: str
    seed: Annotated[int, msgspec.Meta(ge=0, le=SEED_MAX)]
    work: Work


class _Judged(msgspec.Struct, frozen=True):
    verdict: Word


def listed(folders: Iterable[Path]) -> RunList:
    """The live runs, the oldest first; then the records below `folders`, the youngest first.

    Raises ConfigError if one is no directory.
    """
    live = list(_live())
    found = {one.record: one for one in live if one.record is not None}
    records, whole = _Search(), True
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder}: no such directory; one with records of runs is allowed")
        for path in records.below(folder, DEPTH_MAX):
            found.setdefault(str(path.resolve()), _recorded(path))
        whole = whole and not records.stopped
    ended = [one for one in found.values() if one.state is not ListedState.LIVE]
    ended.sort(key=lambda one: (-(one.began_s or 0.0), one.record or ""))
    return RunList((*live, *ended), whole)


def _live() -> Iterator[ListedRun]:
    for name in run_directory.live():
        try:
            status = control_client.ask(run_directory.root() / name, control_client.StatusQuery())
            record = Path(str(status["record"]))
            about, began_s = _about(record / "run.json")
        except (ConfigError, KeyError):  # it has just ended
            continue
        kept = record.parent != run_directory.root() / name
        yield _listed(
            ListedState.LIVE,
            about,
            began_s,
            ftm=str(status.get("ftm", about.ftm)),
            record=str(record) if kept else None,
        )


class _Search:
    """Looks for records, in FOLDERS_MAX directories at most."""

    def __init__(self) -> None:
        self._left = FOLDERS_MAX

    @property
    def stopped(self) -> bool:
        return self._left <= 0

    def below(self, folder: Path, depth: int) -> Iterator[Path]:
        """The records in `folder`, itself included; links and hidden directories are left out."""
        self._left -= 1
        if self.stopped:
            return
        try:
            names = {one.name: one for one in folder.iterdir()}
        except OSError:
            return
        if "journal" in names and names.keys() & {"run.json", "end.json", "seal.json"}:
            yield folder
        elif depth:
            for name, path in sorted(names.items()):
                if not name.startswith(".") and path.is_dir() and not path.is_symlink():
                    yield from self.below(path, depth - 1)


def _recorded(path: Path) -> ListedRun:
    try:
        about, began_s = _about(path / "run.json")
        verdict = _verdict(path / VERDICT_NAME)
    except ConfigError as error:
        return ListedRun(state=ListedState.DAMAGED, record=str(path), damage=str(error))
    state = ListedState.ENDED if (path / "end.json").exists() else ListedState.UNFINISHED
    return _listed(state, about, began_s, verdict=verdict, record=str(path))


def _about(path: Path) -> tuple[_About, float]:
    """With the time at which it was written."""
    about = _decoded(path, _About)
    try:
        return about, path.stat().st_mtime
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def _verdict(path: Path) -> Word | None:
    """None where its command left none."""
    return _decoded(path, _Judged).verdict if path.exists() else None


def _decoded(path: Path, kind: type[Found]) -> Found:
    """Raises ConfigError."""
    try:
        return msgspec.json.decode(read_input(path, FILE_BYTES_MAX), type=kind)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None


def _listed(
    state: ListedState,
    about: _About,
    began_s: float,
    *,
    ftm: str = "",
    verdict: Word | None = None,
    record: str | None = None,
) -> ListedRun:
    return ListedRun(
        state=state,
        run=about.run,
        ftm=ftm or about.ftm,
        placement=about.placement,
        scenario=_scenario(about.work),
        seed=about.seed,
        began_s=round(began_s, 3),
        verdict=verdict,
        record=record,
    )


def _scenario(work: Work) -> str:
    match work:
        case CarRun(scenario=scenario):
            return scenario
        case ReplayRun(log=log):
            return f"replay {log}"
        case LoadRun(requests=requests):
            return f"requests {requests}" if requests else "load"
        case _:
            assert_never(work)


def age_s(one: ListedRun) -> float | None:
    """How long ago it began, by the clock of this machine."""
    return None if one.began_s is None else max(0.0, round(time.time() - one.began_s, 1))
