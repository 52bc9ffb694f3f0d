"""Runs and explorations for other programs: `aftbed.run` and `aftbed.explore_crashes`.

A simulated run happens in the process of the caller. A real one is a process of its own, which executes the
very command that the report names. It is no fork of the caller: that may have threads, and its memory, its
descriptors and its handlers of signals would get into all processes of the run. It dies with the caller,
and whatever ends it, its run leaves nothing. So both may be called from any thread.
"""

import contextlib
import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Final, Literal

import msgspec

from aftbed.adapt import commands
from aftbed.adapt.commands import Wish
from aftbed.adapt.planner import APPLICATION
from aftbed.adapt.suitability import unsuitable
from aftbed.cli import EXIT_USAGE
from aftbed.cli.explore import REQUESTS as EXPLORED_REQUESTS
from aftbed.cli.explore import REQUESTS_MAX as EXPLORED_MAX
from aftbed.cli.explore import broken_one
from aftbed.cli.options import check_range, check_seed, class_source
from aftbed.cli.request_options import RequestSource
from aftbed.cli.sim import COUNT_MAX, check_setup, load_of, read_fault
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.messages import Scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build, protected_by
from aftbed.functions.load import OWN_CODE, Code, characteristics_of
from aftbed.functions.request_file import GivenRequests, check_payload, located_requests
from aftbed.functions.source import located
from aftbed.inject.model import FaultReport
from aftbed.judge.asked import AskedAdaptation
from aftbed.judge.checks import Failover, Requests
from aftbed.judge.intervals import HandlingIntervals
from aftbed.judge.simulated import evidence_of_run, verdict_of
from aftbed.judge.verdict import Verdict, Word
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.trust import state_directory
from aftbed.search.explore import Broken, Explored, attempt, crashes, selected
from aftbed.vehicle.aeb.function import default_application

COUNT: Final = 100  # requests of a run for which none are given
RUN_SECONDS_MAX: Final = 120.0  # of a real run, from its launch to its verdict, beside the requests
REQUESTS_PER_SECOND_MIN: Final = 50.0  # of a closed loop on a busy machine
END_SECONDS_MAX: Final = 12.0  # of a run that is ended
LINES_SHOWN: Final = 20  # of what a command printed that came to no verdict
CALLED: Final = "AFTBED_CALLED"  # in the environment of the processes of a run that a program began
KEPT_MAX: Final = 200  # lists of requests of callers, for the commands that repeat their runs

Texts = str | Sequence[str]
Bytes = Sequence[bytes] | str | os.PathLike[str]


class RunReport(msgspec.Struct, frozen=True):
    """What came of a run. `str(report)` is for people.

    `checks`: each promise, and what the judge found of it. `record`: the directory of a real run that was
    asked for one. `command` repeats the run in a shell; "" where the requests could not be kept for it.
    """

    verdict: Word
    reasons: tuple[str, ...]  # why it is no pass
    requests: Requests
    failovers: tuple[Failover, ...]
    intervals: tuple[HandlingIntervals, ...]  # how long each fault took to be handled
    adaptations: tuple[AskedAdaptation, ...]
    faults: tuple[FaultReport, ...]
    failures: tuple[str, ...]  # why nodes stopped whose function ended, or broke its contract
    checks: dict[str, str]
    record: Path | None
    command: str

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"verdict: {self.verdict}"
        yield from (f"  because    {reason}" for reason in self.reasons)
        requests = self.requests
        yield (
            f"  requests   {requests.sent} sent, {requests.answered} answered, {requests.lost} lost,"
            f" {requests.duplicated} duplicated, {requests.wrong} wrong"
        )
        yield from (f"  failed     {failure}" for failure in self.failures)
        yield from (f"  fault      {fault.fault}: {fault.receipt.value}" for fault in self.faults)
        yield from (f"  adaptation {one}" for one in self.adaptations)
        if self.record is not None:
            yield f"  record     {self.record}"
        yield f"  repeat     {self.command or '(no command: the requests could not be kept)'}"


