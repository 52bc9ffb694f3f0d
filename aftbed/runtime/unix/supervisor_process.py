"""The process that is the supervisor of a run, from its fork until it knows what to run.

It is a fork of the command, and begins at one of three moments:

| command | this process begins | its zygotes |
|---|---|---|
| `aftbed run` | before anything is imported (`begin_early`) | forks of it, before there is a run |
| one of many runs (`warm_up`) | at the launch | forks of it, which have nothing to import |
| any other | at the launch | interpreters of their own |

On its line come `RUN`, with the options in a file and some descriptors, and `GO`, when the directories of
the run have been made.
"""

import contextlib
import errno
import gc
import os
import signal
import socket
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from aftbed.core.errors import AftbedError, HarnessError
from aftbed.runtime import control
from aftbed.runtime.interface import BUS, LIGHT
from aftbed.runtime.unix import interrupts, linux, run_directory
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.runtime.unix.process_pool import Started, start_zygote
from aftbed.runtime.unix.transport import Line, decode_order, decode_report, read_file

RUN: Final = (
    b"run"  # comes with a file of options, the supervisor's life, the warden's waker, the hub's socket, a log
)
RUN_FDS_MAX: Final = 5
GO: Final = b"go"
_decode: Final = msgspec.msgpack.Decoder(RunOptions).decode


_WARM: Final[set[str]] = set()  # the zygotes that this process can fork


def warm_up(name: str) -> None:
    """Import and rehearse what the zygote `name` hands on, for all runs of this process and of its forks.

    Their zygotes are forks from then on. That is for a process that starts many runs.
    """
    from aftbed.runtime.unix import rehearsal, supervisor, zygote  # noqa: PLC0415 - for many runs

    assert supervisor
    if name not in _WARM:
        zygote.preload(name)
        rehearsal.warm_up()
        _WARM.add(name)


def begin_early(owner: socket.socket, *, has_bus: bool, application: str) -> NoReturn:
    """Fork zygotes, then be the supervisor. Called in a process that has imported next to nothing.

    `has_bus`: whether the run has one, and `application`: its function, as far as can be told; if it has
    another one, that costs time.
    """
    gc.disable()  # what is imported stays
    linux.continue_at_parents_death()
    linux.set_name("aftbed-supervis")
    linux.allow_files()
    from aftbed.runtime.unix import rehearsal, zygote  # noqa: PLC0415 - a launch does not need them

    cpus = sorted(os.sched_getaffinity(0))
    zygotes: dict[str, Started] = {}
    with contextlib.suppress(OSError):  # no process can be forked: the launch will say so
        if has_bus:  # it has more to import
            zygotes[BUS] = zygote.fork(BUS, cpus)
        rehearsal.rehearse()
        zygotes[LIGHT] = zygote.fork(LIGHT, cpus, application)
    from aftbed.runtime.unix import supervisor  # noqa: PLC0415 - the zygotes have less to copy without it

    assert supervisor
    be_supervisor(owner, zygotes)


def be_supervisor(owner: socket.socket, zygotes: dict[str, Started]) -> NoReturn:
    """Be the supervisor of the run that the command sends on the line `owner`; end if it sends none.

    `zygotes` have been forked by this process before it knew of the run.
    """
    code, record = 1, Path()
    gc.freeze()  # to visit what this process shares with others would be to copy it
    gc.enable()
    try:
        handed_over, fds, _, _ = socket.recv_fds(owner, len(RUN), RUN_FDS_MAX, socket.MSG_CMSG_CLOEXEC)
        if handed_over != RUN:
            _end(zygotes)
            os._exit(code)
        interrupts.ignore()
        options, _life, waker = _decode(read_file(fds[0])), *fds[1:3]  # the life is kept open, no more
        listener, log, *_ = *fds[3:], -1, -1
        options = msgspec.structs.replace(options, listener=listener, log=log)
        if owner.recv(len(GO)) != GO:
            _end(zygotes)
            os._exit(code)
        private, record = Path(options.private), Path(options.record)
        run_directory.mark(private)
        os.environ[run_directory.VARIABLE] = str(private)  # of all that is executed from here on
        output = os.open(record / "processes.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(output, 1)
        os.dup2(output, 2)
        linux.set_name("aftbed-supervis")
        zygotes = _joined(zygotes, options, output)
        from aftbed.runtime.unix.supervisor import supervise  # noqa: PLC0415 - behind the first zygote

        supervise(options, owner, zygotes, UndoLedger(private, waker))
        code = 0
    except (AftbedError, OSError) as error:  # of the machine: a full disk, a limit
        if isinstance(error, OSError):
            error = HarnessError(f"the supervisor cannot go on: {error.strerror}{_hint(error, record)}")
        with contextlib.suppress(OSError):
            Line(owner, decode_order).send(control.Report("trouble", str(error).encode()))
    except BaseException:  # noqa: BLE001 - the last frame of this process
        import traceback  # noqa: PLC0415 - rarely needed

        traceback.print_exc()
    finally:
        os._exit(code)


def _joined(zygotes: dict[str, Started], options: RunOptions, output: int) -> dict[str, Started]:
    """The zygotes of the run, as far as they have been started; one that it does not need is ended."""
    load = isinstance(options.work, LoadRun)
    names = (LIGHT,) if load else (LIGHT, BUS)
    assert set(zygotes) <= set(names), "a zygote without a use"
    for _, sock in zygotes.values():
        with contextlib.suppress(ConnectionError):  # it is dead, which the supervisor will see
            Line(sock, decode_report).send(control.JoinRun(control.UNANSWERED, options.private), (output,))
    if zygotes:
        return zygotes
    cpus = sorted(os.sched_getaffinity(0))
    largest = LIGHT if load else BUS
    if largest in _WARM:
        from aftbed.runtime.unix import zygote  # noqa: PLC0415 - imported by `warm_up`

        return {name: zygote.fork(name, cpus, warm=True) for name in names}
    # It imports while this process does; the smaller one is started by the supervisor.
    return {largest: start_zygote(largest, cpus)}


def _end(zygotes: dict[str, Started]) -> None:
    for pid, sock in zygotes.values():
        sock.close()
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def _hint(error: OSError, record: Path) -> str:
    """What to look at, where that can be told from the error."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f": is the disk of {record} full?"
    return f": {error.filename}" if error.filename else ""
