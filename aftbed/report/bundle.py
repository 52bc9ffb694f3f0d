"""A bundle: a zip archive with all that a campaign is evidence by, fit to be filed and to be run again.

    README.md                 what is in it, how it is verified, how it is run again
    SHA256SUMS                the hash of every other file, as `sha256sum -c` reads them
    rerun.sh                  runs the campaigns again with the aftbed that is installed, compares outcomes
    NAME.yaml                 the campaign file, with every key
    NAME/plan.jsonl           its experiments, a line each
    NAME/records.jsonl        the ledger
    NAME/summary.json, junit.xml, report.html
    NAME/environment.json     on what it was run; what its functions declare
    NAME/worst/ID/            of the worst runs: the result; what happened in it, simulated once more; the
                              record of a real run that was broken or unexpected
    files/N/...               files of the user that the campaigns name

Equal records give equal bytes: names are sorted, times are fixed, and what is said of time and machine is
that of the records. A path of the machine would tell the name of its user, and names nothing elsewhere: files
of the user lie in `files`, and of every other absolute path only the name is kept.

Limits: a hash tells what was damaged, not who has written it. Whoever signs a bundle signs `SHA256SUMS`. What
the files of a function import or load is not in it.
"""

import hashlib
import io
import os
import re
import shlex
import stat
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from aftbed.adapt.commands import read as read_adaptation
from aftbed.campaign import ledger as ledgers
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.ledger import Head, Ledger
from aftbed.campaign.plan import plan, size_of
from aftbed.campaign.summary import Summary, summarise
from aftbed.core.application import Characteristics
from aftbed.core.archive import ArchiveLimits, opened_archive
from aftbed.core.errors import ConfigError
from aftbed.core.input_file import read_input
from aftbed.core.progress import Show, unshown
from aftbed.core.yaml_file import yaml_text
from aftbed.functions.request_file import names_function
from aftbed.functions.source import FunctionKind, parse_source
from aftbed.judge.isolated import declared_by
from aftbed.report.documents import documents
from aftbed.report.worst import by_badness, rerun
from aftbed.runtime.sim import trace
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.trust import Trust, vetted
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.scenarios.library import names_file

SUMS: Final = "SHA256SUMS"
ENVIRONMENT: Final = "environment.json"
LIMITS: Final = ArchiveLimits(archive_bytes_max=1 << 30, unpacked_bytes_max=1 << 30, members_max=10_000)
FILE_BYTES_MAX: Final = 64 << 20  # of a file of the user
WORST_MAX: Final = 10  # runs of a campaign that are looked at
SUMS_BYTES_MAX: Final = 16 << 20
FIXED_TIME: Final = (1980, 1, 1, 0, 0, 0)  # the first that a zip archive can say
UNIX: Final = 3  # the system whose modes the archive has
CHUNK_BYTES: Final = 1 << 20
NO_CLAIM: Final = (
    "aftbed is not a qualified tool, and nothing here is a claim of an ASIL: it is what was measured."
)
_PATH: Final = re.compile(r"(?<![\w.~:/*@+-])/(?:[^\s/'\",;:=()<>]+/)+(?=[^\s/])")
_LINE: Final = re.compile(r"([0-9a-f]{64})  ([^\n]+)")
_SHARD: Final = re.compile(r"[0-9]+/[0-9]+")

T = TypeVar("T")


class BundledFile(msgspec.Struct, frozen=True):
    """A file of a bundle, to be."""

    data: bytes
    executable: bool = False


class CampaignEnvironment(msgspec.Struct, frozen=True):
    """`functions`: what each declares (None: not known), by its text; the built-in one by ""."""

    code: str
    python: str
    kernel: str
    cpus: str
    command: str
    packages: dict[str, str]
    functions: dict[str, Characteristics | None]


# -- what is put into it --------------------------------------------------------------------------


