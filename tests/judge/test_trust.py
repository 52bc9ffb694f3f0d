"""Functions that a record names: executed only if they are trusted, and then in a process of their own.

Each function leaves a sentinel file when it is imported. Records are made by hand, as a stranger could do it.
"""

import json
import os
import py_compile
import re
import socket
import sys
from hashlib import sha256
from pathlib import Path
from typing import Final

import pytest
from records import outcomes, whole

from aftbed.core.events import Event
from aftbed.core.installed import search_path
from aftbed.functions.load import load_module
from aftbed.functions.source import parse_source
from aftbed.judge.checks import Evidence
from aftbed.judge.isolated import declared_by, reference_of, tried_out
from aftbed.judge.outcome import outcome_of
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.verdict import Verdict, evidence_of, judge
from aftbed.runtime.unix import linux, trust
from aftbed.runtime.unix.confined import ProcessLimits
from aftbed.runtime.unix.trust import (
    NOBODY,
    OWN_RUN,
    Trust,
    known_hashes,
    loaded_before,
    note,
    remember,
    trusting,
    versioned,
    vetted,
)

FUNCTION: Final = """\
from pathlib import Path
from aftbed.vehicle.aeb.function import AebFunction

Path({sentinel!r}).touch()


class Mine(AebFunction):
    {body}
"""
NEEDS_FUNCTION: Final = "one_history"
starts_process = pytest.mark.process


class Planted:
    """A directory with a function `mine.py`, and the file that appears when it is executed."""

    def __init__(self, folder: Path, body: str = "pass", name: str = "mine.py") -> None:
        self.folder, self.file, self.sentinel = folder, folder / name, folder / f"{name}-was-executed"
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(FUNCTION.format(sentinel=str(self.sentinel), body=body))
        self.source = f"{self.file}:Mine"

    @property
    def executed(self) -> bool:
        return self.sentinel.exists()


def record_naming(path: Path, *sources: str) -> RunRecord:
    """A run in which nothing is wrong, updated to each of these functions from its first request on."""
    run = whole(path)
    run.note("a.protocol.1", Event.REPLY_STORED, 0)
    run.verdict()
    updates = outcomes(*({"application": source, "opened_ns": 1} for source in sources))
    (path / "adaptations.jsonl").write_text(updates)
    return read_record(path)


def verdict_of(record: RunRecord, allowed: Trust = NOBODY) -> Verdict:
    return judge(record, evidence_of(record, trust=allowed))


def remembered(folder: Path, planted: Planted) -> None:
    """A run of this user has executed it."""
    folder.mkdir()
    note(folder, str(planted.file), load_module(str(planted.file)))
    assert remember(folder) == ""
    planted.sentinel.unlink()


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The state directory of the user, where nothing was run yet."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "aftbed"


@pytest.fixture
def planted(tmp_path: Path) -> Planted:
    return Planted(tmp_path / "code")


# -- what is not trusted --------------------------------------------------------------------------


def test_a_function_that_is_not_trusted_is_unknown_and_not_executed(tmp_path: Path, planted: Planted) -> None:
    record = record_naming(tmp_path / "record", planted.source)
    verdict = verdict_of(record)
    assert (verdict.verdict, verdict.checks[NEEDS_FUNCTION]) == ("inconclusive", "unknown")
    (reason,) = verdict.reasons
    assert planted.source in reason and f"--trust {planted.folder}" in reason
    assert [name for name, word in verdict.checks.items() if word != "pass"] == [NEEDS_FUNCTION]
    assert outcome_of(evidence_of(record))[0] == "inconclusive"
    assert not planted.executed


def test_neither_the_record_nor_the_working_directory_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("record", "here"):
        in_package = Planted(tmp_path / place, name="evil/__init__.py")
        as_module = Planted(tmp_path / place, name="evil_module.py")
        monkeypatch.chdir(tmp_path / place)
        monkeypatch.syspath_prepend(str(tmp_path / place))  # as of `python -m`
        assert str(Path.cwd()) not in search_path()
        for number, source in enumerate(
            ("evil:Mine", "evil.inner:Mine", "evil_module:Mine", "evil_module.py:Mine")
        ):
            record = record_naming(tmp_path / f"{place}{number}", source)
            verdict = verdict_of(record)
            assert verdict.checks[NEEDS_FUNCTION] == "unknown" and source in verdict.reasons[0]
        assert not in_package.executed and not as_module.executed


