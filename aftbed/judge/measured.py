"""Measures what a function declares: whether it is deterministic, and what its states are good for.

Four processes execute the same requests (`exercise`), one after the other:

    execute   captures at the end only: the replies that all others are compared with, and the times
    watch     captures after each request, twice; then it goes on from some of its states, in an instance
              that is used already and in new ones
    resume    goes on from the same states, in other surroundings
    watch     the same as the first one, in other surroundings, and some time later

The surroundings are the order of hashes, addresses, time zone, language, working directory and an unknown
variable. What differs between the two that watch is not deterministic. What differs between the first two is
done by capturing. What differs behind a restore is the function's access to its state.

The function is never executed in the process of the command. What it does wrong in the first two, or in the
last one, leaves nothing to conclude (`UnmeasuredError`); in the third one it is a state that is not accepted.
"""

import math
import time
from collections.abc import Callable, Sequence
from random import Random
from typing import Final

import msgspec

from aftbed.core.application import EXACT, NONE, AccessKind, Characteristics, StateAccess
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.installed import search_path
from aftbed.functions.source import told_of
from aftbed.judge.exercise import (
    Answer,
    ExecuteAll,
    Executed,
    ExerciseJob,
    NoFunction,
    Resumed,
    ResumedElsewhere,
    ResumeStates,
    Surroundings,
    Task,
    Unanswered,
    Watched,
    WatchStates,
    behind,
    differs,
    of_reply,
)
from aftbed.runtime.unix.confined import JobFailedError, ProcessLimits, ask
from aftbed.runtime.unix.trust import OWN_RUN, vetted

MODULE: Final = "aftbed.judge.exercise"
START_SECONDS_MAX: Final = 20.0  # of a process and of what it loads
CALL_SECONDS_MAX: Final = 0.06  # a replica that answers later is taken for one that hangs
CALLS_MAX: Final = 20  # of each request, and of each state, in the process with the most
SLOWER_MAX: Final = 3.0  # another process than the first one
STATE_NS_PER_BYTE: Final = 1.0  # to copy it once, or to compare it
MEMORY_BYTES: Final = 4 << 30
FILE_BYTES: Final = 1 << 30
APART_SECONDS: Final = 1.1  # between the first request of the two that watch: not within the same second
POINTS: Final = 5  # at which states are restored, beside the initial one
STATES_BYTES_MAX: Final = 256 << 20  # of all points
HASH_SEED_MAX: Final = 2**32 - 1


class UnmeasuredError(HarnessError):
    """Nothing can be said of the function: exit code 3. The text says what it did."""


class StateChange(msgspec.Struct, frozen=True):
    """Of the requests; `most` is the greatest one."""

    p50: int
    most: int


class MeasuredFunction(msgspec.Struct, frozen=True):
    """What was found. `largest`: the greatest difference of a number in a reply behind a restore.

    `access`: None where a state is not that of the function: it is refused, or replies differ.
    `differences`: what was found against the declaration, or against any; `remarks`: what else to know.
    """

    declared: Characteristics
    deterministic: bool
    access: AccessKind | None
    largest: float | None
    serialisable: bool
    requests: int
    state_bytes: int
    changed_bytes: StateChange
    changed_pages: StateChange
    execute_us: tuple[float, float]  # p50, p99
    differences: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def access_name(self) -> str:
        return "false" if self.access is None else self.access.value

    @property
    def characteristics(self) -> Characteristics:
        """What it may declare, at most."""
        match self.access:
            case AccessKind.EXACT:
                access = EXACT
            case AccessKind.APPROXIMATE:
                access = StateAccess(AccessKind.APPROXIMATE, self.largest or 0.0)
            case _:
                access = NONE
        return Characteristics(self.deterministic, access)

    @property
    def wrong(self) -> tuple[str, ...]:
        """What it declares and is not. To be more than declared is no danger: see `understated`."""
        found = []
        if self.declared.deterministic and not self.deterministic:
            found.append("it declares to be deterministic, and is not")
        declared = self.declared.state_access
        if not self._good_for(declared):
            found.append(f"it declares {_access_words(declared)}, and has {self.access_words}")
        return tuple(found)

    @property
    def understated(self) -> tuple[str, ...]:
        found = []
        if self.deterministic and not self.declared.deterministic:
            found.append("it does not declare to be deterministic, and no difference was found")
        declared = self.declared.state_access
        better = self.access is AccessKind.EXACT and declared.kind is not AccessKind.EXACT
        if better or (self.access is AccessKind.APPROXIMATE and declared == NONE):
            found.append(f"it declares {_access_words(declared)}, and has {self.access_words}")
        return tuple(found)

    @property
    def access_words(self) -> str:
        match self.access:
            case None:
                return "false state access"
            case AccessKind.APPROXIMATE:
                largest = "?" if self.largest is None else f"{self.largest:.3g}"
                return f"approximate state access (difference {largest})"
            case AccessKind.EXACT:
                return _access_words(EXACT)
            case AccessKind.NONE:
                return _access_words(NONE)

    def _good_for(self, declared: StateAccess) -> bool:
        match declared.kind:
            case AccessKind.NONE:
                return True  # no mechanism makes use of it
            case AccessKind.EXACT:
                return self.access is AccessKind.EXACT
            case AccessKind.APPROXIMATE:
                within = self.largest is None or self.largest <= declared.tolerance
                return self.access is AccessKind.EXACT or (self.access is AccessKind.APPROXIMATE and within)