def entries(found: Sequence[Ledger], trust: Trust, show: Show = unshown) -> dict[str, BundledFile]:
    """The files of a bundle of these campaigns, by name; `show` gets how many of the worst runs are done.

    Nothing is executed but what `trust` allows.

    Raises ConfigError: a shard alone, records that are not of their own plan, functions or requests that are
    not there any more, are others by now, or were never run by this user.
    """
    files = _UserFiles()
    for one in found:
        for path in _files_of(one, trust):
            files.add(path)
    made, campaigns = files.entries, dict[str, Summary]()
    for one in found:
        name = _free(one.head.spec.campaign, campaigns)
        experiments, portable = _planned(one), _portable(one, files)
        spec = portable.head.spec
        campaigns[name] = summary = summarise(portable, size_of(spec), sum(r.seconds for r in one.results))
        made[f"{name}.yaml"] = _text(f"# The campaign as it was run, with every key.\n{yaml_text(spec)}")
        made[f"{name}/plan.jsonl"] = BundledFile(_lines(files.moved(e, Experiment) for e in experiments))
        made[f"{name}/{ledgers.NAME}"] = BundledFile(_lines([portable.head, *portable.results]))
        made |= {f"{name}/{file}": _text(text) for file, text in documents(summary, portable).items()}
        made[f"{name}/{ENVIRONMENT}"] = BundledFile(_json(_environment(one, portable.head, files, trust)))
        kept = _kept(one, portable, files)
        worst = _worst(portable.results, kept, show)
        made |= {f"{name}/worst/{file}": entry for file, entry in worst}
    runtimes = {name: one.head.spec.system.runtime for name, one in zip(campaigns, found, strict=True)}
    made["rerun.sh"] = BundledFile(_script(campaigns, runtimes).encode(), executable=True)
    made["README.md"] = _text(_readme(runtimes, carried=bool(files.places)))
    sums = "".join(f"{sha256(made[name].data)}  {name}\n" for name in sorted(made))
    return made | {SUMS: _text(sums)}


def _free(campaign: str, taken: Mapping[str, object]) -> str:
    """A name for the campaign that no other one has."""
    names = (campaign, *(f"{campaign}-{number}" for number in range(2, len(taken) + 2)))
    return next(name for name in names if name not in taken)


def _planned(found: Ledger) -> list[Experiment]:
    """The experiments of its plan, of which its results are some."""
    head = found.head
    if head.shards > 1:
        raise ConfigError(
            f"{found.path}: shard {head.shard} of {head.shards}: `aftbed campaign merge` makes one of them"
        )
    made = plan(head.spec)
    system = head.spec.system
    if made.digest != head.digest and any((system.app, system.request_file, names_file(system.scenario))):
        raise ConfigError(
            f"{found.path}: the function, the requests or the scenario are not those of these records any"
            f" more, or aftbed is not (records {head.code}, installed {made.code}): restore what it was"
        )
    made = msgspec.structs.replace(made, digest=head.digest, code=head.code)
    experiments = list(made.experiments())
    for result in found.results:
        one = result.experiment
        expected = experiments[one.index] if one.index < len(experiments) else None
        if expected != msgspec.structs.replace(one, runtime=system.runtime):
            raise ConfigError(
                f"{found.path}: experiment {one.id} (number {one.index}) is not that of the plan"
                f" (records {head.code}, installed {made.code}): the aftbed of the records bundles them"
            )
    return experiments


def _environment(found: Ledger, head: Head, files: "_UserFiles", trust: Trust) -> CampaignEnvironment:
    functions: dict[str, Characteristics | None] = {}
    for source in _functions(found):
        try:
            declared = declared_by(source, trust) if source else default_application().characteristics
        except ConfigError:
            declared = None
        functions[files.replaced(source)] = declared
    machine = head.environment
    return CampaignEnvironment(
        head.code,
        machine.python,
        machine.kernel,
        machine.cpus,
        machine.command,
        machine.packages,
        functions,
    )


def _functions(found: Ledger) -> list[str]:
    """The texts that name the functions of a campaign, the one that it begins with first."""
    spec = found.head.spec
    wishes = [read_adaptation(text).wish for entry in spec.adaptations for text in entry.texts]
    return list(dict.fromkeys([spec.system.app, *(wish.source for wish in wishes if wish.source)]))


def _worst(
    results: Sequence[Result], kept: Mapping[str, dict[str, bytes]], show: Show
) -> Iterator[tuple[str, BundledFile]]:
    """A ledger keeps no messages, so what happened in a run is that of its simulation with the same seed.

    `kept`: the records of real runs, by the ids of their experiments.
    """
    worst = by_badness(results)[:WORST_MAX]
    worst += [result for result in results if result.experiment.id in kept and result not in worst]
    for number, result in enumerate(worst):
        show(number, len(worst))
        name = result.experiment.id
        yield f"{name}/result.json", BundledFile(_json(result))
        again, command = rerun(result.experiment), result.experiment.command()
        if again.trace is None:
            words = f"not simulated again: {again.why_not}; recorded: {result.outcome}\n{command}\n"
        else:
            words = f"simulated again: {again.outcome}; recorded: {result.outcome}\n{command}\n"
            words += "".join(f"{line}\n" for line in trace.lines(again.trace))
        yield f"{name}/trace.txt", _text(words)
        for file, data in kept.get(name, {}).items():
            yield f"{name}/record/{file}", BundledFile(data)


