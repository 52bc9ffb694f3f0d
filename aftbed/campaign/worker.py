"""A worker: a process that is given one experiment after the other, and answers with what it found.

Started afresh (`python -m`) or forked; it ends with its end of the pipe. Little is imported here, above all
not `threading`, nor `multiprocessing`, which needs it: the nodes of a real run are forks of a fresh worker,
and each would pay 0.3 ms of CPU for it.
"""

import os
import pickle
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from typing import Any, Final, NoReturn

from aftbed.runtime.unix import linux

SIZE_BYTES: Final = 8
PIPE_FD: Final = 3  # of a fresh one

Judge = Callable[[Any], object]
Answer = tuple[Any, Exception | None]  # what was found, or what was raised


def send(pipe: socket.socket, thing: object) -> None:
    """Raises OSError: nobody reads it."""
    data = pickle.dumps(thing, pickle.HIGHEST_PROTOCOL)
    pipe.sendall(len(data).to_bytes(SIZE_BYTES, "little") + data)


def receive(pipe: socket.socket) -> Any:
    """Raises EOFError, OSError."""
    return pickle.loads(_read(pipe, int.from_bytes(_read(pipe, SIZE_BYTES), "little")))


def _read(pipe: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    left = memoryview(data)
    while left:
        count = pipe.recv_into(left)
        if not count:
            raise EOFError
        left = left[count:]
    return data


def work(command: int, pipe: socket.socket, judge: Judge | None = None) -> NoReturn:
    """Leave interrupts to the command, and die with it, whatever ends it (G7).

    A fork has its `judge`; a fresh one is told first where modules are found, then it.
    """
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        linux.die_with(command)
        _answer(pipe, judge or _told(pipe))
    except (EOFError, OSError):
        os._exit(0)  # the command ends
    except BaseException:  # noqa: BLE001 - the last frame of this process
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)


def _told(pipe: socket.socket) -> Judge:
    sys.path[:] = receive(pipe)
    judge: Judge = receive(pipe)
    return judge


def _answer(pipe: socket.socket, judge: Judge) -> NoReturn:
    while True:
        setup = receive(pipe)
        answer: Answer
        try:
            answer = judge(setup), None
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the command's
            error.add_note(traceback.format_exc())
            answer = None, error
        send(pipe, answer)


if __name__ == "__main__":
    os.set_inheritable(PIPE_FD, False)
    work(int(sys.argv[1]), socket.socket(fileno=PIPE_FD))