def _access_words(access: StateAccess) -> str:
    return "no state access" if access == NONE else f"{access} state access"


# -- the processes --------------------------------------------------------------------------------

Host = Callable[[Task, Surroundings, float], Answer]  # within so many seconds


class ProcessHost:
    """Has each task done by a process of its own. Raises ConfigError where the source cannot be read."""

    def __init__(self, source: str, seconds_max: float = math.inf) -> None:
        self._source, self._files, self._seconds_max = source, vetted(source, OWN_RUN), seconds_max

    def __call__(self, task: Task, surroundings: Surroundings, seconds: float) -> Answer:
        job = msgspec.msgpack.encode(
            ExerciseJob(task, self._source, self._files, tuple(search_path()), surroundings)
        )
        limits = ProcessLimits(min(seconds, self._seconds_max), MEMORY_BYTES, FILE_BYTES)
        try:
            found: Answer = msgspec.msgpack.decode(
                ask(MODULE, job, limits, surroundings.variables), type=Answer
            )
        except JobFailedError as error:
            return Unanswered(f"its process {error}", error.noted)
        except (msgspec.DecodeError, RecursionError) as error:
            return Unanswered(f"its process answered what is no answer: {error}")
        return found


def measure(
    source: str,
    requests: Sequence[bytes],
    seed: int = 0,
    host: Host | None = None,
    apart_seconds: float | None = None,
) -> MeasuredFunction:
    """Execute `requests`, at least one, by the function `source`. `seed` draws where states are restored.

    Raises ConfigError if it names no function, UnmeasuredError.
    """
    execute = host or ProcessHost(source)
    random, payloads = Random(seed), tuple(requests)
    usual, other = _surroundings(random)
    seconds = START_SECONDS_MAX + CALL_SECONDS_MAX * len(payloads)

    def done(task: Task, surroundings: Surroundings) -> Answer:
        found = execute(task, surroundings, seconds)
        if isinstance(found, NoFunction):
            raise ConfigError(told_of(source, found.reason))
        return found

    first = done(ExecuteAll(payloads), usual)
    if not isinstance(first, Executed):
        raise _unmeasured(source, first)
    if first.refused == len(payloads):
        raise UnmeasuredError(f"{source} cannot be measured: it refused each of {first.refused} requests")
    seconds = _seconds_max(first)
    begun_s = time.monotonic()
    watched = done(WatchStates(payloads, _points(random, len(payloads), len(first.state)), first), usual)
    if not isinstance(watched, Watched):
        raise _unmeasured(source, watched)
    elsewhere: Answer = ResumedElsewhere(())
    if watched.state_bytes:
        elsewhere = done(ResumeStates(payloads, watched.points, first), other)
    if not isinstance(elsewhere, ResumedElsewhere | Unanswered):
        raise _unmeasured(source, elsewhere)
    apart_s = APART_SECONDS if apart_seconds is None else apart_seconds
    time.sleep(max(0.0, apart_s - (time.monotonic() - begun_s)))
    again = done(WatchStates(payloads), other)
    if not isinstance(again, Watched):
        raise _unmeasured(source, again)
    return conclude(first, watched, elsewhere, again)


