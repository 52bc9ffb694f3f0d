"""The records of a campaign: a text file, one JSON document per line, appended as the results come.

The first line names the campaign. Each further line is one result, written in one `write` to a
file opened for appending, by the process that has just judged the run: so a `kill -9` of the campaign
loses at most what is in flight, and workers need no lock. A last line without its end can only be what a
full disk or a dead machine left; `resume` cuts it off, all other readers refuse it.
"""

import os
import platform
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from aftbed.campaign.experiment import Result
from aftbed.campaign.plan import CampaignPlan
from aftbed.campaign.spec import Spec
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.input_file import read_input

CPUINFO = Path("/proc/cpuinfo")
NAME: Final = "records.jsonl"
RECORDS: Final = "runs"  # beside it: the records of real runs that were broken or unexpected, by their ids
LINE_BYTES_MAX: Final = 1_000_000
LEDGER_BYTES_MAX: Final = 4 << 30
OWN: Final = {"digest": "spec", "code": "version of the code", "shard": "shard", "shards": "number of shards"}
_PACKAGE: Final = re.compile(r"[A-Za-z0-9._-]+")

T = TypeVar("T")


class Environment(msgspec.Struct, frozen=True):
    """On what a campaign was run: versions, machine, and the command that it was started with.

    `packages`: the versions of those that aftbed needs, by name.
    """

    python: str
    kernel: str
    cpus: str
    command: str
    packages: dict[str, str] = {}


def here() -> Environment:
    """That of this process."""
    usable = len(os.sched_getaffinity(0))
    try:
        lines = CPUINFO.read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return Environment(
        f"{platform.python_implementation()} {platform.python_version()}",
        f"{platform.system()} {platform.release()}",
        f"{usable} of {os.cpu_count()}, {next(models, platform.machine())}",
        shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        _packages(),
    )


def _packages() -> dict[str, str]:
    """None where aftbed is not installed, but only on the path of Python."""
    from importlib import metadata  # noqa: PLC0415 - with it comes `threading`, see `worker_pool`

    try:
        wanted = [_PACKAGE.match(text) for text in metadata.requires("aftbed") or () if ";" not in text]
        names = sorted(match[0] for match in wanted if match)
        return {name: metadata.version(name) for name in names}
    except metadata.PackageNotFoundError:
        return {}


class Head(msgspec.Struct, frozen=True):
    """The first line. `shard` I of `shards`, counted from 1."""

    digest: str
    code: str
    spec: Spec
    environment: Environment
    shard: int = 1
    shards: int = 1


class Ledger(msgspec.Struct, frozen=True):
    """A ledger, read."""

    path: Path
    head: Head
    results: tuple[Result, ...]


def head_of(plan: CampaignPlan, shard: int = 1, shards: int = 1) -> Head:
    """Of the ledger of `plan`."""
    return Head(plan.digest, plan.code, plan.spec, here(), shard, shards)


def begin(path: Path, head: Head) -> None:
    """A new ledger. Raises ConfigError where there is one."""
    try:
        with open(path, "xb") as file:
            file.write(msgspec.json.encode(head) + b"\n")
    except FileExistsError:
        text = f"{path}: exists already: --resume goes on with it, --out names another place"
        raise ConfigError(text) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}") from None


def resume(path: Path, head: Head) -> None:
    """Cut off a torn last line, to go on after it. Raises ConfigError on the ledger of another campaign."""
    data = _bytes(path)
    whole = data.rfind(b"\n") + 1
    found = read(path, data[:whole])
    for name in OWN:
        old, new = getattr(found.head, name), getattr(head, name)
        if old != new:
            raise ConfigError(f"{path}: another {OWN[name]} ({old}; now {new}): --out begins a new campaign")
    if whole < len(data):
        os.truncate(path, whole)


def opened(path: Path) -> int:
    """A descriptor to append results to."""
    return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)