@starts_process
def test_a_package_is_found_without_executing_it(
    tmp_path: Path, planted: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    outer = Planted(tmp_path / "libraries", name="outer/__init__.py")
    inner = Planted(tmp_path / "libraries", name="outer/inner.py")
    monkeypatch.syspath_prepend(str(tmp_path / "libraries"))
    record = record_naming(tmp_path / "record", "outer.inner:Mine")
    assert "outer.inner:Mine is not trusted" in verdict_of(record).reasons[0]
    assert not outer.executed and not inner.executed and "outer" not in sys.modules
    assert verdict_of(record, Trust((outer.file,))).verdict == "inconclusive", "each file on the way counts"
    assert verdict_of(record, trusting((tmp_path / "libraries",))).verdict == "pass"
    assert outer.executed and inner.executed and "outer" not in sys.modules, "in another process"


@pytest.mark.parametrize(
    "source", ["pathlib:Path", "builtins:object", "..:Mine", "a..b:Mine", ":", "/:Mine", "\0.py:M"]
)
def test_other_code_of_this_machine_is_no_function_to_execute(tmp_path: Path, source: str) -> None:
    assert verdict_of(record_naming(tmp_path / "record", source)).checks[NEEDS_FUNCTION] == "unknown"


def test_a_link_out_of_a_trusted_directory_is_not_trusted(tmp_path: Path, planted: Planted) -> None:
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    (trusted / "link.py").symlink_to(planted.file)
    for source in (f"{trusted}/link.py:Mine", f"{trusted}/../code/mine.py:Mine"):
        with pytest.raises(trust.ConfigError, match="is not trusted"):
            vetted(source, trusting((trusted,)))
    assert not planted.executed


# -- what is trusted ------------------------------------------------------------------------------


@starts_process
def test_what_lies_in_a_trusted_directory_is_executed_in_another_process(
    tmp_path: Path, planted: Planted
) -> None:
    record = record_naming(tmp_path / "record", planted.source)
    verdict = verdict_of(record, trusting((planted.folder,)))
    assert (verdict.verdict, verdict.reasons) == ("pass", []) and planted.executed
    assert "mine" not in sys.modules


@starts_process
def test_what_this_user_has_run_is_executed_wherever_it_lies(
    tmp_path: Path, planted: Planted, state: Path
) -> None:
    remembered(tmp_path / "run", planted)
    assert (state.stat().st_mode & 0o777, (state / "functions").stat().st_mode & 0o777) == (0o700, 0o600)
    elsewhere = tmp_path / "elsewhere.py"
    elsewhere.write_bytes(planted.file.read_bytes())
    assert verdict_of(record_naming(tmp_path / "record", f"{elsewhere}:Mine")).verdict == "pass"
    assert planted.executed
    elsewhere.write_text(planted.file.read_text() + "\n")
    assert verdict_of(record_naming(tmp_path / "other", f"{elsewhere}:Mine")).verdict == "inconclusive"


@starts_process
def test_a_compiled_file_beside_a_known_one_is_not_executed(tmp_path: Path, planted: Planted) -> None:
    remembered(tmp_path / "run", planted)
    evil = Planted(tmp_path / "evil")
    compiled = py_compile.compile(
        str(evil.file), invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH
    )
    assert compiled is not None
    evil.file.write_bytes(planted.file.read_bytes())
    assert verdict_of(record_naming(tmp_path / "record", evil.source)).verdict == "pass"
    assert planted.executed and not evil.executed


def test_a_file_that_is_exchanged_after_it_was_looked_at_is_not_executed(
    tmp_path: Path, planted: Planted
) -> None:
    code = vetted(planted.source, trusting((planted.folder,)))
    planted.file.write_text(planted.file.read_text() + "\n")
    with pytest.raises(trust.ConfigError, match=r"mine\.py: was changed meanwhile"):
        trust.load(code)
    assert not planted.executed


def test_the_run_of_this_command_executes_its_own_function_here(tmp_path: Path, planted: Planted) -> None:
    assert verdict_of(record_naming(tmp_path / "record", planted.source), OWN_RUN).verdict == "pass"
    assert planted.executed


@starts_process
def test_what_a_function_declares_is_asked_in_another_process(tmp_path: Path) -> None:
    declared = "Characteristics(deterministic=False)"
    mine = Planted(
        tmp_path, f"from aftbed.core.application import Characteristics; characteristics = {declared}"
    )
    with pytest.raises(trust.ConfigError, match="--trust"):
        declared_by(mine.source, NOBODY)
    assert not mine.executed
    assert not declared_by(mine.source, trusting((tmp_path,))).deterministic


@starts_process
def test_a_function_that_is_never_loaded_declares_nothing(tmp_path: Path) -> None:
    """Its module loops. The command that asks is told, and goes on."""
    (tmp_path / "looping.py").write_text("while True: pass\nclass Mine: ...\n")
    source = f"{tmp_path}/looping.py:Mine"
    with pytest.raises(trust.ConfigError, match=f"{source}: its process takes more than 0.5 s"):
        declared_by(source, OWN_RUN, ProcessLimits(seconds=0.5, memory_bytes=1 << 30))


# -- trusted functions that go wrong --------------------------------------------------------------


@starts_process
@pytest.mark.parametrize(
    ("body", "word"),
    [
        ("execute = lambda self, request: 1 / 0", "ZeroDivisionError"),
        ("execute = lambda self, request: __import__('os')._exit(7)", "ended with code 7"),
        ("execute = lambda self, request: __import__('os').kill(__import__('os').getpid(), 11)", "signal 11"),
        ("execute = lambda self, request: bytes(1 << 40)", "MemoryError"),
        ("execute = lambda self, request: 'no bytes'", "execute returned str, bytes are required"),
        ("execute = lambda self, request: exit('bye')", "SystemExit: bye"),
        ("execute = lambda self, request: print('noise') or b''", ""),
        ("execute = lambda self, request: input()", "EOFError"),
        ("def __init__(self, more): pass", "TypeError"),
        ("execute = capture = None", "TypeError"),
        ("pass\n\ndel Mine", "no class Mine"),
        ("pass\n\nraise SystemExit", "SystemExit"),
        ("this is no Python", "SyntaxError"),
    ],
)
def test_a_function_that_goes_wrong_is_a_reason(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], body: str, word: str
) -> None:
    mine = Planted(tmp_path / "code", body)
    found = reference_of(record_naming(tmp_path / "record", mine.source), None, trusting((mine.folder,)))
    assert word in found.unknown and bool(found.unknown) == bool(word), found.unknown
    assert capfd.readouterr() == ("", ""), "it prints nothing into the verdict"