def _seconds_max(first: Executed) -> float:
    """Of any other process: `first` is what the first one did."""
    of_states_ns = first.capture_ns + STATE_NS_PER_BYTE * len(first.state)
    all_ns = sum(first.execute_ns) + len(first.replies) * of_states_ns
    return START_SECONDS_MAX + SLOWER_MAX * CALLS_MAX * all_ns / 1e9


def _unmeasured(source: str, found: Answer) -> UnmeasuredError:
    match found:
        case Unanswered():
            return UnmeasuredError(f"{source} cannot be measured: {_located(found)}")
        case _:
            return UnmeasuredError(f"{source} cannot be measured: its process answered something else")


def _surroundings(random: Random) -> tuple[Surroundings, Surroundings]:
    """The usual ones, and those that differ in all that they can."""
    one, other = random.sample(range(1, HASH_SEED_MAX), 2)
    return (
        Surroundings(
            {"PYTHONHASHSEED": str(one), "TZ": "UTC0", "LANG": "C.UTF-8", "LC_ALL": "C.UTF-8"}, "/", 0
        ),
        Surroundings(
            {
                "PYTHONHASHSEED": str(other),
                "TZ": "ELSEWHERE-5:45",
                "LANG": "tr_TR.UTF-8",
                "LC_ALL": "tr_TR.UTF-8",
                "AFTBED_ELSEWHERE": "1",
            },
            "/dev",
            random.randrange(10_000, 20_000),
        ),
    )


