"""A co-simulation model (FMU, by FMI 2 or 3) as a protected function.

A request is a step: its bytes are set as inputs, the model takes a step, its outputs are the reply. What the
bytes mean is in `ports.yaml` (`functions.ports`). The model's shared library is loaded into the process that
hosts the function, by FMPy, which is imported only here.

The state is what the FMU serialises, behind a header: the time, and the time field of the last request. An
FMU that says falsely that it serialises its whole state is a function that declares what it does not have.

An FMU is unpacked into a directory of its own: below the private directory of the run (`RUN_VARIABLE`), which
the run removes whatever happens, else below the directory of temporary files. It is removed with the last
object that uses it, or at the end of the process. What a process leaves that is killed, or that ends without
its cleanup as nodes do, is removed by the next one that unpacks an FMU beside it: a lock on each directory
tells whether its process lives.
"""

import contextlib
import fcntl
import io
import os
import shutil
import stat
import struct
import sys
import tempfile
import weakref
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from math import inf, isfinite
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol
from xml.etree import ElementTree

import msgspec

from aftbed.core.application import STATE_BYTES_MAX, AccessKind, Application, Characteristics, Field
from aftbed.core.archive import ArchiveLimits, opened_archive
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError, shown
from aftbed.core.yaml_file import read_yaml
from aftbed.functions.ports import Kind, Ports, PortsFile, Value, Variable, bind

INSTALL: Final = 'pip install "aftbed[fmi]"'
RUN_VARIABLE: Final = "AFTBED_RUN"  # as in runtime.unix.run_directory: the private directory of the run
DESCRIPTION: Final = "modelDescription.xml"
ARCHIVE_BYTES_MAX: Final = 256 << 20
UNPACKED_BYTES_MAX: Final = 1 << 30
DESCRIPTION_BYTES_MAX: Final = 64 << 20
MEMBERS_MAX: Final = 10_000
LOG_MESSAGES_MAX: Final = 10  # kept of those of a request
LOG_MESSAGE_CHARS_MAX: Final = 300
STATUS_OK: Final = 0
INSTANCE_NAME: Final = "aftbed"  # the same in all replicas: it may be part of a state
NOT_UNPACKED: Final = ("sources/", "documentation/")
SWEPT: Final = "unpacked-"  # begins the name of a directory whose lock tells whether its process lives
ELSEWHERE: Final = "set TMPDIR to a directory that this user can write to"