@starts_process
def test_a_function_that_hangs_is_ended(tmp_path: Path) -> None:
    mine = Planted(
        tmp_path / "code",
        f"""def execute(self, request):
        import os
        Path({str(tmp_path / "pid")!r}).symlink_to(str(os.getpid()))
        while True: pass
    """,
    )
    record = record_naming(tmp_path / "record", mine.source)
    limits = ProcessLimits(seconds=2.0, memory_bytes=4 << 30)
    found = reference_of(record, None, trusting((mine.folder,)), limits)
    assert "takes more than 2 s" in found.unknown
    pid = (
        (tmp_path / "pid").readlink() if (tmp_path / "pid").is_symlink() else None
    )  # a slow machine: not yet
    assert pid is None or not (Path("/proc") / pid).exists()


@starts_process
def test_a_function_writes_nothing_and_reaches_no_network(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        mine = Planted(
            tmp_path / "code",
            f"""def execute(self, request):
        import os, socket
        try:
            Path({str(tmp_path / "written")!r}).write_text("more than nothing")
        except OSError:
            pass
        try:
            socket.create_connection(("127.0.0.1", {port}), 1).close()
            return b"reached"
        except OSError:
            return b"cut off:" + os.getcwd().encode()
    """,
        )
        found = reference_of(record_naming(tmp_path / "record", mine.source), None, trusting((mine.folder,)))
    assert not found.unknown
    assert not (tmp_path / "written").exists() or (tmp_path / "written").stat().st_size == 0
    if network_can_be_left():
        assert {reply for _, reply in found.replies} == {b"cut off:/"}


def network_can_be_left() -> bool:
    """Whether this machine lets a process have a network of its own."""
    pid = os.fork()
    if pid == 0:
        os._exit(0 if linux.leave_network() else 1)
    return os.waitpid(pid, 0)[1] == 0


@starts_process
def test_versions_of_the_package_are_executed_too(tmp_path: Path) -> None:
    """Those of the package need no trust. A name in it that is no function is a reason, not a traceback."""
    record = record_naming(tmp_path / "record", "aftbed.vehicle.aeb.variants:WithoutStateAccess")
    assert reference_of(record).unknown == ""
    for source in ("aftbed.judge.bare_server:Succession", "aftbed.__main__:main", "aftbed.nothing:Mine"):
        found = reference_of(record_naming(tmp_path / source, source))
        assert source in found.unknown and "cannot be executed again" in found.unknown


def test_without_replies_nothing_is_called_wrong(tmp_path: Path, planted: Planted) -> None:
    record = record_naming(tmp_path / "record", planted.source)
    evidence: Evidence = evidence_of(record)
    assert evidence.reference.replies == () and judge(record, evidence).requests.wrong == 0


# -- what a run keeps -----------------------------------------------------------------------------


def loaded_in(record: Path, planted: Planted) -> None:
    """A node of the run has loaded it as its function."""
    source = parse_source(planted.source)
    record.mkdir(exist_ok=True)
    note(record, source.place, load_module(source.place), source.key)
    planted.sentinel.unlink()


def test_a_run_loads_by_one_name_always_the_same(tmp_path: Path, planted: Planted) -> None:
    record, source = tmp_path / "run", parse_source(planted.source)
    assert versioned(planted.source, record) == planted.source
    loaded_in(record, planted)
    before = planted.file.read_bytes()
    assert versioned(planted.source, record) == planted.source and loaded_before(record, source) is None
    planted.file.write_text("class Mine: ...\n")
    kept = loaded_before(record, source)
    assert kept is not None and Path(kept.kept[str(planted.file)]).read_bytes() == before
    named = versioned(planted.source, record)
    assert (
        named.startswith(f"{planted.source}@sha256:") and loaded_before(record, parse_source(named)) is None
    )
    planted.file.write_text("class Mine: pass\n")
    with pytest.raises(trust.ConfigError, match=f"{named}: was changed meanwhile"):
        loaded_before(record, parse_source(named))
    planted.file.write_bytes(before)
    assert versioned(planted.source, record) == planted.source


def test_what_was_too_large_to_be_kept_is_not_replaced_by_something_else(
    tmp_path: Path, planted: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trust, "KEPT_BYTES_MAX", 10)
    loaded_in(tmp_path / "run", planted)
    planted.file.write_text("class Mine: ...\n")
    with pytest.raises(trust.ConfigError, match=r"mine\.py: has other content than what this run has loaded"):
        loaded_before(tmp_path / "run", parse_source(planted.source))


@starts_process
def test_a_judge_executes_the_copy_of_what_was_changed_since(tmp_path: Path, planted: Planted) -> None:
    """If this user has run it: a record of a stranger has copies too. Trust in a folder is not for them."""
    record = record_naming(tmp_path / "record", planted.source)
    loaded_in(record.path, planted)
    planted.file.write_text("raise SystemExit('the new one')\n")
    stranger = verdict_of(record, trusting((planted.folder,)))
    assert (stranger.verdict, planted.executed) == ("inconclusive", False) and "--trust" in stranger.reasons[
        0
    ]
    assert remember(record.path) == "" and verdict_of(record).verdict == "pass" and planted.executed
    planted.sentinel.unlink()
    (copy,) = (record.path / "functions").glob("*/mine.py")
    copy.write_text(copy.read_text() + "\n")
    assert "was changed meanwhile" in verdict_of(record).reasons[0] and not planted.executed


# -- the ledger of the user -----------------------------------------------------------------------


def noted_run(path: Path, *hashes: str) -> Path:
    path.mkdir(parents=True)
    (path / "functions.jsonl").write_text("".join(json.dumps({"sha256": one}) + "\n" for one in hashes))
    return path


def digest(number: int) -> str:
    return sha256(str(number).encode()).hexdigest()


def test_the_ledger_is_bounded_and_keeps_the_latest(tmp_path: Path, state: Path) -> None:
    for part in range(3):
        run = noted_run(tmp_path / str(part), *(digest(part * 500 + n) for n in range(500)))
        assert remember(run) == ""
    known, why_not = known_hashes()
    assert why_not == "" and known == {digest(n) for n in range(500, 1500)}
    assert (state / "functions").stat().st_size == 65_000
    assert [path.name for path in state.iterdir()] == ["functions"]


def test_notes_that_are_none_are_left_out(tmp_path: Path) -> None:
    run = noted_run(tmp_path / "run", digest(1), "short")
    with (run / "functions.jsonl").open("a") as file:
        file.write("[]\n{}\nnot JSON\n\n" + json.dumps({"sha256": digest(2)}))
    assert remember(run) == "" and known_hashes()[0] == {digest(1), digest(2)}


@starts_process
def test_a_ledger_that_others_can_write_is_not_believed(
    tmp_path: Path, state: Path, planted: Planted
) -> None:
    remembered(tmp_path / "run", planted)
    record = record_naming(tmp_path / "record", planted.source)
    (state / "functions").chmod(0o620)
    (reason,) = verdict_of(record).reasons
    assert "functions must belong to this user alone" in reason and "--trust" in reason
    assert "must belong to this user alone" in remember(noted_run(tmp_path / "more", digest(1)))
    (state / "functions").chmod(0o600)
    state.chmod(0o755)
    assert "must belong to this user alone" in verdict_of(record).reasons[0]
    state.chmod(0o700)
    assert verdict_of(record).verdict == "pass"


def test_a_ledger_that_is_a_link_is_not_followed(tmp_path: Path, state: Path, planted: Planted) -> None:
    state.mkdir(mode=0o700, parents=True)
    other = tmp_path / "other"
    other.write_text("untouched")
    (state / "functions").symlink_to(other)
    assert known_hashes()[1] != "" and remember(noted_run(tmp_path / "run", digest(1))) != ""
    assert other.read_text() == "untouched"


def test_a_state_directory_that_cannot_be_made_is_no_error(
    tmp_path: Path, planted: Planted, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    assert "File exists" in remember(noted_run(tmp_path / "run", digest(1)))
    assert "--trust" in verdict_of(record_naming(tmp_path / "record", planted.source)).reasons[0]
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert trust.state_directory().is_absolute()


# -- a function that is tried out before a run ----------------------------------------------------

COUNTS: Final = """\
import os, signal
from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError

class Mine:
    characteristics = Characteristics()
    def __init__(self):
        self.count = self.calls = 0
    def execute(self, request):
        self.calls += 1
        {body}
        self.count += len(request)
        return b"%d" % self.count
    def capture(self):
        return b"%d" % self.count
    def restore(self, state):
        self.count = int(state)
"""


def trial(tmp_path: Path, body: str = "pass", *changes: tuple[str, str]) -> str:
    """What it does otherwise, when it is tried out with four requests."""
    text = COUNTS.replace("{body}", body)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "mine.py").write_text(text)
    limits = ProcessLimits(seconds=2.0, memory_bytes=1 << 30, file_bytes=0)
    return tried_out(f"{tmp_path}/mine.py:Mine", [b"a", b"", b"bc", b"d"], OWN_RUN, limits).otherwise


@starts_process
@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("if request == b'bc': 1 / 0", "mine.py:Mine: request 3: execute: "),
        (
            "if not request: os.kill(os.getpid(), 11)",
            "its process ended with signal 11 (Segmentation fault): request 2: execute",
        ),
        ("while request == b'd': pass", "its process takes more than 2 s: request 4: execute"),
        ("if request == b'd': return 7", "execute returned int, bytes are required"),
    ],
)
def test_a_function_that_fails_its_first_requests_is_told(tmp_path: Path, body: str, told: str) -> None:
    with pytest.raises(trust.ConfigError, match=re.escape(told)):
        trial(tmp_path, body)


