"""The control socket of a live run: the supervisor answers other commands between other things.

Only a process of the same user gets a connection (SO_PEERCRED); what it sends is decoded whole or not
at all, and a bad packet ends its connection and nothing else.
"""

import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, assert_never

import msgspec

from aftbed.adapt.planner import plan
from aftbed.core.errors import AftbedError, ConfigError
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.run_controller import RunController
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.control_client import Answer, ControlRequest, ProcessRow
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import RunOptions
from aftbed.runtime.unix.transport import Line
from aftbed.runtime.unix.workload import Workload

NOT_IN_GRAPH: Final = (ProcessKind.ZYGOTE, ProcessKind.SPARE, ProcessKind.SERVICE, ProcessKind.STAGED)
REQUESTS_MAX: Final = 16  # connections at once, and requests that wait for the launch


class ControlServer:
    """Answers the requests that other commands send to one run; `finish` ends the run."""

    def __init__(
        self,
        options: RunOptions,
        loop: EventLoop,
        controller: RunController,
        work: Workload,
        finish: Callable[[str], None],
    ) -> None:
        self._options, self._loop, self._work, self._finish = options, loop, work, finish
        self._deployment = controller.deployment
        self._faults, self._adaptations = controller.faults, controller.adaptations
        self._state = controller.state
        self._started_ns = time.monotonic_ns()
        self._lines: dict[int, Line[ControlRequest]] = {}
        # Requests that came before the graph was complete; None since then.
        self._early: list[tuple[Line[ControlRequest], ControlRequest]] | None = []

    def listen(self) -> None:
        """Open the socket; from here on other commands find the run."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        before = os.umask(0o177)
        try:
            self._listener.bind(str(Path(self._options.private) / run_directory.SOCKET_NAME))
        finally:
            os.umask(before)
        self._listener.listen(REQUESTS_MAX)
        self._loop.read(self._listener.fileno(), self._accept)

    def launched(self) -> None:
        """The graph is complete and the function works: faults and adaptations are accepted from here on."""
        early, self._early = self._early, None
        for line, request in early or ():
            if self._lines.get(line.fileno()) is line:  # else the command has given up
                self._answer(line, request)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        sock.setblocking(False)
        if not control_client.same_user(sock, os.getuid()) or len(self._lines) >= REQUESTS_MAX:
            sock.close()
            return
        line = self._lines[sock.fileno()] = Line(sock, control_client.decode_request)
        self._loop.read(sock.fileno(), lambda: self._read(line))

    def _read(self, line: Line[ControlRequest]) -> None:
        try:
            got = line.recv()
        except BlockingIOError:
            return
        except (OSError, AftbedError):
            got = None
        if got is None:
            self._loop.forget(line.fileno())
            self._lines.pop(line.fileno(), None)
            line.close()
            return
        request, fds = got
        for fd in fds:  # no request has any
            os.close(fd)
        self._answer(line, request)

    def _answer(self, line: Line[ControlRequest], request: ControlRequest) -> None:
        def answer(data: bytes, error: str = "") -> None:
            try:
                line.send(Answer(data, error))
            except OSError:
                return

        try:
            self._carry_out(line, request, answer)
        except ConfigError as error:
            answer(b"{}", str(error))

    def _carry_out(
        self, line: Line[ControlRequest], request: ControlRequest, answer: Callable[..., None]
    ) -> None:
        """Carry out one request; `answer` may be called later. Raises ConfigError."""
        match request:
            case control_client.StatusQuery():
                answer(msgspec.json.encode(self._status()))
            case control_client.ProcessesQuery():
                answer(msgspec.json.encode({"processes": self._processes()}))
            case control_client.GraphQuery():
                answer(msgspec.json.encode(self._deployment.graph))
            case control_client.AdaptationsQuery():
                answer(self._adaptations.to_json())
            case control_client.PlanQuery(goal):
                there = self._adaptations.plan(goal)
                back = plan(there.new, there.old, goal.recipe)
                answer(msgspec.json.encode(control_client.PlanAnswer(there, back)))
            case control_client.StopCommand():
                self._finish("stopped")
                answer(b'{"stopping": true}')
            case _ if self._early is not None:
                if len(self._early) >= REQUESTS_MAX:
                    raise ConfigError("the run has not started yet: ask again when it has")
                self._early.append((line, request))
            case control_client.InjectCommand(fault):
                fault.check(self._deployment.graph)
                armed = json.dumps({"armed": str(fault)}).encode()
                self._loop.tasks.start(
                    "inject", self._faults.arm(fault, live=True), lambda failure: answer(armed, failure)
                )
            case control_client.AdaptCommand(goal):

                def adapted(outcome: Outcome) -> None:
                    refused = outcome.outcome == "refused"  # any other outcome is an answer
                    answer(msgspec.json.encode(outcome), outcome.reason if refused else "")

                self._adaptations.ask(goal, adapted)
            case _:
                assert_never(request)

    def _status(self) -> control_client.Status:
        options, work = self._options, self._work
        return control_client.Status(
            **msgspec.structs.asdict(self._state(work.cycle_us, work.requests)),
            run=options.run,
            adaptations=len(self._adaptations.history),
            placement=options.placement,
            seconds=round((time.monotonic_ns() - self._started_ns) / 1e9, 2),
            busy=self._loop.tasks.names(),
            record=options.record,
            slowest_us=work.slowest_us,
            port=options.port,
            bitrate_bps=getattr(options.work, "bitrate_bps", None),
            vehicle=work.telemetry,
            sees=work.sight,
        )

    def _processes(self) -> list[ProcessRow]:
        """Every process of the run; the nodes and the supervisor are the paper's count."""
        deployment = self._deployment
        rows = [ProcessRow("supervisor", "master", os.getpid(), True)]
        for node in deployment.graph.nodes:
            process = deployment.nodes.get(node)
            if process is not None and process.alive:
                rows.append(ProcessRow(node, deployment.role_of(node), process.pid, True))
        others = [p for p in deployment.pool.processes if p.kind in NOT_IN_GRAPH and p.pid]
        return rows + [ProcessRow(p.name, p.kind.value, p.pid, False) for p in others]