_STATE: Final = struct.Struct("<4sdB8s")  # mark, time in s, length and bytes of the last time field
_MARK: Final = b"FMU1"
_WHOLE: Final[Mapping[str, tuple[float, float]]] = {
    **{f"Int{bits}": (-(2.0 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"UInt{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "Integer": (-(2**31), 2**31 - 1),
}
_FLOAT32_MAX: Final = 3.4028234663852886e38


class FmuFailedError(FunctionFailedError):
    """The model failed: a fault of the replica that hosts it. The text says what happened, with its log."""


# -- the function ---------------------------------------------------------------------------------


def fmu_function(model: Path, ports: Path) -> Callable[[], Application]:
    """The maker of the function that `model` is, with the ports of the file `ports`.

    It has the function's `characteristics` and `reply_fields` as well. Raises ConfigError, when called too.
    """
    description = _described(model)
    bound = bind(ports, read_yaml(ports, PortsFile), model, description.variables, description.has_state)
    return FmuFunction(model, ports, description, bound)


class FmuFunction:
    """Makes instances of the model. Those of a process share one copy of it, unless it allows one each."""

    def __init__(self, model: Path, ports_path: Path, description: "Description", ports: Ports) -> None:
        self.characteristics: Characteristics = ports.characteristics
        self.reply_fields: tuple[Field, ...] = ports.reply_fields
        self._model, self._ports_path, self._description, self._ports = model, ports_path, description, ports
        self._shared: _Unpacked | None = None

    def __call__(self) -> "FmuApplication":
        files = self._shared
        if files is None or files.pid != os.getpid() or self._description.once_per_process:
            files = self._shared = _Unpacked(self._model, self._description)
        try:
            application = FmuApplication(self._model, self._description, self._ports, files)
        except FmuFailedError as error:
            raise ConfigError(str(error)) from error
        if self.characteristics.state_access.kind is not AccessKind.NONE:
            try:
                application.capture()
            except FmuFailedError as error:
                found = self.characteristics.state_access.kind.value
                key = f"{self._ports_path}: characteristics.state_access"
                raise ConfigError(f"{key}: found {found}, allowed is none: {error}") from error
        return application


class FmuApplication:
    """An instance of the model, behind the contract of `Application`."""

    def __init__(self, model: Path, description: "Description", ports: Ports, files: "_Unpacked") -> None:
        self.characteristics = ports.characteristics
        self.reply_fields = ports.reply_fields
        self._has_state = ports.characteristics.state_access.kind is not AccessKind.NONE
        self._name, self._ports = str(model), ports
        self._time_s, self._time_before = 0.0, b""
        self._files = files  # removed with the last function that uses them
        self._inputs = _by_type(ports.inputs)
        self._outputs = _by_type(ports.outputs)
        _LOG.clear()
        self._free: weakref.finalize[[], FmuApplication] | None = None
        with self._failing("it cannot be loaded"), contextlib.chdir(Path.cwd()):  # FMPy may not come back
            self._model = _load(description, files.path)
        self._free = weakref.finalize(self, self._model.free)
        self._free.atexit = False
        with self._failing("it cannot be initialised"):
            for variable, value in ports.start:
                self._model.put(variable.type, [variable.reference], [value])
            self._model.initialise()

    def execute(self, request: bytes) -> bytes:
        inputs = self._ports.read_request(request, self._time_before)
        _LOG.clear()
        with self._failing(f"at {self._time_s:g} s, in a step of {inputs.step_s:g} s"):
            for kind, references, places in self._inputs:
                self._model.put(kind, references, [inputs.values[place] for place in places])
            self._model.step(self._time_s, inputs.step_s)
            outputs: list[Value] = [0] * len(self._ports.outputs)
            for kind, references, places in self._outputs:
                for place, value in zip(places, self._model.fetch(kind, references), strict=True):
                    outputs[place] = value
            reply = self._ports.write_reply(outputs)
        self._time_s += inputs.step_s
        self._time_before = inputs.time
        return reply

    def capture(self) -> bytes:
        if not self._has_state:
            return b""
        _LOG.clear()
        with self._failing("its state cannot be captured"):
            state = self._model.save()
            if len(state) > STATE_BYTES_MAX - _STATE.size:
                raise ValueError(f"{len(state)} bytes, allowed are {STATE_BYTES_MAX - _STATE.size}")
        before = self._time_before
        return _STATE.pack(_MARK, self._time_s, len(before), before) + state

    def restore(self, state: bytes) -> None:
        if not self._has_state:
            if state:
                raise PeerError(f"a state of {len(state)} bytes, for a model without access to its state")
            return
        if len(state) < _STATE.size:
            raise PeerError(f"a state of {len(state)} bytes, at least {_STATE.size} are required")
        mark, time_s, length, before = _STATE.unpack_from(state)
        before, rest = before[:length], before[length:]
        if (
            mark != _MARK
            or any(rest)
            or not (isfinite(time_s) and time_s >= 0)
            or not self._ports.is_time(before)
        ):
            raise PeerError("not a state of this model")
        _LOG.clear()
        with self._failing("its state cannot be restored"):
            try:
                prepared = self._model.prepare(state[_STATE.size :])
            except import_fmpy().fmi1.FMICallException as error:
                raise PeerError(f"the model refuses the state: {error}{_LOG.text()}") from error
            self._model.load(prepared)
        self._time_s, self._time_before = time_s, before

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._ports.acceptable(reply)

    @contextlib.contextmanager
    def _failing(self, when: str) -> Iterator[None]:
        """What goes wrong in the model ends its use, as FmuFailedError. The instance is not freed then."""
        try:
            yield
        except PeerError:
            raise
        except Exception as error:
            if self._free is not None:
                self._free.detach()
            raise FmuFailedError(f"{self._name}: {when}: {str(error).rstrip('.')}{_LOG.text()}") from error


def _by_type(variables: Sequence[Variable]) -> list[tuple[str, list[int], list[int]]]:
    """Type, references and places of the variables: those of a type are set or read by one call."""
    found: dict[str, tuple[str, list[int], list[int]]] = {}
    for place, variable in enumerate(variables):
        _, references, places = found.setdefault(variable.type, (variable.type, [], []))
        references.append(variable.reference)
        places.append(place)
    return list(found.values())


# -- FMPy -----------------------------------------------------------------------------------------


@cache
def import_fmpy() -> Any:
    """The package. Raises ConfigError.

    It prints what it misses, and numpy, which it brings, starts a thread for each core.
    """
    alone = "OPENBLAS_NUM_THREADS"
    given = os.environ.get(alone)
    os.environ[alone] = given or "1"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import fmpy.fmi2  # noqa: PLC0415 - an extra, and 0.3 s
            import fmpy.fmi3  # noqa: PLC0415
            import fmpy.model_description  # noqa: PLC0415, F401
    except ImportError as error:
        raise ConfigError(f"an FMU needs FMPy ({error}): {INSTALL}") from None
    finally:
        if given is None:
            del os.environ[alone]
    return sys.modules["fmpy"]


class _Log:
    """The messages of FMUs in this process; `clear` is called before each use of an instance."""

    def __init__(self) -> None:
        self._messages: deque[str] = deque(maxlen=LOG_MESSAGES_MAX)
        self.clear = self._messages.clear

    def add(self, status: int, message: bytes | None) -> None:
        """What is no trouble is left out: some models tell each call."""
        if status != STATUS_OK:
            text = shown((message or b"").decode(errors="replace"))
            self._messages.append(" ".join(text.split())[:LOG_MESSAGE_CHARS_MAX])

    def text(self) -> str:
        """As the end of a sentence."""
        return f"; its log: {' | '.join(self._messages)}" if self._messages else ""


_LOG: Final = _Log()


@cache
def _callbacks() -> Any:
    """Of FMI 2. They live as long as the process: FMPy's proxy, which formats messages, points to them."""
    import ctypes  # noqa: PLC0415 - with FMPy

    fmi2 = import_fmpy().fmi2
    found = fmi2.fmi2CallbackFunctions()
    found.logger = fmi2.fmi2CallbackLoggerTYPE(
        lambda _env, _name, status, _category, text: _LOG.add(status, text)
    )
    memory = ctypes.CDLL(None)
    found.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(("calloc", memory))
    found.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(("free", memory))
    with contextlib.suppress(Exception):  # not for each platform: the messages are not formatted then
        from fmpy.logging import addLoggerProxy  # noqa: PLC0415

        addLoggerProxy(ctypes.byref(found))
    return found


class _Model(Protocol):
    """An instance of a model, by any version of FMI. Raises FMICallException."""

    def initialise(self) -> None: ...
    def put(self, kind: str, references: list[int], values: Sequence[Value | str]) -> None: ...
    def fetch(self, kind: str, references: list[int]) -> list[Value]: ...
    def step(self, time_s: float, step_s: float) -> None: ...
    def save(self) -> bytes: ...
    def prepare(self, state: bytes) -> Any:
        """Read the state without changing the instance; for `load`."""

    def load(self, prepared: Any) -> None: ...
    def free(self) -> None: ...


class _Access:
    """What both versions have in common. The library is never unloaded: many do not survive that."""

    def __init__(self, instance: Any) -> None:
        self._instance = instance

    def put(self, kind: str, references: list[int], values: Sequence[Value | str]) -> None:
        getattr(self._instance, f"set{kind}")(references, values)

    def fetch(self, kind: str, references: list[int]) -> list[Value]:
        found: list[Value] = getattr(self._instance, f"get{kind}")(references)
        return found


class _Fmi2(_Access):
    def __init__(self, names: dict[str, str]) -> None:
        super().__init__(import_fmpy().fmi2.FMU2Slave(**names))
        self._instance.instantiate(callbacks=_callbacks(), loggingOn=True)

    def initialise(self) -> None:
        self._instance.setupExperiment(startTime=0.0)
        self._instance.enterInitializationMode()
        self._instance.exitInitializationMode()

    def step(self, time_s: float, step_s: float) -> None:
        self._instance.doStep(time_s, step_s, False)  # an earlier state may be restored

    def save(self) -> bytes:
        state = self._instance.getFMUstate()
        try:
            found: bytes = self._instance.serializeFMUstate(state)
        finally:
            self._instance.freeFMUstate(state)
        return found

    def prepare(self, state: bytes) -> Any:
        return self._instance.deSerializeFMUstate(state)

    def load(self, prepared: Any) -> None:
        self._instance.setFMUstate(prepared)
        self._instance.freeFMUstate(prepared)

    def free(self) -> None:
        self._instance.fmi2FreeInstance(self._instance.component)


class _Fmi3(_Access):
    def __init__(self, names: dict[str, str]) -> None:
        super().__init__(import_fmpy().fmi3.FMU3Slave(**names))
        self._instance.instantiate(
            loggingOn=True, logMessage=lambda _environment, status, _category, text: _LOG.add(status, text)
        )

    def initialise(self) -> None:
        self._instance.enterInitializationMode(startTime=0.0)
        self._instance.exitInitializationMode()

    def step(self, time_s: float, step_s: float) -> None:
        _, ended, early, until_s = self._instance.doStep(
            time_s, step_s, False
        )  # an earlier state may be restored
        if ended or early:
            raise ValueError(
                f"the model {'ended the simulation' if ended else 'returned early'} at {until_s:g} s"
            )

    def save(self) -> bytes:
        state = self._instance.getFMUState()
        try:
            found: bytes = self._instance.serializeFMUState(state)
        finally:
            self._instance.freeFMUState(state)
        return found

    def prepare(self, state: bytes) -> Any:
        return self._instance.deserializeFMUState(state)

    def load(self, prepared: Any) -> None:
        self._instance.setFMUState(prepared)
        self._instance.freeFMUState(prepared)

    def free(self) -> None:
        self._instance.fmi3FreeInstance(self._instance.component)


def _load(description: "Description", folder: Path) -> _Model:
    names = {
        "guid": description.guid,
        "modelIdentifier": description.identifier,
        "unzipDirectory": str(folder),
        "instanceName": INSTANCE_NAME,
    }
    kind: type[_Fmi2 | _Fmi3] = _Fmi2 if description.version == 2 else _Fmi3
    return kind(names)


# -- the archive ----------------------------------------------------------------------------------


class Description(msgspec.Struct, frozen=True):
    """What is needed of a model description. `version`: of FMI. `has_state`: whether it says so."""

    version: int
    guid: str
    identifier: str
    binary: str
    has_state: bool
    once_per_process: bool
    variables: tuple[Variable, ...]


def _opened(model: Path) -> contextlib.AbstractContextManager[tuple[BinaryIO, zipfile.ZipFile]]:
    """The archive, its members checked. Raises ConfigError, also for what goes wrong with it in the block."""
    limits = ArchiveLimits(ARCHIVE_BYTES_MAX, UNPACKED_BYTES_MAX, MEMBERS_MAX)
    return opened_archive(model, "an FMU", limits)


def _described(model: Path) -> Description:
    """Raises ConfigError: no FMU for co-simulation by FMI 2 or 3, or without a binary for this platform."""
    with _opened(model) as (file, archive):
        names = set(archive.namelist())
        if DESCRIPTION not in names:
            raise ConfigError(f"{model}: no FMU: {DESCRIPTION} is missing")
        for name in (DESCRIPTION, "sources/buildDescription.xml"):
            if name in names and (size := archive.getinfo(name).file_size) > DESCRIPTION_BYTES_MAX:
                raise ConfigError(f"{model}: {name}: found {size} bytes, allowed are {DESCRIPTION_BYTES_MAX}")
        version = _version(model, archive)
        fmpy = import_fmpy()
        try:
            found = fmpy.read_model_description(file)
        except Exception as error:  # whatever FMPy thinks of it
            reason = " ".join(str(error).split())
            raise ConfigError(f"{model}: {DESCRIPTION}: cannot be read: {reason}") from error
    if found.coSimulation is None:
        raise ConfigError(f"{model}: found an FMU for model exchange only, allowed is one for co-simulation")
    identifier = found.coSimulation.modelIdentifier
    binary = f"binaries/{fmpy.platform if version == 2 else fmpy.platform_tuple}/{identifier}.so"
    if binary not in names:
        others = sorted(
            {name.split("/")[1] for name in names if name.startswith("binaries/") and name[-1] != "/"}
        )
        raise ConfigError(
            f"{model}: {binary} is missing (it has binaries for: {', '.join(others) or 'none'})"
        )
    return Description(
        version,
        found.guid,
        identifier,
        binary,
        found.coSimulation.canGetAndSetFMUstate and found.coSimulation.canSerializeFMUstate,
        found.coSimulation.canBeInstantiatedOnlyOncePerProcess,
        tuple(_variable(one, version) for one in found.modelVariables),
    )


def _version(model: Path, archive: zipfile.ZipFile) -> int:
    """The major version of FMI."""
    try:
        with archive.open(DESCRIPTION) as file:
            root = next(iter(ElementTree.iterparse(file, events=("start",))))[1]
    except (ElementTree.ParseError, StopIteration) as error:
        raise ConfigError(f"{model}: {DESCRIPTION}: not XML: {error}") from error
    found = root.get("fmiVersion", "none")
    if not found.startswith(("2.", "3.")):
        raise ConfigError(
            f"{model}: {DESCRIPTION}: fmiVersion: found {shown(found)}, allowed are 2.0 and 3.0"
        )
    return int(found[0])


def _variable(found: Any, version: int) -> Variable:
    kind: Kind = "array" if found.dimensions else "other"
    low, high = -inf, inf
    of_type = found.type
    match of_type:
        case "Enumeration":  # an integer, by another name
            of_type = "Integer" if version == 2 else "Int64"
        case "Float32":
            low, high = -_FLOAT32_MAX, _FLOAT32_MAX
    if of_type in _WHOLE:
        low, high = _WHOLE[of_type]
    if not found.dimensions:
        kinds: dict[str, Kind] = {"Real": "real", "Float32": "real", "Float64": "real", "Boolean": "boolean"}
        kinds |= {"String": "text", **dict.fromkeys(_WHOLE, "integer")}
        kind = kinds.get(of_type, "other")
    parameter = found.causality == "parameter"
    tunable = parameter and found.variability == "tunable"
    has_start = found.initial in ("exact", "approx") and found.variability != "constant"
    return Variable(
        found.name,
        found.valueReference,
        of_type,
        kind,
        " ".join(filter(None, (found.variability, found.causality))) or "local",
        low,
        high,
        settable=found.causality == "input" or tunable,
        startable=found.causality in ("parameter", "input") or has_start,
        output=found.causality == "output",
    )


# -- where it is unpacked -------------------------------------------------------------------------


class _Unpacked:
    """A copy of the FMU on disk, for this process; removed with this object. Raises ConfigError."""

    def __init__(self, model: Path, description: Description) -> None:
        self.pid = os.getpid()
        above = _above()
        try:
            _sweep(above)
            self.path, descriptor = _locked_directory(above)
        except OSError as error:
            raise ConfigError(f"{above}: cannot be used: {error.strerror}; {ELSEWHERE}") from None
        remove = weakref.finalize(self, _remove, self.path, descriptor, self.pid)
        try:
            with _opened(model) as (_, archive):
                _unpack(model, archive, self.path, description.binary.rpartition("/")[0])
        except BaseException:
            remove()
            raise


def outside_of_runs() -> Path:
    """The directory above those of FMUs that no run has unpacked: a judge, a simulation, a test."""
    return Path(os.environ.get("TMPDIR") or "/tmp") / f"aftbed-fmu-{os.getuid()}"


def left_behind() -> list[Path]:
    """What killed processes have left there."""
    above = outside_of_runs()
    with contextlib.suppress(OSError):
        if above.lstat().st_uid == os.getuid() and not above.is_symlink():
            return sorted(path for path in above.glob(f"{SWEPT}*") if _is_dead(path, lambda: None))
    return []


def remove_dead(path: Path) -> bool:
    """Remove one of these, unless a process uses it. Whether it is gone."""
    _is_dead(path, lambda: shutil.rmtree(path, ignore_errors=True))
    return not path.exists()


def _above() -> Path:
    """The directory above those of FMUs, of this user alone. Raises ConfigError."""
    run = Path(os.environ.get(RUN_VARIABLE) or "")
    path = outside_of_runs()
    if run.is_absolute() and run.is_dir():
        path = run / "fmu"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        state = path.lstat()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}; {ELSEWHERE}") from None
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise ConfigError(f"{path}: must be a directory of this user alone (mode 0700); remove it")
    return path


def _locked_directory(above: Path) -> tuple[Path, int]:
    """A new directory, and the descriptor that holds its lock. Raises OSError.

    It gets the name by which it can be swept only with the lock.
    """
    made = Path(tempfile.mkdtemp(prefix=".", dir=above))
    descriptor = os.open(made, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return made.rename(above / f"{SWEPT}{made.name[1:]}"), descriptor
    except OSError:
        os.close(descriptor)
        made.rmdir()
        raise


def _sweep(above: Path) -> None:
    """Remove what processes have left that were killed. Raises OSError."""
    for path in above.glob(f"{SWEPT}*"):
        remove_dead(path)


def _is_dead(path: Path, act: Callable[[], None]) -> bool:
    """Whether no process uses it; then `act`, while none can."""
    with contextlib.suppress(OSError):  # its process lives, or another one removes it
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            act()
        finally:
            os.close(descriptor)
        return True
    return False


def _remove(path: Path, descriptor: int, pid: int) -> None:
    if os.getpid() == pid:  # not a child's, which has the object as well
        shutil.rmtree(path, ignore_errors=True)
    os.close(descriptor)


def _unpack(model: Path, archive: zipfile.ZipFile, folder: Path, platform: str) -> None:
    """All but sources, documentation, and binaries for other platforms."""
    try:
        for one in archive.infolist():
            name = one.filename
            foreign = name.startswith("binaries/") and not name.startswith(f"{platform}/")
            if foreign or name.startswith(NOT_UNPACKED):
                continue
            target = folder / name
            (target if one.is_dir() else target.parent).mkdir(mode=0o700, parents=True, exist_ok=True)
            if not one.is_dir():
                with archive.open(one) as source, open(target, "xb", opener=_private) as sink:
                    shutil.copyfileobj(source, sink)
    except OSError as error:
        raise ConfigError(
            f"{model}: cannot be unpacked into {folder}: {error.strerror}; {ELSEWHERE}"
        ) from error


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o700)
