"""Whom a run's control socket answers: processes of its own user, and no other's."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, cast
from unittest import mock

import msgspec
import pytest

from aftbed.core.errors import HarnessError
from aftbed.runtime.sim.world import Setup, World
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.control_server import ControlServer
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.runtime.unix.workload import Workload

SECONDS_MAX: Final = 10.0


@contextmanager
def served(private: Path, uid: int) -> Iterator[None]:
    """A server in a process of its own, which takes itself for one of the user `uid`."""
    options = RunOptions("run", str(private), "", "pbr", "process", 0, LoadRun(1, 0.0))
    loop = EventLoop()
    no_work = cast("Workload", None)  # nothing here asks for it
    server = ControlServer(options, loop, World(Setup("pbr")).controller, no_work, lambda reason: None)
    ready, told = os.pipe()
    pid = os.fork()
    if not pid:
        with mock.patch.object(os, "getuid", return_value=uid):
            server.listen()
            os.write(told, b"1")
            loop.run()
    try:
        os.read(ready, 1)
        yield
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(ready)
        os.close(told)


@pytest.mark.parametrize("more", [0, 1])
def test_another_user_gets_no_answer(tmp_path: Path, more: int) -> None:
    with (
        served(tmp_path, os.getuid() + more),
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock,
    ):
        sock.settimeout(SECONDS_MAX)
        sock.connect(str(tmp_path / run_directory.SOCKET_NAME))
        try:
            sock.send(msgspec.msgpack.encode(control_client.GraphQuery()))
            answer = sock.recv(1 << 16)
        except (BrokenPipeError, ConnectionResetError):
            answer = b""
    assert bool(answer) is not bool(more)


def test_a_run_that_ends_with_a_request_unread_is_said_to_have_ended(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(tmp_path / run_directory.SOCKET_NAME))
        listener.listen()
        line = control_client.send(tmp_path, control_client.StatusQuery())
        listener.accept()[0].close()
        with pytest.raises(HarnessError, match="the run closed the connection: it has ended"):
            control_client.receive(line)
