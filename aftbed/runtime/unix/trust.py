"""Which code outside of the package a judge may execute, and how it is loaded.

A record names the function that served a run. Its author chose that name, so a judge executes the code
behind it only if the user has agreed: its files lie under a directory of `--trust`, or each of them has the
SHA-256 of a file that this user has run. A run notes what it loads in its record (`note`), and its command
keeps the hashes in a ledger of this user (`remember`).

A user edits a function while a run goes on, so the run keeps copies in its record of what it has loaded
(`KEPT_NAME`). By one text it always loads the same: where the file is another one by now, a new backup gets
the copy, and so does the judge. `update app` to the same text gives the new content a text of its own
(`versioned`).

Code is found without executing any of it: the import system would execute the packages on the way to a
module. It is executed from the very bytes that were hashed: neither a file that was exchanged meanwhile nor a
compiled one beside it is. The working directory is not searched.
"""

import contextlib
import fcntl
import importlib
import json
import os
import re
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Final

import msgspec

import aftbed
from aftbed.core.errors import ConfigError
from aftbed.core.input_file import open_input, read_input
from aftbed.core.installed import search_path
from aftbed.functions.load import Code, SourceLoader
from aftbed.functions.source import FunctionKind, FunctionSource, parse_source

PACKAGE: Final = Path(aftbed.__file__).resolve().parent
FILE_BYTES_MAX: Final = 1 << 28  # a program may be as long as an interpreter
NOTES_NAME: Final = "functions.jsonl"  # in the record: a line for each file of code that was loaded
KEPT_NAME: Final = "functions"  # in the record: copies of them, each in a directory named by its hash
KEPT_BYTES_MAX: Final = 64 << 20  # of a file; a larger one is not kept
VERSION_DIGITS: Final = 12
NOTES_BYTES_MAX: Final = 10_000_000
LEDGER_NAME: Final = "functions"  # in the state directory: a hash per line, the latest last
HASHES_MAX: Final = 1000
HASH_DIGITS: Final = 64
LEDGER_BYTES_MAX: Final = HASHES_MAX * (HASH_DIGITS + 1)


class Trust(msgspec.Struct, frozen=True):
    """`folders`: of `--trust`. `own_run`: this very command made the record, and named its functions."""

    folders: tuple[Path, ...] = ()
    own_run: bool = False


NOBODY: Final = Trust()  # nobody's code but what this user has run
OWN_RUN: Final = Trust(own_run=True)


def trusting(folders: Iterable[Path] | None) -> Trust:
    """For `--trust`. Raises ConfigError where one is no directory."""
    given = tuple(folders or ())
    for folder in given:
        if not folder.is_dir():
            raise ConfigError(f"--trust {folder}: no such directory")
    return Trust(tuple(folder.resolve() for folder in given))


# -- what a source executes -----------------------------------------------------------------------


class CodeFile(msgspec.Struct, frozen=True):
    """A file that is executed as `module`; `folders` are those of a package, none of another module.

    Without a `module`: one that is no Python, and is executed as it is. `kept`: the copy that is executed in
    the place of `path`, which has other content by now.
    """

    module: str
    path: str
    sha256: str
    folders: tuple[str, ...] = ()
    kept: str = ""

    @property
    def executed(self) -> Path:
        return Path(self.kept or self.path)


class VettedFiles(msgspec.Struct, frozen=True):
    """All that loading a function executes, in order; no file of a module of this package.

    `place`: `MODULE`, `FILE.py`, or all of the text that names a function of another kind.
    """

    place: str
    files: tuple[CodeFile, ...]
    key: str = ""  # `FunctionSource.key`

    @property
    def kept(self) -> dict[str, str]:
        """The copies, by the paths in whose place they are executed."""
        return {file.path: file.kept for file in self.files if file.kept}


