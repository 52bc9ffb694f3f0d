"""Whatever is written to a run's control socket, the run goes on: one run, many hostile packets."""

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from liveruns import Home, Started, under_load, until

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.ftm.compose import build
from aftbed.inject import targets
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client, run_directory

pytestmark = pytest.mark.process

EXAMPLES: Final = 6 * settings.default.max_examples
WORDS: Final = st.text(max_size=20)
GRAPH: Final = build("pbr", "process")
WHOM: Final = {*targets.ROLES, *GRAPH.nodes, *targets.OTHERS}
INTEGERS: Final = st.integers(-(2**63), 2**64 - 1)
HARMLESS_TARGETS: Final = WORDS.filter(lambda word: word not in WHOM)

questions = st.one_of(
    st.binary(max_size=200),
    st.dictionaries(WORDS, st.one_of(WORDS, INTEGERS, st.none()), max_size=5).map(msgspec.msgpack.encode),
    st.builds(
        lambda tag, rest: msgspec.msgpack.encode({"type": tag, **rest}),
        st.sampled_from(["Status", "Processes", "GraphNow", "Inject", "Answer", "Park", "Nothing"]),
        st.dictionaries(WORDS, st.one_of(WORDS, INTEGERS), max_size=3),
    ),
    st.builds(
        lambda target, event, nth, after_ms, for_ms: msgspec.msgpack.encode(
            control_client.InjectCommand(Fault(Hang(for_ms), target, Trigger(event, nth, after_ms)))
        ),
        HARMLESS_TARGETS,
        st.sampled_from(["", "request.sent", "checkpoint.applied", "nonsense"]),
        INTEGERS,
        INTEGERS,
        INTEGERS,
    ),
)


@pytest.fixture
def run(home: Home) -> Iterator[Started]:
    """A run that would go on for minutes."""
    with under_load(home, 100_000) as started:
        yield started


def connected(run: Started) -> socket.socket:
    """A connection; asked for again while too many others wait to be accepted."""

    def attempt() -> socket.socket | None:
        try:
            return run_directory.connect(run.private)
        except BlockingIOError:
            return None

    found = until(attempt, "a connection")
    assert found is not None
    return found


def tell(run: Started, *packets: bytes, fds: tuple[int, ...] = (), listen: bool = True) -> None:
    """Say `packets` on one connection; being hung up on is an answer too."""
    with connected(run) as sock:
        try:
            for packet in packets:
                socket.send_fds(sock, [packet], fds)
            if listen:
                sock.recv(PACKET_BYTES_MAX)
        except (BrokenPipeError, ConnectionResetError):
            return


def finish(run: Started) -> None:
    """Nothing has changed: one master, all its processes, and a good end."""
    status = run.status()
    assert (status["leader"], status["backup"], status["epoch"]) == ("a", "b", 1)
    run.launched.stop()
    outcome = run.finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.told("died") == []


def test_garbage_changes_nothing(run: Started) -> None:
    before = {row.name: row.pid for row in run.rows() if row.node}

    @settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.lists(questions, min_size=1, max_size=3))
    def check(packets: list[bytes]) -> None:
        tell(run, *[packet or b"\0" for packet in packets])

    check()
    assert {row.name: row.pid for row in run.rows() if row.node} == before
    finish(run)


def test_truncated_questions_change_nothing(run: Started) -> None:
    fault = Fault(Crash(), "primary", Trigger())
    for question in (
        control_client.InjectCommand(fault),
        control_client.StopCommand(),
        control_client.ProcessesQuery(),
    ):
        whole = msgspec.msgpack.encode(question)
        for length in range(1, len(whole)):
            tell(run, whole[:length])
    finish(run)


def test_oversized_packets_change_nothing(run: Started) -> None:
    whole = msgspec.msgpack.encode(control_client.StopCommand())
    for size in (PACKET_BYTES_MAX - 1, PACKET_BYTES_MAX, PACKET_BYTES_MAX + 1, 2 * PACKET_BYTES_MAX):
        tell(run, whole.ljust(size, b"\0"))
    finish(run)


def test_descriptors_that_come_along_are_closed(run: Started) -> None:
    supervisor = run.launched.supervisor
    before = run.descriptors(supervisor)
    with Path("/dev/null").open() as null:
        for _ in range(30):
            tell(run, b"\xc1", fds=(null.fileno(),))
            tell(run, msgspec.msgpack.encode(control_client.StatusQuery()), fds=(null.fileno(),) * 3)
    until(lambda: run.descriptors(supervisor) <= before, "the descriptors to be closed", 5.0)
    finish(run)


def test_connections_that_say_nothing_do_not_shut_others_out(run: Started) -> None:
    """More of them than are served at once: the rest is hung up on, and the run does not care."""
    silent = [connected(run) for _ in range(40)]
    answered = run.answered()
    until(lambda: run.answered() > answered + 20, "replies")
    for sock in silent:
        sock.close()
    until(lambda: _answers(run), "an answer after they have gone")
    finish(run)


def _answers(run: Started) -> bool:
    try:
        run.status()
    except (ConfigError, HarnessError):  # hung up on: ask again
        return False
    return True


def test_a_closed_end_before_the_answer_is_no_trouble(run: Started) -> None:
    for question in (
        control_client.StatusQuery(),
        control_client.ProcessesQuery(),
        control_client.GraphQuery(),
    ):
        for _ in range(20):
            tell(run, msgspec.msgpack.encode(question), listen=False)
    finish(run)


@pytest.mark.parametrize("number", [0, -1, 2**32, 2**63, 2**64 - 1])
def test_a_fault_with_absurd_numbers_does_not_end_the_run(run: Started, number: int) -> None:
    for trigger in (Trigger("request.sent", nth=number), Trigger(after_ms=number)):
        tell(
            run, msgspec.msgpack.encode(control_client.InjectCommand(Fault(Hang(number), "engine", trigger)))
        )
        run.status()