def append(descriptor: int, result: Result) -> None:
    """One line, whole or not at all."""
    line = msgspec.json.encode(result) + b"\n"
    assert len(line) <= LINE_BYTES_MAX, f"{len(line)} bytes for one result"
    try:
        written = os.write(descriptor, line)
    except OSError as error:
        raise HarnessError(f"{_path_of(descriptor)}: a result cannot be written: {error.strerror}") from None
    if written != len(line):
        raise HarnessError(
            f"{_path_of(descriptor)}: {written} of {len(line)} bytes of a result fitted: make room, "
            "then go on with --resume"
        )


def read(path: Path, data: bytes | None = None) -> Ledger:
    """The ledger in `path`. Raises ConfigError naming the line that is no record."""
    data = _bytes(path) if data is None else data
    lines = data.split(b"\n")
    if lines[-1]:
        raise ConfigError(
            f"{path}: line {len(lines)}: it is torn: `aftbed campaign run --resume` cuts it off and goes on"
        )
    if len(lines) < 2:
        raise ConfigError(f"{path}: it is empty: not the records of a campaign")
    head = _decoded(path, 1, lines[0], Head)
    results = [_decoded(path, number, line, Result) for number, line in enumerate(lines[1:-1], 2)]
    _refuse_doubles(path, results)
    return Ledger(path, head, tuple(sorted(results, key=lambda r: r.experiment.index)))


def merged(ledgers: Iterable[Ledger]) -> Ledger:
    """One ledger out of those of all shards. Raises ConfigError where they do not belong together."""
    found = list(ledgers)
    first = found[0]
    for other in found[1:]:
        if (other.head.digest, other.head.code) != (first.head.digest, first.head.code):
            raise ConfigError(f"{other.path}: of another spec or code than {first.path}")
        if other.head.shards != first.head.shards:
            raise ConfigError(
                f"{other.path}: shard {other.head.shard} of {other.head.shards}; {first.path} is one of "
                f"{first.head.shards}: shards of one run belong together"
            )
    # Each shard once, and all of them: a sum that lacks one looks like a whole campaign.
    shards = first.head.shards
    seen = set[int]()
    for ledger in found:
        if ledger.head.shard in seen:
            raise ConfigError(f"{ledger.path}: shard {ledger.head.shard} of {shards} stands twice")
        seen.add(ledger.head.shard)
    missing = [str(shard) for shard in range(1, shards + 1) if shard not in seen]
    if missing:
        raise ConfigError(f"shard {', '.join(missing)} of {shards} is missing: name the records of all")
    results = [result for ledger in found for result in ledger.results]
    _refuse_doubles(first.path, results)
    head = msgspec.structs.replace(first.head, shard=1, shards=1)
    return Ledger(first.path, head, tuple(sorted(results, key=lambda r: r.experiment.index)))


def find(ledger: Ledger, name: str) -> Result:
    """The result whose experiment has the id, or the beginning of the id, or the index `name`."""
    found = [r for r in ledger.results if r.experiment.id.startswith(name) or str(r.experiment.index) == name]
    exact = [r for r in found if str(r.experiment.index) == name] or found
    if len(exact) != 1:
        raise ConfigError(f"experiment {name!r}: {len(exact)} of {ledger.path} are called so: give its id")
    return exact[0]


def _refuse_doubles(path: Path, results: list[Result]) -> None:
    for name, count in Counter(result.experiment.id for result in results).items():
        if count > 1:
            raise ConfigError(f"{path}: experiment {name} stands twice")


def _path_of(descriptor: int) -> str:
    return str(Path(f"/proc/self/fd/{descriptor}").readlink())


def _bytes(path: Path) -> bytes:
    try:
        return read_input(path, LEDGER_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; is this the directory of a campaign?") from None


def _decoded(path: Path, number: int, line: bytes, shape: type[T]) -> T:
    try:
        return msgspec.json.decode(line, type=shape)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path}: line {number}: {error}") from None
