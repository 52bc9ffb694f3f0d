"""Programs on stdio: any language, and what is said of a program that breaks the protocol."""

import gc
import json
import os
import re
import select
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest
from examples import HERE, PYTHON, example, program
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.application import EXACT, NONE, REPLY_BYTES_MAX, Characteristics, approximate
from aftbed.core.errors import ConfigError, PeerError
from aftbed.functions import program as programs
from aftbed.functions.program import Program, ProgramFailedError, program_function, read_answer

DESCRIBED: Final = '{"id":@,"describe":{}}'
ECHO: Final = '{"id":@,"execute":"0a"}'
WAIT_SECONDS_MAX: Final = 20.0


def started(command: str) -> Program:
    found = program_function(command)()
    assert isinstance(found, Program)
    return found


def faulty(does: str, describes: str = DESCRIBED) -> Program:
    return started(program("faulty.py", describes, does))


@pytest.fixture(scope="module")
def python_sum(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The command line of the example of the page."""
    path = tmp_path_factory.mktemp("example") / "sum.py"
    path.write_text(example(path.name))
    return f"{PYTHON} {path}"


SHELL_SUM: Final = f"sh {HERE / 'sum.sh'}"


@pytest.fixture(params=["python", "shell"])
def command(request: pytest.FixtureRequest, python_sum: str) -> str:
    return python_sum if request.param == "python" else SHELL_SUM


@contextmanager
def watched(pid: int) -> Iterator[int]:
    """A pidfd of the process."""
    descriptor = os.pidfd_open(pid)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def gone(pidfd: int) -> bool:
    """Whether the process ends before long."""
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(WAIT_SECONDS_MAX * 1e3))


def pid_of(one: Program) -> int:
    """Of the program."""
    return one._process.pid


# -- a program of any language --------------------------------------------------------------------


def test_it_executes_and_its_state_is_captured_and_restored(command: str) -> None:
    one = started(command)
    assert one.characteristics == Characteristics(deterministic=True, state_access=EXACT)
    assert [one.execute(bytes([n])) for n in (1, 255, 7)] == [b"\1\0\0\0", b"\0\1\0\0", b"\7\1\0\0"]
    state = one.capture()
    assert state == b"\7\1\0\0"
    one.execute(b"\x09")
    one.restore(state)
    assert one.capture() == state and one.execute(b"\1") == b"\x08\1\0\0"


def test_a_refused_request_changes_nothing_and_is_no_fault(command: str) -> None:
    one = started(command)
    one.execute(b"\5")
    with pytest.raises(PeerError, match=r"sum\.\w+: a request has one byte"):
        one.execute(b"12")
    with pytest.raises(PeerError, match=r"sum\.\w+: a state has four bytes"):
        one.restore(b"123")
    assert one.capture() == b"\5\0\0\0"


def test_instances_are_independent_and_a_state_goes_from_one_language_to_the_other(python_sum: str) -> None:
    make = program_function(python_sum)
    one, same, other = make(), make(), started(SHELL_SUM)
    for number in (250, 3, 200):
        one.execute(bytes([number]))
    assert same.capture() == bytes(4)
    for each in (same, other):
        each.restore(one.capture())
        assert each.execute(b"\1") == (454).to_bytes(4, "little")
    assert one.capture() == (453).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("describes", "declared"),
    [
        ("{}", Characteristics(True, EXACT)),
        ('{"deterministic":false,"state_access":"exact"}', Characteristics(False, EXACT)),
        ('{"state_access":"none"}', Characteristics(True, NONE)),
        ('{"state_access":{"approximate":1e-9}}', Characteristics(True, approximate(1e-9))),
    ],
)
def test_what_a_program_declares(describes: str, declared: Characteristics) -> None:
    assert faulty(ECHO, f'{{"id":@,"describe":{describes}}}').characteristics == declared


def test_without_state_access_the_state_is_empty() -> None:
    one = faulty(ECHO, '{"id":@,"describe":{"state_access":"none"}}')
    one.execute(b"")
    assert one.capture() == b""
    one.restore(b"")
    with pytest.raises(PeerError, match="a state of 2 bytes, but there is no access to it"):
        one.restore(b"12")


def test_the_executable_assertion_is_asked_for_where_it_is_declared() -> None:
    one = faulty(ECHO, '{"id":@,"describe":{"acceptable":true}}')
    assert one.acceptable(b"a", b"\1a") and not one.acceptable(b"a", b"a")
    assert faulty(ECHO).acceptable(b"a", b"a"), "without an assertion every reply is acceptable"


STORE: Final = """
import json, sys
stored = ""
for line in sys.stdin:
    request = json.loads(line)
    number = request.pop("id")
    ((asked, given),) = request.items()
    stored = given if asked == "restore" else stored
    answer = {"describe": {}, "execute": "6d" * 61440, "capture": stored, "restore": None}[asked]
    print(json.dumps({"id": number, asked: answer}), flush=True)
"""
DEAF: Final = """
import time
print('{"id":0,"describe":{}}', flush=True)
time.sleep(1000)
"""
DEAF_PROGRAM: Final = f"{PYTHON} -c {shlex.quote(DEAF)}"  # does not see the end of its stdin either


def test_a_reply_may_have_its_whole_length_and_a_state_is_as_large_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "store.py"
    path.write_text(STORE)
    one = started(f"{PYTHON} {path}")
    assert one.execute(b"") == b"m" * REPLY_BYTES_MAX
    state = os.urandom(1 << 20)
    one.restore(state)
    assert one.capture() == state


# -- what cannot be started -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "the command line of the program is empty"),
        ("sh 'unclosed", '"sh \'unclosed" is no command line: no closing quotation'),
        (
            "no-such-program x",
            "no-such-program x: cannot be started: no-such-program: No such file or directory",
        ),
        ("/ x", "/ x: cannot be started: /: Permission denied"),
        ("sh a\0b", "cannot be started: sh: embedded null byte"),
    ],
)
def test_what_cannot_be_started(command: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        program_function(command)()


def test_a_file_of_no_known_format_cannot_be_started(tmp_path: Path) -> None:
    path = tmp_path / "script"
    path.write_text("no interpreter is named here\n")
    path.chmod(0o700)
    with pytest.raises(ConfigError, match=r"script x: cannot be started: /.*/script: Exec format error"):
        program_function(f"{path} x")()


# -- faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("exit", r"ended with exit code 3, asked to execute\nthe end of its stderr:\nout of brakes�\[2J$"),
        (
            "die in the middle",
            "was killed by SIGKILL, 6 bytes into its answer to execute; nothing is on its stderr",
        ),
        ("late", r"answered to execute: more than one line: b'\{\"id\":1,\"execute\":\"02\"\}"),
        ("flood", "answered to execute: more than 126976 bytes in a line"),
        ("brake!", "answered to execute: b'brake!': JSON is malformed"),
    ],
)
def test_a_fault_is_an_error_that_says_what_happened(does: str, message: str) -> None:
    one = faulty(does)
    with watched(pid_of(one)) as pidfd:
        with pytest.raises(ProgramFailedError, match=message) as failed:
            one.execute(b"x")
        assert str(failed.value).startswith(program("faulty.py", DESCRIBED, does)), "the command"
        assert gone(pidfd), "it is killed"
    with pytest.raises(ProgramFailedError, match=message):
        one.capture()


def test_too_long_a_reply_is_a_fault() -> None:
    one = faulty('{"id":@,"execute":"' + "00" * (REPLY_BYTES_MAX + 1) + '"}')
    with pytest.raises(
        ProgramFailedError, match="answered to execute: 61441 bytes, at most 61440 are allowed"
    ):
        one.execute(b"x")


@pytest.mark.parametrize("does", ["sleep", "drip", "noise without end", "noise and no answer"])
def test_an_answer_has_a_deadline(does: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = faulty(does)
    monkeypatch.setattr(programs, "ANSWER_SECONDS_MAX", 0.05)
    with pytest.raises(ProgramFailedError, match=r"gave no answer to execute within 0\.05 s"):
        one.execute(b"x")


def test_a_request_that_is_not_read_has_a_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    one = started(DEAF_PROGRAM)
    monkeypatch.setattr(programs, "ANSWER_SECONDS_MAX", 0.05)
    with pytest.raises(ProgramFailedError, match="gave no answer to restore within"):
        one.restore(bytes(1 << 20))


def test_a_program_that_is_killed_between_two_requests() -> None:
    one = faulty(ECHO)
    one.execute(b"x")
    with watched(pid_of(one)) as pidfd:
        os.kill(pid_of(one), signal.SIGKILL)
        assert gone(pidfd)
    with pytest.raises(ProgramFailedError, match="was killed by SIGKILL"):
        one.execute(b"x")


def test_a_program_that_closes_its_output_but_lives_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "END_SECONDS_MAX", 0.05)
    one = faulty("close")
    with watched(pid_of(one)) as pidfd:
        with pytest.raises(ProgramFailedError, match="closed its stdout, asked to execute"):
            one.execute(b"x")
        assert gone(pidfd)


@pytest.mark.parametrize(
    ("describes", "message"),
    [
        ("hello", "answered to describe: b'hello': JSON is malformed"),
        ('{"id":1,"describe":{}}', "answered to describe: .*: the id is 1, not 0"),
        ('{"id":@,"error":"no"}', "answered to describe: .*: it has 'error', not 'describe'"),
        (
            '{"id":@,"describe":{"state_access":"some"}}',
            r"Invalid enum value 'some' - at `\$.describe.state_access`",
        ),
        (
            '{"id":@,"describe":{"state_access":{"approximate":0}}}',
            r"Expected `float` > 0.0 - at `\$.describe.state_access.approximate`",
        ),
        (
            '{"id":@,"describe":{"state_access":{"approximate":1e999}}}',
            "Number out of range",
        ),
        ('{"id":@,"describe":{"determinstic":true}}', "unknown field `determinstic`"),
    ],
)
def test_a_description_that_is_none(describes: str, message: str) -> None:
    with pytest.raises(ProgramFailedError, match=message):
        faulty(ECHO, describes)


def test_a_program_that_ends_at_once() -> None:
    with pytest.raises(ProgramFailedError, match="ended with exit code 1"):
        started("false x")
    with pytest.raises(ProgramFailedError, match=r"can't open.*sum\.py|No such file"):
        started(f"{PYTHON} /nowhere/sum.py")


def test_a_description_has_a_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "DESCRIBE_SECONDS_MAX", 0.05)
    with pytest.raises(
        ProgramFailedError, match=r"no answer to describe within 0\.05 s; does it flush its stdout\?"
    ):
        started("sleep 1000")


def test_much_on_stderr_blocks_nothing() -> None:
    """Neither while it is asked nor, for longer than until the next request, between two requests."""
    one = faulty("noise")
    for _ in range(3):
        assert one.execute(b"x") == b""


def test_the_end_of_stderr_is_kept() -> None:
    one = faulty("noise and exit")
    with pytest.raises(ProgramFailedError, match="exit code 3") as failed:
        one.execute(b"x")
    _, end = str(failed.value).split("\nthe end of its stderr:\n")
    assert end == "x" * (4096 - len("the last line")) + "the last line"


def test_a_program_may_close_its_stderr() -> None:
    one = faulty("no stderr")
    assert one.execute(b"x") == b""
    with pytest.raises(ProgramFailedError, match="nothing is on its stderr"):
        one.execute(b"x")  # closes it once more


# -- its life -------------------------------------------------------------------------------------


def test_no_descriptor_leaks_into_it(tmp_path: Path) -> None:
    leaked = os.open(tmp_path, os.O_RDONLY)
    os.set_inheritable(leaked, True)
    try:
        other = faulty(ECHO)
        one = faulty("descriptors")
        assert one.execute(b"").decode().splitlines() == ["0 pipe", "1 pipe", "2 pipe"]
        assert other.execute(b"") == b"\n"
    finally:
        os.close(leaked)


def test_it_is_killed_when_it_is_closed_or_collected() -> None:
    one, other = started(DEAF_PROGRAM), started(DEAF_PROGRAM)
    with watched(pid_of(one)) as first, watched(pid_of(other)) as second:
        one.close()
        one.close()
        assert gone(first)
        with pytest.raises(ProgramFailedError, match="is closed"):
            one.execute(b"x")
        gc.disable()  # as in a node: there may be no cycle
        try:
            del other
            assert gone(second)
        finally:
            gc.enable()


HOST: Final = """
import sys, time
from aftbed.functions.program import program_function
one = program_function(sys.argv[1])()
print(one._process.pid, flush=True)
one.execute(b"x")
"""


def test_it_dies_with_the_process_that_made_it() -> None:
    host = subprocess.Popen([sys.executable, "-c", HOST, DEAF_PROGRAM], stdout=subprocess.PIPE)
    with host:
        assert host.stdout is not None
        with watched(int(host.stdout.readline())) as pidfd:
            host.kill()
            host.wait(WAIT_SECONDS_MAX)
            assert gone(pidfd)


def test_a_fork_of_the_host_neither_uses_nor_ends_it() -> None:
    one = faulty(ECHO)
    assert one.execute(b"x") == b"\n"
    child = os.fork()
    if child == 0:
        code = 1
        try:
            one.execute(b"x")
        except RuntimeError as error:
            code = 2 if "which started it, may use it" in str(error) else 1
        one.close()
        os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
    assert one.execute(b"x") == b"\n" and one.capture() == b"\0\0\0\2"


def test_an_instance_that_is_made_in_a_fork_is_of_that_fork() -> None:
    """As the zygote makes nodes."""
    make = program_function(program("faulty.py", DESCRIBED, ECHO))
    kept = make()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = 3 if make().execute(b"x") == b"\n" else 2
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    assert kept.execute(b"x") == b"\n"


# -- the decoder ----------------------------------------------------------------------------------

ASKED: Final = ("describe", "execute", "capture", "restore", "acceptable")
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=3,
)
answers = st.dictionaries(st.sampled_from(("id", "error", *ASKED)), values, max_size=4)
lines = st.binary(max_size=200) | st.builds(lambda answer: json.dumps(answer).encode(), answers)


@given(lines, st.integers(0, 3), st.sampled_from(ASKED))
def test_any_line_is_an_answer_or_refused(line: bytes, number: int, asked: str) -> None:
    try:
        found = read_answer(line, number, asked)
    except ValueError as error:
        assert str(error)
        return
    except PeerError:
        assert asked in ("execute", "restore")
        return
    given = json.loads(line)
    assert given["id"] == number and list(given.keys()) in (["id", asked], [asked, "id"])
    if asked in ("execute", "capture"):
        assert isinstance(found, bytes) and found.hex() == given[asked].lower()


@given(st.binary(max_size=100), st.integers(0, 2**63 - 1), st.sampled_from(("execute", "capture")))
def test_bytes_come_back_as_they_were_sent(data: bytes, number: int, asked: str) -> None:
    line = json.dumps({"id": number, asked: data.hex()}).encode()
    assert read_answer(line, number, asked) == data
    assert read_answer(line[:-1] + b"} \r", number, asked) == data


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"id":1,"execute":"0a"', "truncated"),
        ('{"id":1,"execute":NaN}', "NaN.*: JSON is malformed"),
        ('{"id":NaN,"execute":"0a"}', "NaN.*: JSON is malformed"),
        ('{"id":7,"execute":"0a"}', ": the id is 7, not 1"),
        ('{"id":1,"execute":"0"}', ": execute: no hex: Odd-length string"),
        (
            '{"id":1,"execute":"0 0a"}',
            ": execute: no hex: Non-hexadecimal digit found",
        ),
        ('{"id":1,"execute":null}', r": Expected `str`, got `null` - at `\$.execute`"),
        ('{"id":1,"reply":"0a"}', ": Object contains unknown field `reply`"),
        ('{"id":1}', ": it has neither, not 'execute' or 'error'"),
        ('{"id":1,"capture":"0a"}', ": it has 'capture', not 'execute' or 'error'"),
        ('{"id":1,"execute":"","error":""}', "it has 'execute', 'error', not 'execute' or 'error'"),
    ],
)
def test_a_line_that_is_no_answer(line: str, message: str) -> None:
    """A program that answers so is killed: see `test_a_fault_is_an_error_that_says_what_happened`."""
    with pytest.raises(ValueError, match=message):
        read_answer(line.encode(), 1, "execute")


@pytest.mark.parametrize("line", [b"[" * 100_000, b'{"x":' * 100_000, b'{"id":' + b"9" * 10_000 + b"}"])
def test_a_line_that_is_nested_too_deep_or_a_number_too_long_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError):
        read_answer(line, 0, "execute")


def test_a_line_that_is_no_text_is_refused() -> None:
    with pytest.raises(ValueError, match=r"(?i)^b'\{\"id\":0,\"error\":\"\\xff\"\}': .*utf-8"):  # by msgspec
        read_answer(b'{"id":0,"error":"\xff"}', 0, "execute")


def test_a_refusal_is_fit_for_a_terminal_and_short() -> None:
    line = json.dumps({"id": 0, "error": "\x1b[2J" + "x" * 10_000}).encode()
    with pytest.raises(PeerError) as refused:
        read_answer(line, 0, "execute")
    assert str(refused.value).startswith("�[2Jx") and len(str(refused.value)) == 300