def vetted(source: str, trust: Trust, record: Path | None = None) -> VettedFiles:
    """The code of a function, or of a brick's class; nothing of it is executed.

    With `record`: what the run of that record has loaded, where it kept it and the files are others by now.
    Raises ConfigError, which names the source, where it is not trusted, or is not there.
    """
    named = parse_source(source)
    place = named.place if named.kind is FunctionKind.CLASS else source
    if _ours(named):
        return VettedFiles(place, (), named.key)
    try:
        files = tuple(_files_of(named, record))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"{source} cannot be read: {reason}") from None
    outside = [one for one in files if not any(one.executed.is_relative_to(f) for f in trust.folders)]
    if outside and not trust.own_run:
        known, why_not = known_hashes()
        strangers = [one for one in outside if one.sha256 not in known]
        if strangers:
            folder = Path(strangers[0].path).parent
            unknown = f" (what you ran before is not known: {why_not})" if why_not else ""
            raise ConfigError(
                f"{source} is not trusted, so it was not executed: you have not run it before{unknown};"
                f" --trust {folder} executes it"
            )
    return VettedFiles(place, files, named.key)


def _ours(source: FunctionSource) -> bool:
    """Whether it is a module of this package."""
    place = source.place
    is_class = source.kind is FunctionKind.CLASS
    return is_class and place.partition(".")[0] == PACKAGE.name and not place.endswith(".py")


def _files_of(source: FunctionSource, record: Path | None = None) -> Iterator[CodeFile]:
    """Raises OSError, ValueError."""
    loaded = _loaded(record).get(source.key, {}) if record is not None else {}

    def file(module: str, path: Path, folders: tuple[str, ...] = ()) -> CodeFile:
        if record is not None and (before := loaded.get(str(path))) is not None:
            kept = _kept(record, before, path)
            if kept.is_file() and not _has(path, before):
                return CodeFile(module, str(path), before, folders, str(kept))
        return CodeFile(module, str(path), _hash(path), folders)

    if source.kind is not FunctionKind.CLASS:
        yield from (file("", path) for path in source.files())
    elif source.place.endswith(".py"):
        path = Path(source.place).resolve()
        yield file(path.stem, path)
    else:
        yield from (file(*found) for found in _modules(source.place.split(".")))


def _modules(parts: list[str]) -> Iterator[tuple[str, Path, tuple[str, ...]]]:
    """Name, file and folders of a module and of the packages around it. Raises ValueError."""
    folders: list[str] | None = search_path()
    for number in range(1, len(parts) + 1):
        name = ".".join(parts[:number])
        spec = PathFinder.find_spec(name, folders)
        if spec is None or not all(parts):
            raise ValueError(f"no module {name}")
        folders = _folders_of(spec)
        if spec.origin is not None:
            path = Path(spec.origin).resolve()
            if path.suffix != ".py":
                raise ValueError(f"{path} is no Python file")
            yield name, path, tuple(folders)


def _folders_of(spec: ModuleSpec) -> list[str]:
    return [str(Path(folder).resolve()) for folder in spec.submodule_search_locations or ()]


def _hash(path: Path) -> str:
    """Raises OSError, ValueError."""
    return sha256(read_input(path, FILE_BYTES_MAX)).hexdigest()


def _has(path: Path, digest: str) -> bool:
    try:
        return _hash(path) == digest
    except OSError:
        return False


# -- loading it, in the process that executes it --------------------------------------------------


class _HashedLoader(SourceLoader):
    """Loads the file if it has the hash."""

    def __init__(self, file: CodeFile) -> None:
        super().__init__(file.module, file.path)
        self._file = file

    def source(self) -> bytes:
        data = read_input(self._file.executed, FILE_BYTES_MAX)
        if sha256(data).hexdigest() != self._file.sha256:
            raise ConfigError(f"{self._file.executed}: was changed meanwhile")
        return data


_IMPORTED: Final[dict[str, str]] = {}  # the hash of each module that `load` has put into `sys.modules`


def load(code: VettedFiles) -> ModuleType:
    """Execute it, which is Python. Raises whatever that raises."""
    if not code.files:
        return importlib.import_module(code.place)
    module = None
    for file in code.files:
        module = sys.modules.get(file.module) if not code.place.endswith(".py") else None
        if module is not None and _IMPORTED.get(file.module, file.sha256) == file.sha256:
            continue
        folders = list(file.folders) or None
        spec = spec_from_file_location(
            file.module, file.path, loader=_HashedLoader(file), submodule_search_locations=folders
        )
        assert spec is not None and spec.loader is not None
        module = module_from_spec(spec)
        if not code.place.endswith(".py"):
            sys.modules[file.module] = module
            _IMPORTED[file.module] = file.sha256
        spec.loader.exec_module(module)
    assert module is not None
    return module