def _kept(found: Ledger, portable: Ledger, files: "_UserFiles") -> dict[str, dict[str, bytes]]:
    """The records that the campaign has kept, each file by its name, those as they were sealed.

    A record that names files of the user is left out: it cannot be changed without its seal.
    """
    records: dict[str, dict[str, bytes]] = {}
    private = [f"{Path.home()}/".encode(), *map(os.fsencode, files.places)]
    for result in portable.results:
        folder = found.path.parent / ledgers.RECORDS / result.experiment.id
        if folder.is_symlink() or not seal.sealed(folder) or any(seal.changes(folder)):
            continue
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        try:
            record = {str(path.relative_to(folder)): read_input(path, FILE_BYTES_MAX) for path in paths}
        except OSError:
            continue
        if not any(word in data for data in record.values() for word in private):
            records[result.experiment.id] = record
    return records


# -- paths ----------------------------------------------------------------------------------------


def _files_of(found: Ledger, trust: Trust) -> Iterator[str]:
    """The paths of files that the campaign names, as they stand in its texts. Raises ConfigError."""
    system = found.head.spec.system
    functions = _functions(found)
    if names_function(system.request_file):
        functions.append(system.request_file)
    elif system.request_file:
        yield system.request_file
    if names_file(system.scenario):
        yield system.scenario
    for text in filter(None, functions):
        try:
            vetted(text, trust)
        except ConfigError as error:
            raise ConfigError(f"{found.path}: a bundle has the files of its functions: {error}") from None
        source = parse_source(text)
        words = source.words if source.kind is FunctionKind.PROGRAM else (source.place, source.part)
        yield from (word for word in words if word.startswith("/") and Path(word).is_file())


class _UserFiles:
    """The files of the user that a bundle has, and texts in which they have their new places.

    Those of one directory stay together, as `files/1`. `places`: by the path as it stands in a text.
    """

    def __init__(self) -> None:
        self.entries: dict[str, BundledFile] = {}
        self.places: dict[str, str] = {}
        self._folders: dict[Path, int] = {}

    def add(self, path: str) -> None:
        """Raises ConfigError if it cannot be read."""
        file = Path(path)
        if not file.name.isprintable() or "\\" in file.name:
            raise ConfigError(f"{path!r}: a name of printable characters is allowed in a bundle")
        try:
            data = read_input(file, FILE_BYTES_MAX)
            executable = bool(file.stat().st_mode & stat.S_IXUSR)
        except OSError as error:
            where = "" if file.is_absolute() else "; bundle it in the directory in which it was run"
            why = f"{error.strerror}: a bundle has the files that its campaign names{where}"
            raise ConfigError(f"{path}: {why}") from None
        folder = file.resolve().parent
        number = self._folders.setdefault(folder, len(self._folders) + 1)
        self.entries[f"files/{number}/{file.name}"] = BundledFile(data, executable)
        dotted = "./" if "/./" in path else ""  # by another text it is another version of the function
        self.places[path] = f"files/{number}/{dotted}{file.name}"

    def moved(self, value: object, shape: type[T]) -> T:
        """`value` without paths of this machine in its texts."""
        return msgspec.convert(self._walked(msgspec.to_builtins(value)), shape)

    def _walked(self, value: object) -> object:
        match value:
            case str():
                return self.replaced(value)
            case dict():
                return {key: self._walked(one) for key, one in value.items()}
            case list() | tuple():
                return [self._walked(one) for one in value]
            case _:
                return value

    def replaced(self, text: str) -> str:
        """One text."""
        if "/" not in text:
            return text
        for path in sorted(self.places, key=len, reverse=True):
            text = text.replace(path, self.places[path])
        return _PATH.sub("", text.replace(f"{Path.home()}/", "/home/"))  # which may have blanks in it


def _portable(found: Ledger, files: _UserFiles) -> Ledger:
    """The same records without paths of this machine."""
    command = _without_folders(found.head.environment.command)
    machine = msgspec.structs.replace(found.head.environment, command=command)
    head = files.moved(msgspec.structs.replace(found.head, environment=machine), Head)
    return Ledger(found.path, head, tuple(files.moved(result, Result) for result in found.results))