@starts_process
@pytest.mark.parametrize(
    ("body", "change", "told"),
    [
        ("pass", ("", ""), ""),
        ("if request == b'd': raise PeerError('no')", ("", ""), ""),
        ("raise PeerError('no')", ("", ""), "it refused each of the first 4 requests"),
        ("pass", ("int(state)", "int(state) + 1"), "restore does not give the state back that capture gave"),
        (
            "self.count += self.calls == 7",
            ("", ""),
            "behind a restored state, the reply to request 3 is anoth",
        ),
        ("self.count += self.calls == 7", ("Characteristics()", "Characteristics(deterministic=False)"), ""),
        (
            "pass",
            ("    def capture", "    acceptable = lambda *_: False\n    def capture"),
            "reply to request 1",
        ),
    ],
)
def test_a_function_that_is_not_as_it_declares_is_told(
    tmp_path: Path, body: str, change: tuple[str, str], told: str
) -> None:
    found = trial(tmp_path, body, change)
    assert told in found and bool(told) == bool(found), found


@starts_process
@pytest.mark.parametrize(
    ("counted", "told"),
    [
        ("self.count += 1", "the second one of the initial state: byte 0 is 0x32 instead of 0x31"),
        ("self.count += bool(self.calls)", "of the state behind request 4: byte 0 is 0x36 instead of"),
    ],
)
def test_a_capture_that_changes_the_state_is_told(tmp_path: Path, counted: str, told: str) -> None:
    change = ("    def capture(self):\n", f"    def capture(self):\n        {counted}\n")
    with pytest.raises(trust.ConfigError, match=f"mine.py:Mine: capture changes the state: .*{told}"):
        trial(tmp_path, "pass", change)


@starts_process
def test_a_function_that_cannot_restore_is_told(tmp_path: Path) -> None:
    with pytest.raises(trust.ConfigError, match="restore of what capture gave: PeerError: not mine"):
        trial(tmp_path, "pass", ("self.count = int(state)", "raise PeerError('not mine')"))