def run(
    app: str | type | None = None,
    requests: Bytes | None = None,
    *,
    ftm: str = "pbr",
    placement: str = "process",
    count: int | None = None,
    rate: float = 0.0,
    seed: int = 0,
    inject: Texts = (),
    adapt: Texts = (),
    runtime: Literal["sim", "unix"] = "sim",
    expect: Bytes | None = None,
    force: bool = False,
    may_fail: bool = False,
    record: str | os.PathLike[str] | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> RunReport:
    """Run `app` under the mechanism `ftm`, and judge the run.

    `app`: what `--app` takes, a class at the top level of a module, or None for the built-in function, an
    emergency brake. `requests`: bytes, or what `--requests` takes; None for those of the built-in function.
    `count` of them are sent, or all, `rate` a second (0: each follows the reply before it). `expect`: the
    replies that they must get. `inject`, `adapt`: one text, or several, in the words of the command line.
    `force`: also where the mechanism does not suit the function. `may_fail`: the adaptations may.

    `runtime`: `sim`, virtual time in this process, or `unix`, real processes, of which `record` keeps the
    record in a new directory. `folder`: where relative paths begin, the working directory if left out.

    Raises ConfigError for what is not allowed, before anything runs; HarnessError where a real run came to no
    verdict. What a fault does is no error: it is in the report.
    """
    _checked(ftm=ftm, placement=placement, count=count, rate=rate, seed=seed, runtime=runtime)
    _refuse_nested()
    if runtime == "sim" and record is not None:
        raise ConfigError("record: a simulated run leaves none; runtime='unix' does")
    here = Path(folder).resolve() if folder is not None else Path.cwd()
    named = _named(app, here)
    wanted = _Wanted(
        app=named,
        sent=_sent(requests, expect, count, here),
        ftm=ftm,
        placement=placement,
        rate=rate,
        seed=seed,
        inject=_texts("inject", inject),
        adapt=tuple(_rooted(text, here) for text in _texts("adapt", adapt)),
        force=force,
        may_fail=may_fail,
        record=(here / record).resolve() if record is not None else None,
    )
    if runtime == "unix":
        return _real(wanted)
    with _simulating():
        return _simulated(wanted)


def explore_crashes(
    app: str | type | None = None,
    requests: Bytes | None = None,
    *,
    ftm: str = "pbr",
    placement: str = "process",
    count: int | None = None,
    only: int | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> Explored:
    """Simulate a death before each effect of each brick, and after its last, while `app` serves requests.

    The arguments are those of `run`. The first `count` requests are sent, 3 if left out: each adds about 30
    runs. `only`: one of these experiments, by its number.

    Raises ConfigError.
    """
    _checked(ftm=ftm, placement=placement, count=count, only=only)
    _refuse_nested()
    here = Path(folder).resolve() if folder is not None else Path.cwd()
    named = _named(app, here)
    count = EXPLORED_REQUESTS if count is None else count
    check_range("count", count, 1, EXPLORED_MAX)
    selection = msgspec.structs.replace(
        selected("crash", (ftm,), (placement,), count), application=named.text, given=None
    )
    kept = True
    if requests is not None:
        sent = _sent(requests, None, count, here)
        assert sent.source is not None
        first = sent.source.of(0).requests[:count]
        file = _kept((first * -(-count // len(first)))[:count])
        kept, selection = bool(file), msgspec.structs.replace(selection, given=GivenRequests(file, first))
    began_s, unavailable, broken = time.monotonic(), 0, list[Broken]()
    with _simulating():
        _refuse_unsuitable(named.code)(build(ftm, placement, application=named.text), Wish("to", ftm))
        setups = list(enumerate(crashes(selection.base, selection.ftms, selection.placements, named.code)))
        if only is not None:
            if not 0 <= only < len(setups):
                raise ConfigError(f"only={only}: there are the experiments 0 to {len(setups) - 1}")
            setups = [setups[only]]
        for number, setup in setups:
            run_, breaches = attempt(setup, named.code)
            unavailable += run_ is not None and run_.rest.lost and not breaches
            if breaches:
                one = broken_one(selection, number, setup, breaches)
                command = f"{_variables(named)}{one.command}" if kept else ""
                broken.append(msgspec.structs.replace(one, command=command))
    seconds = round(time.monotonic() - began_s, 3)
    return Explored(len(setups), len(setups) - len(broken), unavailable, seconds, tuple(broken))


# -- what the arguments mean ----------------------------------------------------------------------


class _Options(msgspec.Struct, frozen=True):
    """Those of a simple type, for their check."""

    ftm: str
    placement: str
    count: int | None = None
    rate: float = 0.0
    seed: int = 0
    runtime: Literal["sim", "unix"] = "sim"
    only: int | None = None


class _App(msgspec.Struct, frozen=True):
    """`text` names the function, "" the built-in one. `path`: the folder in which its module is found, if it
    has to be named for that, as PYTHONPATH does. `code`: how this process loads it.
    """

    text: str = ""
    path: str = ""
    code: Code = OWN_CODE


class _CallersCode(Code):
    """The module of the caller's class is there already; to load it once more might call `run` once more."""

    def __init__(self, place: str, module: ModuleType) -> None:
        self._place, self._module = place, module

    def module(self, place: str) -> ModuleType:
        return self._module if place == self._place else super().module(place)


class _Sent(msgspec.Struct, frozen=True):
    """The requests of a run. Without a `source`, those that are drawn for the built-in function."""

    count: int
    source: RequestSource | None = None
    requests: str = ""  # as `--requests` takes them
    expect: str = ""
    repeatable: bool = True  # the files of both will still be there


class _Wanted(msgspec.Struct, frozen=True):
    """The arguments of a run, with absolute paths."""

    app: _App
    sent: _Sent
    ftm: str
    placement: str
    rate: float = 0.0
    seed: int = 0
    inject: tuple[str, ...] = ()
    adapt: tuple[str, ...] = ()
    force: bool = False
    may_fail: bool = False
    record: Path | None = None


def _checked(**values: object) -> None:
    """Raise ConfigError for the first that has a wrong type."""
    try:
        msgspec.convert(values, _Options)
    except msgspec.ValidationError as error:
        reason = str(error).replace("$.", "")
        raise ConfigError(reason) from None


_simulates = threading.local()


@contextlib.contextmanager
def _simulating() -> Iterator[None]:
    _simulates.now = True
    try:
        yield
    finally:
        _simulates.now = False


def _refuse_nested() -> None:
    """Raise ConfigError where a module that is loaded for a run begins another one: there is no end to it."""
    if getattr(_simulates, "now", False) or os.environ.get(CALLED):
        raise ConfigError(
            "a run was called while the module of its function is loaded: do that below"
            ' `if __name__ == "__main__":`'
        )


def _texts(name: str, value: Texts) -> tuple[str, ...]:
    found = (value,) if isinstance(value, str) else value
    if not isinstance(found, Sequence) or not all(isinstance(text, str) for text in found):
        raise ConfigError(f"{name}: found {value!r}, a text or a list of texts is allowed")
    return tuple(found)


def _named(app: object, folder: Path) -> _App:
    """Raises ConfigError."""
    match app:
        case None:
            return _App()
        case str():
            return _App(located(app, folder))
        case type():
            return _named_class(app)
        case _:
            raise ConfigError(f"app: found {app!r}, a text, a class or None is allowed")


def _named_class(found: type) -> _App:
    """A class by its module, or by its file where no other process would find the module."""
    name, module = found.__name__, sys.modules.get(found.__module__)
    file = getattr(module, "__file__", None)
    at_top = found.__qualname__ == name and getattr(module, name, None) is found
    if not at_top or module is None or file is None:
        raise ConfigError(
            f"app: {found.__module__}.{found.__qualname__}: no other process would find it; a class at the"
            " top level of a module that has a file is allowed"
        )
    path = Path(file).resolve()
    place = path.parent if path.name == "__init__.py" else path.with_suffix("")
    parts = found.__module__.split(".")
    if place.parts[-len(parts) :] != tuple(parts):  # `__main__`, for one
        return _App(f"{path}:{name}", str(path.parent), _CallersCode(str(path), module))
    root = str(place.parents[len(parts) - 1])
    known = (*os.environ.get("PYTHONPATH", "").split(os.pathsep), *sysconfig.get_paths().values())
    return _App(f"{found.__module__}:{name}", "" if root in known else root)


def _sent(requests: object, expect: object, count: int | None, folder: Path) -> _Sent:
    """Raises ConfigError."""
    if requests is None:
        if expect is not None:
            raise ConfigError("expect: these are replies to requests: give them too")
        return _Sent(COUNT if count is None else count)
    with contextlib.ExitStack() as standing:
        named = _file_of("requests", requests, folder, standing)
        expected = _file_of("expect", expect, folder, standing) if expect is not None else None
        source = RequestSource(
            named.read,
            count=count,
            count_max=COUNT_MAX,
            expect=expected.read if expected is not None else None,
            tolerance=None,
        )
        repeatable = bool(named.kept and (expected is None or expected.kept))
        return _Sent(source.count, source, named.kept, expected.kept if expected else "", repeatable)


class _File(msgspec.Struct, frozen=True):
    """`kept`: its name in a command, "" if it will be gone."""

    read: str
    kept: str


def _file_of(name: str, given: object, folder: Path, standing: contextlib.ExitStack) -> _File:
    """A file, or a function; of a list of bytes, a file with them. Raises ConfigError."""
    if isinstance(given, str | os.PathLike):
        text = os.fspath(given)
        if isinstance(text, str):
            found = located_requests(text, folder)
            return _File(found, found)
    if not isinstance(given, Sequence) or not all(isinstance(one, bytes) for one in given):
        raise ConfigError(f"{name}: found {str(given)[:60]!r}, a path or a list of bytes is allowed")
    if not given:
        raise ConfigError(f"{name}: found none, at least one is required")
    for number, one in enumerate(given, 1):
        try:
            check_payload(one, "request" if name == "requests" else "reply")
        except ConfigError as error:
            raise ConfigError(f"{name}: number {number}: {error}") from None
    if path := _kept(given):
        return _File(path, path)
    file = standing.enter_context(tempfile.NamedTemporaryFile("w", suffix=".csv"))  # noqa: SIM115
    file.write(_as_csv(given))
    file.flush()
    return _File(file.name, "")


def _as_csv(payloads: Sequence[bytes]) -> str:
    return "\n".join(["hex", *(one.hex() or '""' for one in payloads)]) + "\n"


def _kept(payloads: Sequence[bytes]) -> str:
    """A file of this user with `payloads`, for the same ones the same; "" where none can be written.

    It is for a command that will repeat what they are sent for, so only the latest ones are kept.
    """
    content = _as_csv(payloads)
    folder = state_directory() / "requests"
    path = folder / f"{sha256(content.encode()).hexdigest()[:16]}.csv"
    try:
        state_directory().mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as file:  # whole, or not at all
            file.write(content)
        Path(file.name).replace(path)
        latest = sorted((one.stat().st_mtime_ns, one) for one in folder.iterdir())
        for _, old in latest[:-KEPT_MAX]:
            old.unlink(missing_ok=True)
    except FileNotFoundError:  # another process has removed an old one meanwhile
        return str(path) if path.exists() else ""
    except OSError:
        return ""
    return str(path)


def _rooted(text: str, folder: Path) -> str:
    """`text` of an adaptation, with the absolute path of what it names. Raises ConfigError."""
    wish = commands.read(text).wish
    if not wish.source:
        return text
    source = _source_of(wish, folder)
    return " ".join(text.split()).replace(f" to {wish.source}", f" to {source}", 1)


def _source_of(wish: Wish, folder: Path | None = None) -> str:
    """Raises ConfigError."""
    if wish.name == APPLICATION:
        return located(wish.source, folder)
    return class_source(wish.source, folder)


# -- in the simulator -----------------------------------------------------------------------------


def _simulated(wanted: _Wanted) -> RunReport:
    code = wanted.app.code
    simulated = simulate(_setup(wanted), code)
    return _reported(verdict_of(simulated, evidence_of_run(simulated, code)), wanted, "sim")


def _setup(wanted: _Wanted) -> Setup:
    """Raises ConfigError."""
    graph = build(wanted.ftm, wanted.placement, application=wanted.app.text)
    if not wanted.force:
        _refuse_unsuitable(wanted.app.code)(graph, Wish("to", wanted.ftm))
    check_seed(wanted.seed)
    source = wanted.sent.source
    setup = msgspec.structs.replace(
        load_of(wanted.sent.count, wanted.rate or None),
        ftm=wanted.ftm,
        placement=wanted.placement,
        seed=wanted.seed,
        faults=tuple(read_fault(text, graph) for text in wanted.inject),
        adaptations=_scheduled(wanted, graph),
        application=wanted.app.text,
        given=source.of(wanted.seed) if source is not None else None,
    )
    check_setup(setup)
    return setup


def _scheduled(wanted: _Wanted, graph: Graph) -> tuple[Scheduled, ...]:
    """Raises ConfigError."""
    judge = commands.whatever_suits if wanted.force else _refuse_unsuitable(wanted.app.code)
    return commands.scheduled(
        wanted.adapt, graph, RECIPES[0], resolve=_source_of, judge=judge, may_fail=wanted.may_fail
    )


def _refuse_unsuitable(code: Code) -> commands.Judge:
    """What raises ConfigError; the function is loaded here, as it will be to be simulated."""

    def judge(graph: Graph, wish: Wish) -> None:
        if wish.verb == "decompose" or (wish.verb == "update" and wish.name != APPLICATION):
            return
        text = protected_by(graph)
        declared = characteristics_of(text, code) if text else default_application().characteristics
        if reason := unsuitable(graph.ftm, declared):
            raise ConfigError(f"{reason}; force=True does it all the same")

    return judge


# -- on real processes ----------------------------------------------------------------------------


def _real(wanted: _Wanted) -> RunReport:
    """Raises ConfigError, HarnessError."""
    if wanted.sent.source is not None and not wanted.sent.repeatable:
        raise ConfigError(f"requests: {state_directory()} cannot be written; give a file")
    words = [*_words(wanted, "unix"), "--json"]
    environment = linux.package_environment() | {CALLED: "1"}
    if wanted.app.path:
        path = environment.get("PYTHONPATH")
        environment["PYTHONPATH"] = os.pathsep.join((wanted.app.path, path)) if path else wanted.app.path
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "aftbed.cli.child", str(os.getpid()), *words],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # an interrupt of the terminal is the caller's
    )
    seconds_max = RUN_SECONDS_MAX + wanted.sent.count / (wanted.rate or REQUESTS_PER_SECOND_MIN)
    try:
        out, err = process.communicate(timeout=seconds_max)
    except subprocess.TimeoutExpired:
        raise HarnessError(f"the run took more than {seconds_max:.0f} s") from None
    finally:
        _end(process)
    return _reported(_verdict(process.returncode, out, err), wanted, "unix")


def _end(process: subprocess.Popen[bytes]) -> None:
    """End it, if it has not ended: in order, or by force, which its run outlives by a second at most."""
    for end in (process.terminate, process.kill):
        if process.poll() is None:
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=END_SECONDS_MAX)


def _verdict(code: int, out: bytes, err: bytes) -> Verdict:
    """Of `aftbed run --json`. Raises ConfigError, HarnessError."""
    lines = err.decode(errors="replace").splitlines()
    if code == EXIT_USAGE:
        raise ConfigError("\n".join(lines).removeprefix("aftbed: error: "))
    try:
        found = msgspec.json.decode(out, type=Verdict)
    except msgspec.MsgspecError:
        said = "\n".join(lines[-LINES_SHOWN:])
        raise HarnessError(f"the run came to no verdict, its command ended with {code}: {said}") from None
    trouble = [line.removeprefix("aftbed: ") for line in lines if line.startswith("aftbed: trouble: ")]
    return msgspec.structs.replace(found, reasons=[*found.reasons, *trouble])


# -- reports, and commands ------------------------------------------------------------------------


def _reported(found: Verdict, wanted: _Wanted, runtime: str) -> RunReport:
    requests, verdict, reasons = found.requests, found.verdict, tuple(found.reasons)
    if verdict == "pass" and requests.answered < wanted.sent.count:
        # Of a run that was ended, and of a simulated one whose faults struck every replica, that is excused.
        verdict = "inconclusive"
        reasons = (f"complete: {requests.answered} of {wanted.sent.count} requests were answered",)
    return RunReport(
        verdict=verdict,
        reasons=reasons,
        requests=requests,
        failovers=tuple(found.failovers),
        intervals=tuple(found.intervals),
        adaptations=tuple(found.adaptations),
        faults=tuple(found.faults),
        failures=tuple(found.function_failures),
        checks=found.checks,
        record=wanted.record,
        command=_command(wanted, runtime) if wanted.sent.repeatable else "",
    )


def _command(wanted: _Wanted, runtime: str) -> str:
    """For a shell."""
    return f"{_variables(wanted.app)}aftbed {shlex.join(_words(wanted, runtime))}"


def _variables(app: _App) -> str:
    """What the shell has to set before the command."""
    path = app.path
    return f"PYTHONPATH={shlex.quote(path)}${{PYTHONPATH:+:$PYTHONPATH}} " if path else ""


def _words(wanted: _Wanted, runtime: str) -> list[str]:
    """The arguments of the command that does it."""
    sent, real = wanted.sent, runtime == "unix"
    words = ["run" if real else "sim", "--ftm", wanted.ftm]
    words += ["--placement", wanted.placement] if wanted.placement != PLACEMENTS[0] else []
    words += ["--seed", str(wanted.seed)] if wanted.seed else []
    words += ["--app", wanted.app.text] if wanted.app.text else []
    rate = repr(float(wanted.rate)).removesuffix(".0") if wanted.rate else ""
    if real and sent.source is None:
        words += ["--load", f"{sent.count}@{rate}" if rate else str(sent.count)]
    else:
        words += ["--requests", sent.requests] if sent.source is not None else []
        words += ["--count", str(sent.count), *(["--rate", rate] if rate else [])]
    words += ["--expect", sent.expect] if sent.expect else []
    for text in wanted.inject:
        words += ["--inject", text]
    for text in wanted.adapt:
        words += ["--adapt", text]
    words += ["--record", str(wanted.record)] if wanted.record is not None else []
    flags = (("--force", wanted.force), ("--may-fail", wanted.may_fail and bool(wanted.adapt)))
    return [*words, *(flag for flag, on in flags if on)]