def _points(random: Random, requests: int, state_bytes: int) -> tuple[int, ...]:
    """How many requests come before each state that is restored; the initial one is the first."""
    count = min(POINTS, requests - 1, STATES_BYTES_MAX // max(1, state_bytes))
    return (0, *random.sample(range(1, requests), count))


# -- what follows from it -------------------------------------------------------------------------


class _Restores(msgspec.Struct, frozen=True):
    """What is known from restores; `there`: in another process, `crash`: what that did instead."""

    new: tuple[Resumed, ...]
    used: tuple[Resumed, ...]
    there: tuple[Resumed, ...]
    crash: str

    @property
    def all(self) -> tuple[Resumed, ...]:
        return (*self.new, *self.used, *self.there)

    @property
    def serialisable(self) -> bool:
        """Whether another process accepts each state, and does not worse with it than its own one."""
        accepted = bool(self.there) and not any(one.failed for one in self.there)
        return accepted and (_greatest(self.there) < math.inf or _greatest(self.new) == math.inf)

    def told(self) -> str:
        """What is wrong, by the simplest use in which it shows itself; "" if nothing is."""
        if problem := _worst(self.new):
            return f"in a new instance, {problem}"
        if problem := _worst(self.used):
            return f"restore keeps what was there: in an instance that is used, {problem}"
        if problem := self.crash or _worst(self.there):
            return f"the state is that of its process: in another one, {problem}"
        return ""


def conclude(
    first: Executed, watched: Watched, elsewhere: ResumedElsewhere | Unanswered, again: Watched
) -> MeasuredFunction:
    """Compare what the four processes answered, in the order of their start."""
    moved = _first_difference(again, watched, first)
    captured = "" if moved else _first_reply(watched.replies, first)
    restores = _restores(watched.resumed, elsewhere, comparable=not moved)
    told = [f"in another process, {moved}"] if moved else []
    if watched.unstable:
        told.append(f"capture changes the state: of two in a row, the second one of {watched.unstable}")
    if captured:
        told.append(f"capture changes the state: with captures after each request, {captured}")
    if problem := restores.told():
        told.append(problem)
    remarks = _remarks(first, compared=not moved or not watched.state_bytes)
    if watched.begun_anew and not moved:
        outside = f"there is a state outside of the instance: in a second one, {watched.begun_anew}"
        (told if problem else remarks).append(outside)

    largest: float | None = _greatest(restores.all)
    access: AccessKind | None = AccessKind.EXACT
    if not watched.state_bytes:
        access, largest = AccessKind.NONE, None
    elif watched.unstable or captured or restores.crash or largest == math.inf:
        access, largest = None, None
    elif problem:
        access, largest = AccessKind.APPROXIMATE, None if moved else largest
    p50_us, p99_us = (_ranked(first.execute_ns, part) / 1e3 for part in (0.5, 0.99))
    return MeasuredFunction(
        first.described.characteristics,
        deterministic=not moved,
        access=access,
        largest=largest,
        serialisable=restores.serialisable,
        requests=len(first.replies),
        state_bytes=watched.state_bytes,
        changed_bytes=StateChange(_ranked(watched.changed_bytes, 0.5), max(watched.changed_bytes)),
        changed_pages=StateChange(_ranked(watched.changed_pages, 0.5), max(watched.changed_pages)),
        execute_us=(p50_us, p99_us),
        differences=tuple(told),
        remarks=tuple(remarks),
    )


def _restores(
    here: tuple[Resumed, ...], elsewhere: ResumedElsewhere | Unanswered, *, comparable: bool
) -> _Restores:
    """Without the replies where those are not `comparable`, nor any states of two processes."""
    there = elsewhere.resumed if isinstance(elsewhere, ResumedElsewhere) else ()
    if not comparable:
        here = tuple(Resumed(one.at, one.used, one.failed, restored_state=one.restored_state) for one in here)
        there = tuple(Resumed(one.at, failed=one.failed) for one in there)
    new, used = tuple(one for one in here if not one.used), tuple(one for one in here if one.used)
    return _Restores(new, used, there, _located(elsewhere) if isinstance(elsewhere, Unanswered) else "")


def _remarks(first: Executed, *, compared: bool) -> list[str]:
    declared = first.described.characteristics.state_access
    found = []
    if not compared:
        found.append("behind a restore no replies were compared, as they are not deterministic")
    if declared.kind is AccessKind.APPROXIMATE and not first.described.reply_fields:
        found.append("it declares no reply_fields, so any difference of a reply is too large")
    if first.refused:
        found.append(f"it refused {first.refused} of {len(first.replies)} requests")
    return found


def _first_difference(found: Watched, expected: Watched, first: Executed) -> str:
    """Of two that watched: where the first reply or state differs; "" if none does."""
    for number, (state, wanted) in enumerate(zip(found.states, expected.states, strict=True)):
        if number and (
            text := differs(
                found.replies[number - 1], expected.replies[number - 1], first.described.reply_fields
            )
        ):
            return of_reply(number, text)
        whole = number < min(found.whole, expected.whole)
        if whole and (text := differs(state, wanted, first.described.fields)):
            return f"{behind(number)}: {text}"
        if state != wanted:
            return f"{behind(number)} differs"
    return ""


def _first_reply(replies: tuple[bytes, ...], first: Executed) -> str:
    """Where `replies` differ from those of the first process."""
    for number, (reply, wanted) in enumerate(zip(replies, first.replies, strict=True), 1):
        if text := differs(reply, wanted, first.described.reply_fields):
            return of_reply(number, text)
    return ""


def _greatest(found: Sequence[Resumed]) -> float:
    """The greatest difference of a number; infinite where a state is no good."""
    return max((math.inf if one.failed else one.size for one in found), default=0.0)


def _worst(found: Sequence[Resumed]) -> str:
    """What is wrong with the worst one; "" if nothing is with any."""
    worst = max(found, key=_badness, default=None)
    if worst is None or not any(_badness(worst)):
        return ""
    state = f"behind it, the state: {worst.restored_state}" if worst.restored_state else ""
    last = f"the last state: {worst.last_state}" if worst.last_state else ""
    return f"restored from {behind(worst.at)}: {worst.failed or worst.reply or state or last}"


def _badness(one: Resumed) -> tuple[bool, float, bool, bool]:
    return bool(one.failed), one.size, bool(one.reply), bool(one.restored_state or one.last_state)


def _located(failed: Unanswered) -> str:
    return f"{failed.call}: {failed.reason}" if failed.call else failed.reason


def _ranked(values: Sequence[int], part: float) -> int:
    """The least one that `part` of all do not exceed."""
    return sorted(values)[max(0, math.ceil(part * len(values)) - 1)]