def check_unchanged(code: VettedFiles) -> None:
    """That the files which are no Python have their hashes still. Raises ConfigError."""
    for file in code.files:
        if not file.module and _hash(file.executed) != file.sha256:
            raise ConfigError(f"{file.executed}: was changed meanwhile")


class VettedCode(Code):
    """From the bytes that were hashed; without any file of this package."""

    def __init__(self, codes: Iterable[VettedFiles]) -> None:
        self._codes = {code.key or code.place: code for code in codes}

    def module(self, place: str) -> ModuleType:
        return load(self._codes[place])

    def function_module(self, source: FunctionSource) -> ModuleType:
        return load(self._codes[source.key])

    def permit(self, source: FunctionSource) -> FunctionSource:
        code = self._codes[source.key]
        check_unchanged(code)
        return source.reading(code.kept)


# -- what runs have loaded ------------------------------------------------------------------------


def note(record: Path, place: str, module: ModuleType, key: str = "") -> None:
    """Add the files of `module`, which a node has loaded as `place`, to the notes in the record of its run.

    `key`: of a function, whose files are kept too. A note that cannot be written is left out: the record can
    then only be judged with `--trust`.
    """
    parts = place.split(".")
    loaded = [module]
    if not place.endswith(".py"):
        names = [".".join(parts[:number]) for number in range(1, len(parts))]
        loaded = [*(sys.modules[name] for name in names if name in sys.modules), module]
    paths = [Path(file) for one in loaded if (file := getattr(one, "__file__", None))]
    _note(record, key or place, paths, keep=bool(key))


def note_files(record: Path, source: FunctionSource) -> None:
    """The same of a function that is no class, which a node is about to execute."""
    with contextlib.suppress(ConfigError):
        _note(record, source.key, source.files(), keep=True)


def _note(record: Path, place: str, paths: list[Path], *, keep: bool) -> None:
    with contextlib.suppress(OSError, ValueError):
        notes = []
        for path in (one.resolve() for one in paths):
            data = read_input(path, FILE_BYTES_MAX)
            digest = sha256(data).hexdigest()
            notes.append({"place": place, "file": str(path), "sha256": digest})
            if keep and len(data) <= KEPT_BYTES_MAX and not _is_python(path):
                _keep(_kept(record, digest, path), data, path.stat().st_mode)
        with open(record / NOTES_NAME, "ab", buffering=0) as file:
            file.write("".join(json.dumps(one) + "\n" for one in notes).encode())


def _is_python(path: Path) -> bool:
    """Whether it is the interpreter: a user edits the program that it executes."""
    return path == Path(sys.executable).resolve() or str(path.parent) in ("/bin", "/usr/bin")


def _kept(record: Path, digest: str, path: Path) -> Path:
    return record.resolve() / KEPT_NAME / digest / path.name


def _keep(place: Path, data: bytes, mode: int) -> None:
    """Whole or not at all: nodes keep the same at the same time."""
    if place.exists():
        return
    place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    beside = place.with_name(f".{os.getpid()}")
    beside.write_bytes(data)
    beside.chmod(0o600 | mode & 0o100)
    beside.replace(place)


def _loaded(record: Path) -> dict[str, dict[str, str]]:
    """What a run has loaded first by each key: the hashes, by file."""
    found: dict[str, dict[str, str]] = {}
    for line in _notes(record):
        with contextlib.suppress(ValueError, LookupError, TypeError):
            one = json.loads(line)
            digest = str(one["sha256"])
            if re.fullmatch(r"[0-9a-f]{64}", digest):  # it is a part of a path
                found.setdefault(str(one["place"]), {}).setdefault(str(one["file"]), digest)
    return found


def loaded_before(record: Path, source: FunctionSource) -> VettedFiles | None:
    """What a run that is under way has loaded as `source`, where the files have other content by now.

    None: what is there is to be loaded. Raises ConfigError where it is neither what was loaded before nor
    kept, and where it is not of the version that `source` names.
    """
    if _ours(source):
        return None
    before = _loaded(record).get(source.key)
    if before is None:
        if source.version and source.version != _version(source):
            raise ConfigError(f"{source}: was changed meanwhile")
        return None
    try:
        files = tuple(_files_of(source, record))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{source}: {error}") from None
    for file in files:
        if file.sha256 != before.get(file.path, file.sha256):
            raise ConfigError(
                f"{file.path}: has other content than what this run has loaded, of which no copy was kept"
                f" (of at most {KEPT_BYTES_MAX >> 20} MiB)"
            )
    code = VettedFiles(source.place, files, source.key)
    return code if code.kept else None


