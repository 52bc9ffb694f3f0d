"""Executes a function that a user or a record names: only if it is trusted, and in a process of its own.

Code that is not trusted is not executed at all (`runtime.unix.trust`). The process of code that is trusted
has limits (`runtime.unix.confined`); a class writes no byte into a file. When it crashes, hangs or answers
anything but MessagePack of the declared type, the replies of the function are unknown, with the reason.
"""

from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from aftbed.core.application import Application, Characteristics
from aftbed.core.errors import ConfigError
from aftbed.core.installed import search_path
from aftbed.functions.load import OWN_CODE, characteristics_of
from aftbed.functions.source import told_of
from aftbed.judge import execution
from aftbed.judge.bare_server import ReferenceRun
from aftbed.judge.execution import (
    WORDS_MAX,
    Answer,
    Declared,
    Describe,
    Execute,
    Failed,
    Job,
    Replies,
    Task,
    TryOut,
)
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import changes_of, reference_run, requests_of, succession
from aftbed.runtime.unix.confined import JobFailedError, ProcessLimits, ask
from aftbed.runtime.unix.trust import NOBODY, Trust, VettedFiles, vetted

OPAQUE_FILE_BYTES: Final = 1 << 30  # a model is unpacked; a program may keep a log
LIMITS: Final = ProcessLimits(seconds=120.0, memory_bytes=4 << 30, file_bytes=0)
TRIAL_LIMITS: Final = ProcessLimits(seconds=10.0, memory_bytes=4 << 30, file_bytes=0)


def reference_of(
    record: RunRecord,
    function: Callable[[], Application] | None = None,
    trust: Trust = NOBODY,
    limits: ProcessLimits = LIMITS,
) -> ReferenceRun:
    """Of `function` if it is given, else of the versions of the function that served the run.

    Those that the record names are executed in a process of their own: whatever they do ends that.
    """
    if function is not None:
        return reference_run(record.history, function())
    first = record.options.application
    changes = changes_of(record.history, record.adaptations, first)
    sources = tuple(dict.fromkeys(source for source in (first, *(one for _, one in changes)) if source))
    if not sources:
        return reference_run(record.history, succession(record, OWN_CODE))
    loaded_by = None if record.simulated else record.path
    try:
        codes = tuple(vetted(source, trust, loaded_by) for source in sources)
    except ConfigError as error:
        return ReferenceRun((), b"", unknown=str(error))
    match _answer(Execute(first, tuple(changes), tuple(requests_of(record.history))), codes, limits):
        case Replies(run):
            return run
        case Failed(reason):
            return _unknown(sources, reason)
        case Declared():
            return _unknown(sources, "it answered something else")


def _unknown(sources: tuple[str, ...], why: str) -> ReferenceRun:
    reason = f"{', '.join(sources)} cannot be executed again: {why}"
    return ReferenceRun((), b"", unknown=reason[: 2 * WORDS_MAX])


def declared_by(source: str, trust: Trust, limits: ProcessLimits = LIMITS) -> Characteristics:
    """What the function `source` declares. Raises ConfigError if that is unknown.

    One outside of this package is asked in a process of its own, too.
    """
    return _declared(source, Describe(source), trust, limits).characteristics


def tried_out(
    source: str, requests: Sequence[bytes], trust: Trust, limits: ProcessLimits = TRIAL_LIMITS
) -> Declared:
    """What the function `source` declares, and whether it is so for `requests`.

    Raises ConfigError where it is not known, or the function fails to execute them, to capture its state or
    to restore it; one that it refuses is none it fails to execute. One of this package is not tried out.
    """
    return _declared(source, TryOut(source, tuple(requests)), trust, limits)


def _declared(source: str, task: Describe | TryOut, trust: Trust, limits: ProcessLimits) -> Declared:
    code = vetted(source, trust)
    if not code.files:
        return Declared(characteristics_of(source, OWN_CODE))
    match _answer(task, (code,), limits):
        case Declared() as found:
            return found
        case Failed(reason):
            raise ConfigError(told_of(source, reason))
        case Replies():
            raise ConfigError(f"{source}: it answered something else")


def _answer(task: Task, codes: tuple[VettedFiles, ...], limits: ProcessLimits) -> Answer:
    """Of a new process, which has ended then."""
    job = msgspec.msgpack.encode(Job(task, codes, tuple(search_path())))
    if any(not file.module for code in codes for file in code.files):
        limits = msgspec.structs.replace(limits, file_bytes=OPAQUE_FILE_BYTES)
    try:
        found: Answer = msgspec.msgpack.decode(ask(execution.__name__, job, limits), type=Answer)
    except JobFailedError as error:
        return Failed(f"its process {error}{f': {error.noted}' if error.noted else ''}")
    except (msgspec.DecodeError, RecursionError) as error:
        return Failed(f"its process answered what is no answer: {error}")
    return found
