"""What other commands ask of a live run, answered by the supervisor between other things.

Only a process of the same user gets a connection (SO_PEERCRED); what it sends is decoded whole or not
at all, and a bad packet ends its connection and nothing else.
"""

import json
import os
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.planner import plan
from aftbed.core.errors import AftbedError, ConfigError
from aftbed.runtime.adaptations import Adaptations, Outcome
from aftbed.runtime.deployment import Deployment
from aftbed.runtime.fault_controller import FaultController
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import RunOptions
from aftbed.runtime.unix.resources import ProcessRow
from aftbed.runtime.unix.transport import Line
from aftbed.runtime.unix.workload import Work

BESIDE: Final = (ProcessKind.ZYGOTE, ProcessKind.SPARE, ProcessKind.SERVICE, ProcessKind.STAGED)
QUESTIONS_MAX: Final = 16  # connections at once, and questions that wait for the launch


class ControlServer:
    """The control socket of the run."""

    def __init__(
        self,
        options: RunOptions,
        loop: EventLoop,
        deployment: Deployment,
        faults: FaultController,
        adaptations: Adaptations,
        work: Work,
        finish: Callable[[str], None],
    ) -> None:
        self._options, self._loop, self._deployment = options, loop, deployment
        self._faults, self._work, self._finish = faults, work, finish
        self._adaptations = adaptations
        self._started_ns = time.monotonic_ns()
        self._lines: dict[int, Line[control_client.Question]] = {}
        # Requests that came before the graph stood; None since then.
        self._early: list[tuple[Line[control_client.Question], control_client.Question]] | None = []

    def launched(self) -> None:
        """The graph is whole, and the function works: from here on it can be disturbed and changed."""
        early, self._early = self._early, None
        for line, question in early or ():
            if self._lines.get(line.fileno()) is line:  # who waits no longer was told that it failed
                self._reply(line, question)

    def listen(self) -> None:
        """Open the socket; from here on the run is found by other commands."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._listener.bind(str(Path(self._options.private) / run_directory.SOCKET_NAME))
        self._listener.listen(QUESTIONS_MAX)
        self._loop.read(self._listener.fileno(), self._accept)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        sock.setblocking(False)
        if not control_client.same_user(sock, os.getuid()) or len(self._lines) >= QUESTIONS_MAX:
            sock.close()
            return
        line = self._lines[sock.fileno()] = Line(sock, control_client.decode_question)
        self._loop.read(sock.fileno(), lambda: self._answer(line))

    def _answer(self, line: Line[control_client.Question]) -> None:
        try:
            got = line.recv()
        except BlockingIOError:
            return
        except (OSError, AftbedError):
            got = None
        if got is not None:
            for fd in got[1]:  # nobody asked for descriptors
                os.close(fd)
            self._reply(line, got[0])
            return
        self._loop.forget(line.fileno())
        self._lines.pop(line.fileno(), None)
        line.close()

    def _send_answer(self, line: Line[control_client.Question], answer: control_client.Answer) -> None:
        try:
            line.send(answer)
        except OSError:
            return

    def _reply(self, line: Line[control_client.Question], question: control_client.Question) -> None:
        answer = partial(self._send_answer, line)
        try:
            match question:
                case control_client.InjectCommand() | control_client.AdaptCommand() if (
                    self._early is not None
                ):
                    if len(self._early) >= QUESTIONS_MAX:
                        raise ConfigError("the run has not started yet: ask again when it has")
                    self._early.append((line, question))
                case control_client.StatusQuery():
                    answer(control_client.Answer(json.dumps(self.status()).encode()))
                case control_client.ProcessesQuery():
                    answer(control_client.Answer(msgspec.json.encode({"processes": self.processes()})))
                case control_client.GraphQuery():
                    answer(control_client.Answer(msgspec.json.encode(self._deployment.graph)))
                case control_client.InjectCommand(fault):
                    fault.check(self._deployment.graph)
                    self._loop.tasks.start(
                        "inject",
                        self._faults.arm(fault),
                        lambda failure: answer(
                            control_client.Answer(json.dumps({"armed": str(fault)}).encode(), error=failure)
                        ),
                    )
                case control_client.AdaptCommand(goal):
                    self._adaptations.ask(goal, lambda outcome: answer(_told(outcome)))
                case control_client.PlanQuery(goal):
                    there = self._adaptations.plan(goal)
                    back = plan(there.new, there.old, goal.recipe)
                    answer(control_client.Answer(msgspec.json.encode(control_client.PlanAnswer(there, back))))
                case control_client.AdaptationsQuery():
                    answer(control_client.Answer(self._adaptations.to_json()))
                case control_client.StopCommand():
                    self._finish("stopped")
                    answer(control_client.Answer(b'{"stopping": true}'))
        except ConfigError as error:
            answer(control_client.Answer(error=str(error)))

    def status(self) -> dict[str, object]:
        """How the run is, for `aftbed status`."""
        deployment = self._deployment
        return {
            "run": self._options.run,
            "ftm": deployment.graph.ftm,
            "adapting": self._adaptations.busy,
            "adaptations": len(self._adaptations.history),
            "placement": self._options.placement,
            "seconds": round((time.monotonic_ns() - self._started_ns) / 1e9, 2),
            "leader": deployment.leader,
            "backup": deployment.backup,
            "epoch": deployment.epoch,
            "busy": self._loop.tasks.names(),
            "record": self._options.record,
            "port": self._options.port,
            "vehicle": self._work.telemetry,
        }

    def processes(self) -> list[ProcessRow]:
        """Every process of the run; the nodes and the supervisor are the paper's count."""
        deployment = self._deployment
        rows = [ProcessRow("supervisor", "master", os.getpid(), True)]
        for node in deployment.graph.nodes:
            process = deployment.nodes.get(node)
            if process is not None and process.alive:
                rows.append(ProcessRow(node, deployment.role_of(node), process.pid, True))
        others = [p for p in deployment.pool.processes if p.kind in BESIDE and p.pid]
        return rows + [ProcessRow(p.name, p.kind.value, p.pid, False) for p in others]


def _told(outcome: Outcome) -> control_client.Answer:
    """What the one who asked for an adaptation hears: only what was refused is an error."""
    refused = outcome.outcome == "refused"
    return control_client.Answer(msgspec.json.encode(outcome), error=outcome.reason if refused else "")