def _version(source: FunctionSource) -> str:
    """Of the content that is there. Raises ConfigError."""
    try:
        hashes = [file.sha256 for file in _files_of(source)]
    except (OSError, ValueError) as error:
        raise ConfigError(f"{source}: {error}") from None
    return sha256("".join(hashes).encode()).hexdigest()[:VERSION_DIGITS]


def versioned(text: str, record: Path) -> str:
    """The text by which a run that is under way loads what `text` names now, whatever it has loaded before.

    Raises ConfigError.
    """
    source = parse_source(text)
    before = {} if _ours(source) else _loaded(record).get(source.key, {})
    if all(_has(Path(path), digest) for path, digest in before.items()):
        return text
    return str(msgspec.structs.replace(source, version=_version(source)))


def noted(record: Path) -> list[str]:
    """The hashes in the notes of a run, each once."""
    found = []
    for line in _notes(record):
        with contextlib.suppress(ValueError, LookupError, TypeError):
            found.append(str(json.loads(line)["sha256"]))
    return list(dict.fromkeys(one for one in found if len(one) == HASH_DIGITS))


def _notes(record: Path) -> list[bytes]:
    try:
        with open_input(record / NOTES_NAME) as file:
            return file.read(NOTES_BYTES_MAX).splitlines()
    except OSError:
        return []


# -- the ledger of this user ----------------------------------------------------------------------


def state_directory() -> Path:
    """Of this user: `$XDG_STATE_HOME/aftbed`, or `~/.local/state/aftbed`."""
    given = Path(os.environ.get("XDG_STATE_HOME") or "")
    return (given if given.is_absolute() else Path.home() / ".local" / "state") / "aftbed"


def known_hashes() -> tuple[frozenset[str], str]:
    """The hashes of what this user has run; and why they are not known, or "".

    A ledger that others could have written is not read.
    """
    try:
        with _state(make=False) as folder:
            return frozenset(_ledger(folder)), ""
    except FileNotFoundError:
        return frozenset(), ""  # nothing was run
    except (OSError, ValueError, RuntimeError) as error:
        return frozenset(), _words(error)


def remember(record: Path) -> str:
    """Add what the run of `record`, which this command made, has loaded. "" if that is done, or why not."""
    new = noted(record)
    if not new:
        return ""
    try:
        with _state(make=True) as folder:
            fcntl.flock(folder, fcntl.LOCK_EX)
            found = _ledger(folder)
            lines = [*(one for one in found if one not in new), *new][-HASHES_MAX:]
            _write_ledger("".join(f"{line}\n" for line in lines).encode())
    except (OSError, ValueError, RuntimeError) as error:
        return _words(error)
    return ""


def _words(error: Exception) -> str:
    """RuntimeError is that of a user without a home."""
    return f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)


@contextlib.contextmanager
def _state(*, make: bool) -> Iterator[int]:
    """A descriptor of the state directory. Raises OSError; ValueError if it is not of this user alone."""
    path = state_directory()
    if make:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        _check_ours(descriptor, path)
        yield descriptor
    finally:
        os.close(descriptor)


def _check_ours(descriptor: int, path: Path) -> None:
    state = os.fstat(descriptor)
    if state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise ValueError(f"{path} must belong to this user alone: no rights for group or others")


def _ledger(folder: int) -> list[str]:
    """The hashes, the latest last."""
    path = state_directory() / LEDGER_NAME
    try:
        descriptor = os.open(
            LEDGER_NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder
        )
    except FileNotFoundError:
        return []
    with open(descriptor, "rb") as file:
        _check_ours(descriptor, path)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError(f"{path} is no file")
        lines = file.read(LEDGER_BYTES_MAX).decode("ascii", "replace").split()
    return [line for line in lines if len(line) == HASH_DIGITS]


def _write_ledger(data: bytes) -> None:
    """Whole or not at all."""
    folder = state_directory()
    descriptor, name = tempfile.mkstemp(prefix=f".{LEDGER_NAME}.", dir=folder)  # mode 0600
    beside = Path(name)
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
        beside.replace(folder / LEDGER_NAME)
    finally:
        beside.unlink(missing_ok=True)