def _without_folders(command: str) -> str:
    """A command line whose paths are names."""
    try:
        words = shlex.split(command)
    except ValueError:
        words = command.split()
    return shlex.join(word if _SHARD.fullmatch(word) else _name_of(word) for word in words)


def _name_of(word: str) -> str:
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return f"{option}{equals}{value.rstrip('/').rpartition('/')[2]}"


# -- as bytes -------------------------------------------------------------------------------------


def archive_of(made: Mapping[str, BundledFile]) -> bytes:
    """The archive. Raises ConfigError where it would be too large to be read."""
    size = sum(len(entry.data) for entry in made.values())
    if size > LIMITS.unpacked_bytes_max or len(made) > LIMITS.members_max:
        most = f"{LIMITS.unpacked_bytes_max} bytes in {LIMITS.members_max} files"
        raise ConfigError(f"a bundle of {size} bytes in {len(made)} files: allowed are {most}")
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in sorted(made):
            about = zipfile.ZipInfo(name, FIXED_TIME)
            about.compress_type, about.create_system = zipfile.ZIP_DEFLATED, UNIX
            about.external_attr = (stat.S_IFREG | (0o755 if made[name].executable else 0o644)) << 16
            archive.writestr(about, made[name].data)
    return file.getvalue()


def sha256(data: bytes) -> str:
    """In hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def _text(text: str) -> BundledFile:
    return BundledFile(text.encode())


def _json(document: object) -> bytes:
    return msgspec.json.format(msgspec.json.encode(document, order="deterministic")) + b"\n"


def _lines(documents_: Iterable[object]) -> bytes:
    return b"".join(msgspec.json.encode(one) + b"\n" for one in documents_)


SCRIPT: Final = """\
#!/bin/sh
# Run the campaigns of this bundle again with the aftbed that is installed, and compare the outcomes.
#
#     sh rerun.sh [DIRECTORY]     the new records go there: a new directory, `again` if left out
#
# AFTBED is the command, `aftbed` if it is not set.
# Exit code: 0 all came out as in the bundle, 1 they did not, 2 usage, else that of a command that failed.
set -u
aftbed=${AFTBED:-aftbed}
out=${1:-again}
case $out in /*) ;; *) out=$PWD/$out ;; esac
cd "$(dirname -- "$0")" || exit 2
if ! command -v ${aftbed%% *} >/dev/null; then
  echo "rerun.sh: no command ${aftbed%% *}: install aftbed, or set AFTBED" >&2
  exit 2
fi
sha256sum -c SHA256SUMS >/dev/null || exit 1
mkdir -p -- "$out" || exit 2
result=0

# again NAME EXIT WORDS [OPTION]: run campaign NAME, whose gates came to EXIT, and compare it with these
# options; WORDS are what it comes to if all is well.
again() {
  name=$1 before=$2 words=$3
  shift 3
  echo "== $name"
  $aftbed campaign run "$name.yaml" --out "$out/$name"
  code=$?
  [ "$code" -le 1 ] || exit "$code"
  if [ "$code" -ne "$before" ]; then
    words="the gates came to exit code $code, in the bundle to $before"
    result=1
  fi
  $aftbed campaign compare "$name" "$out/$name" "$@"
  code=$?
  [ "$code" -le 1 ] || exit "$code"
  if [ "$code" -ne 0 ]; then
    words="other outcomes"
    result=1
  fi
  echo "rerun.sh: $name: $words"
}

"""


def _script(campaigns: Mapping[str, Summary], runtimes: Mapping[str, str]) -> str:
    """A simulated campaign comes to the same outcomes; of a real one, no stratum may be worse."""
    calls = ""
    for name, summary in campaigns.items():
        words = "'same outcomes' --outcomes" if runtimes[name] == "sim" else "'no stratum is worse'"
        calls += f"again {name} {0 if summary.gate == 'pass' else 1} {words}\n"
    return f'{SCRIPT}{calls}exit "$result"\n'


def _readme(runtimes: Mapping[str, str], *, carried: bool) -> str:
    how = {"sim": "simulated", "unix": "on real processes"}
    rows = "".join(f"| `{name}.yaml`, `{name}/` | {how[runtime]} |\n" for name, runtime in runtimes.items())
    files = "`files/` has the files of the user that the campaigns name, as they were.\n\n" if carried else ""
    return f"""\
# Evidence of fault injection campaigns

{NO_CLAIM}

| campaign | run |
|---|---|
{rows}
Of each: the campaign file with every key; `plan.jsonl`, the experiments; `records.jsonl`, the ledger;
`summary.json`, `junit.xml` and `report.html`, what they come to; `environment.json`, on what it was run;
`worst/`, the runs to look at first: what happened in each, simulated once more with the same seed, and the
record of a real one that was broken or unexpected (`aftbed check`).
Of absolute paths only the name is kept.

{files}- Verify the files: `sha256sum -c SHA256SUMS`, or `aftbed campaign verify` of the archive.
- Run the campaigns again: `sh rerun.sh DIRECTORY`. A simulated campaign has to come to the same outcomes,
  one by one. Real processes differ in time, so there no stratum may have become worse.
"""


# -- what is read ---------------------------------------------------------------------------------


class Misfit(msgspec.Struct, frozen=True):
    """A file that is not what `SHA256SUMS` has, and why."""

    path: str
    why: str


class Bundle(msgspec.Struct, frozen=True):
    """A bundle that was read: the hash of the archive, and of each file as it is."""

    sha256: str
    files: dict[str, str]
    misfits: tuple[Misfit, ...]


def verified(path: Path, show: Show = unshown) -> Bundle:
    """Hash all of a bundle; nothing is unpacked. `show` gets how many files are done.

    Raises ConfigError if it is none.
    """
    with opened_archive(path, "a bundle", LIMITS) as (file, archive):
        files: dict[str, str] = {}
        members = archive.infolist()
        for number, one in enumerate(members):
            show(number, len(members))
            if one.is_dir():
                continue
            digest = hashlib.sha256()
            with archive.open(one) as member:
                while chunk := member.read(CHUNK_BYTES):
                    digest.update(chunk)
            files[one.filename] = digest.hexdigest()
        if SUMS not in files:
            raise ConfigError(f"{path}: no bundle: {SUMS} is missing")
        if (size := archive.getinfo(SUMS).file_size) > SUMS_BYTES_MAX:
            raise ConfigError(f"{path}: {SUMS}: found {size} bytes, allowed are {SUMS_BYTES_MAX}")
        stated = _stated(path, archive.read(SUMS))
        file.seek(0)
        whole = hashlib.sha256()
        while chunk := file.read(CHUNK_BYTES):
            whole.update(chunk)
    del files[SUMS]
    misfits = [
        Misfit(name, "it is missing" if name not in files else f"its hash is {files[name]}, not {digest}")
        for name, digest in stated.items()
        if files.get(name) != digest
    ]
    misfits += [Misfit(name, f"it is not in {SUMS}") for name in files if name not in stated]
    return Bundle(whole.hexdigest(), files, tuple(misfits))


def _stated(path: Path, data: bytes) -> dict[str, str]:
    found: dict[str, str] = {}
    for number, line in enumerate(data.decode(errors="replace").removesuffix("\n").split("\n"), 1):
        match = _LINE.fullmatch(line)
        if match is None or match[2] in found:
            why = "stands twice" if match else "is no hash, two blanks and a name"
            raise ConfigError(f"{path}: {SUMS}: line {number}: {line[:80]!r} {why}")
        found[match[2]] = match[1]
    return found


class FiledCampaign(msgspec.Struct, frozen=True):
    """A campaign of a bundle: its ledger, by its name in the bundle, and its environment."""

    entry: str
    ledger: Ledger
    environment: CampaignEnvironment


def campaigns_in(path: Path) -> list[FiledCampaign]:
    """The campaigns of a bundle, by name. Raises ConfigError, also if there is none."""
    found = []
    with opened_archive(path, "a bundle", LIMITS) as (_, archive):
        names = sorted(name for name in archive.namelist() if name.count("/") == 1)
        for name in (name for name in names if name.endswith(f"/{ledgers.NAME}")):
            records = ledgers.read(path / name, archive.read(name))
            about = name.replace(ledgers.NAME, ENVIRONMENT)
            if about not in names:
                raise ConfigError(f"{path}: {about} is missing")
            try:
                environment = msgspec.json.decode(archive.read(about), type=CampaignEnvironment)
            except msgspec.DecodeError as error:
                raise ConfigError(f"{path}: {about}: {error}") from None
            found.append(FiledCampaign(name, records, environment))
    if not found:
        raise ConfigError(f"{path}: it has no campaign: {ledgers.NAME} is missing")
    return found
